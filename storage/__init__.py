"""Every byte at rest: recordings (MCAP), clouds, the catalogue (DuckDB), files in and out.

Why so: formats change, numbers do not. A package that owns all bytes can read every version that
was ever written, and is tested by round trips alone.
"""
