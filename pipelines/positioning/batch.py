"""Stations from some of their marks, hundreds of them at once: hides compiled loops.

Each station is a small problem of its own over some rows of common tables: centres with their
marks and gravity, as the free station has them, or distances alone. The geometry is always taken
anew at each step; the weights of ``place`` and ``meet`` stay as they are where these begin.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import compiled, compiled_with
from spheremark.pipelines.estimation.linear_algebra import invert
from spheremark.pipelines.model import Array, Index, Mask

USELESS = 1.0
"""A position worse than this says nothing of its geometry [m]."""

_N_STEPS = 40
_SETTLED = 1e-7  # [m] and [rad] of a step of Newton; steps shrink at least tenfold
_MET = 1e-9  # [m] of a step between circles, which may shrink slowly
_STILL = 1e-15  # square of a step in standard deviations
_CLOSE = 1e-12  # of the last step, for poses that hardly move any more
_USABLE = 1e-4  # [m] of the last step, for positions that hardly move any more
_DAMPING = 1e-9  # of the trace of the normal matrix; keeps singular ones solvable


class Positions(NamedTuple):
    """Where stations are, and how sure that is.

    Attributes
    ----------
    p : (s, 3)
        Positions, or how far they are from the approximate one [m].
    cov : (s, a, a)
        Covariances of all unknowns, of which the position is the last three.
    is_settled : (s,) bool
        Whether the steps became small.
    """

    p: Array
    cov: Array
    is_settled: Mask


class Sightings(NamedTuple):
    """What stations are adjusted from.

    Attributes
    ----------
    p_base : (n, 3)
        Centres [m].
    cov_base : (n, 3, 3)
        Their covariances [m^2].
    marks : (n, 3)
        The mark of each [m].
    cov_marks : (n, 3, 3)
        Their covariances [m^2].
    up_base : (3,)
        Measured up direction.
    J_up : (3, 2)
        What a sigma of roll and of pitch adds to it.
    """

    p_base: Array
    cov_base: Array
    marks: Array
    cov_marks: Array
    up_base: Array
    J_up: Array


class Poses(NamedTuple):
    """How stations stand, and how sure that is.

    Attributes
    ----------
    T : (s, 4, 4)
        From base to the frame of the marks [m].
    cov : (s, 6, 6)
        Covariances of small motions (rotation about the station [rad], translation [m]).
    is_settled : (s,) bool
        Whether the steps became small.
    """

    T: Array
    cov: Array
    is_settled: Mask


class SharedErrors(NamedTuple):
    """Errors of range and height that all centres have in common.

    Attributes
    ----------
    by_ranges, by_heights : (n, a)
        The gradient by a unit of each centre's range, and of its height.
    variances : (n,)
        How much of each centre's variance is shared [m^2].
    sigma_range, sigma_height : float
        Of what all ranges are too long, and all centres too high [m].
    """

    by_ranges: Array
    by_heights: Array
    variances: Array
    sigma_range: float
    sigma_height: float


def adjust(chosen: Index, seen: Sightings, start: Array) -> Poses:
    """Adjust stations to some of their centres and to gravity, as a station alone would be."""
    n = len(chosen)
    T, cov, last = np.tile(start, (n, 1, 1)), np.empty((n, 6, 6)), np.empty(n)
    _adjust(chosen, *seen, T, cov, last)
    return Poses(T, cov, last < _CLOSE)


def place(
    chosen: Index, q: Array, goals: Array, weights: Array, up: Array, of_gravity: Array
) -> Positions:
    """Find the stations from which some centres lie on their marks best.

    Parameters
    ----------
    chosen : (s, k)
        Which centres each station has.
    q : (n, 3)
        Centres as vectors from the approximate station, about turned into the site [m].
    goals : (n, 3)
        Their marks, relative to the approximate station [m].
    weights : (n, 3, 3)
        Inverses of the covariances of their differences.
    up : (3,)
        Measured up direction, turned like the centres.
    of_gravity : (2, 2)
        Inverse of the covariance of its horizontal part.

    Returns
    -------
    Positions
        Relative to the approximate station, with the (6, 6) covariances of motions (rotation about
        the station [rad], translation [m]).

    Notes
    -----
    Weights and normal matrices are those of the approximate pose; the gradient is exact, so that
    the steps end where the adjustment of each station alone would.
    """
    n = len(chosen)
    motions, cov, last = np.zeros((n, 6)), np.empty((n, 6, 6)), np.zeros(n)
    _place(chosen, q, goals, weights, up, of_gravity, motions, cov, last)
    return Positions(motions[:, 3:], cov, last < _USABLE)


def meet(chosen: Index, marks: Array, measured: Array, weights: Array, start: Array) -> Positions:
    """Find the stations that meet the distances to some marks best.

    Parameters
    ----------
    chosen : (s, k)
        Which marks each station has.
    marks : (n, 3)
        Marks [m].
    measured : (n, m)
        Slope distance to each, m = 1, or horizontal distance and difference of height, m = 2 [m].
    weights : (n, m, m)
        Inverses of their covariances.
    start : (3,)
        Approximate position, common to all; it chooses between intersections [m].

    Returns
    -------
    Positions
        With (3, 3) covariances at ``start``, infinite where the problem is singular there.

    Notes
    -----
    Gauss-Newton, with that part of the second derivative that is never negative: circles that miss
    each other are met where they are nearest, and the normal matrix alone is singular there.
    """
    n = len(chosen)
    p, cov, last = np.empty((n, 3)), np.full((n, 3, 3), np.inf), np.zeros(n)
    p[:] = start
    _meet(chosen, marks, measured, weights, p, cov, last)
    return Positions(p, cov, last < _USABLE)


def carry(chosen: Index, noise: Array, leans: Array, cov: Array) -> Array:
    """Carry the errors of distances, and of the levelling, to positions."""
    out = np.zeros_like(cov)
    _carry(chosen, noise, leans, cov, out)
    return out


def share(chosen: Index, errors: SharedErrors, cov: Array) -> Array:
    """Return what it changes in positions that some errors are shared by all centres."""
    out = np.zeros((len(cov), 3, 3))
    _share(chosen, *errors, cov, out)
    return out


@compiled
def _adjust(chosen, p_base, cov_base, marks, cov_marks, up_base, J_up, T, cov, last):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0913
    """Move each station by steps of Gauss and Newton; tell the square of the last in sigmas."""
    N, gradient, weight = np.empty((6, 6)), np.empty(6), np.empty((3, 3))
    of_gravity, step = np.empty((2, 2)), np.empty(6)
    for s in range(len(chosen)):
        last[s] = np.inf
        for _ in range(_N_STEPS):
            N[:] = 0.0
            up = _times(T[s], up_base)
            _weigh_gravity(T[s], J_up, of_gravity)
            _add_gravity(up, of_gravity, N)
            _lean(up, of_gravity, gradient)
            for k in chosen[s]:
                q = _times(T[s], p_base[k])
                _weigh(T[s], cov_base[k], cov_marks[k], weight)
                _add_centre(q, weight, N)
                _add_slope(q, T[s, :3, 3], marks[k], weight, gradient)
            if not invert(N, cov[s]):
                last[s] = np.inf
                break
            if last[s] < _STILL:
                break
            last[s] = 0.0
            for i in range(6):
                step[i] = 0.0
                for j in range(6):
                    step[i] -= cov[s, i, j] * gradient[j]
                last[s] -= step[i] * gradient[i]
            _move(step, T[s])


@compiled
def _weigh_gravity(T, J_up, of_gravity):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Find the inverse of the covariance of the horizontal part of the up direction."""
    a, b = _times(T, J_up[:, 0]), _times(T, J_up[:, 1])
    xx, xy, yy = a[0] ** 2 + b[0] ** 2, a[0] * a[1] + b[0] * b[1], a[1] ** 2 + b[1] ** 2
    square = xx * yy - xy * xy
    of_gravity[0, 0], of_gravity[1, 1] = yy / square, xx / square
    of_gravity[0, 1] = of_gravity[1, 0] = -xy / square


