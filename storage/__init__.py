"""Every byte at rest: recordings (MCAP), clouds (files named by digest), the catalogue (DuckDB).

Nobody else opens a file of the product. Why so: formats change, numbers do not; a room that owns
all bytes can read every version that was ever written and be tested by round trips alone.
"""
