"""The station from every two and every three of its markers: hides a solver of hundreds at once.

Each subset is a small resection of its own, with gravity. All start at the pose from all markers,
which is right to centimetres, so that the weights can stay as they are there and only the
geometry is taken anew at each step.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import combinations
from typing import NamedTuple

import numba
import numpy as np

from pipelines.config import ResectionConfig
from pipelines.errors import ConfigError
from pipelines.geometry import included_angle, rigid, skew
from pipelines.matching import Scene, cov_of_shared, gather, observe
from pipelines.ranging import (
    Influences,
    Measure,
    circles,
    influences,
    observe_distances,
    slope_ranges,
)
from pipelines.values import Array, ControlMarks, Index, MarkerFits, Mask, StationFix, SubsetFixes

SIZES = (2, 3)
"""How many markers a subset has."""

_UPRIGHT = 0.05  # spread across over spread along a plumb line that tells no heading
_FLAT = 0.05  # [rad] 3 deg: circles that cut at less than this touch rather than cut
_USELESS = 1.0  # [m] a position worse than this says nothing of its geometry
_N_STEPS = 40
_SETTLED = 1e-7  # [m] and [rad]; steps shrink at least tenfold
_USABLE = 1e-4  # [m] of the last step, for positions that hardly move any more
_DAMPING = 1e-9  # of the trace of the normal matrix; keeps singular ones solvable


class Positions(NamedTuple):
    """Positions, (s, 3), with covariances, (s, 3, 3), and whether the steps became small, (s,)."""

    p: Array
    cov: Array
    is_settled: Mask


_Solve = Callable[[Scene, Index, Index, Array], Positions]


def resect_subsets(
    method: str, fix: StationFix, fits: MarkerFits, marks: ControlMarks, config: ResectionConfig
) -> tuple[SubsetFixes, ...]:
    """Position a station from each pair and each triple of its markers alone.

    Parameters
    ----------
    method : str
        One of ``RESECTION_METHODS``; it need not be that of the fix.
    fix : StationFix
        The fix from all markers: its matches and its pose as approximate value.
    fits : MarkerFits
        The fits that it came from.
    marks : ControlMarks
        The marks that it came from.
    config : ResectionConfig
        As for the fix.

    Returns
    -------
    tuple of SubsetFixes
        Pairs, then triples. Left out are subsets that tell no position: on a plumb line
        (``free_station``), circles that touch rather than cut (``paper``), pairs of slope distances
        (``ranges``), and all whose sigma is above a metre.

    Raises
    ------
    ConfigError
        If there is no such method.

    Notes
    -----
    Predicted sigmas are those at the pose from all markers. Cost: 14 markers have 91 pairs and 364
    triples, which take some milliseconds; it grows with the third power of the markers.
    """
    if method not in _METHODS:
        raise ConfigError(f"There is no resection method {method!r}; known: {', '.join(_METHODS)}.")
    scene = gather(fits, marks, config)
    start = fix.T_site_station @ rigid(scene.R_station_base, np.zeros(3))
    start[:3, 3] -= scene.middle
    return tuple(_subsets(method, scene, fix.matches, start, size) for size in SIZES)


def theory_of_pairs(method: str, sigma: float, angles: Array) -> Array:
    """Return the horizontal error that two marks give in theory.

    Parameters
    ----------
    method : str
        ``free_station``, 3-D centres with unknown heading, or ``paper``, two circles.
    sigma : float
        Standard deviation of a centre per axis [m].
    angles : (...)
        Included angles in the plane [rad].

    Returns
    -------
    (...)
        Square root of the trace of the covariance of x and y [m].

    Notes
    -----
    Both marks equally far. Circles: ``sqrt(2) sigma / sin``, which grows again towards 180 degrees,
    where the circles touch; centres: ``sigma sqrt(1 + cot^2(angle / 2) / 2)``, which does not.
    """
    if method == "paper":
        return np.asarray(np.sqrt(2.0) * sigma / np.sin(angles))
    return np.asarray(sigma * np.sqrt(1.0 + 0.5 / np.tan(np.asarray(angles) / 2.0) ** 2))


def angles_that_keep(method: str, sigma: float, tolerance: float) -> tuple[float, float]:
    """Return between which included angles two marks keep a tolerance in theory.

    Parameters
    ----------
    method : str
        As for ``theory_of_pairs``, of which this is the inverse.
    sigma : float
        Standard deviation of a centre per axis [m].
    tolerance : float
        Horizontal error that is accepted [m].

    Returns
    -------
    tuple of float
        Smallest and largest angle; NaN where none keeps it [rad].
    """
    if method == "paper":
        sine = np.sqrt(2.0) * sigma / tolerance
        least = float(np.arcsin(sine)) if sine <= 1.0 else np.nan
        return least, np.pi - least
    room = 2.0 * ((tolerance / sigma) ** 2 - 1.0)  # the square of cot(angle / 2)
    return (2.0 * float(np.arctan2(1.0, np.sqrt(room))), np.pi) if room >= 0.0 else (np.nan, np.nan)


def _subsets(method: str, scene: Scene, matches: Index, start: Array, size: int) -> SubsetFixes:
    """Solve all subsets of one size."""
    n = len(matches)
    chosen = np.array(list(combinations(range(n), size)), dtype=np.intp).reshape(-1, size)
    is_usable, solve = _METHODS[method]
    chosen = chosen[is_usable(scene.marks_site[matches[:, 1]] - start[:3, 3], chosen)]
    found = solve(scene, matches, chosen, start)
    sigma_3d = np.sqrt(np.trace(found.cov, axis1=1, axis2=2))
    keep = found.is_settled & (sigma_3d < _USELESS)
    levelled = scene.centres_base[matches[:, 0]] @ scene.R_station_base.T
    return SubsetFixes(
        method=method,
        marks=matches[chosen[keep], 1],
        included_angles=_spread_of_angles(levelled, chosen[keep]),
        included_angles_horizontal=_spread_of_angles(levelled * [1.0, 1.0, 0.0], chosen[keep]),
        p_site=found.p[keep] + scene.middle,
        sigma_horizontal=np.sqrt(np.trace(found.cov[keep, :2, :2], axis1=1, axis2=2)),
        sigma_3d=sigma_3d[keep],
    )


def _angles(v: Array, chosen: Index) -> Array:
    """Return the angles between each two vectors of each subset, (s, 1) or (s, 3)."""
    table = included_angle(v[:, None], v[None])
    first, second = np.triu_indices(chosen.shape[1], 1)
    return np.asarray(table[chosen[:, first], chosen[:, second]])


def _spread_of_angles(v: Array, chosen: Index) -> Array:
    """Return the smallest and the largest angle between the vectors of each subset, (s, 2)."""
    angles = _angles(v, chosen)
    return np.stack([angles.min(axis=1), angles.max(axis=1)], axis=1)


def _by_pose(scene: Scene, matches: Index, chosen: Index, start: Array) -> Positions:
    """Position subsets by their full poses: centres and gravity, as the free station does."""
    R, t = start[:3, :3], start[:3, 3]
    centres, gravity = observe(scene, matches, start)
    q = scene.centres_base[matches[:, 0]] @ R.T
    goals = scene.marks_site[matches[:, 1]] - t
    up, of_gravity = R @ scene.R_station_base[2], _inverses(gravity.cov[0])
    weights = _inverses(centres.cov)
    found, cov = _placed(q[chosen], goals[chosen], weights[chosen], up, of_gravity)
    pull = np.swapaxes(_by_motion(q), -1, -2) @ weights
    by_range = (pull @ (q / np.linalg.norm(q, axis=1, keepdims=True))[..., None])[..., 0]
    gain, variances = cov[:, :, 3:], scene.shared[matches[:, 0]]
    of_heights = ((pull @ up)[chosen].sum(axis=1)[:, None] @ gain)[:, 0]
    shared = cov_of_shared(scene, variances[chosen], by_range[chosen] @ gain, of_heights)
    return found._replace(p=t + found.p, cov=found.cov + shared)


def place(q: Array, goals: Array, weights: Array, up: Array, of_gravity: Array) -> Positions:
    """Find the stations from which centres lie on their marks best, many problems at once.

    Parameters
    ----------
    q : (s, k, 3)
        Centres of each problem as vectors from the station, about turned into the site [m].
    goals : (s, k, 3)
        The marks, relative to the approximate station [m].
    weights : (s, k, 3, 3)
        Inverses of the covariances of their differences.
    up : (3,)
        Measured up direction, turned like the centres.
    of_gravity : (2, 2)
        Inverse of the covariance of its horizontal part.

    Returns
    -------
    Positions
        Of the stations, relative to the approximate one.

    Notes
    -----
    The motion turns about the station. Weights and normal matrices are those of the approximate
    pose; the gradient is exact, so that the steps end where the adjustment of each problem alone
    would.
    """
    return _placed(q, goals, weights, up, of_gravity)[0]


def _placed(
    q: Array, goals: Array, weights: Array, up: Array, of_gravity: Array
) -> tuple[Positions, Array]:
    """Return positions, and the covariances of the motions that they come from, (s, 6, 6)."""
    cov = _inverses(_normal_matrices(q, weights, up, of_gravity))
    motions, last = np.zeros((len(q), 6)), np.zeros(len(q))
    _settle(q, goals, weights, up, of_gravity, cov, motions, last)
    return Positions(motions[:, 3:], cov[:, 3:, 3:], last < _USABLE), cov


@numba.njit(cache=True, nogil=True)
def _settle(q, goals, weights, up, of_gravity, cov, motions, last):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0913
    """Move each problem by steps of Newton until these are small; tell the size of the last."""
    R, gradient = np.empty((3, 3)), np.empty(6)
    for s in range(len(q)):
        for _ in range(_N_STEPS):
            _rotation(motions[s, :3], R)
            _slope(q[s], goals[s], weights[s], R, motions[s, 3:], gradient)
            _lean(up, of_gravity, R, gradient)
            last[s] = 0.0
            for i in range(6):
                step = 0.0
                for j in range(6):
                    step -= cov[s, i, j] * gradient[j]
                motions[s, i] += step
                last[s] += abs(step)
            if last[s] < _SETTLED:
                break


@numba.njit(cache=True, nogil=True)
def _slope(q, goals, weights, R, shift, gradient):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Find the gradient of the weighted squares of one problem's centres."""
    p, off, pull = np.empty(3), np.empty(3), np.empty(3)
    gradient[:] = 0.0
    for k in range(len(q)):
        for i in range(3):
            p[i] = R[i, 0] * q[k, 0] + R[i, 1] * q[k, 1] + R[i, 2] * q[k, 2]
            off[i] = p[i] + shift[i] - goals[k, i]
        for i in range(3):
            w = weights[k, i]
            pull[i] = w[0] * off[0] + w[1] * off[1] + w[2] * off[2]
            gradient[3 + i] += pull[i]
        _add_cross(p, pull, gradient)


