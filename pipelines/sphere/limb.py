"""That a beam which returned from a sphere has met it: what returns tell beside their ranges.

Hides how that bounds a centre. The footprint of such a beam reaches inside the outline, so that the
outermost returns hold the outline from all sides. Nothing is asked of shots that did not return:
where returns are missing, or reach less far than their footprints would, nothing is said.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import Array
from spheremark.pipelines.sphere.linearisation import Linear
from spheremark.pipelines.sphere.returns import Rows

_EDGES = np.arange(-0.5, 1.01, 0.05)  # half widths inside the outline
_SOFTNESSES = 0.05 * 2.0 ** np.arange(0.0, 4.6, 0.5)  # half widths of the footprint
_EDGE, _SIGMA_EDGE = 0.2, 0.4  # prior of where returns begin
_SOFTNESS, _SPREAD = 0.2, 0.7  # prior of the softness, and its standard deviation in the logarithm
_FROM, _BIN, _N_BINS = -2.0, 0.05, 75  # half widths inside: where returns are counted
_POLE_BELOW, _POLE_HALF = 0.6, 0.25  # radii below the centre and to either side: beside the pole
_SOFTNESS_MIN = 0.03  # half widths: an edge that a bin cannot tell from a sharp one
_SIGMA_OWN = 0.05  # half widths by which the edge of one sphere may differ from that of all
_POLE_BLUR = 0.3  # half widths by which returns from there may be its own, and not of the outline
_LUCK = 0.01  # share of returns that are from the sphere by their range and yet did not meet it
_CERTAIN = 4.0  # standard deviations inside the outline from where meeting is no news
_CAVITY_MIN = 0.05  # of a centre's precision: the least that is not one return's own
_TINY = 1e-9  # [m]
_Pair = tuple[float, float]  # across the beam, or along the axes of a footprint
_HALF, _DENSITY = math.sqrt(0.5), 1.0 / math.sqrt(2.0 * math.pi)


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


def outline_before(radius: float) -> Outline:
    """Return how returns may end before any are seen: as softly as is likely."""
    return Outline(radius, _EDGE, _SOFTNESS * math.exp(_SPREAD))


def outline_of(rows: Rows, linear: Linear, weights: Array, radius: float) -> Outline:
    """Return how returns end at the outline of the spheres of a stop.

    Notes
    -----
    Returns lie evenly up to the edge: one that seems to reach inside of it by ``x``, give or take
    ``s``, has a density like ``Phi(x / s)``. Footprints that are wider or narrower than they are
    said to be move the edge; directions that are off, and what else carries returns across it, make
    it soft, and then it says less. Mean over a grid, with a weak prior for few spheres. Returns
    from beside the pole are not asked: there footprints that miss the sphere return too.
    """
    counts, lateral2 = _counts(rows, linear, weights, radius)
    logs = np.tensordot(counts, _logarithms(), axes=1) + _logarithms_before()
    chances = np.exp(logs - logs.max())
    chances /= chances.sum()
    softness2 = float(np.exp(2.0 * chances.sum(axis=0) @ np.log(_SOFTNESSES))) - lateral2
    edge = float(chances.sum(axis=1) @ _EDGES)
    return Outline(radius, edge, math.sqrt(max(softness2, _SOFTNESS_MIN**2)))


@cache
def _logarithms() -> Array:
    """Return the log-density of returns of each bin, (b, e, s), for each edge and softness."""
    inside = _FROM + _BIN * (np.arange(_N_BINS) + 0.5)
    z = (inside[:, None, None] - _EDGES[:, None]) / _SOFTNESSES
    t = (_FROM + _BIN * _N_BINS - _EDGES[:, None]) / _SOFTNESSES
    length = t * ndtr(t) + _DENSITY * np.exp(-0.5 * t * t)
    return np.asarray(np.log(_LUCK + (1.0 - _LUCK) * ndtr(z)) - np.log(_SOFTNESSES * length))


@cache
def _logarithms_before() -> Array:
    """Return the log-density of each edge and softness before returns are seen, (e, s)."""
    edges = ((_EDGES[:, None] - _EDGE) / _SIGMA_EDGE) ** 2
    return np.asarray(-0.5 * (edges + (np.log(_SOFTNESSES / _SOFTNESS) / _SPREAD) ** 2))


@compiled
def _counts(rows: Rows, linear: Linear, weights: Array, radius: float) -> tuple[Array, float]:
    """Count returns by how many half widths of their footprints they reach inside, (b,).

    With them the mean square of what the noise of their directions is, in half widths too.
    """
    counts, lateral2 = np.zeros(_N_BINS), 0.0
    for i in range(len(weights)):
        passed, up = _pair(linear.offsets, i), _pair(rows.up, i)
        half, inside = _reach(passed, _pair(rows.half_widths, i), radius)
        k = int(max((inside / half - _FROM) / _BIN, 0.0))
        if (
            weights[i] > 0.0
            and k < _N_BINS
            and not _is_by_pole(passed, up, rows.blurs[1, i], radius)
        ):
            counts[k] += 1.0
            lateral2 += (rows.lateral[i] / half) ** 2
    return counts, lateral2 / max(counts.sum(), 1.0)


@compiled
def outline_normals(
    rows: Rows,
    linear: Linear,
    weights: Array,
    covs: Array,
    outline: Outline,
    sites: Array,
) -> tuple[Array, Array, Array, Array, Array]:
    """Return what it adds to the normal equations of centres that returns have met their spheres.

    Notes
    -----
    Expectation propagation (Minka, Expectation propagation for approximate Bayesian inference,
    2001): each return is taken out of the present estimate, its truth that it reaches inside is
    multiplied in, and a normal distribution of the same mean and variance stands for the product.
    It speaks of the place across the line of sight alone: how large the outline looks would tell
    the distance too, and would be trusted more than the footprint is known. Where returns lie to
    one side only, an edge that is not quite that of all spheres would pass for a place: each sphere
    has an edge of its own, which is eliminated.
    """
    n, found = len(covs), np.zeros(sites.shape)
    N, faces = np.zeros((n, 4, 4)), np.zeros((n, 4, 4))  # of the centre and the sphere's own edge
    pulls, pull_faces = np.zeros((n, 4)), np.zeros((n, 4))
    a, b, u = rows.firsts_axis, rows.seconds_axis, rows.directions
    for m in range(n):
        N[m, 3, 3] = 1.0 / _SIGMA_OWN**2
        widest = covs[m, 0, 0] + covs[m, 1, 1] + covs[m, 2, 2]
        for i in range(rows.firsts[m], rows.firsts[m + 1]):
            passed, up = _pair(linear.offsets, i), _pair(rows.up, i)
            half, inside = _reach(passed, _pair(rows.half_widths, i), outline.radius)
            inside -= outline.edge * half
            blur = (outline.softness * half) ** 2 + rows.lateral[i] ** 2
            if weights[i] == 0.0 or inside > _CERTAIN * math.sqrt(widest + blur):
                continue
            if _is_by_pole(passed, up, rows.blurs[1, i], outline.radius):
                blur += (_POLE_BLUR * half) ** 2
            x, y, lean = _towards(passed, rows.ranges[i])
            row = (
                x * a[0, i] + y * b[0, i] + lean * u[0, i],
                x * a[1, i] + y * b[1, i] + lean * u[1, i],
                x * a[2, i] + y * b[2, i] + lean * u[2, i],
                -half,
            )
            known = (_variance(covs[m], row[:3]), blur)
            precision, pull = _site(inside, known, (sites[i, 0], sites[i, 1]))
            found[i, 0], found[i, 1] = weights[i] * precision, weights[i] * pull
            precision, pull, sign = found[i, 0], found[i, 1] - found[i, 0] * inside, up[0]
            for p in range(4):
                pulls[m, p] += pull * row[p]
                pull_faces[m, p] += sign * pull * row[p]
                for q in range(4):
                    N[m, p, q] += precision * row[p] * row[q]
                    faces[m, p, q] += sign * precision * row[p] * row[q]
        _eliminate_edge(N[m], pulls[m], faces[m], pull_faces[m])
    return N[:, :3, :3], pulls[:, :3], faces[:, :3, :3], pull_faces[:, :3], found


@compiled
def _eliminate_edge(N: Array, pull: Array, faces: Array, pull_faces: Array) -> None:
    """Take the last unknown, a sphere's own edge, out of equations of it and the centre."""
    gain, gain_faces = N[:3, 3] / N[3, 3], faces[:3, 3] / N[3, 3]
    pull[:3] -= gain * pull[3]
    pull_faces[:3] -= gain_faces * pull[3]
    for p in range(3):
        for q in range(3):
            faces[p, q] -= gain[p] * faces[3, q]
            N[p, q] -= gain[p] * N[3, q]


