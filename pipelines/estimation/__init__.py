"""The only place that solves and tests.

- ``linear_algebra``: positive definite systems in compiled loops; Schur complement
- ``least_squares``: Gauss-Newton of one problem or of many at once, with its statistics
- ``statistical_tests``: redundancy, w-test, reliability, global test, data snooping
- ``robust``: weights, scale and covariance in the presence of outliers
"""
