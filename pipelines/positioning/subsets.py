"""The station from each pair and each triple of its markers.

Each subset is a small resection of its own, with gravity. All start at the pose from all markers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from itertools import combinations

import numpy as np

from spheremark.pipelines.config import ResectionConfig
from spheremark.pipelines.errors import ConfigError
from spheremark.pipelines.estimation.least_squares import solve_by_chords
from spheremark.pipelines.estimation.linear_algebra import invert_each
from spheremark.pipelines.geometry import (
    by_motion,
    has_heading,
    included_angle,
    rigid,
    skew,
)
from spheremark.pipelines.model import (
    Array,
    ControlMarks,
    Index,
    MarkerFits,
    StationFix,
    SubsetFixes,
)
from spheremark.pipelines.positioning.matching import (
    Scene,
    cov_of_shared,
    cov_together,
    gather,
    moved,
    observe,
)
from spheremark.pipelines.positioning.trilateration import (
    USELESS,
    Measure,
    Positions,
    circles,
    influences,
    meet,
    observe_distances,
    slope_ranges,
)

SIZES = (2, 3)
"""How many markers a subset has."""

_FLAT = 0.05  # [rad] 3 deg: circles that cut at less than this touch rather than cut

_Usable = Callable[[Array, Sequence[Index]], list[Index]]
_Solve = Callable[[Scene, Index, Sequence[Index], Array], list[Positions]]


def resect_subsets(
    methods: Sequence[str],
    fix: StationFix,
    fits: MarkerFits,
    marks: ControlMarks,
    config: ResectionConfig,
) -> dict[str, tuple[SubsetFixes, ...]]:
    """Position a station from each pair and each triple of its markers alone.

    Parameters
    ----------
    methods : sequence of str
        Some of ``RESECTION_METHODS``; that of the fix need not be among them.
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
    dict of str to tuple of SubsetFixes
        By method: pairs, then triples. Left out are subsets that give no position: on a plumb line
        (``free_station``), circles that touch rather than cut (``paper``), pairs of slope distances
        (``ranges``), and all whose sigma is above a metre.

    Raises
    ------
    ConfigError
        If there is no such method.

    Notes
    -----
    Predicted sigmas are those at the pose from all markers. Cost: 14 markers have 91 pairs and 364
    triples, which take a few milliseconds; it grows with the third power of the markers.
    """
    for method in methods:
        if method not in _METHODS:
            known = ", ".join(_METHODS)
            raise ConfigError(f"There is no resection method {method!r}; known: {known}.")
    scene = gather(fits, marks, config)
    start = fix.T_site_station @ rigid(scene.R_station_base, np.zeros(3))
    start[:3, 3] -= scene.middle
    towards = scene.marks_site[fix.matches[:, 1]] - start[:3, 3]
    every = [_combinations(len(fix.matches), size) for size in SIZES]
    levelled = scene.centres_base[fix.matches[:, 0]] @ scene.R_station_base.T
    angles = _table(levelled), _table(levelled * [1.0, 1.0, 0.0])
    found = {}
    for method in methods:
        usable, solve = _METHODS[method]
        groups = usable(towards, every)
        solved = zip(groups, solve(scene, fix.matches, groups, start), strict=True)
        found[method] = tuple(
            _fixes(method, scene, fix.matches[:, 1], *one, angles) for one in solved
        )
    return found


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


@lru_cache(maxsize=64)
def _combinations(n: int, size: int) -> Index:
    """Return all subsets of one size, (s, size)."""
    found = np.array(list(combinations(range(n), size)), dtype=np.intp).reshape(-1, size)
    found.flags.writeable = False
    return found


def _fixes(
    method: str,
    scene: Scene,
    marks: Index,
    chosen: Index,
    found: Positions,
    angles: tuple[Array, Array],
) -> SubsetFixes:
    """Return the subsets of one size whose positions are determined."""
    variances = found.cov.diagonal(axis1=1, axis2=2)
    sigma_3d = np.sqrt(variances.sum(axis=1))
    keep = found.is_settled & (sigma_3d < USELESS)
    rows = chosen[keep]
    in_space, horizontal = (_of_pairs(table, rows) for table in angles)
    return SubsetFixes(
        method=method,
        marks=marks[rows],
        included_angles=_spread(in_space),
        included_angles_horizontal=_spread(horizontal),
        p_site=found.p[keep] + scene.middle,
        sigma_horizontal=np.sqrt(variances[keep, :2].sum(axis=1)),
        sigma_3d=sigma_3d[keep],
    )


def _table(v: Array) -> Array:
    """Return the angles between each two of some vectors, (n, n)."""
    return included_angle(v[:, None], v[None])


def _of_pairs(table: Array, chosen: Index) -> Array:
    """Return the entries of a table for the pairs of each subset, (1, s) or (3, s)."""
    pairs = combinations(range(chosen.shape[1]), 2)
    return np.stack([table[chosen[:, i], chosen[:, j]] for i, j in pairs])


def _spread(angles: Array) -> Array:
    """Return the smallest and the largest angle of each subset, (s, 2)."""
    return np.stack([angles.min(axis=0), angles.max(axis=0)], axis=1)


def _with_heading(towards: Array, groups: Sequence[Index]) -> list[Index]:
    """Return the subsets of marks that do not stand on one plumb line."""
    return [chosen[has_heading(towards[chosen])] for chosen in groups]


def _cutting(towards: Array, groups: Sequence[Index]) -> list[Index]:
    """Return the subsets of marks about which circles through the station cut each other there."""
    cuts = np.sin(_table(towards * [1.0, 1.0, 0.0]))
    return [chosen[_of_pairs(cuts, chosen).max(axis=0) > _FLAT] for chosen in groups]


def _of_three(_towards: Array, groups: Sequence[Index]) -> list[Index]:
    """Return the subsets of three marks; two slope distances leave a whole circle."""
    return [chosen[np.full(len(chosen), chosen.shape[1] >= 3)] for chosen in groups]


def _by_pose(
    scene: Scene, matches: Index, groups: Sequence[Index], start: Array
) -> list[Positions]:
    """Position subsets by their full poses: centres and gravity, as the free station does.

    Unknown are small motions in base, about its origin, in which the equations stay the same.
    """
    R, (fits, marks) = start[:3, :3], matches.T
    base, goals, plumb = scene.centres_base[fits], scene.marks_site[marks], scene.R_station_base[2]
    own, shared = scene.cov_own[fits] + R.T @ scene.cov_marks[marks] @ R, scene.shared_base[fits]
    _, gravity = observe(scene, matches, start)
    J, turn = by_motion(base), np.hstack([-skew(plumb), np.zeros((3, 3))])
    level = invert_each(gravity.cov[0])[0]
    leaned = R[:2] @ turn
    found = []
    for chosen in groups:
        n = len(chosen)
        by_pose = J[chosen].reshape(n, 3 * chosen.shape[1], 6)
        weighted = invert_each(cov_together(own[chosen], shared[chosen]))[0] @ by_pose
        cov, _ = invert_each(np.swapaxes(weighted, 1, 2) @ by_pose + leaned.T @ level @ leaned)

        def rhs(T: Array, chosen: Index = chosen, weighted: Array = weighted) -> Array:
            off = base[chosen] + (T[:, None, :3, 3] - goals[chosen]) @ T[:, :3, :3]
            tilt = (T[:, :2, :3] @ plumb) @ level
            up = (tilt[:, None] @ T[:, :2, :3])[:, 0] @ turn
            return np.asarray(
                -(off.reshape(len(off), 1, 3 * chosen.shape[1]) @ weighted)[:, 0] - up
            )

        def move(T: Array, xi: Array) -> Array:
            return np.asarray(T @ moved(np.tile(np.eye(4), (len(T), 1, 1)), xi))

        T, is_settled = solve_by_chords(cov, rhs, move, np.tile(start, (n, 1, 1)))
        found.append(Positions(T[:, :3, 3], R @ cov[:, 3:, 3:] @ R.T, is_settled))
    return found


def _by_distances(
    measure: Measure, scene: Scene, matches: Index, groups: Sequence[Index], start: Array
) -> list[Positions]:
    """Position subsets by distances alone, as the study's circles and ``ranges`` do."""
    p_start = start[:3, 3]
    seen = observe_distances(measure, scene, matches, p_start)
    marks = scene.marks_site[matches[:, 1]]
    measured, weights = seen.residuals + measure(marks - p_start)[0], invert_each(seen.cov)[0]
    own = influences(measure, scene, matches, p_start)
    found = []
    for chosen in groups:
        one = meet(chosen, marks, measured, weights, p_start)
        lean = own.leans[chosen].sum(axis=1)
        spread = own.noise[chosen].sum(axis=1) + lean @ np.swapaxes(lean, 1, 2)
        cov = one.cov @ spread @ one.cov + cov_of_shared(
            scene, matches[chosen, 0], one.cov[:, None] @ own.centres[chosen]
        )
        found.append(one._replace(cov=cov))
    return found


_METHODS: dict[str, tuple[_Usable, _Solve]] = {
    "free_station": (_with_heading, _by_pose),
    "ranges": (_of_three, partial(_by_distances, slope_ranges)),
    "paper": (_cutting, partial(_by_distances, circles)),
}
"""For each method: which subsets it can use, by the vectors to their marks, and how it solves them.
"""