@compiled
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


@compiled
def _chance(z: float) -> float:
    """Return the chance that a return which reaches so far inside has met the sphere."""
    if z > _CERTAIN:
        return 1.0
    return _LUCK + (1.0 - _LUCK) * 0.5 * math.erfc(-_HALF * z)


@compiled
def _pair(columns: Array, i: int) -> _Pair:
    """Return both numbers of a return: a call with whole arrays would count their references."""
    return columns[0, i], columns[1, i]


@compiled
def _reach(passed: _Pair, half_widths: _Pair, radius: float) -> _Pair:
    """Return half of a footprint's width and how far it reaches inside the outline [m].

    It is told by where it passes the centre, and its half widths.
    """
    x, y = passed
    off = max(math.sqrt(x * x + y * y), _TINY)
    a, b = half_widths[0] * x, half_widths[1] * y
    half = math.sqrt(a * a + b * b) / off
    return half, radius + half - off


@compiled
def _is_by_pole(passed: _Pair, up: _Pair, blur: float, radius: float) -> bool:
    """Tell whether a footprint lies so low and so near the vertical that it may be on the pole.

    It is told by where it passes the centre, the vertical, and its half width across that.
    """
    (x, y), (up_x, up_y) = passed, up
    is_low = x * up_x + y * up_y < -_POLE_BELOW * radius
    return bool(is_low and abs(x * up_y - y * up_x) < _POLE_HALF * radius + blur)


@compiled
def _towards(passed: _Pair, away: float) -> tuple[float, float, float]:
    """Return the direction from a centre to a beam, square to the line of sight to the centre."""
    x, y = passed
    off = max(math.sqrt(x * x + y * y), _TINY)
    return x / off, y / off, off / away


@compiled
def _variance(cov: Array, v: tuple[float, float, float]) -> float:
    """Return the variance along a vector."""
    x, y, z = v
    crossed = cov[0, 1] * x * y + cov[0, 2] * x * z + cov[1, 2] * y * z
    along = cov[0, 0] * x * x + cov[1, 1] * y * y + cov[2, 2] * z * z
    return float(along + 2.0 * crossed)
