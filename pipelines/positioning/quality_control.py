"""What can be known of accuracy where no truth is: hides which comparisons are fair.

Distances between marks in one scan need no station at all: they are the first thing to look at on
site. A station is then tried without each of its markers, and each mark predicted from the others.
"""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.config import ResectionConfig
from spheremark.pipelines.geometry import rigid, transform
from spheremark.pipelines.model import (
    Array,
    ControlMarks,
    DistanceChecks,
    Index,
    MarkerFits,
    Mask,
    Omissions,
    StationFix,
    StationQuality,
)
from spheremark.pipelines.positioning.batch import Sightings, adjust
from spheremark.pipelines.positioning.matching import Match, Scene, gather, match_marks
from spheremark.pipelines.positioning.trilateration import circles, slope_ranges

_SURPRISE = 3.29  # sigmas that one in a thousand normal residuals exceeds
_N_LEFT = 3  # markers at least, of which one can be left out
_DISPLACED = 1.0  # [m] from a marker that is no mark: a mark without one may be given wrongly
_UPRIGHT = 0.05  # spread across over spread along a plumb line of marks that tell no heading
_N_POSE = 6  # unknowns: with as many more observations of centres, the levelling was left out
_OPEN = 1e-9  # of the largest eigenvalue of a normal matrix: what is smaller tells nothing
_UNKNOWN = 1.0  # [rad] of a levelling that was left out


def station_quality(
    fix: StationFix, fits: MarkerFits, marks: ControlMarks, config: ResectionConfig
) -> StationQuality:
    """Return what the scan and the control tell of a station's quality, without truth.

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
        Centres in base; nobody knows which mark is which.
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
    Neither pose nor levelling enters. A range bias that all share changes a distance by as much as
    the two lines of sight open towards each other; what the covariances of the centres hold of it
    is taken off them.
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
    cov = _cov_own(scene)[places[..., 0]].sum(axis=1)
    cov_given = scene.cov_marks[places[..., 1]].sum(axis=1)
    opening = np.sum(along * (_unit(q) - _unit(p)), axis=1) * config.sigma_range
    sigmas = np.sqrt(_projected(cov, along) + _projected(cov_given, along_site) + opening**2)
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

    Where fewer than three others agree, nothing tells that these belong together.
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


def _cov_own(scene: Scene) -> Array:
    """Return the covariances of centres without the error of range that all of them share."""
    v = _unit(scene.centres_base)
    return scene.cov_centres - scene.shared[:, None, None] * v[:, :, None] * v[:, None, :]


def _unit(v: Array) -> Array:
    """Return vectors of length one."""
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


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
    values = np.linalg.eigvalsh(N)
    if values[0] < _OPEN * values[-1]:
        return float("inf")
    return float(np.sqrt(np.trace(np.linalg.inv(N)[-3:, -3:])))


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
    sigma_level = _UNKNOWN if fix.dof == 3 * n - _N_POSE else scene.sigma_level
    fit, mark = fix.matches.T
    seen = Sightings(
        p_base=scene.centres_base[fit],
        cov_base=scene.cov_centres[fit],
        marks=scene.marks_site[mark],
        cov_marks=scene.cov_marks[mark],
        up_base=scene.R_station_base[2],
        J_up=sigma_level * scene.J_up,
    )
    start = fix.T_site_station @ rigid(scene.R_station_base, np.zeros(3))
    start[:3, 3] -= scene.middle
    every = np.arange(n)
    others = np.tile(every, (n, 1))[~np.eye(n, dtype=np.bool_)].reshape(n, n - 1)
    with_all, without = (adjust(chosen, seen, start) for chosen in (every[None], others))
    is_told = without.is_settled & with_all.is_settled & _have_heading(seen.marks[others])
    T = np.where(is_told[:, None, None], without.T, np.nan)
    R, t = T[:, :3, :3], T[:, :3, 3]
    q = (R @ seen.p_base[:, :, None])[:, :, 0]
    cov = R @ seen.cov_base @ np.swapaxes(R, 1, 2) + seen.cov_marks
    J = _by_motion(q)
    return Omissions(
        shifts_site=t - with_all.T[0, :3, 3],
        predictions_site=q + t - seen.marks,
        cov_predictions_site=J @ without.cov @ np.swapaxes(J, 1, 2) + cov,
    )


def _have_heading(p: Array) -> Mask:
    """Tell which groups of marks, (n, k, 3), do not stand on one plumb line."""
    off = p - p.mean(axis=1, keepdims=True)
    across = np.linalg.norm(off[..., :2], axis=(1, 2))
    return np.asarray(across > _UPRIGHT * np.linalg.norm(off, axis=(1, 2)))


def _by_motion(p: Array) -> Array:
    """Return the derivative of places, (n, 3), by a small motion on the left, (n, 3, 6)."""
    J = np.zeros((len(p), 3, 6))
    x, y, z = p.T
    J[:, 0, 1], J[:, 1, 2], J[:, 2, 0] = z, x, y
    J[:, 1, 0], J[:, 2, 1], J[:, 0, 2] = -z, -x, -y
    J[:, [0, 1, 2], [3, 4, 5]] = 1.0
    return J
