"""Readers of foreign files: what may come from anywhere is parsed in a confined process.

- ``confined`` runs one reader on one file in a process that can do nothing else,
- ``terrain`` decides which file is a terrain, and which reader it gets,
- ``rasters`` (GeoTIFF), ``ascii_grids`` and ``clouds`` (LAS, LAZ, Parquet, and PLY by ``ply``) are
  the readers; they run in the confined process alone.
"""
