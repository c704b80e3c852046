"""Linear algebra, least squares and statistical tests: the only place that solves."""
