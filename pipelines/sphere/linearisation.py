"""What beams should measure to spheres whose places are known only so well.

Hides over which places a range is averaged and linearised. The range to a sphere bends within less
than a millimetre near the outline: a derivative at one place says how precise that beam would be if
the centre were known already. So ranges are linearised over the width of what is not known.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import FUSED, compiled, compiled_with
from spheremark.pipelines.model import Array, Index, Mask
from spheremark.pipelines.sphere.footprint import depths_anywhere, depths_inside
from spheremark.pipelines.sphere.returns import Rows

_INNER = 0.9  # radii from the middle within which the range hardly bends
_THIN = 1e-6  # [m] of a spread: keeps what is divided by it finite
_WIDTH = np.sqrt(3.0)  # standard deviations to either side: has the fourth moment of a normal one


# Columns of how a sphere is seen along beams: its place along the footprint's axes, its radius, and
# half widths of the footprint; its place along the beam, how far the beam passes it by, and how far
# its places reach; its covariance along the footprint's axes, then Cholesky's factor of that, away
# from the middle, aside, and of the radius.
_X, _Y, _RADIUS, _HALF_X, _HALF_Y, _ALONG, _AWAY, _REACH = range(8)
_XX, _XY, _YY, _XR, _YR = range(8, 13)
_AA, _BA, _BB, _RA, _RB, _RR = range(8, 14)
_N_SEEN = 14

# Columns of what that tells: by how much the range is shorter than the way to the closest place,
# its slopes with the sign turned, its bend.
_SHORTER, _BY_X, _BY_Y, _BY_RADIUS, _BEND = range(5)
_N_TOLD = 5


class Linear(NamedTuple):
    """What beams should measure to spheres whose places are known only so well.

    Attributes
    ----------
    ranges : (n,)
        Predicted ranges, less what the bend adds on average over where the sphere may be [m].
    J : (4, n)
        Derivatives of the ranges by the centre and by the radius, over the width of what is not
        known of them.
    bends : (n,)
        Standard deviation of what the range leaves beside the linear part [m].
    offsets : (2, n)
        Where the middle of the beam passes the centre, along the footprint's two axes [m].
    """

    ranges: Array
    J: Array
    bends: Array
    offsets: Array


@compiled
def linearise(rows: Rows, spheres: Array, covs: Array, is_in: Mask | None = None) -> Linear:
    """Predict ranges, linearised over the width of what is not known of the spheres.

    Notes
    -----
    Near the outline the derivative is the slope between places the square root of three standard
    deviations to either side, which for a normal spread is the mean derivative (statistical
    linearisation by cubature: Garcia-Fernandez, Svensson, Morelande, Sarkka, Posterior
    linearization filter, 2015). Along the beam a range is linear in the centre as it is, so that
    places differ only across the beam, and in the radius where it is free. Well inside the outline
    slope and derivative agree, and the exact one is taken, with the bend of a ray. What the bend
    adds on average is taken off: without that least squares puts centres some millimetres too near
    where returns are few (Box, Bias in nonlinear estimation, 1971).

    Sphere by sphere, and step by step over all returns of one: each loop is without a branch, so
    that the compiler takes several returns at once.
    """
    n = len(rows.ranges)
    out = Linear(np.empty(n), np.empty((4, n)), np.empty(n), np.empty((2, n)))
    matters = np.ones(n, dtype=np.bool_) if is_in is None else is_in
    longest = np.max(rows.firsts[1:] - rows.firsts[:-1])
    seen, some = np.empty((_N_SEEN, longest)), np.empty((_N_SEEN, longest))
    told, found = np.empty((_N_TOLD, longest)), np.empty((_N_TOLD, longest))
    inner, outer = np.empty(longest + 1, np.intp), np.empty(longest + 1, np.intp)
    work = (np.empty((5, 7 * longest)), np.empty((4, 7 * longest)))
    for m in range(len(spheres)):
        first, n = rows.firsts[m], rows.firsts[m + 1] - rows.firsts[m]
        _see(rows, first, n, spheres[m], seen)
        told[:, :n] = 0.0
        if np.any(matters[first : first + n]):
            _spread(rows, first, n, covs[m], seen)
            _factor(n, covs[m, 3, 3], seen)
            n_inner, n_outer = _part(matters, first, n, seen, (inner, outer))
            _pick(inner, n_inner, seen, some)
            _tell_inside(n_inner, some, work[1], found)
            _put_back(inner, n_inner, found, told)
            _pick(outer, n_outer, seen, some)
            n_places = 7 if covs[m, 3, 3] > 0.0 else 5
            _tell_anywhere(n_outer, n_places, some, work, found)
            _put_back(outer, n_outer, found, told)
        _combine(rows, first, n, seen, told, out)
    return out


@compiled
def _part(
    matters: Mask, first: int, n: int, seen: Array, parts: tuple[Index, Index]
) -> tuple[int, int]:
    """List the returns that lie well inside the outline, and the others; return how many."""
    inner, outer = parts
    n_inner, n_outer = 0, 0
    for k in range(n):
        inner[n_inner] = outer[n_outer] = k
        is_inner = seen[_REACH, k] < _INNER * seen[_RADIUS, k]
        n_inner += matters[first + k] and is_inner
        n_outer += matters[first + k] and not is_inner
    return n_inner, n_outer


@compiled_with(fastmath=FUSED)
def _see(rows: Rows, first: int, n: int, sphere: Array, seen: Array) -> None:
    """Fill in where a sphere is along beams, and their footprints."""
    o, u, a, b = rows.origins, rows.directions, rows.firsts_axis, rows.seconds_axis
    x, y, z = sphere[0], sphere[1], sphere[2]
    for k in range(n):
        i = first + k
        vx, vy, vz = x - o[0, i], y - o[1, i], z - o[2, i]
        seen[_X, k] = vx * a[0, i] + vy * a[1, i] + vz * a[2, i]
        seen[_Y, k] = vx * b[0, i] + vy * b[1, i] + vz * b[2, i]
        seen[_ALONG, k] = vx * u[0, i] + vy * u[1, i] + vz * u[2, i]
    for k in range(n):
        seen[_RADIUS, k] = sphere[3]
        seen[_HALF_X, k] = rows.half_widths[0, first + k]
        seen[_HALF_Y, k] = rows.half_widths[1, first + k]


@compiled_with(fastmath=FUSED)
def _spread(rows: Rows, first: int, n: int, cov: Array, seen: Array) -> None:
    """Fill in a sphere's covariance along the axes of footprints."""
    a, b = rows.firsts_axis, rows.seconds_axis
    xx, xy, xz, yy, yz, zz = cov[0, 0], cov[0, 1], cov[0, 2], cov[1, 1], cov[1, 2], cov[2, 2]
    xr, yr, zr = cov[0, 3], cov[1, 3], cov[2, 3]
    for k in range(n):
        i = first + k
        ax, ay, az, bx, by, bz = a[0, i], a[1, i], a[2, i], b[0, i], b[1, i], b[2, i]
        x, y, z = (
            xx * ax + xy * ay + xz * az,
            xy * ax + yy * ay + yz * az,
            xz * ax + yz * ay + zz * az,
        )
        seen[_XX, k], seen[_XY, k] = ax * x + ay * y + az * z, bx * x + by * y + bz * z
        x, y, z = (
            xx * bx + xy * by + xz * bz,
            xy * bx + yy * by + yz * bz,
            xz * bx + yz * by + zz * bz,
        )
        seen[_YY, k] = bx * x + by * y + bz * z
        seen[_XR, k], seen[_YR, k] = ax * xr + ay * yr + az * zr, bx * xr + by * yr + bz * zr


