"""What can be known of accuracy where no truth is: hides which comparisons are fair.

Distances between marks in one scan need no station at all: they are the first thing to look at on
site. A station is then tried without each of its markers, and each mark predicted from the others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.config import ResectionConfig
from pipelines.geometry import rigid
from pipelines.matching import gather, match_marks, solve_pose
from pipelines.values import Array, ControlMarks, Index, MarkerFits, Mask, StationFix, _seal

_SURPRISE = 3.29  # sigmas that one in a thousand normal residuals exceeds
_N_LEFT = 3  # markers at least, of which one can be left out


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class DistanceChecks:
    """Distances between the marks of one scan, as measured against as given, one row per pair.

    Attributes
    ----------
    fits : (n, 2)
        Places of the two among the fits.
    marks : (n, 2)
        Places of the two among the control marks.
    measured, given : (n,)
        Distance between the centres, and between the control marks [m].
    sigmas : (n,)
        Standard deviation of their difference [m].
    is_off : (n,) bool
        Whether they differ by more than the tolerance, or by more than 3.29 sigma.
    suspects : tuple of int
        Places among the control marks of those without which no distance would be off, or that most
        of the distances that are off share.
    """

    fits: Index
    marks: Index
    measured: Array
    given: Array
    sigmas: Array
    is_off: Mask
    suspects: tuple[int, ...]

    def __post_init__(self) -> None:
        n = len(self.fits)
        columns: dict[str, tuple[int | None, ...]] = dict.fromkeys(
            ("measured", "given", "sigmas", "is_off"), (n,)
        )
        _seal(self, fits=(n, 2), marks=(n, 2), **columns)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Omissions:
    """A station without each of its markers, one row per used marker, in the order of its matches.

    Attributes
    ----------
    shifts : (n, 3)
        Position of the station without the marker, minus its position with all [m].
    predictions : (n, 3)
        Where the scan puts the mark when the others alone position the station, minus where it is
        given [m].
    cov_predictions : (n, 3, 3)
        Covariances of these differences [m^2].
    """

    shifts: Array
    predictions: Array
    cov_predictions: Array

    def __post_init__(self) -> None:
        n = len(self.shifts)
        _seal(self, shifts=(n, 3), predictions=(n, 3), cov_predictions=(n, 3, 3))


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
        All pairs of markers that are control marks, those that a resection would leave out too.

    Raises
    ------
    SolveError
        If the markers cannot be matched to the marks.

    Notes
    -----
    Neither pose nor levelling enters. A range bias that all share changes a distance by as much as
    the two lines of sight open towards each other.
    """
    scene = gather(fits, marks, config)
    pairs = match_marks(scene, config).pairs
    first, second = np.triu_indices(len(pairs), 1)
    places = np.stack([pairs[first], pairs[second]], axis=1)
    p, q = scene.centres_base[places[:, 0, 0]], scene.centres_base[places[:, 1, 0]]
    measured = np.linalg.norm(q - p, axis=1)
    goals = scene.marks_site[places[..., 1]]
    given = np.linalg.norm(goals[:, 1] - goals[:, 0], axis=1)
    along = (q - p) / measured[:, None]
    along_site = (goals[:, 1] - goals[:, 0]) / given[:, None]
    cov = scene.cov_centres[places[..., 0]].sum(axis=1)
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
        return Omissions(
            shifts=np.zeros((0, 3)),
            predictions=np.zeros((0, 3)),
            cov_predictions=np.zeros((0, 3, 3)),
        )
    scene = gather(fits, marks, config)
    start = fix.T_site_station @ rigid(scene.R_station_base, np.zeros(3))
    start[:3, 3] -= scene.middle
    all_at_once = solve_pose(scene, fix.matches[None], start[None]).estimate[0]
    others = np.array([np.delete(fix.matches, k, axis=0) for k in range(n)])
    without = solve_pose(scene, others, np.tile(start, (n, 1, 1)))
    T, (fit, mark) = without.estimate, fix.matches.T
    p = np.einsum("nij,nj->ni", T[:, :3, :3], scene.centres_base[fit]) + T[:, :3, 3]
    J = _by_motion(p)
    R = T[:, :3, :3]
    cov = R @ scene.cov_centres[fit] @ np.swapaxes(R, 1, 2) + scene.cov_marks[mark]
    return Omissions(
        shifts=T[:, :3, 3] - all_at_once[:3, 3],
        predictions=p - scene.marks_site[mark],
        cov_predictions=J @ without.cov @ np.swapaxes(J, 1, 2) + cov,
    )


def _by_motion(p: Array) -> Array:
    """Return the derivative of places, (n, 3), by a small motion on the left, (n, 3, 6)."""
    J = np.zeros((len(p), 3, 6))
    x, y, z = p.T
    J[:, 0, 1], J[:, 1, 2], J[:, 2, 0] = z, x, y
    J[:, 1, 0], J[:, 2, 1], J[:, 0, 2] = -z, -x, -y
    J[:, [0, 1, 2], [3, 4, 5]] = 1.0
    return J
