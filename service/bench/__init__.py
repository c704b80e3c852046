"""Benchmarks and experiments of ``spheremark bench`` and ``spheremark reproduce``."""