@numba.njit(cache=True, nogil=True)
def _lean(up, of_gravity, R, gradient):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Add the gradient of gravity's weighted square."""
    leaning, pull = np.empty(3), np.zeros(3)
    for i in range(3):
        leaning[i] = R[i, 0] * up[0] + R[i, 1] * up[1] + R[i, 2] * up[2]
    for i in range(2):
        pull[i] = leaning[0] * of_gravity[0, i] + leaning[1] * of_gravity[1, i]
    _add_cross(leaning, pull, gradient)


@numba.njit(cache=True, nogil=True)
def _add_cross(v, w, out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Add the cross product of two vectors to the first places of another."""
    out[0] += v[1] * w[2] - v[2] * w[1]
    out[1] += v[2] * w[0] - v[0] * w[2]
    out[2] += v[0] * w[1] - v[1] * w[0]


@numba.njit(cache=True, nogil=True)
def _rotation(turn, R):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Find the rotation of a small turn by the formula of Rodrigues."""
    x, y, z = turn
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


def _normal_matrices(q: Array, weights: Array, up: Array, of_gravity: Array) -> Array:
    """Return the normal matrices of small motions about the station, (s, 6, 6)."""
    J = _by_motion(q)
    N = np.asarray((np.swapaxes(J, -1, -2) @ weights @ J).sum(axis=1))
    J_up = -skew(up)[:2]
    N[:, :3, :3] += J_up.T @ of_gravity @ J_up
    return N


def _by_motion(q: Array) -> Array:
    """Return the derivative of vectors from the station by its small motions, (..., 3, 6)."""
    return np.concatenate([-skew(q), np.broadcast_to(np.eye(3), (*q.shape, 3))], axis=-1)


def _inverses(matrices: Array) -> Array:
    """Return the inverses of the last two dimensions."""
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)


