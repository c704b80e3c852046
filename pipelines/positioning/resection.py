"""MarkerFits + control marks -> StationFix.

A free station: the unknown is the full pose of ``base`` in ``site``; centres are observed in
``base``, gravity is observed by the AHRS. ``trilateration`` positions from distances alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from spheremark.pipelines.config import ResectionConfig
from spheremark.pipelines.errors import ConfigError, DegenerateGeometryError, NoMarkersError
from spheremark.pipelines.estimation.least_squares import Adjustment, Groups, Observations, adjust
from spheremark.pipelines.estimation.statistical_tests import Dropped, snoop
from spheremark.pipelines.geometry import (
    by_motion,
    has_heading,
    inverse,
    is_on_a_line,
    rigid,
    skew,
    transform,
    turn_in_place,
)
from spheremark.pipelines.model import (
    Array,
    ControlMarks,
    Exclusion,
    Index,
    MarkerFits,
    Mask,
    StationFix,
    Status,
)
from spheremark.pipelines.positioning.fix import (
    Pose,
    assumed_levelling,
    failed_global_test,
    station_fix,
)
from spheremark.pipelines.positioning.matching import (
    Match,
    Scene,
    contradiction,
    gather,
    match_marks,
    moved,
    observe,
)
from spheremark.pipelines.positioning.trilateration import fix_by_ranges

_MANY_LEFT_OUT = 1.0 / 3.0  # of the matched markers: not they are bad, but the sigmas too small
_TELLING = 4  # markers that agree: with fewer, the one that was left out may be the good one


def resect(
    method: str, fits: MarkerFits, marks: ControlMarks, config: ResectionConfig
) -> StationFix:
    """Position a station from its markers and the control marks.

    Parameters
    ----------
    method : str
        One of ``RESECTION_METHODS``.
    fits : MarkerFits
        Centres in base with covariances, not labelled.
    marks : ControlMarks
        Known places of spheres; may be more or fewer than the fits.
    config : ResectionConfig
        Tolerance of matching, levels of the tests.

    Returns
    -------
    StationFix
        Pose, covariance, residuals, tests; weak with a reason where it cannot be relied on.

    Raises
    ------
    NoMarkersError
        If there is no fit at all.
    DegenerateGeometryError
        If there is only one marker or mark, or all stand on one plumb line.
    NoMatchError
        If the markers do not agree with the marks better than chance.
    AmbiguousMatchError
        If they agree in two different ways equally well.
    """
    if method not in _METHODS:
        raise ConfigError(f"There is no resection method {method!r}; known: {', '.join(_METHODS)}.")
    return _METHODS[method](fits, marks, config)


def free_station(fits: MarkerFits, marks: ControlMarks, config: ResectionConfig) -> StationFix:
    """Position a station by adjusting its full pose to the centres and to gravity.

    Notes
    -----
    Residuals are ``T_site_base p_base - p_mark`` with the covariances of both in the site frame,
    and the horizontal part of the measured up direction, turned into the site, with that of the
    AHRS. The errors that centres have in common, of ranges above all, are unknowns beside the pose,
    with their priors, and taken off the covariances of the centres. To each centre ``sigma_common``
    is added per axis and independently: a fit's covariance knows the noise of its returns, lasers
    and the mounting, not what changes from direction to direction and moves both faces alike; what
    of it all centres share is a motion of the pose and cannot be separated from it. Where data
    snooping would leave out more than a third of the markers, the sigmas are to blame: it is done
    again with w divided by sigma0. Gravity that contradicts three or more marks is left out like a
    bad marker, and the fix is weak.
    """
    _refuse_too_few(fits, marks)
    scene = gather(fits, marks, config)
    match = match_marks(scene, config)
    pairs, n_shared = match.pairs, scene.shared_base.shape[2]
    alone = replace(scene, cov_centres=scene.cov_own)

    def adjusted(keep: Mask) -> Adjustment:
        return adjust(
            lambda state: _observe(alone, pairs[keep[:-2]], state, has_gravity=bool(keep[-2])),
            _moved,
            np.column_stack([match.T_site_base, np.zeros((4, n_shared))]),
            test_level=config.test_level,
            test_power=config.test_power,
        )

    def may_drop(keep: Mask, block: int) -> bool:
        rest = keep.copy()
        rest[block] = False
        left = scene.marks_site[pairs[rest[:-2], 1]]
        if not (rest[-1] and rest[-2]):
            return bool(rest[-1]) and not is_on_a_line(left)
        return len(left) >= 2 and bool(has_heading(left))

    adjustment, keep, dropped = snoop(adjusted, len(pairs) + 2, may_drop)
    if len(dropped) > _MANY_LEFT_OUT * len(pairs):
        adjustment, keep, dropped = snoop(adjusted, len(pairs) + 2, may_drop, is_studentised=True)
    used = pairs[keep[:-2]]
    excluded = _exclusions(match, dropped, scene, adjustment, config)
    reasons = _weaknesses(scene, match, used, adjustment, dropped)
    return _fix(scene, match, used, adjustment, excluded, reasons)


def _observe(scene: Scene, pairs: Index, state: Array, *, has_gravity: bool) -> Groups:
    """Linearise centres, gravity, and what centres have in common, by the pose and by that.

    The state is the pose with a column for each error in common; the last row has their sizes.
    """
    T, sizes = state[:, :4], state[3, 4:]
    nearer = replace(scene, centres_base=scene.centres_base - scene.shared_base @ sizes)
    centres, gravity = observe(nearer, pairs, T)
    by_sizes = -T[:3, :3] @ scene.shared_base[pairs[:, 0]]
    groups = [replace(centres, J=np.concatenate([centres.J, by_sizes], axis=2))]
    if has_gravity:
        free = np.zeros((1, 2, len(sizes)))
        groups.append(replace(gravity, J=np.concatenate([gravity.J, free], axis=2)))
    prior = Observations(
        residuals=sizes[None],
        J=np.eye(len(sizes), 6 + len(sizes), 6)[None],
        cov=np.eye(len(sizes))[None],
    )
    return (*groups, prior)


def _moved(state: Array, step: Array) -> Array:
    """Move a pose on the left, and the sizes of what centres have in common."""
    out = moved(state, step[:6])
    out[3, 4:] += step[6:]
    return out


def _refuse_too_few(fits: MarkerFits, marks: ControlMarks) -> None:
    """Raise where no station can come out."""
    if not fits.fits:
        raise NoMarkersError(
            f"No marker was found by {fits.method!r} ({len(fits.rejected)} candidates were "
            "refused); a station needs two, better three or more."
        )
    for n, kind in ((len(fits.fits), "marker"), (len(marks.names), "control mark")):
        if n < 2:
            raise DegenerateGeometryError(
                f"{'One' if n else 'No'} {kind} gives no position: the heading stays open. At "
                "least two are needed, better three or more."
            )


def _exclusions(
    match: Match,
    dropped: Dropped,
    scene: Scene,
    adjustment: Adjustment,
    config: ResectionConfig,
) -> tuple[Exclusion, ...]:
    """Return which markers were left out, and why."""
    pairs = match.pairs
    placed = transform(adjustment.estimate[:, :4], scene.centres_base)
    excluded = _false_markers(match, scene, adjustment.estimate[:, :4], config)
    for block, w in dropped:
        if block < len(pairs):
            fit, mark = pairs[block]
            off = float(np.linalg.norm(scene.marks_site[mark] - placed[fit]))
            reason = (
                f"w = {w:.1f} (good data stay below {adjustment.critical_w:.1f}): it is {off:.3f} "
                f"m from mark {scene.names[mark]}."
            )
            excluded.append(Exclusion(fit=int(fit), reason=reason))
    return tuple(sorted(excluded, key=lambda exclusion: exclusion.fit))


def _false_markers(
    match: Match, scene: Scene, T: Array, config: ResectionConfig
) -> list[Exclusion]:
    """Return which markers are no control marks at a pose of base."""
    placed = transform(T, scene.centres_base)
    excluded = []
    for fit in np.flatnonzero(match.marks < 0):
        off = float(np.linalg.norm(scene.marks_site - placed[fit], axis=1).min())
        reason = f"It is {off:.2f} m from the nearest control mark"
        nearer = off <= config.match_tolerance
        reason += ", which another marker is nearer to." if nearer else ": a false marker."
        excluded.append(Exclusion(fit=int(fit), reason=reason))
    return excluded


def _weaknesses(
    scene: Scene,
    match: Match,
    used: Index,
    adjustment: Adjustment,
    dropped: Dropped,
) -> list[str]:
    """Return why a fix is weak."""
    reasons = []
    if len(match.alternatives):
        reasons.append(_other_places(scene, match))
    if against := contradiction(match, scene):
        reasons.append(against)
    if len(used) < 3:
        reasons.append(
            "only two marks: solved with gravity, and an error in one of them would not show"
        )
    elif is_on_a_line(scene.marks_site[used[:, 1]]):
        reasons.append("the marks lie on one line: the turn about it rests on gravity alone")
    reasons += failed_global_test(adjustment)
    reasons += [
        f"the levelling contradicts the marks (w = {w:.1f}) and was left out"
        for block, w in dropped
        if block == match.n
    ]
    n_dropped = sum(block < match.n for block, _ in dropped)
    if n_dropped and n_dropped >= _MANY_LEFT_OUT * match.n:
        reasons.append(f"{n_dropped} of {match.n} matched markers had to be left out")
    elif n_dropped and len(used) < _TELLING:
        reasons.append(
            f"{n_dropped} of {match.n} matched markers contradicts the others and was left out: "
            "with so few it may be one of the others that is wrong"
        )
    return reasons + assumed_levelling(scene)


def _other_places(scene: Scene, match: Match) -> str:
    """Return where else the station may stand, when two markers fit two marks in several ways."""
    places = match.alternatives + scene.middle
    text = ", ".join(f"({x:.2f}, {y:.2f}, {z:.2f})" for x, y, z in places[:3])
    more = f" and {len(places) - 3} more places" if len(places) > 3 else ""
    return (
        f"two markers fit the marks in {len(places) + 1} ways about equally well: the station may "
        f"as well stand at {text}{more} m; a third mark would decide"
    )


def _fix(
    scene: Scene,
    match: Match,
    used: Index,
    adjustment: Adjustment,
    excluded: tuple[Exclusion, ...],
    reasons: list[str],
) -> StationFix:
    """Assemble a fix, back in the unshifted site frame."""
    T = adjustment.estimate[:, :4]
    shift = np.eye(6)
    shift[3:, :3] = skew(scene.middle)
    T_site_base = rigid(T[:3, :3], T[:3, 3] + scene.middle)
    cov, J = adjustment.cov[:6, :6], by_motion(T[:3, 3])
    elsewhere = match.alternatives + scene.middle - T_site_base[:3, 3]
    T_site_station = T_site_base @ inverse(rigid(scene.R_station_base, np.zeros(3)))
    pose = Pose(
        T_site_station=T_site_station,
        cov_T_site_station=shift @ cov @ shift.T
        + _cov_of_heading(scene, elsewhere, T_site_station),
        cov_p_site=J @ cov @ J.T + _cov_of_alternatives(elsewhere),
        J_position=np.column_stack([J, np.zeros((3, len(adjustment.cov) - 6))]),
        residuals_site=adjustment.groups[0].residuals,
    )
    fix = station_fix("free_station", scene, used, adjustment, pose, (reasons, excluded))
    return replace(fix, axis_station=scene.R_station_base[:, 2].copy())


def _cov_of_alternatives(elsewhere: Array) -> Array:
    """Return the covariance, (3, 3), of a position with equally good alternatives.

    ``elsewhere``, (k, 3), are the shifts to them, each as likely as the chosen one.
    """
    return np.asarray(elsewhere.T @ elsewhere / (len(elsewhere) + 1))


def _cov_of_heading(scene: Scene, elsewhere: Array, T_site_station: Array) -> Array:
    """Return the covariance that an uncertain heading and alternative positions add, (6, 6).

    Mounting, encoder and clocks leave the zero of the joint angle uncertain, which turns all
    centres about the axis of the gimbal; the position does not move. That axis leans as the rover
    does: on a slope of 3 degrees a degree of heading is 1 mrad of lean too. The alternatives lie
    half a turn away.
    """
    k, heading = len(elsewhere), turn_in_place(T_site_station, scene.R_station_base[:, 2])
    turn = turn_in_place(T_site_station)
    cov = scene.sigma_heading**2 * np.outer(heading, heading)
    cov += np.pi**2 * k / (k + 1) * np.outer(turn, turn)
    cov[3:, 3:] += _cov_of_alternatives(elsewhere)
    return np.asarray(cov)


def _by_ranges(
    name: str, fits: MarkerFits, marks: ControlMarks, config: ResectionConfig
) -> StationFix:
    """Position a station from distances; which marker is which comes from the centres."""
    _refuse_too_few(fits, marks)
    scene = gather(fits, marks, config)
    match = match_marks(scene, config)
    excluded = _false_markers(match, scene, match.T_site_base, config)
    fix = fix_by_ranges(name, scene, match, config, tuple(excluded))
    if not (against := contradiction(match, scene)):
        return fix
    reason = "; ".join(filter(None, (against, fix.reason)))
    return replace(fix, status=Status.WEAK, reason=reason)


_METHODS: dict[str, Callable[[MarkerFits, ControlMarks, ResectionConfig], StationFix]] = {
    "free_station": free_station,
    "ranges": partial(_by_ranges, "ranges"),
    "paper": partial(_by_ranges, "paper"),
}
