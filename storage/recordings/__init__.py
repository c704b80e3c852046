"""Scan logs: MCAP files to and from ``ScanLog``, and the preflight report."""