def _has_heading(towards: Array, chosen: Index) -> Mask:
    """Tell which subsets of marks do not stand on one plumb line."""
    off = towards[chosen] - towards[chosen].mean(axis=1, keepdims=True)
    across = np.linalg.norm(off[..., :2], axis=(1, 2))
    return np.asarray(across > _UPRIGHT * np.linalg.norm(off, axis=(1, 2)))


def _circles_cut(towards: Array, chosen: Index) -> Mask:
    """Tell about which subsets of marks circles through the station cut each other there."""
    cuts = np.sin(_angles(towards * [1.0, 1.0, 0.0], chosen))
    return np.asarray(cuts.max(axis=1) > _FLAT)


def _are_three(_towards: Array, chosen: Index) -> Mask:
    """Tell which subsets have three marks; two slope distances leave a whole circle."""
    return np.full(len(chosen), chosen.shape[1] >= 3)


def _by_distances(
    measure: Measure, scene: Scene, matches: Index, chosen: Index, start: Array
) -> Positions:
    """Position subsets by distances alone, as the study's circles and ``ranges`` do."""
    p_start = start[:3, 3]
    seen = observe_distances(measure, scene, matches, p_start)
    marks = scene.marks_site[matches[:, 1]]
    measured = seen.residuals + measure(marks - p_start)[0]
    weights = _inverses(seen.cov)
    found = meet(measure, marks[chosen], measured[chosen], weights[chosen], p_start)
    cov = np.full_like(found.cov, np.inf)
    good = np.isfinite(found.cov[:, 0, 0])
    told = influences(measure, scene, matches, p_start)
    cov[good] = _propagated(scene, matches, told, chosen[good], found.cov[good])
    return found._replace(cov=cov)