@compiled
def _weigh(T, cov_base, cov_mark, weight):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Find the inverse of the covariance of a centre's difference from its mark."""
    cov = np.empty((3, 3))
    for j in range(3):
        cov[:, j] = _times(T, cov_base[j])
    for i in range(3):
        cov[i] = _times(T, cov[i])
        for j in range(3):
            cov[i, j] += cov_mark[i, j]
    invert(cov, weight)


@compiled
def _move(step, T):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Turn a pose about its own place, and shift it."""
    R = np.empty((3, 3))
    _rotation(step, R)
    for j in range(3):
        T[0, j], T[1, j], T[2, j] = _times(R, T[:3, j])
        T[j, 3] += step[3 + j]


@compiled
def _place(chosen, q, goals, weights, up, of_gravity, motions, cov, last):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0913
    """Move each station by steps of Newton until these are small; tell the size of the last."""
    R, N, gradient = np.empty((3, 3)), np.empty((6, 6)), np.empty(6)
    for s in range(len(chosen)):
        N[:] = 0.0
        _add_gravity(up, of_gravity, N)
        for k in chosen[s]:
            _add_centre(q[k], weights[k], N)
        invert(N, cov[s])
        for _ in range(_N_STEPS):
            _rotation(motions[s], R)
            _lean(_times(R, up), of_gravity, gradient)
            for k in chosen[s]:
                p = _times(R, q[k])
                _add_slope(p, motions[s, 3:], goals[k], weights[k], gradient)
            last[s] = 0.0
            for i in range(6):
                step = 0.0
                for j in range(6):
                    step -= cov[s, i, j] * gradient[j]
                motions[s, i] += step
                last[s] += abs(step)
            if last[s] < _SETTLED:
                break


@compiled
def _add_centre(q, weight, N):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Add one centre to the normal matrix of small motions about the station."""
    columns = _cross(q, weight[0]), _cross(q, weight[1]), _cross(q, weight[2])
    for i in range(3):
        row = columns[0][i], columns[1][i], columns[2][i]
        turned = _cross(q, row)
        for j in range(3):
            N[i, j] += turned[j]
            N[i, 3 + j] += row[j]
            N[3 + j, i] += row[j]
            N[3 + i, 3 + j] += weight[i, j]


