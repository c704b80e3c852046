"""Bounds that no arrangement exceeds: they refuse impossible goals without a search."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi

from spheremark.pipelines.model import Array
from spheremark.pipelines.placement.plan import Requirement
from spheremark.pipelines.placement.station_covariance import Observables, independent_information


def least_sigmas(observables: Observables, requirement: Requirement) -> Array:
    """Return the 3-D sigmas that no arrangement of so many of the marks goes below.

    Notes
    -----
    As if the station's rotation were known, and every stop had its own best marks:
    ``trace(A^-1) >= 9 / trace(A)``, and traces of information add up. By three circles three marks
    carry a position, out of any number.
    """
    traces = np.trace(independent_information(observables, requirement), axis1=2, axis2=3)
    best = -np.sort(-traces, axis=1)
    if requirement.method == "paper":
        best[:, 3:] = 0.0
    with np.errstate(divide="ignore"):
        variances = 9.0 / np.cumsum(best, axis=1)
    return np.asarray(np.sqrt(variances + requirement.resection.sigma_height**2))


def widest_sigma(tolerance: float, probability: float) -> float:
    """Return the largest 3-D sigma with which an error can be within a tolerance so probably."""
    return float(max(tolerance * np.sqrt(n) / chi(n).ppf(probability) for n in (1, 2, 3)))
