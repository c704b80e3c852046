"""Cramer-Rao bound of a centre from ranges, for comparison with truth only.

From the Fisher information of footprint-averaged ranges. No unbiased estimator that uses only these
ranges, the radius and their noise does better; one that also uses which beams missed can.
"""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.errors import DegenerateGeometryError
from spheremark.pipelines.model import Array, Beams, Mask
from spheremark.pipelines.sphere.footprint import predict

_N_MIN = 3  # ranges, as many as unknowns
_CONDITION_MAX = 1e12


def hits(
    returns: Beams, p_true: Array, radius: float, tolerance: float, share: float = 0.0
) -> Mask:
    """Tell which beams returned from a sphere.

    Parameters
    ----------
    returns : Beams
        Returns.
    p_true : (3,)
        True centre in the base frame [m].
    radius : float
        Radius of the sphere [m].
    tolerance : float
        Largest difference from the predicted range: some sigmas of the noise [m].
    share : float
        Share of the footprint that must be exceeded on the sphere. Zero takes every beam that hit;
        0.02 leaves out grazing beams, whose derivative has no limit.

    Returns
    -------
    (n,)
        Whether the footprint meets the sphere and the range is that of the sphere.
    """
    which = np.zeros(len(returns.ranges), dtype=np.intp)
    expected = predict(returns, p_true[None], np.array([radius]), which)
    return np.asarray(
        (expected.lit > share) & (np.abs(returns.ranges - expected.ranges) < tolerance)
    )


def cramer_rao(
    returns: Beams,
    p_true: Array,
    radius: float,
    sigma: float | Array,
    sigma_common: float = 0.0,
) -> Array:
    """Return the Cramer-Rao bound of a centre: the least covariance of unbiased estimates.

    Parameters
    ----------
    returns : Beams
        All returns from the sphere, those near the limb included.
    p_true : (3,)
        True centre in the base frame [m].
    radius : float
        Radius of the sphere, which is known [m].
    sigma : float or (n,)
        Standard deviation of the ranges; directions are exact [m].
    sigma_common : float
        Standard deviation of an error that all ranges of the LiDAR have in common, over the LiDARs
        of its kind [m].

    Returns
    -------
    (3, 3)
        Inverse of the Fisher information, where ``J`` is the derivative of the range averaged over
        the footprint [m^2].

    Raises
    ------
    DegenerateGeometryError
        If the beams leave the centre undetermined.

    Notes
    -----
    The information is ``I = sum J^T J / sigma^2``. A common error ``b`` of variance ``s^2`` is one
    more unknown with a prior: with ``g = sum J / sigma^2`` and ``w = sum 1 / sigma^2`` it leaves
    ``I - g g^T / (w + 1 / s^2)`` (Schur complement; the hybrid bound of Rockah and Schultheiss
    1987). As ``J`` is nearly the direction of the beam along the line of sight, the variance there
    grows by nearly ``s^2``, whatever the number of returns: the apparent size of a sphere hardly
    separates a bias from a distance.
    """
    n = len(returns.ranges)
    expected = predict(returns, p_true[None], np.array([radius]), np.zeros(n, dtype=np.intp))
    is_lit = expected.lit > 0.0
    roots = 1.0 / np.broadcast_to(sigma, n)[is_lit, None]
    J = expected.J[is_lit, :3] * roots
    information = J.T @ J
    is_open = len(J) < _N_MIN or bool(np.linalg.cond(information) > _CONDITION_MAX)
    if sigma_common > 0.0:
        common = J.T @ roots
        information -= common @ common.T / (np.sum(roots**2) + sigma_common**-2.0)
    if is_open:
        raise DegenerateGeometryError(
            f"{len(J)} of {n} beams meet the sphere and leave its centre undetermined; at least "
            f"{_N_MIN} that do not lie on one line are needed."
        )
    return np.asarray(np.linalg.inv(information))
