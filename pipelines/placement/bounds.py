"""Bounds by sums of information, that refuse impossible goals, and groups of near places."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from spheremark.pipelines.model import Array, Column, Index
from spheremark.pipelines.placement.packing import COLUMNS, ROWS, packed, unpacked
from spheremark.pipelines.placement.plan import Requirement

_TWICE = np.where(ROWS == COLUMNS, 1.0, 2.0)  # of elements off the diagonal in a trace
_LOOSE_PRIOR = np.array([3.0, 3.0, 3.0, 1.0, 10.0, 10.0, 10.0])  # [rad, m] before a mark is seen
_IS_POSITION = (ROWS == COLUMNS) & (ROWS > 3)  # elements of a packed matrix


def groups_of(p_site: Array, apart: float) -> Index:
    """Return boxes, by number, whose places are too near to each other for two marks."""
    n_levels = int(np.ceil(np.ptp(p_site[:, 2]) / (0.55 * apart))) or 1
    height = np.ptp(p_site[:, 2]) / n_levels
    width = 0.999 * np.sqrt((apart**2 - height**2) / 2.0)
    low = p_site.min(axis=0)
    cells = np.floor((p_site - low) / [width, width, max(height, 1e-9)])
    cells[:, 2] = np.minimum(cells[:, 2], n_levels - 1)
    return np.asarray(np.unique(cells, axis=0, return_inverse=True)[1].ravel(), dtype=np.intp)


def gained(rows: Column, start: Array, chosen: Array) -> tuple[float, float]:
    """Return the logarithm of the determinant that marks gain, and its bound over arrangements.

    ``rows`` of all places and of those ``chosen``, (c, s, 28), and ``start``, (s, 28), are packed.
    The bound is the tangent of the concave logarithm at the marks' own information.
    """
    loose = unpacked(start) + np.diag(_LOOSE_PRIOR**-2.0)
    normal = loose + unpacked(chosen.sum(axis=0))
    slopes = packed(np.asarray(np.linalg.inv(normal), dtype=np.float64)) * _TWICE
    gain = float((np.linalg.slogdet(normal)[1] - np.linalg.slogdet(loose)[1]).sum())
    scores, own = (
        np.asarray(one.reshape(len(one), -1) @ slopes.ravel().astype(one.dtype), np.float64)
        for one in (rows, chosen)
    )
    return gain, gain + float(np.sort(scores)[-len(chosen) :].sum() - own.sum())


def least_sigmas(rows: Array, requirement: Requirement) -> Array:
    """Return the 3-D sigmas, (s, n), that no arrangement of so many of the marks goes below.

    Notes
    -----
    As if the station's rotation were known, and every stop had its own best marks:
    ``trace(A^-1) >= 9 / trace(A)``, and traces of information add up. By three circles three marks
    carry a position, out of any number.
    """
    best = -np.sort(-rows[..., _IS_POSITION].sum(axis=2).T, axis=1)
    if requirement.method == "paper":
        best[:, 3:] = 0.0
    with np.errstate(divide="ignore"):
        variances = 9.0 / np.cumsum(best, axis=1)
    return np.asarray(np.sqrt(variances + requirement.resection.sigma_height**2))


def widest_sigma(tolerance: float, probability: float) -> float:
    """Return the largest 3-D sigma with which an error can be within a tolerance so probably."""
    return float(max(tolerance * np.sqrt(n / chdtri(n, 1.0 - probability)) for n in (1, 2, 3)))
