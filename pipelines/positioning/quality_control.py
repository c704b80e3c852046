"""Quality of a station without truth.

Distances between marks in one scan need no station: they are the first check on site. A station is
then computed without each of its markers, and each mark predicted from the others.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spheremark.pipelines.config import ResectionConfig
from spheremark.pipelines.estimation.linear_algebra import invert_each
from spheremark.pipelines.geometry import by_motion, has_heading, rigid, transform
from spheremark.pipelines.model import (
    Array,
    ControlMarks,
    DistanceChecks,
    Index,
    MarkerFits,
    Omissions,
    StationFix,
    StationQuality,
)
from spheremark.pipelines.positioning.matching import (
    Match,
    Scene,
    gather,
    match_marks,
    observe_together,
    solve_poses,
)
from spheremark.pipelines.positioning.trilateration import circles, slope_ranges

_SURPRISE = 3.29  # sigmas that one in a thousand normal residuals exceeds
_N_LEFT = 3  # markers at least, of which one can be left out
_DISPLACED = 1.0  # [m] from a marker that is no mark: a mark without one may be given wrongly
_N_POSE = 6  # unknowns: with as many more observations of centres, the levelling was left out
_UNKNOWN = 1.0  # [rad] of a levelling that was left out


def station_quality(
    fix: StationFix, fits: MarkerFits, marks: ControlMarks, config: ResectionConfig
) -> StationQuality:
    """Return the quality of a station from scan and control, without truth.

    Parameters
    ----------
    fix : StationFix
        The station.
    fits : MarkerFits
        The fits that it came from.
    marks : ControlMarks
        The marks that it came from.
    config : ResectionConfig
        As for the fix.

    Returns
    -------
    StationQuality
        Dilution of precision, and for a free station the fix without each of its markers.
    """
    is_free = fix.method == "free_station"
    return StationQuality(
        dilution_of_precision=dilution_of_precision(fix, marks),
        without_each=leave_each_out(fix, fits, marks, config) if is_free else Omissions.none(),
    )


def check_distances(
    fits: MarkerFits, marks: ControlMarks, config: ResectionConfig, tolerance: float
) -> DistanceChecks:
    """Compare the distances between the marks of a scan with those of the control.

    Parameters
    ----------
    fits : MarkerFits
        Centres in base, not labelled.
    marks : ControlMarks
        Known places.
    config : ResectionConfig
        As for a resection.
    tolerance : float
        Difference that is accepted [m].

    Returns
    -------
    DistanceChecks
        All pairs of markers that are control marks, those that a resection would leave out too. A
        mark without a marker is paired with a marker without a mark within a metre of it.

    Raises
    ------
    SolveError
        If the markers cannot be matched to the marks.

    Notes
    -----
    Neither pose nor levelling enters. What centres have in common changes a distance by as much as
    it moves the two apart: a range bias, as the two lines of sight open towards each other.
    """
    scene = gather(fits, marks, config)
    match = match_marks(scene, config)
    pairs = np.concatenate([match.pairs, _displaced(scene, match)])
    first, second = np.triu_indices(len(pairs), 1)
    places = np.stack([pairs[first], pairs[second]], axis=1)
    p, q = scene.centres_base[places[:, 0, 0]], scene.centres_base[places[:, 1, 0]]
    measured = np.linalg.norm(q - p, axis=1)
    goals = scene.marks_site[places[..., 1]]
    given = np.linalg.norm(goals[:, 1] - goals[:, 0], axis=1)
    along = (q - p) / measured[:, None]
    along_site = (goals[:, 1] - goals[:, 0]) / given[:, None]
    own, (a, b) = scene.cov_own, places[..., 0].T
    cov, cov_given = own[a] + own[b], scene.cov_marks[places[..., 1]].sum(axis=1)
    apart = (along[:, None] @ (scene.shared_base[b] - scene.shared_base[a]))[:, 0]
    sigmas = np.sqrt(
        _projected(cov, along) + _projected(cov_given, along_site) + np.sum(apart**2, axis=1)
    )
    off = np.abs(measured - given)
    is_off = (off > tolerance) | (off > _SURPRISE * sigmas)
    return DistanceChecks(
        fits=places[..., 0],
        marks=places[..., 1],
        measured=measured,
        given=given,
        sigmas=sigmas,
        is_off=is_off,
        suspects=_suspects(places[is_off, :, 1]),
    )


def _displaced(scene: Scene, match: Match) -> Index:
    """Return markers and marks, (k, 2), that have no other and are nearest to each other.

    None where fewer than three others agree: then nothing shows that these belong together.
    """
    fits = np.flatnonzero(match.marks < 0)
    marks = np.setdiff1d(np.arange(len(scene.marks_site)), match.marks)
    if not len(fits) or not len(marks) or len(match.pairs) < _N_LEFT:
        return np.empty((0, 2), dtype=np.intp)
    places = transform(match.T_site_base, scene.centres_base[fits])
    gaps = np.linalg.norm(places[:, None] - scene.marks_site[marks], axis=2)
    nearest = gaps.argmin(axis=1)
    is_mutual = gaps.argmin(axis=0)[nearest] == np.arange(len(fits))
    rows = np.flatnonzero(is_mutual & (gaps.min(axis=1) < _DISPLACED))
    return np.stack([fits[rows], marks[nearest[rows]]], axis=1)


def _projected(cov: Array, direction: Array) -> Array:
    """Return the variance along a direction of each."""
    return np.asarray(np.einsum("ni,nij,nj->n", direction, cov, direction))


def _suspects(off: Index) -> tuple[int, ...]:
    """Return marks that explain distances that are off, the one that most share first."""
    suspects = []
    while len(off):
        counts = np.bincount(off.ravel())
        worst = int(counts.argmax())
        if counts[worst] < 2:
            break
        suspects.append(worst)
        off = off[(off != worst).all(axis=1)]
    return tuple(suspects)


def dilution_of_precision(fix: StationFix, marks: ControlMarks) -> float:
    """Return how much the geometry of a station enlarges the errors of what was observed.

    Parameters
    ----------
    fix : StationFix
        The fix.
    marks : ControlMarks
        The marks that it came from.

    Returns
    -------
    float
        3-D sigma of the position of a levelled station where each observation has a sigma of 1: the
        coordinates of centres, or distances (``ranges``; ``paper`` with heights); infinite where
        these leave it open.
    """
    v = marks.p_site[fix.matches[:, 1]] - fix.p_site
    if fix.method == "free_station":
        J = np.zeros((len(v), 3, 4))
        J[:, 0, 0], J[:, 1, 0], J[:, :, 1:] = -v[:, 1], v[:, 0], np.eye(3)
    else:
        J = (slope_ranges if fix.method == "ranges" else circles)(v)[1]
    N = np.einsum("kmi,kmj->ij", J, J)
    cofactor, is_regular = invert_each(N)
    return float(np.sqrt(np.trace(cofactor[-3:, -3:]))) if is_regular else float("inf")


def leave_each_out(
    fix: StationFix, fits: MarkerFits, marks: ControlMarks, config: ResectionConfig
) -> Omissions:
    """Position a station without each of its markers, and predict each mark from the others.

    Parameters
    ----------
    fix : StationFix
        The fix from all markers, by ``free_station``.
    fits : MarkerFits
        The fits that it came from.
    marks : ControlMarks
        The marks that it came from.
    config : ResectionConfig
        As for the fix.

    Returns
    -------
    Omissions
        One row per match; no rows where there are fewer than three.
    """
    n = len(fix.matches)
    if n < _N_LEFT:
        return Omissions.none()
    scene = gather(fits, marks, config)
    if fix.dof == 3 * n - _N_POSE:
        scene = replace(scene, sigma_level=_UNKNOWN)
    start = fix.T_site_station @ rigid(scene.R_station_base, np.zeros(3))
    start[:3, 3] -= scene.middle
    others = fix.matches[np.nonzero(~np.eye(n, dtype=np.bool_))[1].reshape(n, n - 1)]
    with_all, without = (solve_poses(scene, pairs, start) for pairs in (fix.matches[None], others))
    is_known = without.is_settled & with_all.is_settled
    is_known &= has_heading(scene.marks_site[others[..., 1]])
    T = np.where(is_known[:, None, None], without.estimates, np.nan)
    fit, mark = fix.matches.T
    R, t = T[:, :3, :3], T[:, :3, 3]
    p_site = np.einsum("nij,nj->ni", R, scene.centres_base[fit]) + t
    J, shared = by_motion(p_site), R @ scene.shared_base[fit]
    # what centres have in common moves the station, and the mark that it predicts, together
    seen, _ = observe_together(scene, others, T)
    of_others = (R[:, None] @ scene.shared_base[others[..., 0]]).reshape(n, 3 * n - 3, -1)
    weights = np.swapaxes(seen.J[:, 0], 1, 2) @ invert_each(seen.cov[:, 0])[0]
    carried = J @ without.covs @ weights @ of_others
    own = R @ scene.cov_own[fit] @ np.swapaxes(R, 1, 2) + scene.cov_marks[mark]
    by_noise = J @ without.covs @ np.swapaxes(J, 1, 2) - _square(carried)
    return Omissions(
        shifts_site=t - with_all.estimates[0, :3, 3],
        predictions_site=p_site - scene.marks_site[mark],
        cov_predictions_site=own + by_noise + _square(shared - carried),
    )


def _square(factors: Array) -> Array:
    """Return the covariances that factors, (n, 3, k), stand for."""
    return np.asarray(factors @ np.swapaxes(factors, 1, 2))
