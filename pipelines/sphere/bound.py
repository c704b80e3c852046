"""How well the ranges of some beams can tell a centre at all: for comparison with truth only.

Hides the Fisher information of footprint-averaged ranges. No unbiased estimator that knows only
these ranges, the radius and their noise does better; one that also knows which beams missed can.
"""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.errors import DegenerateGeometryError
from spheremark.pipelines.model import Array, Beams, Mask
from spheremark.pipelines.sphere.footprint import predict

_N_MIN = 3  # ranges, as many as unknowns
_CONDITION_MAX = 1e12


def hits(shots: Beams, p_true: Array, radius: float, tolerance: float, share: float = 0.0) -> Mask:
    """Tell which beams returned from a sphere.

    Parameters
    ----------
    shots : Beams
        Returns.
    p_true : (3,)
        True centre in the base frame [m].
    radius : float
        Radius of the sphere [m].
    tolerance : float
        By how much a range may differ from the one predicted: some sigmas of the noise [m].
    share : float
        Share of the footprint that must meet the sphere, and more. Zero takes every beam that hit;
        with 0.02 those are left out that touch with so little that their derivative has no limit.

    Returns
    -------
    (n,)
        Whether the footprint meets the sphere and the range is that of the sphere.
    """
    which = np.zeros(len(shots.ranges), dtype=np.intp)
    expected = predict(shots, p_true[None], np.array([radius]), which)
    return np.asarray((expected.lit > share) & (np.abs(shots.ranges - expected.ranges) < tolerance))


def cramer_rao(shots: Beams, p_true: Array, radius: float, sigma: float) -> Array:
    """Return the covariance that no unbiased estimate of a centre from these ranges undercuts.

    Parameters
    ----------
    shots : Beams
        The very beams that returned from the sphere, those near the limb included.
    p_true : (3,)
        True centre in the base frame [m].
    radius : float
        Radius of the sphere, which is known [m].
    sigma : float
        Standard deviation of every range; directions are exact [m].

    Returns
    -------
    (3, 3)
        Inverse of the Fisher information ``sum J^T J / sigma^2``, where ``J`` is the derivative of
        the range averaged over the footprint [m^2].

    Raises
    ------
    DegenerateGeometryError
        If the beams leave the centre undetermined.
    """
    n = len(shots.ranges)
    expected = predict(shots, p_true[None], np.array([radius]), np.zeros(n, dtype=np.intp))
    J = expected.J[expected.lit > 0.0, :3]
    information = J.T @ J / sigma**2
    if len(J) < _N_MIN or np.linalg.cond(information) > _CONDITION_MAX:
        raise DegenerateGeometryError(
            f"{len(J)} of {n} beams meet the sphere and leave its centre undetermined; at least "
            f"{_N_MIN} that do not lie on one line are needed."
        )
    return np.asarray(np.linalg.inv(information))
