"""Trilateration: positions from distances.

``ranges`` takes the slope distances to all marks, ``paper`` the horizontal distances to three (the
three circles of the published method) and the height from the same three. Both are yaw-invariant
functions of a levelled centre; the heading follows from the directions at the position.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.config import ResectionConfig
from spheremark.pipelines.errors import DegenerateGeometryError, NotConvergedError
from spheremark.pipelines.estimation.least_squares import Adjustment, Observations, adjust
from spheremark.pipelines.estimation.linear_algebra import factorise, invert, invert_each, solve
from spheremark.pipelines.estimation.statistical_tests import snoop
from spheremark.pipelines.geometry import is_on_a_line, rigid, rot_z, skew, unit
from spheremark.pipelines.model import Array, Exclusion, Index, Mask, StationFix
from spheremark.pipelines.positioning.fix import (
    Pose,
    assumed_levelling,
    failed_global_test,
    station_fix,
)
from spheremark.pipelines.positioning.matching import Match, Scene, cov_of_shared

Measure = Callable[[Array], tuple[Array, Array]]
"""Gives what is measured of vectors, (..., 3), and its derivative by them."""

USELESS = 1.0
"""A position worse than this says nothing of its geometry [m]."""

_N_STEPS = 40
_MET = 1e-9  # [m] of a step between circles, which may shrink slowly
_USABLE = 1e-4  # [m] of the last step, for positions that hardly move any more
_DAMPING = 1e-9  # of the trace of the normal matrix; keeps singular ones solvable
_NEAREST = 1e-9  # [m] of a mark on the plumb line of the station, whose circle has no direction
_LOOSE = 0.1  # [m] a position that is worse than this is weak
_FAINT = 0.05  # change of distances, RMS, by a unit of an undetermined motion
_STEEP = 0.9  # vertical part of a motion that is about the height


class Influences(NamedTuple):
    """What each marker adds to the gradient of a position from distances."""

    noise: Array  # (k, 3, 3) its covariance by the errors of centre and mark alone
    centres: Array  # (k, 3, 3) the gradient by the centre in base
    leans: Array  # (k, 3, 2) the gradient by a sigma of roll and of pitch


def slope_ranges(v: Array) -> tuple[Array, Array]:
    """Return the lengths of vectors."""
    r = np.linalg.norm(v, axis=-1)[..., None]
    return r, (v / r)[..., None, :]


def circles(v: Array) -> tuple[Array, Array]:
    """Return horizontal lengths and heights of vectors.

    Parameters
    ----------
    v : (..., 3)
        Vectors from the station to centres or marks, levelled [m].

    Returns
    -------
    tuple
        Lengths and heights, (..., 2) [m], and their derivatives by the vectors, (..., 2, 3).
    """
    flat = np.hypot(v[..., 0], v[..., 1])
    J = np.zeros((*v.shape[:-1], 2, 3))
    J[..., 0, :2] = v[..., :2] / np.maximum(flat, _NEAREST)[..., None]
    J[..., 1, 2] = 1.0
    return np.stack([flat, v[..., 2]], axis=-1), J


def fix_by_ranges(
    name: str, scene: Scene, match: Match, config: ResectionConfig, excluded: tuple[Exclusion, ...]
) -> StationFix:
    """Position a station from distances to matched marks.

    Notes
    -----
    ``paper`` takes the three marks whose circles cut best, weighs them by their sigmas and leaves
    nothing out: three circles do not show which is wrong. The covariance of the pose is that
    of all centres, marks and the levelling carried to first order through position and heading,
    and so are the errors of range and height that all centres share.
    """
    if match.n < 3:
        raise DegenerateGeometryError(
            f"{match.n} marks were matched; three are needed to position a station from distances."
        )
    measure = circles if name == "paper" else slope_ranges
    pairs = match.pairs if name == "ranges" else _best_three(scene, match)

    def adjusted(keep: Mask) -> Adjustment:
        return adjust(
            lambda p: (observe_distances(measure, scene, pairs[keep], p),),
            lambda p, dp: np.asarray(p + dp),
            match.T_site_base[:3, 3],
            test_level=config.test_level,
            test_power=config.test_power,
        )

    try:
        adjustment, keep, dropped = snoop(
            adjusted, len(pairs), lambda rest, _block: name == "ranges" and int(rest.sum()) > 4
        )
    except NotConvergedError as error:
        raise _unsettled(measure, scene, pairs, match.T_site_base[:3, 3]) or error from error
    out = [
        Exclusion(
            fit=int(pairs[block, 0]),
            reason=f"w = {w:.1f} (good data stay below {adjustment.critical_w:.1f}): its distance "
            f"to mark {scene.names[pairs[block, 1]]} contradicts the others.",
        )
        for block, w in dropped
    ]
    unused = [
        Exclusion(fit=int(fit), reason="Three circles are met, and three other marks cut better.")
        for fit in match.pairs[:, 0]
        if fit not in pairs[:, 0]
    ]
    every = tuple(sorted((*excluded, *out, *unused), key=lambda one: one.fit))
    return _fix(name, measure, scene, pairs[keep], adjustment, every)


def _unsettled(
    measure: Measure, scene: Scene, pairs: Index, p: Array
) -> DegenerateGeometryError | None:
    """Return which direction of a position distances leave undetermined, if any."""
    J = measure(scene.marks_site[pairs[:, 1]] - p)[1].reshape(-1, 3)
    _, strengths, ways = np.linalg.svd(J)
    if strengths[-1] > _FAINT * np.sqrt(len(pairs)):
        return None
    way = "the height" if abs(ways[-1, 2]) > _STEEP else "the position across their plane"
    return DegenerateGeometryError(
        f"The distances to {len(pairs)} marks leave {way} open: the marks stand about in one plane "
        "with the station, and on either side of it the distances are the same. Use the method "
        "free_station, or add a mark well above or below the others."
    )


def observe_distances(measure: Measure, scene: Scene, pairs: Index, p: Array) -> Observations:
    """Linearise what is measured at positions."""
    levelled, cov_levelled = _levelled(scene, pairs)
    marks = scene.marks_site[pairs[..., 1]]
    measured, by_centre = measure(levelled)
    computed, by_mark = measure(marks - p[..., None, :])
    cov = by_centre @ cov_levelled @ np.swapaxes(by_centre, -1, -2)
    cov = cov + by_mark @ scene.cov_marks[pairs[..., 1]] @ np.swapaxes(by_mark, -1, -2)
    leaned = by_centre @ _leaned(levelled)
    cov = cov + scene.sigma_level**2 * leaned @ np.swapaxes(leaned, -1, -2)
    return Observations(residuals=measured - computed, J=by_mark, cov=cov)


def influences(measure: Measure, scene: Scene, pairs: Index, p: Array) -> Influences:
    """Return what errors of each marker add to the gradient of a position from distances."""
    levelled, cov_levelled = _levelled(scene, pairs)
    seen, (_, by_centre) = observe_distances(measure, scene, pairs, p), measure(levelled)
    weighted = np.swapaxes(seen.J, -1, -2) @ invert_each(seen.cov)[0]
    of_centre, of_mark = weighted @ by_centre, weighted @ seen.J
    own = of_centre @ cov_levelled @ np.swapaxes(of_centre, -1, -2)
    own += of_mark @ scene.cov_marks[pairs[:, 1]] @ np.swapaxes(of_mark, -1, -2)
    return Influences(
        noise=own,
        centres=of_centre @ scene.R_station_base,
        leans=scene.sigma_level * of_centre @ _leaned(levelled),
    )


def _levelled(scene: Scene, pairs: Index) -> tuple[Array, Array]:
    """Return centres and their covariances in the measured levelled frame."""
    R = scene.R_station_base
    return scene.centres_base[pairs[..., 0]] @ R.T, R @ scene.cov_centres[pairs[..., 0]] @ R.T


def _leaned(p: Array) -> Array:
    """Return the derivative of levelled points by small turns about x and y, (..., 3, 2)."""
    return -skew(p)[..., :2]


def _best_three(scene: Scene, match: Match) -> Index:
    """Return the three matches whose circles cut best."""
    towards = scene.marks_site[match.pairs[:, 1], :2] - match.T_site_base[:2, 3]
    three = np.zeros(3, dtype=np.intp)
    best_three(unit(towards), -1.0, 1.0, three)
    return np.asarray(match.pairs[three])


def _pose(
    scene: Scene, measure: Measure, pairs: Index, adjustment: Adjustment
) -> tuple[float, Array]:
    """Return the heading, and the covariance of (rotation, position) at the station.

    Every input has a first-order effect on position and heading: the columns of ``effects``.
    """
    p = adjustment.estimate
    levelled, cov_levelled = _levelled(scene, pairs)
    towards = scene.marks_site[pairs[:, 1]] - p
    seen, aimed = (np.arctan2(v[:, 1], v[:, 0]) for v in (levelled, towards))
    by_centre, by_mark = (_azimuth_by_place(v) for v in (levelled, towards))
    weights = 1.0 / np.einsum("ki,kij,kj->k", by_centre, cov_levelled, by_centre)
    weights = weights / weights.sum()
    turns = aimed - seen
    yaw = float(np.arctan2(weights @ np.sin(turns), weights @ np.cos(turns)))
    _, measured_by_centre = measure(levelled)
    group = adjustment.groups[0]
    gain = -adjustment.cov @ np.swapaxes(group.J, 1, 2) @ invert_each(group.cov)[0]
    effects = np.zeros((2, len(pairs), 4, 3))  # of centres and of marks on heading and position
    effects[0, :, 1:] = gain @ measured_by_centre
    effects[1, :, 1:] = -gain @ group.J
    effects[:, :, 0] = -(weights @ by_mark) @ effects[:, :, 1:]
    effects[0, :, 0] -= weights[:, None] * by_centre
    effects[1, :, 0] += weights[:, None] * by_mark
    covs = np.stack([cov_levelled, scene.cov_marks[pairs[:, 1]]])
    cov = np.einsum("ekab,ekbc,ekdc->ad", effects, covs, effects)
    cov += cov_of_shared(scene, pairs[:, 0], effects[0] @ scene.R_station_base)
    lean = np.zeros((6, 2))  # of the measured levelling
    lean[2:] = -np.einsum("kab,kbc->ac", effects[0], _leaned(levelled))
    lean[:2] = -rot_z(yaw)[:2, :2]
    full = np.zeros((6, 6))
    full[2:, 2:] = cov
    full[2, 2] += scene.sigma_heading**2
    return yaw, full + scene.sigma_level**2 * lean @ lean.T


def _azimuth_by_place(v: Array) -> Array:
    """Return the derivative of the azimuths of vectors, (k, 3)."""
    flat = np.sum(v[:, :2] ** 2, axis=1)
    return np.stack([-v[:, 1] / flat, v[:, 0] / flat, np.zeros(len(v))], axis=1)


def _fix(
    name: str,
    measure: Measure,
    scene: Scene,
    pairs: Index,
    adjustment: Adjustment,
    excluded: tuple[Exclusion, ...],
) -> StationFix:
    """Assemble a fix, back in the unshifted site frame."""
    p = adjustment.estimate + scene.middle
    yaw, cov = _pose(scene, measure, pairs, adjustment)
    shift = np.eye(6)
    shift[3:, :3] = skew(p)  # a rotation about the station moves the site's origin
    group = adjustment.groups[0]
    pose = Pose(
        T_site_station=rigid(rot_z(yaw), p),
        cov_T_site_station=shift @ cov @ shift.T,
        cov_p_site=cov[3:, 3:].copy(),
        J_position=np.eye(3),
        residuals_site=np.einsum("km,kmi->ki", group.residuals, group.J),
    )
    reasons = _weaknesses(pairs, adjustment, cov, scene)
    return station_fix(name, scene, pairs, adjustment, pose, (reasons, excluded))


def _weaknesses(pairs: Index, adjustment: Adjustment, cov: Array, scene: Scene) -> list[str]:
    """Return why a fix is weak."""
    reasons = []
    if adjustment.dof == 0:
        reasons.append(f"{len(pairs)} distances: an error in one of them would not show")
    if is_on_a_line(scene.marks_site[pairs[:, 1]]):
        reasons.append(
            "the marks lie on one line: on the other side of it the distances are the same, and "
            "only the directions of the markers determine the side"
        )
    reasons += failed_global_test(adjustment)
    sigmas = np.sqrt(np.diag(cov)[3:])
    if sigmas.max() > _LOOSE:
        reasons.append(
            f"the distances leave {'xyz'[int(np.argmax(sigmas))]} open to {sigmas.max():.2f} m: "
            "the marks stand too much in one plane with the station"
        )
    return reasons + assumed_levelling(scene)


@compiled
def best_three(lines: Array, least: float, greatest: float, three: Index) -> tuple[float, bool]:
    """Find the three marks whose circles cut best.

    Parameters
    ----------
    lines : (n, 2)
        Horizontal unit vectors from the station to the marks.
    least, greatest : float
        Cosines that the angles between the three should keep to; -1 and 1 allow all.
    three : (3,)
        Receives their places: of those that keep to it, or of all where none do.

    Returns
    -------
    tuple
        Trace of the cofactor of the horizontal position, and whether the three keep to the window;
        infinite for fewer than three marks.
    """
    best, best_inside = np.inf, np.inf
    n, a, b, c = len(lines), 0, 0, 0
    for i in range(n):
        xi, yi = lines[i, 0], lines[i, 1]
        for j in range(i + 1, n):
            xj, yj = lines[j, 0], lines[j, 1]
            xx, xy, ij = xi * xi + xj * xj, xi * yi + xj * yj, xi * xj + yi * yj
            for k in range(j + 1, n):
                xk, yk = lines[k, 0], lines[k, 1]
                p, q = xx + xk * xk, xy + xk * yk
                spread = 3.0 / max(p * (3.0 - p) - q * q, 1e-12)  # trace over determinant
                if spread < best:
                    best = spread
                    three[0], three[1], three[2] = i, j, k
                if spread < best_inside:
                    ik, jk = xi * xk + yi * yk, xj * xk + yj * yk
                    if max(ij, ik, jk) <= greatest and min(ij, ik, jk) >= least:
                        best_inside, a, b, c = spread, i, j, k
    if best_inside < np.inf:
        three[0], three[1], three[2] = a, b, c
        return best_inside, True
    return best, False


class Positions(NamedTuple):
    """Positions of independent stations."""

    p: Array  # (s, 3) positions [m]
    cov: Array  # (s, 3, 3) their covariances [m^2]
    is_settled: Mask  # (s,) bool whether the steps became small and the covariance is finite


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
        With covariances at ``start``; zero where the geometry leaves a position open there.
    """
    p, cov = np.tile(start, (len(chosen), 1)), np.empty((len(chosen), 3, 3))
    last = np.empty(len(chosen))
    _meet_all(chosen, marks, measured, weights, p, cov, last)
    return Positions(p, cov, (last < _USABLE) & (cov[:, 0, 0] > 0.0))


