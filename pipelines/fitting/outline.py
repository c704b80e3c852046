"""That a beam which returned from a sphere has met it: what returns tell beside their ranges.

Hides how that bounds a centre. The footprint of such a beam reaches inside the outline, so that the
outermost returns hold the outline from all sides. Nothing is asked of shots that did not return:
where returns are missing, or reach less far than their footprints would, nothing is said.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

from pipelines.fitting.linearising import Linear
from pipelines.fitting.rows import Rows
from pipelines.values import Array

_EDGES = np.array([-0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0])  # half widths inside the outline
_SOFTNESSES = np.array([0.07, 0.14, 0.28, 0.56, 1.12])  # half widths of the footprint
_EDGE, _SIGMA_EDGE = 0.2, 0.4  # prior of where returns begin
_SOFTNESS, _SPREAD = 0.2, 0.7  # prior of the softness, and its standard deviation in the logarithm
_LUCK = 0.01  # share of returns that are from the sphere by their range and yet did not meet it
_NEAR = 1.75  # half widths inside the outline within which returns tell of it
_CERTAIN = 4.0  # standard deviations inside the outline from where meeting is no news
_CAVITY_MIN = 0.05  # of a centre's precision: the least that is not one return's own
_N_PRODUCT = 25  # chances that are multiplied before the logarithm is taken
_TINY = 1e-9  # [m]
_NEVER = 8.0  # standard deviations outside from where only luck is left
_PER_SIGMA = 64  # nodes of the normal distribution, between which a series is good to 1e-12
_DENSITY = 1.0 / math.sqrt(2.0 * math.pi)


def _normal() -> Array:
    """Return nodes of a normal deviate, their chances, densities, and integrals, (n, 4)."""
    z = np.arange(-_NEVER, _CERTAIN + 1.0 / _PER_SIGMA, 1.0 / _PER_SIGMA)
    chance = np.array([0.5 * math.erfc(-math.sqrt(0.5) * at) for at in z])
    density = _DENSITY * np.exp(-0.5 * z * z)
    return np.column_stack([z, chance, density, z * chance + density])


_NORMAL = _normal()


class Outline(NamedTuple):
    """How returns end at the outline of spheres.

    Attributes
    ----------
    radius : float
        Radius of the spheres [m].
    edge : float
        How far inside the outline a footprint must reach to return, in its half widths.
    softness : float
        Standard deviation of that, in the same.
    """

    radius: float
    edge: float
    softness: float


def outline_of(rows: Rows, linear: Linear, weights: Array, covs: Array, radius: float) -> Outline:
    """Return how returns end at the outline of the spheres of a stop.

    Parameters
    ----------
    rows : Rows
        Returns of all spheres.
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
    Outline
        The same for all spheres.

    Notes
    -----
    Returns lie evenly up to the edge: one that seems to reach inside of it by ``x``, give or take
    ``s``, has a density like ``Phi(x / s)``. Footprints that are wider or narrower than they are
    said to be move the edge; directions that are off, and what else carries returns across it, make
    it soft, and then it says less. Mean over a grid, with a weak prior for few spheres.
    """
    logs = _logarithms(rows, linear, weights, covs, radius)
    logs -= 0.5 * ((_EDGES[:, None] - _EDGE) / _SIGMA_EDGE) ** 2
    logs -= 0.5 * (np.log(_SOFTNESSES / _SOFTNESS) / _SPREAD) ** 2
    chances = np.exp(logs - logs.max())
    chances /= chances.sum()
    softness = np.exp(chances.sum(axis=0) @ np.log(_SOFTNESSES))
    return Outline(radius, float(chances.sum(axis=1) @ _EDGES), float(softness))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _logarithms(rows: Rows, linear: Linear, weights: Array, covs: Array, radius: float) -> Array:
    """Return the log-likelihood of each edge and softness."""
    shape, n = (len(_EDGES), len(_SOFTNESSES)), 0
    logs, product = np.zeros(shape), np.ones(shape)
    for m in range(len(covs)):
        for i in range(rows.firsts[m], rows.firsts[m + 1]):
            half, inside = _reach(rows, linear, i, radius)
            if weights[i] == 0.0 or inside > _NEAR * half:
                continue
            variance = _variance(covs[m], _towards(rows, linear, i)) + rows.lateral[i] ** 2
            _multiply(inside / half, variance / (half * half), product)
            n += 1
            if n % _N_PRODUCT == 0:
                logs += np.log(product)
                product[:] = 1.0
    return logs + np.log(product)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _multiply(inside: float, variance: float, product: Array) -> None:
    """Multiply densities of how far a footprint reaches inside, in its half widths."""
    for k in range(len(_SOFTNESSES)):
        per_sigma = 1.0 / math.sqrt(variance + _SOFTNESSES[k] ** 2)
        for e in range(len(_EDGES)):
            z, t = (inside - _EDGES[e]) * per_sigma, (_NEAR - _EDGES[e]) * per_sigma
            product[e, k] *= _chance(z) * per_sigma / _length(t)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def outline_normals(
    rows: Rows,
    linear: Linear,
    weights: Array,
    covs: Array,
    outline: Outline,
    sites: Array,
) -> tuple[Array, Array, Array, Array, Array]:
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
    outline : Outline
        How returns end there.
    sites : (n, 2)
        What the last call returned; zeros before the first.

    Returns
    -------
    centres : (m, 3, 3)
        To the normal equations.
    pull_centres : (m, 3)
        To their right-hand sides.
    faces : (m, 3, 3)
        As ``centres``, with what is swept downwards counted negative.
    pull_faces : (m, 3)
        As ``pull_centres``, counted likewise.
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
    n, found = len(covs), np.zeros(sites.shape)
    centres, pull_centres = np.zeros((n, 3, 3)), np.zeros((n, 3))
    faces, pull_faces = np.zeros((n, 3, 3)), np.zeros((n, 3))
    for m in range(n):
        widest = covs[m, 0, 0] + covs[m, 1, 1] + covs[m, 2, 2]
        for i in range(rows.firsts[m], rows.firsts[m + 1]):
            half, inside = _reach(rows, linear, i, outline.radius)
            inside -= outline.edge * half
            blur = (outline.softness * half) ** 2 + rows.lateral[i] ** 2
            if weights[i] == 0.0 or inside > _CERTAIN * math.sqrt(widest + blur):
                continue
            towards = _towards(rows, linear, i)
            known = (_variance(covs[m], towards), blur)
            precision, pull = _site(inside, known, (sites[i, 0], sites[i, 1]))
            precision, pull = weights[i] * precision, weights[i] * pull
            found[i, 0], found[i, 1] = precision, pull
            for p in range(3):
                pull_centres[m, p] += (pull - precision * inside) * towards[p]
                pull_faces[m, p] += rows.up[0, i] * (pull - precision * inside) * towards[p]
                for q in range(3):
                    centres[m, p, q] += precision * towards[p] * towards[q]
                    faces[m, p, q] += rows.up[0, i] * precision * towards[p] * towards[q]
    return centres, pull_centres, faces, pull_faces, found


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _site(inside, known, site):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Return precision, and that times the mean, which stand for one return's reaching inside."""
    (variance, blur), (own, own_pull) = known, site
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
    if z > _CERTAIN:
        return 1.0
    if not z > -_NEVER:
        return _LUCK
    node = _NORMAL[int((z + _NEVER) * _PER_SIGMA + 0.5)]
    at, density, d = node[0], node[2], z - node[0]
    bent = d * (at / 2.0 - d * ((at * at - 1.0) / 6.0 - d * (at * at - 3.0) * at / 24.0))
    return float(_LUCK + (1.0 - _LUCK) * (node[1] + density * d * (1.0 - bent)))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _length(t: float) -> float:
    """Return the integral of the chance of a normal deviate below its limit, up to ``t`` >= 0."""
    if not t < _CERTAIN:
        return t
    node = _NORMAL[int((t + _NEVER) * _PER_SIGMA + 0.5)]
    at, density, d = node[0], node[2], t - node[0]
    bent = 0.5 - d * (at / 6.0 - d * (at * at - 1.0) / 24.0)
    return float(node[3] + d * (node[1] + density * d * bent))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _reach(rows: Rows, linear: Linear, i: int, radius: float) -> tuple[float, float]:
    """Return half of a footprint's width and how far it reaches inside the outline [m]."""
    x, y = linear.offsets[0, i], linear.offsets[1, i]
    off = max(math.sqrt(x * x + y * y), _TINY)
    a, b = rows.half_widths[0, i] * x, rows.half_widths[1, i] * y
    half = math.sqrt(a * a + b * b) / off
    return half, radius + half - off


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _towards(rows: Rows, linear: Linear, i: int) -> tuple[float, float, float]:
    """Return the direction from a centre to a beam, square to the line of sight to the centre."""
    x, y = linear.offsets[0, i], linear.offsets[1, i]
    off = max(math.sqrt(x * x + y * y), _TINY)
    x, y, lean = x / off, y / off, off / rows.ranges[i]
    a, b, u = rows.firsts_axis, rows.seconds_axis, rows.directions
    return (
        x * a[0, i] + y * b[0, i] + lean * u[0, i],
        x * a[1, i] + y * b[1, i] + lean * u[1, i],
        x * a[2, i] + y * b[2, i] + lean * u[2, i],
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _variance(cov: Array, v: tuple[float, float, float]) -> float:
    """Return the variance along a vector."""
    x, y, z = v
    crossed = cov[0, 1] * x * y + cov[0, 2] * x * z + cov[1, 2] * y * z
    along = cov[0, 0] * x * x + cov[1, 1] * y * y + cov[2, 2] * z * z
    return float(along + 2.0 * crossed)