@compiled_with(fastmath=FUSED)
def _factor(n: int, variance: float, seen: Array) -> None:
    """Replace covariances by their factor away, aside and of the radius, whose variance is told."""
    least = _THIN * _THIN
    for k in range(n):
        x, y = seen[_X, k], seen[_Y, k]
        away = max(np.sqrt(x * x + y * y), 1e-9)
        c, s = x / away, y / away
        xx, xy, yy, xr, yr = seen[_XX, k], seen[_XY, k], seen[_YY, k], seen[_XR, k], seen[_YR, k]
        mixed = 2.0 * c * s * xy
        aa = np.sqrt(max(c * c * xx + mixed + s * s * yy, least))
        ba = (c * s * (yy - xx) + (c * c - s * s) * xy) / aa
        bb = np.sqrt(max(s * s * xx - mixed + c * c * yy - ba * ba, least))
        ra = (c * xr + s * yr) / aa
        rb = (c * yr - s * xr - ba * ra) / bb
        rr = np.sqrt(max(variance - ra * ra - rb * rb, least)) if variance > 0.0 else 0.0
        out, aside = away + _WIDTH * aa, _WIDTH * (abs(ba) + bb)
        wider = max(seen[_HALF_X, k], seen[_HALF_Y, k]) + _WIDTH * (abs(ra) + rr)
        seen[_AWAY, k], seen[_REACH, k] = away, np.sqrt(out * out + aside * aside) + wider
        seen[_AA, k], seen[_BA, k], seen[_BB, k] = aa, ba, bb
        seen[_RA, k], seen[_RB, k], seen[_RR, k] = ra, rb, rr


@compiled
def _pick(which: Index, n: int, table: Array, some: Array) -> None:
    """Copy some rows of columns."""
    for j in range(len(table)):
        for k in range(n):
            some[j, k] = table[j, which[k]]


@compiled
def _put_back(which: Index, n: int, some: Array, table: Array) -> None:
    """Copy what was found of some rows to where they are among all."""
    for j in range(len(table)):
        for k in range(n):
            table[j, which[k]] = some[j, k]


