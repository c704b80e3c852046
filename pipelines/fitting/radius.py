"""The radius that a sphere's returns show by themselves: the test of the one that is assumed.

Hides its estimate along the beams together with the centre. The scatter of residuals passes a ball
of another size that is seen at the wrong range; this does not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipelines.fitting.passes import Rows, linearise, normals_of, rows_of
from pipelines.values import Array, Beams

_N_STEPS = 8
_SETTLED = 1e-4  # [m] of a step: what is asked is millimetres
_STEP_MAX = 0.25  # radii per step
_PRIOR = 0.5  # radii: standard deviation of centre and radius that no return tells
_START = 0.1  # radii by which a centre may be off per axis
_INFLATION = 1.5  # what few returns add to the variance of a free radius: 1 + this exp(-n /
_RETURNS = 100.0  # this), by Monte Carlo
_SIGMA_MAX, _RADIUS_MAX = 0.4, 5.0  # radii: what is worse or larger is no answer
_N_ROUNDS = 3
_SPAN_MIN = 0.001  # [m] returns that lie in one place have no span
_OUTERMOST = 1.2  # radii over the ninth tenth of the returns' distances from the middle
_NORMAL = 1.4826  # standard deviation of a normal spread over its median of absolute values
_SCATTER_MIN = 0.001  # [m] 2 mm quantisation alone gives as much
_STRAY_SIGMAS = 4.0
_SIGMAS = 3.5  # by which a free radius may be off, and
_SLACK = 0.006  # [m] by which it may whatever its sigma


class Weighing(NamedTuple):
    """What is known of the ranges of some returns.

    Attributes
    ----------
    ranges : (n,)
        Measured ranges without the biases of their lasers [m].
    variances : (n,)
        Of their noise [m^2].
    weights : (n,)
        Robust weights, 0 to 1.
    """

    ranges: Array
    variances: Array
    weights: Array


def free_radii(
    rows: Rows, weighing: Weighing, spheres: Array, covs: Array, n_lasers: int
) -> tuple[Array, Array]:
    """Return radii estimated together with the centres, and their standard deviations.

    Parameters
    ----------
    rows : Rows
        Returns of all spheres.
    weighing : Weighing
        What is known of their ranges.
    spheres : (m, 4)
        Centres and radii to start from [m].
    covs : (m, 4, 4)
        How well these are known [m^2].
    n_lasers : int
        Lasers that ``rows`` tells apart.

    Returns
    -------
    radii, sigmas : (m,)
        Both NaN where the returns do not tell [m].
    """
    found, covs = _free(rows, weighing, spheres, covs, n_lasers)
    radius = spheres[:, 3]
    counts = np.diff(np.cumsum(np.r_[0, weighing.weights > 0.0])[rows.firsts])
    inflation = 1.0 + _INFLATION * np.exp(-counts / _RETURNS)
    radii, sigmas = found[:, 3], np.sqrt(inflation * covs[:, 3, 3])
    is_known = (sigmas < _SIGMA_MAX * radius) & (radii < _RADIUS_MAX * radius) & (radii > 0.0)
    return np.where(is_known, radii, np.nan), np.where(is_known, sigmas, np.nan)


def _free(
    rows: Rows, weighing: Weighing, spheres: Array, covs: Array, n_lasers: int
) -> tuple[Array, Array]:
    """Return centres with radii, (m, 4), and their covariances; what has settled stays."""
    radius, counts = spheres[:, 3], np.diff(rows.firsts)
    moves = np.ones(len(spheres), dtype=bool)
    for _ in range(_N_STEPS):
        is_in = (weighing.weights > 0.0) & np.repeat(moves, counts)
        linear = linearise(rows, spheres, covs, is_in)
        per_square = is_in * weighing.weights / (weighing.variances + linear.bends**2)
        residuals = weighing.ranges - linear.ranges
        N, _, _, pull, _ = normals_of(rows, linear, residuals, per_square, (4, n_lasers))
        inverse = np.linalg.inv(N + np.eye(4) / (_PRIOR * radius[:, None, None]) ** 2)
        covs = np.where(moves[:, None, None], inverse, covs)
        limit = _STEP_MAX * radius[:, None]
        step = np.clip(np.einsum("mij,mj->mi", inverse, pull), -limit, limit)
        spheres = spheres + step
        moves &= np.abs(step).max(axis=1) >= _SETTLED
        if not moves.any():
            break
    return spheres, covs


def own_radius(shots: Beams, radius: float) -> tuple[float, float]:
    """Return the radius that one sphere's returns show, all with the same noise, and its sigma.

    Parameters
    ----------
    shots : Beams
        Returns from the sphere, and perhaps some of its pole.
    radius : float
        The radius that was assumed: nothing larger than five of it is an answer [m].

    Returns
    -------
    radius_free, sigma_radius_free : float
        Both NaN where the returns do not tell [m].

    Notes
    -----
    It starts with the sphere that the returns span, whatever was assumed: from a smaller one the
    beams at the outline would be taken for such that pass by. The noise is that of the residuals,
    and what is off by more than some sigmas has no weight: both are found again each round.
    """
    n = len(shots.ranges)
    nothing = np.zeros(n, dtype=np.intp)
    noise = (nothing, np.ones(n), 0.0)
    rows = rows_of(shots, np.array([0, n]), np.array([0.0, 0.0, 1.0]), nothing, noise)
    sphere = _spanned(shots)
    covs = np.array([(_START * sphere[0, 3]) ** 2 * np.eye(4)])
    weighing = _weighing(rows, sphere, covs)._replace(weights=np.ones(n))
    for _ in range(_N_ROUNDS):
        sphere, known = _free(rows, weighing, sphere, covs, 1)
        if not 0.0 < sphere[0, 3] < _RADIUS_MAX * radius:
            return float("nan"), float("nan")
        weighing = _weighing(rows, sphere, known)
    radii, sigmas = free_radii(rows, weighing, sphere, covs, 1)
    return float(radii[0]), float(sigmas[0])


def _spanned(shots: Beams) -> Array:
    """Return the centre and radius, (1, 4), of a sphere that spans returns across the beam."""
    axis = shots.directions_base.mean(axis=0)
    axis /= np.linalg.norm(axis)
    p = shots.origins_base + shots.ranges[:, None] * shots.directions_base
    middle = np.median(p, axis=0)
    v = p - middle
    beside = np.linalg.norm(v - (v @ axis)[:, None] * axis, axis=1)
    radius = max(_OUTERMOST * float(np.quantile(beside, 0.9)), _SPAN_MIN)
    # seen evenly, the half of a sphere is two thirds of its radius deep
    return np.array([[*(middle + 2.0 / 3.0 * radius * axis), radius]])


def _weighing(rows: Rows, spheres: Array, covs: Array) -> Weighing:
    """Return ranges with the noise that their residuals show, and weights."""
    residuals = rows.ranges - linearise(rows, spheres, covs).ranges
    sigma = max(_NORMAL * float(np.median(np.abs(residuals))), _SCATTER_MIN)
    is_in = np.abs(residuals) < _STRAY_SIGMAS * sigma
    return Weighing(rows.ranges, np.full(len(residuals), sigma**2), is_in.astype(np.float64))


def other_radius(radius: float, radius_free: float, sigma: float) -> list[str]:
    """Say whether returns show a sphere of another radius.

    Parameters
    ----------
    radius : float
        The radius that is assumed [m].
    radius_free, sigma : float
        The one that returns have by themselves, and its standard deviation; NaN when they do not
        tell [m].

    Returns
    -------
    list of str
        The reason without capital and full stop, or none.
    """
    if abs(radius_free - radius) > max(_SIGMAS * sigma, _SLACK):
        return [f"its own radius is {1e3 * radius_free:.0f} mm"]
    return []
