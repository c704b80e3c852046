"""That a beam which returned from a sphere has met it: what returns tell beside their ranges.

Hides how that bounds a centre. The footprint of such a beam reaches inside the outline, so that the
outermost returns hold the outline from all sides. Nothing is asked of shots that did not return:
where returns are missing, or reach less far than their footprints would, nothing is said.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from pipelines.fitting.passes import Linear, Rows
from pipelines.values import Array

_SOFTNESSES = np.array([0.07, 0.14, 0.28, 0.56, 1.12])  # half widths of the footprint
_SOFTNESS, _SPREAD = 0.2, 0.7  # prior of the softness, and its standard deviation in the logarithm
_LUCK = 0.01  # share of returns that are from the sphere by their range and yet did not meet it
_NEAR = 2.0  # half widths inside the outline within which returns tell its softness
_CERTAIN = 4.0  # standard deviations inside the outline from where meeting is no news
_CAVITY_MIN = 0.05  # of a centre's precision: the least that is not one return's own
_TINY = 1e-9  # [m]
_HALF, _DENSITY = math.sqrt(0.5), 1.0 / math.sqrt(2.0 * math.pi)


def softness(rows: Rows, linear: Linear, weights: Array, covs: Array, radius: float) -> float:
    """Return how softly the outline ends: by how much returns seem to pass spheres by.

    Parameters
    ----------
    rows : Rows
        Returns of all spheres of a stop.
    linear : Linear
        Where they pass the centres, found from ranges alone.
    weights : (n,)
        Weights of the returns; those without any are not asked.
    covs : (m, 3, 3)
        Covariances of the centres [m^2].
    radius : float
        Radius of the spheres [m].

    Returns
    -------
    float
        Standard deviation of where the outline begins, in half widths of the footprint.

    Notes
    -----
    Returns lie evenly, save that none can lie outside: where one of them seems to reach inside the
    outline by ``x``, give or take ``s``, it has the density ``Phi(x / s)``, whose integral over a
    given width to both sides does not depend on ``s``. Directions that are off, footprints that are
    wider than they are said to be and what else moves returns across the outline make it soft, and
    then it says less.
    """
    logs = _logarithms(rows, linear, weights, covs, radius)
    logs -= 0.5 * (np.log(_SOFTNESSES / _SOFTNESS) / _SPREAD) ** 2
    chances = np.exp(logs - logs.max())
    return float(np.exp(chances @ np.log(_SOFTNESSES) / chances.sum()))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _logarithms(rows: Rows, linear: Linear, weights: Array, covs: Array, radius: float) -> Array:
    """Return the log-likelihood of each softness."""
    logs = np.zeros(len(_SOFTNESSES))
    for m in range(len(covs)):
        for i in range(rows.firsts[m], rows.firsts[m + 1]):
            half, inside, towards = _met(rows, linear, i, radius)
            if weights[i] > 0.0 and inside < _NEAR * half:
                variance = _variance(covs[m], towards) + rows.lateral[i] ** 2
                for k in range(len(logs)):
                    sigma = math.sqrt(variance + (_SOFTNESSES[k] * half) ** 2)
                    logs[k] += math.log(_chance(inside / sigma))
    return logs


@numba.njit(cache=True, nogil=True, error_model="numpy")
def outline_normals(
    rows: Rows,
    linear: Linear,
    weights: Array,
    covs: Array,
    outline: tuple[float, float],
    sites: Array,
) -> tuple[Array, Array, Array]:
    """Return what it adds to the normal equations of centres that returns have met their spheres.

    Parameters
    ----------
    rows : Rows
        Returns of all spheres.
    linear : Linear
        Where they pass the present centres.
    weights : (n,)
        Robust weights of the returns, 0 to 1.
    covs : (m, 3, 3)
        Covariances of the present centres [m^2].
    outline : tuple of float
        Radius of the spheres [m], and softness of the outline in half widths of the footprint.
    sites : (n, 2)
        What the last call returned; zeros before the first.

    Returns
    -------
    centres : (m, 3, 3)
        To the normal equations.
    pull_centres : (m, 3)
        To their right-hand sides.
    sites : (n, 2)
        What each return says of how far it reaches inside: precision [1/m^2], and precision times
        mean [1/m].

    Notes
    -----
    Expectation propagation (Minka, Expectation propagation for approximate Bayesian inference,
    2001): each return is taken out of the present estimate, its truth that it reaches inside is
    multiplied in, and a normal distribution of the same mean and variance stands for the product.
    It speaks of the place across the line of sight alone: how large the outline looks would tell
    the distance too, and would be trusted more than the footprint is known.
    """
    radius, soft = outline
    n, found = len(covs), np.zeros(sites.shape)
    centres, pull_centres = np.zeros((n, 3, 3)), np.zeros((n, 3))
    for m in range(n):
        for i in range(rows.firsts[m], rows.firsts[m + 1]):
            half, inside, towards = _met(rows, linear, i, radius)
            variance = _variance(covs[m], towards)
            blur = (soft * half) ** 2 + rows.lateral[i] ** 2
            if weights[i] == 0.0 or inside > _CERTAIN * math.sqrt(variance + blur):
                continue
            precision, pull = _site(inside, variance, blur, (sites[i, 0], sites[i, 1]))
            precision, pull = weights[i] * precision, weights[i] * pull
            found[i, 0], found[i, 1] = precision, pull
            for p in range(3):
                pull_centres[m, p] += (pull - precision * inside) * towards[p]
                for q in range(3):
                    centres[m, p, q] += precision * towards[p] * towards[q]
    return centres, pull_centres, found


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _site(inside, variance, blur, site):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Return precision, and that times the mean, which stand for one return's reaching inside."""
    own, own_pull = site
    precision = max(1.0 / variance - own, _CAVITY_MIN / variance)
    pull = inside / variance - own_pull
    spread = 1.0 / precision + blur
    z = pull / precision / math.sqrt(spread)
    ratio = (1.0 - _LUCK) * _DENSITY * math.exp(-0.5 * z * z) / _chance(z)
    bend = ratio * (z + ratio) / spread  # minus the second derivative of the log-likelihood
    if bend <= 0.0:
        return 0.0, 0.0  # so far outside that it may as well be luck
    given = bend / (1.0 - bend / precision)
    mean = pull / precision + ratio / math.sqrt(spread) / precision
    return given, (precision + given) * mean - pull


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _chance(z: float) -> float:
    """Return the chance that a return which reaches so far inside has met the sphere."""
    return _LUCK + (1.0 - _LUCK) * 0.5 * math.erfc(-_HALF * z)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _met(rows: Rows, linear: Linear, i: int, radius: float):  # type: ignore[no-untyped-def]  # noqa: ANN202
    """Return half a footprint's width [m], how far inside the outline it reaches, and its slope."""
    x, y = linear.offsets[i, 0], linear.offsets[i, 1]
    off = max(math.hypot(x, y), _TINY)
    x, y = x / off, y / off
    half = math.hypot(rows.half_widths[i, 0] * x, rows.half_widths[i, 1] * y)
    a, b, u = rows.firsts_axis, rows.seconds_axis, rows.directions
    lean = off / rows.ranges[i]  # square to the line to the centre, not to the beam
    towards = (
        x * a[i, 0] + y * b[i, 0] + lean * u[i, 0],
        x * a[i, 1] + y * b[i, 1] + lean * u[i, 1],
        x * a[i, 2] + y * b[i, 2] + lean * u[i, 2],
    )
    return half, radius + half - off, towards


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _variance(cov: Array, v: tuple[float, float, float]) -> float:
    """Return the variance along a vector."""
    total = 0.0
    for p in range(3):
        for q in range(3):
            total += v[p] * cov[p, q] * v[q]
    return total