@compiled
def _add_gravity(up, of_gravity, N):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Add gravity to the normal matrix of small motions about the station."""
    ways = (0.0, up[2], -up[1]), (-up[2], 0.0, up[0])  # crossed with the two axes
    for a in range(2):
        for b in range(2):
            for i in range(3):
                for j in range(3):
                    N[i, j] += of_gravity[a, b] * ways[a][i] * ways[b][j]


@compiled
def _lean(up, of_gravity, gradient):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Find the gradient of gravity's weighted square."""
    x = up[0] * of_gravity[0, 0] + up[1] * of_gravity[1, 0]
    y = up[0] * of_gravity[0, 1] + up[1] * of_gravity[1, 1]
    turn = _cross(up, (x, y, 0.0))
    for i in range(3):
        gradient[i], gradient[3 + i] = turn[i], 0.0


@compiled
def _add_slope(q, shift, goal, weight, gradient):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Add the gradient of one centre's weighted square."""
    off = q[0] + shift[0] - goal[0], q[1] + shift[1] - goal[1], q[2] + shift[2] - goal[2]
    pull = _times(weight, off)
    turn = _cross(q, pull)
    for i in range(3):
        gradient[i] += turn[i]
        gradient[3 + i] += pull[i]


@compiled
def _times(M, v):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, N803
    """Return the product of a matrix and a vector as three numbers: no array is made."""
    x = M[0, 0] * v[0] + M[0, 1] * v[1] + M[0, 2] * v[2]
    y = M[1, 0] * v[0] + M[1, 1] * v[1] + M[1, 2] * v[2]
    return x, y, M[2, 0] * v[0] + M[2, 1] * v[1] + M[2, 2] * v[2]


@compiled
def _cross(v, w):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Return the cross product as three numbers."""
    x, y = v[1] * w[2] - v[2] * w[1], v[2] * w[0] - v[0] * w[2]
    return x, y, v[0] * w[1] - v[1] * w[0]


@compiled
def _solved(M, v):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, N803
    """Return the solution of three equations as three numbers."""
    a, b, c = _cross(M[1], M[2]), _cross(M[2], M[0]), _cross(M[0], M[1])
    size = M[0, 0] * a[0] + M[0, 1] * a[1] + M[0, 2] * a[2]
    x = (v[0] * a[0] + v[1] * b[0] + v[2] * c[0]) / size
    y = (v[0] * a[1] + v[1] * b[1] + v[2] * c[1]) / size
    return x, y, (v[0] * a[2] + v[1] * b[2] + v[2] * c[2]) / size


@compiled
def _rotation(motion, R):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Find the rotation of a small motion by the formula of Rodrigues."""
    x, y, z = motion[0], motion[1], motion[2]
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    a = np.sin(angle) / angle if angle > 0.0 else 1.0
    b = (1.0 - np.cos(angle)) / square if angle > 1e-4 else 0.5 - square / 24.0
    R[0, 0], R[1, 1], R[2, 2] = (
        1 - b * (y * y + z * z),
        1 - b * (x * x + z * z),
        1 - b * (x * x + y * y),
    )
    R[0, 1], R[1, 0] = b * x * y - a * z, b * x * y + a * z
    R[0, 2], R[2, 0] = b * x * z + a * y, b * x * z - a * y
    R[1, 2], R[2, 1] = b * y * z - a * x, b * y * z + a * x


