"""Marker fits and control marks to the pose of a station: matching, resection, quality control."""