@compiled_with(fastmath=FUSED)
def _tell_inside(n: int, seen: Array, depths: Array, told: Array) -> None:
    """Fill in what beams well inside the outline tell: exact slopes, and the bend of a ray."""
    depths_inside(seen, n, depths)
    for k in range(n):
        away, radius = seen[_AWAY, k], seen[_RADIUS, k]
        aa, ba, bb = seen[_AA, k], seen[_BA, k], seen[_BB, k]
        ra, rb, rr = seen[_RA, k], seen[_RB, k], seen[_RR, k]
        square = radius * radius - away * away
        outwards = radius * aa - away * ra
        bent = outwards * outwards + away * away * (rb * rb + rr * rr)
        curving = -(bent / square + ba * ba + bb * bb) / np.sqrt(square)
        told[_SHORTER, k], told[_BEND, k] = depths[0, k] - 0.5 * curving, 0.0
        told[_BY_X, k], told[_BY_Y, k] = depths[1, k], depths[2, k]
        told[_BY_RADIUS, k] = depths[3, k]


@compiled_with(fastmath=FUSED)
def _tell_anywhere(
    n: int, n_places: int, seen: Array, work: tuple[Array, Array], told: Array
) -> None:
    """Fill in what beams tell about the outline: slopes between places, and what is not linear."""
    places, depths = work
    _lay_out(n, n_places, seen, places)
    depths_anywhere(places, n_places * n, depths)
    is_free = n_places == 7
    plus, minus = (5 * n, 6 * n) if is_free else (0, 0)  # of the radius: of the middle, if known
    for k in range(n):
        d, d0, d1, d2, d3 = (
            depths[0, k],
            depths[0, n + k],
            depths[0, 2 * n + k],
            depths[0, 3 * n + k],
            depths[0, 4 * n + k],
        )
        d4, d5 = depths[0, plus + k], depths[0, minus + k]
        mean = (d0 + d1 + d2 + d3 + d4 + d5) / 6.0
        square = (d0 * d0 + d1 * d1 + d2 * d2 + d3 * d3 + d4 * d4 + d5 * d5) / 6.0
        by_a, by_b, by_r = (
            (d0 - d1) / (2.0 * _WIDTH),
            (d2 - d3) / (2.0 * _WIDTH),
            (d4 - d5) / (2.0 * _WIDTH),
        )
        linear = by_a * by_a + by_b * by_b + by_r * by_r
        told[_BEND, k] = np.sqrt(max(square - mean * mean - linear, 0.0))
        told[_SHORTER, k] = 2.0 * d - mean
        by_r = by_r / seen[_RR, k] if is_free else 0.0
        by_b = (by_b - seen[_RB, k] * by_r) / seen[_BB, k]
        by_a = (by_a - seen[_BA, k] * by_b - seen[_RA, k] * by_r) / seen[_AA, k]
        c, s = seen[_X, k] / seen[_AWAY, k], seen[_Y, k] / seen[_AWAY, k]
        told[_BY_X, k], told[_BY_Y, k] = by_a * c - by_b * s, by_a * s + by_b * c
        told[_BY_RADIUS, k] = by_r


@compiled_with(fastmath=FUSED)
def _lay_out(n: int, n_places: int, seen: Array, places: Array) -> None:
    """Fill in the present places, and those to either side along each column of the factor."""
    for j in range(5):
        for p in range(n_places):
            for k in range(n):
                places[j, p * n + k] = seen[j, k]
    for p in range(1, n_places):
        axis, width = (p - 1) // 2, _WIDTH if p % 2 else -_WIDTH
        for k in range(n):
            c, s = seen[_X, k] / seen[_AWAY, k], seen[_Y, k] / seen[_AWAY, k]
            along = seen[_AA, k] if axis == 0 else 0.0
            aside = seen[_BA + axis, k] if axis < 2 else 0.0
            places[_X, p * n + k] += width * (along * c - aside * s)
            places[_Y, p * n + k] += width * (along * s + aside * c)
            places[_RADIUS, p * n + k] += width * seen[_RA + axis, k]


@compiled_with(fastmath=FUSED)
def _combine(rows: Rows, first: int, n: int, seen: Array, told: Array, out: Linear) -> None:
    """Fill in ``Linear`` for the returns of one sphere."""
    u, a, b = rows.directions, rows.firsts_axis, rows.seconds_axis
    for j in range(3):
        for k in range(n):
            i = first + k
            out.J[j, i] = u[j, i] - told[_BY_X, k] * a[j, i] - told[_BY_Y, k] * b[j, i]
    for k in range(n):
        i = first + k
        out.J[3, i], out.bends[i] = -told[_BY_RADIUS, k], told[_BEND, k]
        out.ranges[i] = seen[_ALONG, k] - told[_SHORTER, k]
        out.offsets[0, i], out.offsets[1, i] = -seen[_X, k], -seen[_Y, k]
