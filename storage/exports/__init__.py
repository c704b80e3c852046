"""Results as files of other programs: networks, ground models."""
