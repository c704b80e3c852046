"""Readers of foreign files: what may come from anywhere is parsed in a confined process.

- ``storage.confined`` runs one reader on one file in a process that can do nothing else,
- ``terrain`` decides which file is a terrain, and which reader it gets,
- ``rasters`` (GeoTIFF), ``ascii_grids``, ``cloud_files`` (LAS, LAZ, Parquet) and ``ply`` read; they
  run in the confined process alone, and hold headers against the file's size by ``declared``.
"""