@compiled
def _meet_all(chosen, marks, measured, weights, p, cov, last):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0913
    """Fill in positions, covariances at the start, and the sizes of the last steps."""
    N, bent, gradient = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for s in range(len(chosen)):
        N[:], gradient[:] = 0.0, 0.0
        for k in chosen[s]:
            _add_distances(marks[k], p[s], measured[k], weights[k], N, bent, gradient)
        cov[s] = N
        for i in range(3):
            bent[i] = N[i]
            bent[i, i] -= 1.0 / USELESS**2
        if not (factorise(bent, bent) and invert(N, cov[s])):
            cov[s] = 0.0
        last[s] = meet_one(chosen[s], marks, measured, weights, p[s])


@compiled
def meet_one(chosen: Index, marks: Array, measured: Array, weights: Array, p: Array) -> float:
    """Move a station to where it meets the distances to some marks best.

    Parameters
    ----------
    chosen, marks, measured, weights
        As of ``meet``, of one station.
    p : (3,)
        Approximate position; replaced by the one that was found [m].

    Returns
    -------
    float
        Largest part of the last step [m]; infinite if the equations cannot be solved.

    Notes
    -----
    Gauss-Newton, with that part of the second derivative that is never negative: circles that miss
    each other are met where they are nearest, and the normal matrix alone is singular there.
    """
    N, bend, gradient, last = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.inf
    for _ in range(_N_STEPS):
        N[:], bend[:], gradient[:] = 0.0, 0.0, 0.0
        for k in chosen:
            _add_distances(marks[k], p, measured[k], weights[k], N, bend, gradient)
        damping = _DAMPING * (N[0, 0] + N[1, 1] + N[2, 2])
        for i in range(3):
            bend[i, i] += damping
        bend += N
        if not solve(bend, gradient):
            return np.inf
        p += gradient
        last = np.abs(gradient).max()
        if last < _MET:
            break
    return last


@compiled
def _add_distances(mark, p, measured, weight, N, bend, gradient):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0913
    """Add what was measured to one mark to normal matrix, second derivative and right-hand side."""
    is_flat = len(measured) == 2
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
        bend[i, i] += beyond if i < 2 or not is_flat else 0.0
    if is_flat:  # the height, which correlates with the horizontal distance beside it
        rise = mark[2] - p[2] - measured[1]
        gradient[2] += weight[1, 1] * rise + weight[1, 0] * off
        N[2, 2] += weight[1, 1]
        for i in range(2):
            gradient[i] += u[i] * weight[0, 1] * rise
            N[i, 2] += u[i] * weight[0, 1]
            N[2, i] += u[i] * weight[1, 0]
