"""How probable it is that a normal error in space keeps a tolerance: the one rule of acceptance."""

from __future__ import annotations

import math

import numpy as np

from spheremark.pipelines.accuracy.tolerance import SHARE
from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import Array, Mask

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)
_FAR = 8.5  # standard deviations beyond which nothing is left
_THIN = 1e-9  # of the tolerance; a thinner ellipsoid is flat
WIDEST_95 = 1.96
"""3-D sigmas within which 95 % of errors along one axis lie; of errors of other shapes more do."""


def keeps_tolerance(covs: Array, tolerance: float) -> Mask:
    """Return which errors are within a tolerance in 95 of 100 cases.

    Parameters
    ----------
    covs : (n, 3, 3)
        Covariances of the errors [m^2].
    tolerance : float
        Largest length that is accepted [m].

    Returns
    -------
    (n,)
        Whether the probability is 95 % or more; False where a covariance is not known.

    Notes
    -----
    Of all covariances of one trace that of a single axis has the largest 95th percentile
    (Szekely and Bakirov, 2003), which decides most cases without the quadrature.
    """
    found: Mask = np.asarray(WIDEST_95**2 * np.trace(covs, axis1=1, axis2=2) <= tolerance**2)
    found[~found] = probability_within(covs[~found], tolerance) >= SHARE
    return found


def probability_within(covs: Array, tolerance: float) -> Array:
    """Return how probable it is that errors are no longer than a tolerance.

    Parameters
    ----------
    covs : (n, 3, 3)
        Covariances of the errors [m^2].
    tolerance : float
        The length [m].

    Returns
    -------
    (n,)
        Probabilities; 0 where a covariance is not known.

    Notes
    -----
    The distribution of a quadratic form with unequal axes (Imhof, 1961; Ruben, 1962), here by
    quadrature of 24 x 24 nodes over the two longer axes and the error function along the shortest;
    the sines of the substitution take the root out of the edge. Good to 1e-6.
    """
    is_known: Mask = np.asarray(np.isfinite(covs).all(axis=(1, 2)))
    axes = np.linalg.eigvalsh(np.where(is_known[:, None, None], covs, np.eye(3)))
    sigmas = np.sqrt(np.maximum(axes, (_THIN * tolerance) ** 2)) / tolerance
    found = _within(np.ascontiguousarray(sigmas), _NODES, _WEIGHTS)
    return np.where(is_known, found, 0.0)


@compiled
def _within(sigmas: Array, nodes: Array, weights: Array) -> Array:
    """Integrate over the unit ball, sigmas ascending."""
    out = np.empty(len(sigmas))
    root2 = math.sqrt(2.0)
    for i in range(len(sigmas)):
        a, b, c = sigmas[i, 2], sigmas[i, 1], sigmas[i, 0]
        top_x = math.asin(min(_FAR * a, 1.0))
        total = 0.0
        for j in range(len(nodes)):
            t = 0.5 * top_x * (nodes[j] + 1.0)
            x, edge = math.sin(t), math.cos(t)
            by_x = weights[j] * edge * math.exp(-0.5 * (x / a) ** 2)
            top_y = math.asin(min(_FAR * b / edge, 1.0))
            inner = 0.0
            for k in range(len(nodes)):
                u = 0.5 * top_y * (nodes[k] + 1.0)
                y, rest = edge * math.sin(u), edge * math.cos(u)
                inner += (
                    weights[k] * rest * math.exp(-0.5 * (y / b) ** 2) * math.erf(rest / (root2 * c))
                )
            total += by_x * inner * 0.5 * top_y
        out[i] = min(4.0 * total * 0.5 * top_x / (2.0 * math.pi * a * b), 1.0)
    return out
