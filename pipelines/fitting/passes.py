"""One pass over the returns of all markers: prediction, gate, weights and normal equations.

Hides the loops that a stop's estimate spends its time in. The range to a sphere bends within less
than a millimetre near the outline: a derivative at one place says how precise that beam would be
if the centre were known already. So ranges are linearised over the width of what is not known.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from pipelines.fitting.footprint import depth_anywhere, depth_inside
from pipelines.values import Array, Beams, Index, Mask

_INNER = 0.9  # radii from the middle within which the range hardly bends
_THIN = 1e-6  # [m]; a thinner footprint is a ray, and this one differs from it by nothing
_POLE_BEGINS = 1.0  # radii below the centre: a footprint that begins lower is on the pole
_POLE_HALF = 0.25  # radii from the vertical through the centre within which the pole is
_WIDTH = np.sqrt(3.0)  # standard deviations to either side: has the fourth moment of a normal one


class Rows(NamedTuple):
    """Returns, those of one marker after those of another.

    Attributes
    ----------
    firsts : (m + 1,)
        First row of each marker, and the row behind the last.
    origins, directions, firsts_axis, seconds_axis : (n, 3)
        Beams, and the axes of their footprints.
    ranges : (n,)
        What was measured [m].
    half_widths : (n, 2)
        Of the footprint [m].
    up : (n, 2)
        The vertical along the footprint's axes, as a unit vector.
    blurs : (n, 2)
        Half widths of the footprint along the vertical and across it [m].
    lasers, classes : (n,)
        Place of each laser, and class of reflectivity.
    sigmas : (n,)
        Prior noise [m].
    lateral : (n,)
        What the noise of the direction moves a return to the side [m].
    """

    firsts: Index
    origins: Array
    directions: Array
    firsts_axis: Array
    seconds_axis: Array
    ranges: Array
    half_widths: Array
    up: Array
    blurs: Array
    lasers: Index
    classes: Index
    sigmas: Array
    lateral: Array


class Linear(NamedTuple):
    """What beams should measure to spheres whose places are known only so well.

    Attributes
    ----------
    ranges : (n,)
        Predicted ranges, less what the bend adds on average over where the sphere may be [m].
    J : (n, 4)
        Derivatives of the ranges by the centre and by the radius, over the width of what is not
        known of them.
    bends : (n,)
        Standard deviation that the bend of the range leaves beside the linear part [m].
    offsets : (n, 2)
        Where the middle of the beam passes the centre, along the footprint's two axes [m].
    """

    ranges: Array
    J: Array
    bends: Array
    offsets: Array


class Normals(NamedTuple):
    """Normal equations.

    Attributes
    ----------
    centres : (m, k, k)
        Of each centre, with the radius where it is free.
    mixed : (m, k, l)
        Between each centre and each laser's bias.
    biases : (l,)
        Of the biases, which are diagonal.
    pull_centres : (m, k)
        Right-hand sides of the centres.
    pull_biases : (l,)
        Right-hand sides of the biases.
    faces : (m, k, k)
        As ``centres``, with what is swept downwards counted negative: how much more one face of the
        scan tells of each centre than the other.
    mixed_faces : (m, k, l)
        As ``mixed``, counted likewise.
    pull_faces : (m, k)
        As ``pull_centres``, counted likewise.
    """

    centres: Array
    mixed: Array
    biases: Array
    pull_centres: Array
    pull_biases: Array
    faces: Array
    mixed_faces: Array
    pull_faces: Array


def rows_of(
    beams: Beams, firsts: Index, up: Array, lasers: Index, noise: tuple[Index, Array, float]
) -> Rows:
    """Return returns as the passes need them.

    Parameters
    ----------
    beams : Beams
        Their beams, marker by marker.
    firsts : (m + 1,)
        First row of each marker, and the row behind the last.
    up : (3,)
        Upward unit vector.
    lasers : (n,)
        Place of each return's laser among those that occur.
    noise : tuple
        Classes of reflectivity (n,), prior noise of ranges (n,) [m] and of directions [rad].

    Returns
    -------
    Rows
        The returns.
    """
    classes, sigmas, sigma_direction = noise
    derived = _derived(beams.directions_base, beams.across_base, beams.ranges, beams.divergence, up)
    return Rows(
        firsts,
        beams.origins_base,
        beams.directions_base,
        beams.across_base,
        derived[0],
        beams.ranges,
        derived[1],
        derived[2],
        derived[3],
        lasers,
        classes,
        sigmas,
        sigma_direction * beams.ranges,
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _derived(
    directions: Array, across: Array, ranges: Array, divergence: Array, up: Array
) -> tuple[Array, Array, Array, Array]:
    """Return second axes, half widths, the vertical along the axes, and half widths along it."""
    n = len(ranges)
    seconds, half_widths = np.empty((n, 3)), np.empty((n, 2))
    ups, blurs = np.empty((n, 2)), np.empty((n, 2))
    for i in range(n):
        u, a, b = directions[i], across[i], seconds[i]
        b[0] = u[1] * a[2] - u[2] * a[1]
        b[1] = u[2] * a[0] - u[0] * a[2]
        b[2] = u[0] * a[1] - u[1] * a[0]
        half_x = max(0.5 * ranges[i] * divergence[0], _THIN)
        half_y = max(0.5 * ranges[i] * divergence[1], _THIN)
        up_x = a[0] * up[0] + a[1] * up[1] + a[2] * up[2]
        up_y = b[0] * up[0] + b[1] * up[1] + b[2] * up[2]
        length = np.hypot(up_x, up_y)
        up_x, up_y = up_x / length, up_y / length
        half_widths[i, 0], half_widths[i, 1] = half_x, half_y
        ups[i, 0], ups[i, 1] = up_x, up_y
        blurs[i, 0] = np.hypot(half_x * up_x, half_y * up_y)
        blurs[i, 1] = np.hypot(half_x * up_y, half_y * up_x)
    return seconds, half_widths, ups, blurs


def linearise(rows: Rows, spheres: Array, covs: Array, is_in: Mask | None = None) -> Linear:
    """Predict ranges, linearised over the width of what is not known of the spheres.

    Parameters
    ----------
    rows : Rows
        The returns.
    spheres : (m, 4)
        Centres in the base frame and radii [m].
    covs : (m, 4, 4)
        Covariances of these; zero of the radius if it is known [m^2].
    is_in : (n,), optional
        Returns that matter; of others only the offsets are right. All by default.

    Returns
    -------
    Linear
        Mean ranges, derivatives, what bends, and offsets.

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
    """
    n = len(rows.ranges)
    out = Linear(np.empty(n), np.empty((n, 4)), np.empty(n), np.empty((n, 2)))
    matters = np.ones(n, dtype=np.bool_) if is_in is None else is_in
    _linearise(rows, spheres, covs, matters, out)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _linearise(rows: Rows, spheres: Array, covs: Array, matters: Mask, out: Linear) -> None:
    """Fill in ``Linear``."""
    for m in range(len(spheres)):
        sphere, cov = spheres[m], covs[m]
        for i in range(rows.firsts[m], rows.firsts[m + 1]):
            u, a, b = _at(rows.directions, i), _at(rows.firsts_axis, i), _at(rows.seconds_axis, i)
            closest, x0, y0 = 0.0, 0.0, 0.0
            for j in range(3):
                v = sphere[j] - rows.origins[i, j]
                closest += v * u[j]
                x0 += v * a[j]
                y0 += v * b[j]
            half_widths = (rows.half_widths[i, 0], rows.half_widths[i, 1])
            depth, by_x, by_y, by_radius, mean, bend = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            if matters[i]:
                depth, by_x, by_y, by_radius, mean, bend = _mean_over_places(
                    (x0, y0, sphere[3]), half_widths, (a, b), cov
                )
            # the bend takes from the depth what it adds to the range
            out.ranges[i] = closest - 2.0 * depth + mean
            for j in range(3):
                out.J[i, j] = u[j] - by_x * a[j] - by_y * b[j]
            out.J[i, 3] = -by_radius
            out.bends[i] = bend
            out.offsets[i, 0], out.offsets[i, 1] = -x0, -y0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _at(rows: Array, i: int) -> tuple[float, float, float]:
    """Return a row of three as numbers: a view of it would cost more than what is done with it."""
    return rows[i, 0], rows[i, 1], rows[i, 2]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mean_over_places(place, half_widths, axes, cov):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Return depth, its mean slopes by x0, y0 and radius, its mean, and what is not linear."""
    x0, y0, radius = place
    half_x, half_y = half_widths
    away = max(np.sqrt(x0 * x0 + y0 * y0), 1e-9)
    c, s = x0 / away, y0 / away
    root = _root(cov, axes, c, s)
    out, aside = away + _WIDTH * root[0], _WIDTH * (abs(root[1]) + root[2])
    reach = np.sqrt(out * out + aside * aside)
    if reach + max(half_x, half_y) + _WIDTH * (abs(root[3]) + root[5]) < _INNER * radius:
        depth, by_x, by_y, by_radius = depth_inside(x0, y0, radius, half_x, half_y)
        return depth, by_x, by_y, by_radius, depth + 0.5 * _curving(away, radius, root), 0.0
    depth = depth_anywhere(x0, y0, radius, half_x, half_y)
    n = 3 if root[5] > 0.0 or root[3] != 0.0 else 2
    mean, square, linear = depth * (3.0 - n) / 3.0, depth * depth * (3.0 - n) / 3.0, 0.0
    slopes = (0.0, 0.0, 0.0)
    for k in range(n):
        along = _WIDTH * (root[0] if k == 0 else 0.0)
        aside = _WIDTH * (root[1] if k == 0 else root[2] if k == 1 else 0.0)
        wider = _WIDTH * (root[3] if k == 0 else root[4] if k == 1 else root[5])
        dx, dy = along * c - aside * s, along * s + aside * c
        plus = depth_anywhere(x0 + dx, y0 + dy, radius + wider, half_x, half_y)
        minus = depth_anywhere(x0 - dx, y0 - dy, radius - wider, half_x, half_y)
        slope = (plus - minus) / (2.0 * _WIDTH)
        mean += (plus + minus) / 6.0
        square += (plus * plus + minus * minus) / 6.0
        linear += slope * slope
        slopes = (
            slope if k == 0 else slopes[0],
            slope if k == 1 else slopes[1],
            slope if k == 2 else slopes[2],
        )
    bend = np.sqrt(max(square - mean * mean - linear, 0.0))
    by_radius = slopes[2] / root[5] if n == 3 else 0.0
    by_side = (slopes[1] - root[4] * by_radius) / root[2]
    by_away = (slopes[0] - root[1] * by_side - root[3] * by_radius) / root[0]
    return depth, by_away * c - by_side * s, by_away * s + by_side * c, by_radius, mean, bend


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _root(cov, axes, c, s):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Return Cholesky's factor of the covariance away, aside, and of the radius: six numbers.

    In the order (away, away), (aside, away), (aside, aside), (radius, away), (radius, aside),
    (radius, radius).
    """
    a, b = axes
    aa, ab, bb, ar, br = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        away_i, side_i = c * a[i] + s * b[i], c * b[i] - s * a[i]
        ar += away_i * cov[i, 3]
        br += side_i * cov[i, 3]
        for j in range(3):
            away_j, side_j = c * a[j] + s * b[j], c * b[j] - s * a[j]
            aa += away_i * cov[i, j] * away_j
            ab += away_i * cov[i, j] * side_j
            bb += side_i * cov[i, j] * side_j
    first = np.sqrt(max(aa, _THIN * _THIN))
    mixed = ab / first
    second = np.sqrt(max(bb - mixed * mixed, _THIN * _THIN))
    if cov[3, 3] <= 0.0:
        return first, mixed, second, 0.0, 0.0, 0.0
    by_first = ar / first
    by_second = (br - mixed * by_first) / second
    third = np.sqrt(max(cov[3, 3] - by_first * by_first - by_second * by_second, _THIN * _THIN))
    return first, mixed, second, by_first, by_second, third


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _curving(away, radius, root):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Return the variances of the place times the second derivatives of a ray's depth."""
    square = radius * radius - away * away
    depth = np.sqrt(square)
    cube = square * depth
    aa, bb = root[0] * root[0], root[1] * root[1] + root[2] * root[2]
    ar, rr = root[0] * root[3], root[3] * root[3] + root[4] * root[4] + root[5] * root[5]
    bent = radius * radius * aa + away * away * rr - 2.0 * radius * away * ar
    return -bent / cube - bb / depth


