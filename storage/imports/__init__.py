"""Readers of foreign files: what may come from anywhere is parsed in a confined process.

- ``storage.confined`` runs one reader on one file in a process that can do nothing else,
- ``terrain`` and ``scans`` decide which file is a terrain or a single scan, and which reader it
  gets,
- ``rasters`` (GeoTIFF), ``ascii_grids``, ``cloud_files`` (LAS, LAZ, Parquet), ``ply`` and
  ``scan_libraries`` (PCD, E57) read; they run in the confined process alone, and hold headers
  against the file's size by ``declared``,
- ``uploads`` has logs and small documents read there, by ``ready``, which has loaded all it needs,
- ``survey_files`` (control marks, truth, rig) and ``plan_files`` (marks, stops, keep-out) parse
  text, JSON by ``nesting``; also outside, for files that the user of a command names,
- ``reference_scans`` reads published real scans, for comparison.
"""