def _propagated(scene: Scene, matches: Index, told: Influences, chosen: Index, cov: Array) -> Array:
    """Return the covariances of positions from distances, with what these have in common.

    ``cov``, (s, 3, 3), are the inverses of the normal matrices.
    """
    leans = told.leans[chosen].sum(axis=1)
    spread = told.noise[chosen].sum(axis=1) + leans @ np.swapaxes(leans, 1, 2)
    of_heights = (told.heights[chosen].sum(axis=1)[:, None] @ cov)[:, 0]
    variances = scene.shared[matches[:, 0]][chosen]
    shared = cov_of_shared(scene, variances, told.ranges[chosen] @ cov, of_heights)
    return np.asarray(cov @ spread @ cov + shared)


def meet(
    measure: Measure, marks: Array, measured: Array, weights: Array, start: Array
) -> Positions:
    """Find the positions that meet the distances to some marks best, many problems at once.

    Parameters
    ----------
    measure : callable
        What is measured: ``circles`` or ``slope_ranges``.
    marks : (s, k, 3)
        Marks of each problem [m].
    measured : (s, k, m)
        What was measured to each.
    weights : (s, k, m, m)
        Inverses of their covariances.
    start : (3,)
        Approximate position, common to all; it chooses between intersections [m].

    Returns
    -------
    Positions
        With covariances at ``start``, infinite where the problem is singular there.

    Notes
    -----
    Gauss-Newton, with that part of the second derivative that is never negative: circles that miss
    each other are met where they are nearest, and the normal matrix alone is singular there.
    """
    p = np.broadcast_to(start, (len(marks), 3)).copy()
    cov, step = np.full((len(marks), 3, 3), np.inf), np.full_like(p, np.inf)
    plane = np.diag([1.0, 1.0, 0.0 if measure is circles else 1.0])
    for i in range(_N_STEPS):
        computed, J = measure(marks - p[:, None])
        weighted = np.swapaxes(J, -1, -2) @ weights
        N = (weighted @ J).sum(axis=1)
        if i == 0:
            is_regular = np.linalg.eigvalsh(N)[:, 0] > 1.0 / _USELESS**2
            cov[is_regular] = _inverses(N[is_regular])
        beyond = computed - measured
        gradient = -(weighted @ beyond[..., None])[..., 0].sum(axis=1)
        bend = np.maximum(beyond[..., 0] / computed[..., 0], 0.0) * weights[..., 0, 0]
        across = bend.sum(axis=1)[:, None, None] * plane
        along = J[..., 0, :]
        across -= np.swapaxes(along * bend[..., None], 1, 2) @ along
        damping = _DAMPING * np.trace(N, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        step = -np.linalg.solve(N + across + damping, gradient[..., None])[..., 0]
        p += step
        if np.abs(step).max(initial=0.0) < _SETTLED:
            break
    return Positions(p, cov, np.asarray(np.abs(step).max(axis=1, initial=0.0) < _USABLE))


_METHODS: dict[str, tuple[Callable[[Array, Index], Mask], _Solve]] = {
    "free_station": (_has_heading, _by_pose),
    "ranges": (_are_three, partial(_by_distances, slope_ranges)),
    "paper": (_circles_cut, partial(_by_distances, circles)),
}
"""For each method: which subsets it can use, by the vectors to their marks, and how it solves them.
"""