@compiled
def _meet(chosen, marks, measured, weights, p, cov, last):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0913
    """Move each station until its steps are small; tell the largest part of the last."""
    N, bend, gradient = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for s in range(len(chosen)):
        for step in range(_N_STEPS):
            N[:], bend[:], gradient[:] = 0.0, 0.0, 0.0
            for k in chosen[s]:
                _add_distances(marks[k], p[s], measured[k], weights[k], N, bend, gradient)
            damping = _DAMPING * (N[0, 0] + N[1, 1] + N[2, 2])
            for i in range(3):
                bend[i, i] += damping
            bend += N
            if step == 0 and _exceeds(N, 1.0 / USELESS**2):
                invert(N, cov[s])
            change = _solved(bend, gradient)
            last[s] = 0.0
            for i in range(3):
                p[s, i] += change[i]
                if not abs(change[i]) <= last[s]:  # NaN too
                    last[s] = abs(change[i])
            if last[s] < _MET:
                break


@compiled_with(inline="always")
def _add_distances(mark, p, measured, weight, N, bend, gradient):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0913
    """Add what was measured to one mark to normal matrix, second derivative and gradient."""
    is_flat = len(measured) == 2  # inline: a call would count references of seven arrays
    v = mark[0] - p[0], mark[1] - p[1], 0.0 if is_flat else mark[2] - p[2]
    distance = np.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
    u = v[0] / distance, v[1] / distance, v[2] / distance
    off = distance - measured[0]
    beyond = max(off / distance, 0.0) * weight[0, 0]
    for i in range(3):
        gradient[i] += u[i] * weight[0, 0] * off
        for j in range(3):
            N[i, j] += weight[0, 0] * u[i] * u[j]
            bend[i, j] -= beyond * u[i] * u[j]
    bend[0, 0] += beyond
    bend[1, 1] += beyond
    if is_flat:
        _add_height(mark[2] - p[2] - measured[1], off, u, weight, N, gradient)
    else:
        bend[2, 2] += beyond


@compiled_with(inline="always")
def _add_height(off, off_flat, u, weight, N, gradient):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Add a difference of height, which correlates with the horizontal distance beside it."""
    gradient[2] += weight[1, 1] * off + weight[1, 0] * off_flat
    N[2, 2] += weight[1, 1]
    for i in range(2):
        gradient[i] += u[i] * weight[0, 1] * off
        N[i, 2] += u[i] * weight[0, 1]
        N[2, i] += u[i] * weight[1, 0]


@compiled
def _exceeds(N, limit):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Tell whether all eigenvalues of a symmetric matrix exceed a limit: by its pivots."""
    rest = N.copy()
    for i in range(len(rest)):
        rest[i, i] -= limit
    for i in range(len(rest)):
        if not rest[i, i] > 0.0:
            return False
        for row in range(i + 1, len(rest)):
            factor = rest[row, i] / rest[i, i]
            for j in range(i, len(rest)):
                rest[row, j] -= factor * rest[i, j]
    return True


@compiled
def _carry(chosen, noise, leans, cov, out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Find the covariances of positions whose gradients have errors."""
    spread, leant = np.empty((3, 3)), np.empty((3, 2))
    for s in range(len(chosen)):
        spread[:], leant[:] = 0.0, 0.0
        for k in chosen[s]:
            spread += noise[k]
            leant += leans[k]
        for i in range(3):
            for j in range(3):
                spread[i, j] += leant[i, 0] * leant[j, 0] + leant[i, 1] * leant[j, 1]
        for i in range(3):
            for j in range(3):
                for a in range(3):
                    for b in range(3):
                        out[s, i, j] += cov[s, i, a] * spread[a, b] * cov[s, b, j]


@compiled
def _share(chosen, by_ranges, by_heights, variances, sigma_range, sigma_height, cov, out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0913
    """Add what errors that all centres share change in the covariances of positions."""
    n = cov.shape[1]
    own, ranges, heights = np.empty(3), np.empty(3), np.empty(3)
    for s in range(len(chosen)):
        gain = cov[s, :, n - 3 :]
        ranges[:], heights[:] = 0.0, 0.0
        for k in chosen[s]:
            own[:] = 0.0
            for a in range(n):
                for i in range(3):
                    own[i] += by_ranges[k, a] * gain[a, i]
                    heights[i] += sigma_height * by_heights[k, a] * gain[a, i]
            for i in range(3):
                ranges[i] += sigma_range * own[i]
                for j in range(3):
                    out[s, i, j] -= variances[k] * own[i] * own[j]
        for i in range(3):
            for j in range(3):
                out[s, i, j] += ranges[i] * ranges[j] + heights[i] * heights[j]