@numba.njit(cache=True, nogil=True, error_model="numpy")
def in_play(rows: Rows, offsets: Array, margins: Array, radius: float) -> Mask:
    """Tell which returns may be the sphere by their place: on its outline, and not on its pole.

    Parameters
    ----------
    rows : Rows
        The returns.
    offsets : (n, 2)
        Where they pass the centres [m].
    margins : (m,)
        By how much a footprint may pass each sphere by [m].
    radius : float
        Radius of the spheres [m].

    Returns
    -------
    (n,)
        Which ones may.

    Notes
    -----
    What passes by no farther than the centre may be off is kept: to leave out returns of the limb
    wherever the present centre misses them would make every centre right in its own eyes.
    """
    is_in = np.empty(len(rows.ranges), dtype=np.bool_)
    for m in range(len(margins)):
        for i in range(rows.firsts[m], rows.firsts[m + 1]):
            x, y = offsets[i, 0], offsets[i, 1]
            up_x, up_y = rows.up[i, 0], rows.up[i, 1]
            is_low = x * up_x + y * up_y + rows.blurs[i, 0] < -_POLE_BEGINS * radius
            is_middle = abs(x * up_y - y * up_x) < _POLE_HALF * radius + rows.blurs[i, 1]
            off = max(np.hypot(x, y), 1e-9)
            half = np.hypot(rows.half_widths[i, 0] * x, rows.half_widths[i, 1] * y) / off
            is_in[i] = off - radius - half < margins[m] and not (is_low and is_middle)
    return is_in


@numba.njit(cache=True, nogil=True, error_model="numpy")
def noise_of(rows: Rows, linear: Linear, factors: Array) -> Array:
    """Return the noise of each range: its own, that of the direction on a slope, the bend.

    Parameters
    ----------
    rows : Rows
        The returns.
    linear : Linear
        What they should measure.
    factors : (c,)
        Noise in units of the prior, by class of reflectivity.

    Returns
    -------
    (n,)
        Standard deviations [m].
    """
    sigmas = np.empty(len(rows.ranges))
    for i in range(len(sigmas)):
        J, u = linear.J[i], rows.directions[i]
        along = J[0] * u[0] + J[1] * u[1] + J[2] * u[2]
        slope2 = max(J[0] * J[0] + J[1] * J[1] + J[2] * J[2] - along * along, 0.0)
        own, lateral = factors[rows.classes[i]] * rows.sigmas[i], rows.lateral[i]
        sigmas[i] = np.sqrt(own * own + lateral * lateral * slope2 + linear.bends[i] ** 2)
    return sigmas


@numba.njit(cache=True, nogil=True, error_model="numpy")
def normals_of(
    rows: Rows, linear: Linear, residuals: Array, per_square: Array, sizes: tuple[int, int]
) -> tuple[Array, Array, Array, Array, Array, Array, Array, Array]:
    """Sum the normal equations of centres and biases.

    Parameters
    ----------
    rows : Rows
        The returns.
    linear : Linear
        Their derivatives.
    residuals : (n,)
        Observed minus computed [m].
    per_square : (n,)
        Weights over variances [1/m^2].
    sizes : tuple of int
        Unknowns of each sphere, 3 or 4, and number of lasers.

    Returns
    -------
    tuple of ndarray
        The fields of ``Normals``.
    """
    m, (k, n_lasers) = len(rows.firsts) - 1, sizes
    centres, mixed = np.zeros((m, k, k)), np.zeros((m, k, n_lasers))
    biases, pull_centres, pull_biases = np.zeros(n_lasers), np.zeros((m, k)), np.zeros(n_lasers)
    faces, mixed_faces = np.zeros((m, k, k)), np.zeros((m, k, n_lasers))
    pull_faces = np.zeros((m, k))
    for s in range(m):
        for i in range(rows.firsts[s], rows.firsts[s + 1]):
            w, laser, up = per_square[i], rows.lasers[i], rows.up[i, 0]
            if w == 0.0:
                continue
            pull = w * residuals[i]
            biases[laser] += w
            pull_biases[laser] += pull
            for p in range(k):
                J = linear.J[i, p]
                pull_centres[s, p] += pull * J
                pull_faces[s, p] += up * pull * J
                mixed[s, p, laser] += w * J
                mixed_faces[s, p, laser] += up * w * J
                for q in range(k):
                    centres[s, p, q] += w * J * linear.J[i, q]
                    faces[s, p, q] += up * w * J * linear.J[i, q]
    return centres, mixed, biases, pull_centres, pull_biases, faces, mixed_faces, pull_faces
