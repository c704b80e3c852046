"""MarkerFits + control marks -> StationFix: hides which marker is which mark, and the adjustment.

A free station: the unknown is the full pose of ``base`` in ``site``; centres are observed in
``base``, gravity is observed by the AHRS. All is computed in a site frame that is shifted to the
middle of the control marks, so that large coordinates cost no digits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import comb
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from pipelines.adjustment import (
    Adjustment,
    Observations,
    Solution,
    adjust,
    external_reliabilities,
    snoop,
    solve,
)
from pipelines.config import ResectionConfig
from pipelines.errors import (
    AmbiguousMatchError,
    ConfigError,
    DegenerateGeometryError,
    NoMarkersError,
    NoMatchError,
    SolveError,
)
from pipelines.geometry import (
    included_angle,
    inverse,
    levelling_rotation,
    rigid,
    rot_z,
    skew,
    transform,
)
from pipelines.values import (
    Array,
    ControlMarks,
    Exclusion,
    Index,
    MarkerFits,
    Mask,
    PairFixes,
    StationFix,
    Status,
)

_N_CANDIDATES = 300_000  # pairs of pairs that are compared at most; more find nothing new
_N_HYPOTHESES = 1000  # poses that are looked at; the true one has many votes
_N_SOLUTIONS = 6  # that are refined: the best, and rivals enough to see that it is ambiguous
_N_ROUNDS = 8  # of adjusting and matching again; two or three are the rule
_RIVAL = 14.0  # -2 ln(0.001): how much better, in the weighted sum of squares, the best must be
_CHANCE = 0.01  # expected number of chance agreements above which a match is none
_LINE = 0.05  # spread across over spread along; 3 deg seen from the end
_UPRIGHT = 0.05  # the same for a pair of marks on a plumb line, which tells no heading
_MANY_LEFT_OUT = 1.0 / 3.0  # of the matched markers; the rest agrees because it was selected


class _Scene(NamedTuple):
    """Centres and marks with covariances; ``marks_site`` is relative to the field's ``middle``."""

    names: tuple[str, ...]
    centres_base: Array
    cov_centres: Array
    marks_site: Array
    cov_marks: Array
    middle: Array
    R_station_base: Array
    J_up: Array
    sigma_level: float
    is_levelled: bool


class _Hypotheses(NamedTuple):
    """Poses to be tried: heading [rad] and translation [m] of the levelled frame."""

    yaws: Array
    translations: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Match:
    """Which fit is which mark (-1 for none), the pose of base that goes with it, its vtpv."""

    marks: Index
    T_site_base: Array
    vtpv: float
    dof: int
    largest_residual: float

    @property
    def n(self) -> int:
        """Number of matched fits."""
        return int(np.sum(self.marks >= 0))

    @property
    def pairs(self) -> Index:
        """Places among fits and marks, (n, 2)."""
        fits = np.flatnonzero(self.marks >= 0)
        return np.stack([fits, self.marks[fits]], axis=1)


def resect(
    method: str, fits: MarkerFits, marks: ControlMarks, config: ResectionConfig
) -> StationFix:
    """Position a station from its markers and the control marks.

    Parameters
    ----------
    method : str
        One of ``RESECTION_METHODS``.
    fits : MarkerFits
        Centres in base with covariances; nobody knows which mark is which.
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
    return _method(method).resect(fits, marks, config)


def resect_pairs(
    method: str, fix: StationFix, fits: MarkerFits, marks: ControlMarks, config: ResectionConfig
) -> PairFixes:
    """Position a station from each pair of its markers alone, gravity included.

    Parameters
    ----------
    method : str
        One of ``RESECTION_METHODS``.
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
    PairFixes
        One row per pair; pairs on a plumb line give no heading and are left out.
    """
    return _method(method).resect_pairs(fix, fits, marks, config)


def free_station(fits: MarkerFits, marks: ControlMarks, config: ResectionConfig) -> StationFix:
    """Position a station by adjusting its full pose to the centres and to gravity.

    Parameters
    ----------
    fits : MarkerFits
        Centres in base.
    marks : ControlMarks
        Known places.
    config : ResectionConfig
        Tolerance of matching, levels of the tests.

    Returns
    -------
    StationFix
        Pose of the levelled frame, ``T_site_base`` times the inverse of the measured levelling.

    Raises
    ------
    SolveError
        As ``resect`` says.

    Notes
    -----
    Residuals are ``T_site_base p_base - p_mark`` with the covariances of both in the site frame,
    and the horizontal part of the measured up direction, turned into the site, with that of the
    AHRS. To each centre ``sigma_common`` is added per axis and independently: a fit's covariance
    knows the noise of its returns only, and what mounting and encoder of the gimbal leave changes
    from direction to direction and from face to face; the part that all centres share is a motion
    of the pose and cannot be told from it. Gravity that contradicts three or more marks is left
    out like a bad marker, and the fix is weak.
    """
    _refuse_too_few(fits, marks)
    scene = _scene(fits, marks, config)
    match = _match(scene, config)
    pairs = match.pairs

    def adjusted(keep: Mask) -> Adjustment[Array]:
        return adjust(
            lambda T: _observe(scene, pairs[keep[:-1]], T)[: 1 + int(keep[-1])],
            _moved,
            match.T_site_base,
            test_level=config.test_level,
            test_power=config.test_power,
        )

    def may_drop(keep: Mask, block: int) -> bool:
        rest = keep.copy()
        rest[block] = False
        if not rest[-1]:
            return not _on_a_line(scene.marks_site[pairs[rest[:-1], 1]])
        return int(rest[:-1].sum()) >= 2 and _has_heading(scene, pairs[rest[:-1]])

    adjustment, keep, dropped = snoop(adjusted, len(pairs) + 1, may_drop)
    used = pairs[keep[:-1]]
    excluded = _exclusions(match, dropped, scene, adjustment, config)
    reasons = _weaknesses(scene, match, used, adjustment, dropped)
    return _fix(scene, used, adjustment, excluded, reasons)


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


def _scene(fits: MarkerFits, marks: ControlMarks, config: ResectionConfig) -> _Scene:
    """Gather what is known, as arrays."""
    levelling = fits.levelling
    R_station_base = levelling_rotation(levelling)
    cr, sr = np.cos(levelling.roll), np.sin(levelling.roll)
    cp, sp = np.cos(levelling.pitch), np.sin(levelling.pitch)
    middle = marks.p_site.mean(axis=0)
    return _Scene(
        names=marks.names,
        centres_base=np.stack([fit.p_base for fit in fits.fits]),
        cov_centres=np.stack([fit.cov_p_base for fit in fits.fits])
        + config.sigma_common**2 * np.eye(3),
        marks_site=marks.p_site - middle,
        cov_marks=marks.cov_p_site,
        middle=middle,
        R_station_base=R_station_base,
        J_up=np.array([[0.0, -cp], [cp * cr, -sp * sr], [-cp * sr, -sp * cr]]),
        sigma_level=levelling.sigma,
        is_levelled=levelling.is_measured,
    )


def _observe(scene: _Scene, pairs: Index, T: Array) -> tuple[Observations, Observations]:
    """Linearise centres and gravity at poses of base, (..., 4, 4), for pairs, (..., k, 2)."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    turned = np.einsum("...ij,...kj->...ki", R, scene.centres_base[pairs[..., 0]])
    p_site = turned + t[..., None, :]
    cov_site = R[..., None, :, :] @ scene.cov_centres[pairs[..., 0]]
    cov_site = cov_site @ np.swapaxes(R, -1, -2)[..., None, :, :]
    eye = np.broadcast_to(np.eye(3), (*p_site.shape, 3))
    centres = Observations(
        residuals=p_site - scene.marks_site[pairs[..., 1]],
        J=np.concatenate([-skew(p_site), eye], axis=-1),
        cov=cov_site + scene.cov_marks[pairs[..., 1]],
    )
    up = R @ scene.R_station_base[2]
    J_up = scene.sigma_level * (R @ scene.J_up)[..., :2, :]
    gravity = Observations(
        residuals=up[..., None, :2],
        J=np.concatenate([-skew(up)[..., :2, :], np.zeros((*up.shape[:-1], 2, 3))], axis=-1)[
            ..., None, :, :
        ],
        cov=(J_up @ np.swapaxes(J_up, -1, -2))[..., None, :, :],
    )
    return centres, gravity


def _moved(T: Array, xi: Array) -> Array:
    """Move poses, (..., 4, 4), on the left by small motions, (..., 6), to first order."""
    turn = Rotation.from_rotvec(xi[..., :3]).as_matrix()
    out = np.array(T)
    out[..., :3, :] = turn @ T[..., :3, :]
    out[..., :3, 3] += xi[..., 3:]
    return out


def _solve(scene: _Scene, pairs: Index, start: Array) -> Solution[Array]:
    """Find the pose of base from some pairs and gravity."""
    return solve(lambda T: _observe(scene, pairs, T), _moved, start)


def _match(scene: _Scene, config: ResectionConfig) -> _Match:
    """Find out which fit is which mark.

    Two fits and two marks with the same distance and the same difference of height give a heading
    and a translation. The poses with most votes are tried on all fits, the best refined. The best
    must agree better than chance, and better than any different one.
    """
    levelled = scene.centres_base @ scene.R_station_base.T
    hypotheses = _voted(_hypotheses(levelled, scene, config), levelled, config)
    solutions = _solutions(hypotheses, levelled, scene, config)
    if not solutions:
        raise NoMatchError(
            f"No two of the {len(levelled)} markers have the distance and the difference of height "
            f"of any two of the {len(scene.marks_site)} control marks (within "
            f"{config.match_tolerance} m): these are marks of another field, or false markers."
        )
    best = solutions[0]
    if best.n > 2 or len(levelled) > 2:
        _refuse_chance(best, scene, config)
    rivals = [other for other in solutions[1:] if _is_rival(other, best)]
    if rivals:
        raise AmbiguousMatchError(
            f"{best.n} of {len(levelled)} markers fit the control marks in {len(rivals) + 1} or "
            "more different ways equally well: several pairs of marks have the same distances "
            "(a symmetric field). Survey more markers, or move one so that no distance repeats."
        )
    return best


def _hypotheses(levelled: Array, scene: _Scene, config: ResectionConfig) -> _Hypotheses:
    """Return the poses that bring some two fits onto some two marks."""
    tolerance = config.match_tolerance
    first, second = _pairs_far_first(len(levelled))
    spans = levelled[second] - levelled[first]
    usable = np.hypot(spans[:, 0], spans[:, 1]) > 2.0 * tolerance
    first, second, spans = first[usable], second[usable], spans[usable]
    a, b = np.nonzero(~np.eye(len(scene.marks_site), dtype=np.bool_))
    targets = scene.marks_site[b] - scene.marks_site[a]
    lengths = np.linalg.norm(targets, axis=1)
    order = np.argsort(lengths, kind="stable")
    reach = np.linalg.norm(spans, axis=1)
    low = np.searchsorted(lengths[order], reach - tolerance)
    counts = np.searchsorted(lengths[order], reach + tolerance) - low
    counts[np.cumsum(counts) > max(_N_CANDIDATES, counts[:1].sum())] = 0
    rows = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    columns = order[low[rows] + within]
    slack = tolerance + 3.0 * scene.sigma_level * reach[rows]
    agree = np.abs(targets[columns, 2] - spans[rows, 2]) <= slack
    rows, columns = rows[agree], columns[agree]
    yaws = np.arctan2(targets[columns, 1], targets[columns, 0]) - np.arctan2(
        spans[rows, 1], spans[rows, 0]
    )
    middles = (levelled[first] + levelled[second])[rows] / 2.0
    goals = (scene.marks_site[a] + scene.marks_site[b])[columns] / 2.0
    return _Hypotheses(yaws, goals - _turned(middles, yaws))


def _pairs_far_first(n: int) -> tuple[Index, Index]:
    """Return all pairs of n fits, those far apart in azimuth first."""
    first, second = np.triu_indices(n, 1)
    apart = np.minimum(second - first, n - (second - first))
    order = np.argsort(-apart, kind="stable")
    return first[order], second[order]


def _turned(p: Array, yaws: Array) -> Array:
    """Turn points, (..., 3), about z by as many angles."""
    c, s = np.cos(yaws), np.sin(yaws)
    x, y, z = np.moveaxis(p, -1, 0)
    x, y, z = np.broadcast_arrays(c * x - s * y, s * x + c * y, z)
    return np.stack([x, y, z], axis=-1)


def _voted(hypotheses: _Hypotheses, levelled: Array, config: ResectionConfig) -> _Hypotheses:
    """Return the hypotheses that most others agree with."""
    if len(hypotheses.yaws) <= _N_HYPOTHESES:
        return hypotheses
    middle = levelled.mean(axis=0)
    spread = np.sqrt(np.mean(np.sum((levelled - middle)[:, :2] ** 2, axis=1)))
    place = _turned(np.tile(middle, (len(hypotheses.yaws), 1)), hypotheses.yaws)
    place = (place + hypotheses.translations)[:, :2]
    turns = spread * (hypotheses.yaws % (2.0 * np.pi))
    cells = np.column_stack([place - place.min(axis=0), turns]) // (2.0 * config.match_tolerance)
    width = cells.max(axis=0) + 1.0
    keys = (cells[:, 0] * width[1] + cells[:, 1]) * width[2] + cells[:, 2]
    _, cell, votes = np.unique(keys, return_inverse=True, return_counts=True)
    chosen = np.argsort(-votes[cell], kind="stable")[:_N_HYPOTHESES]
    return _Hypotheses(hypotheses.yaws[chosen], hypotheses.translations[chosen])


def _solutions(
    hypotheses: _Hypotheses, levelled: Array, scene: _Scene, config: ResectionConfig
) -> list[_Match]:
    """Return refined matches that differ from each other, the best first."""
    if not len(hypotheses.yaws):
        return []
    placed = _turned(levelled, hypotheses.yaws[:, None]) + hypotheses.translations[:, None]
    reach = float(np.linalg.norm(levelled, axis=1).max())
    slack = 1.0 + 3.0 * scene.sigma_level * reach / config.match_tolerance
    marks, scores = _assigned(placed, scene.marks_site, config.match_tolerance, slack)
    solutions: list[tuple[float, _Match]] = []
    for _ in range(_N_SOLUTIONS):
        best = int(np.argmax(scores))
        if scores[best] <= 0:
            break
        T = rigid(
            rot_z(hypotheses.yaws[best]) @ scene.R_station_base, hypotheses.translations[best]
        )
        refined = _refined(marks[best], T, scene, config)
        shared = np.sum((marks == marks[best]) & (marks[best] >= 0), axis=1)
        if refined is not None:
            solutions.append(refined)
            same = np.sum((marks == refined[1].marks) & (refined[1].marks >= 0), axis=1)
            shared = np.maximum(shared, same)
        scores[2 * shared >= np.sum(marks >= 0, axis=1)] = 0.0
        scores[best] = 0.0
    return [match for _, match in sorted(solutions, key=lambda item: -item[0])]


def _assigned(
    placed: Array, marks_site: Array, tolerance: float, slack: float
) -> tuple[Index, Array]:
    """Return, for poses, (h, n, 3) of placed fits, the mark of each fit or -1, and a score.

    Heights count less by ``slack``. A mark goes to the fit that is nearest. The score of a matched
    fit falls from 1 to 0 with the square of its distance (MSAC, Torr and Zisserman 2000).
    """
    scale = np.array([1.0, 1.0, 1.0 / slack])
    distances, marks = cKDTree(marks_site * scale).query(
        placed * scale, distance_upper_bound=tolerance
    )
    distances = np.asarray(distances)
    h, n = marks.shape
    found = np.flatnonzero(np.isfinite(distances.ravel()))
    keys = (found // n) * len(marks_site) + marks.ravel()[found]
    order = np.lexsort((distances.ravel()[found], keys))
    winners = found[order[np.unique(keys[order], return_index=True)[1]]]
    out = np.full(h * n, -1, dtype=np.intp)
    out[winners] = marks.ravel()[winners]
    gains = np.zeros(h * n)
    gains[winners] = 1.0 - (distances.ravel()[winners] / tolerance) ** 2
    return out.reshape(h, n), gains.reshape(h, n).sum(axis=1)


def _refined(
    marks: Index, T: Array, scene: _Scene, config: ResectionConfig
) -> tuple[float, _Match] | None:
    """Adjust a hypothesis to its matches and match again until nothing changes; with its score."""
    for _ in range(_N_ROUNDS):
        fits = np.flatnonzero(marks >= 0)
        if len(fits) < 2:
            return None
        try:
            solution = _solve(scene, np.stack([fits, marks[fits]], axis=1), T)
        except SolveError:
            return None
        T = solution.estimate
        placed = transform(T, scene.centres_base)[None]
        again, scores = _assigned(placed, scene.marks_site, config.match_tolerance, 1.0)
        if np.array_equal(again[0], marks):
            residuals = solution.groups[0].residuals
            return float(scores[0]), _Match(
                marks=marks,
                T_site_base=T,
                vtpv=_weighted_square(solution),
                dof=3 * len(fits) - 4,
                largest_residual=float(np.linalg.norm(residuals, axis=1).max()),
            )
        marks = again[0]
    return None


def _weighted_square(solution: Solution[Array]) -> float:
    """Return the weighted sum of squares at a solution."""
    return sum(
        float(np.einsum("km,kmn,kn->", g.residuals, np.linalg.inv(g.cov), g.residuals))
        for g in solution.groups
    )


def _is_rival(other: _Match, best: _Match) -> bool:
    """Return whether another match explains the markers about as well and differs."""
    shared = int(np.sum((other.marks == best.marks) & (best.marks >= 0)))
    worse = (other.vtpv - best.vtpv) / max(1.0, best.vtpv / best.dof)
    return other.n >= best.n and 2 * shared < best.n and worse <= _RIVAL


def _refuse_chance(match: _Match, scene: _Scene, config: ResectionConfig) -> None:
    """Raise NoMatchError if marks strewn at random would agree as well.

    The expected number of chance agreements is counted a contrario (Moisan and Stival 2004): pairs
    of fits on pairs of marks, times the ways to choose the others, times the share of the field's
    volume that lies as near to a mark as the worst of them.
    """
    n, m, k = len(scene.centres_base), len(scene.marks_site), match.n
    near = max(match.largest_residual, 3.0 * float(np.sqrt(scene.cov_centres.trace(0, 1, 2).min())))
    reach = float(np.linalg.norm(scene.centres_base, axis=1).max())
    near_height = near + 3.0 * scene.sigma_level * reach
    extent = np.maximum(np.ptp(scene.marks_site, axis=0), 2.0 * near)
    share_height = min(1.0, 2.0 * near_height / extent[2])
    share = min(1.0, m * np.pi * near**2 / (extent[0] * extent[1]) * share_height)
    share_pair = 2.0 * near / np.hypot(extent[0], extent[1]) * share_height
    expected = comb(n, 2) * m * (m - 1) * share_pair * comb(n - 2, k - 2) * share ** (k - 2)
    if expected > _CHANCE:
        raise NoMatchError(
            f"Only {k} of {n} markers fit the {m} control marks within {config.match_tolerance} m, "
            f"and by chance {expected:.2g} such agreements are expected (at most {_CHANCE} is "
            "accepted): these are marks of another field, or too many markers are false."
        )


def _on_a_line(p: Array) -> bool:
    """Return whether points lie about on one line, or are fewer than three."""
    if len(p) < 3:
        return True
    spreads = np.linalg.svd(p - p.mean(axis=0), compute_uv=False)
    return bool(spreads[1] < _LINE * spreads[0])


def _has_heading(scene: _Scene, pairs: Index) -> bool:
    """Return whether the marks are far enough from one plumb line to tell a heading."""
    off = scene.marks_site[pairs[:, 1]]
    off = off - off.mean(axis=0)
    return bool(np.linalg.norm(off[:, :2]) > _UPRIGHT * np.linalg.norm(off))


def _exclusions(
    match: _Match,
    dropped: tuple[tuple[int, float], ...],
    scene: _Scene,
    adjustment: Adjustment[Array],
    config: ResectionConfig,
) -> tuple[Exclusion, ...]:
    """Say which markers were left out, and why."""
    pairs = match.pairs
    placed = transform(adjustment.estimate, scene.centres_base)
    excluded = []
    for fit in np.flatnonzero(match.marks < 0):
        off = float(np.linalg.norm(scene.marks_site - placed[fit], axis=1).min())
        reason = f"It is {off:.2f} m from the nearest control mark"
        nearer = off <= config.match_tolerance
        reason += ", which another marker is nearer to." if nearer else ": a false marker."
        excluded.append(Exclusion(fit=int(fit), reason=reason))
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


def _weaknesses(
    scene: _Scene,
    match: _Match,
    used: Index,
    adjustment: Adjustment[Array],
    dropped: tuple[tuple[int, float], ...],
) -> list[str]:
    """Say why a fix cannot be relied on."""
    reasons = []
    if len(used) < 3:
        reasons.append(
            "only two marks: solved with gravity, and an error in one of them would not show"
        )
    elif _on_a_line(scene.marks_site[used[:, 1]]):
        reasons.append("the marks lie on one line: the turn about it rests on gravity alone")
    if not adjustment.passes_global_test:
        reasons.append(
            f"the global test fails (sigma0 = {adjustment.sigma0:.2f}): residuals are larger than "
            "their sigmas promise"
        )
    reasons += [
        f"the levelling contradicts the marks (w = {w:.1f}) and was left out"
        for block, w in dropped
        if block == match.n
    ]
    n_dropped = sum(block < match.n for block, _ in dropped)
    if n_dropped >= _MANY_LEFT_OUT * match.n:
        reasons.append(f"{n_dropped} of {match.n} matched markers had to be left out")
    if not scene.is_levelled:
        reasons.append("no AHRS: the levelling is only assumed")
    return reasons


def _fix(
    scene: _Scene,
    used: Index,
    adjustment: Adjustment[Array],
    excluded: tuple[Exclusion, ...],
    reasons: list[str],
) -> StationFix:
    """Assemble a fix, back in the unshifted site frame."""
    T, n = adjustment.estimate, len(used)
    shift = np.eye(6)
    shift[3:, :3] = skew(scene.middle)
    T_site_base = rigid(T[:3, :3], T[:3, 3] + scene.middle)
    first, second = np.triu_indices(n, 1)
    centres = scene.centres_base[used[:, 0]]
    angles = included_angle(centres[first], centres[second])
    return StationFix(
        method="free_station",
        T_site_station=T_site_base @ inverse(rigid(scene.R_station_base, np.zeros(3))),
        cov_T_site_station=shift @ adjustment.cov @ shift.T,
        matches=used,
        residuals_site=adjustment.groups[0].residuals,
        redundancies=adjustment.redundancies[:n],
        w_statistics=adjustment.w_statistics[:n],
        detectable_biases=adjustment.detectable_biases[:n],
        external_reliabilities=external_reliabilities(adjustment, _position_by_motion(T))[:n],
        dof=adjustment.dof,
        sigma0=adjustment.sigma0,
        passes_global_test=adjustment.passes_global_test,
        included_angles=np.array([angles.min(), angles.max()]),
        status=Status.WEAK if reasons else Status.OK,
        reason="; ".join(reasons),
        excluded=excluded,
    )


def _position_by_motion(T: Array) -> Array:
    """Return the derivative of the positions of poses, (..., 4, 4), by small motions."""
    p = T[..., :3, 3]
    return np.concatenate([-skew(p), np.broadcast_to(np.eye(3), (*p.shape, 3))], axis=-1)


def free_station_pairs(
    fix: StationFix, fits: MarkerFits, marks: ControlMarks, config: ResectionConfig
) -> PairFixes:
    """Position a station from each pair of its markers and gravity, all pairs at once.

    Parameters
    ----------
    fix : StationFix
        The fix from all markers.
    fits : MarkerFits
        The fits that it came from.
    marks : ControlMarks
        The marks that it came from.
    config : ResectionConfig
        As for the fix.

    Returns
    -------
    PairFixes
        With the sigma that the same model gives each pair.
    """
    scene = _scene(fits, marks, config)
    first, second = np.triu_indices(len(fix.matches), 1)
    pairs = np.stack([fix.matches[first], fix.matches[second]], axis=1)
    pairs = pairs[np.array([_has_heading(scene, pair) for pair in pairs], dtype=np.bool_)]
    start = fix.T_site_station @ rigid(scene.R_station_base, np.zeros(3))
    start[:3, 3] -= scene.middle
    solution = _solve(scene, pairs, np.tile(start, (len(pairs), 1, 1)))
    J = _position_by_motion(solution.estimate)
    cov_p_site = J @ solution.cov @ np.swapaxes(J, -1, -2)
    v, w = np.moveaxis(scene.centres_base[pairs[..., 0]], 1, 0)
    flat = np.array([1.0, 1.0, 0.0])
    return PairFixes(
        method="free_station",
        marks=pairs[..., 1],
        included_angles=included_angle(v, w),
        included_angles_horizontal=included_angle(
            v @ scene.R_station_base.T * flat, w @ scene.R_station_base.T * flat
        ),
        p_site=solution.estimate[:, :3, 3] + scene.middle,
        sigma_3d=np.sqrt(np.trace(cov_p_site, axis1=1, axis2=2)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Method:
    """What a resection method can do."""

    resect: Callable[[MarkerFits, ControlMarks, ResectionConfig], StationFix]
    resect_pairs: Callable[[StationFix, MarkerFits, ControlMarks, ResectionConfig], PairFixes]


_METHODS = {"free_station": _Method(free_station, free_station_pairs)}


def _method(name: str) -> _Method:
    """Return the named method."""
    if name not in _METHODS:
        raise ConfigError(f"There is no resection method {name!r}; known: {', '.join(_METHODS)}.")
    return _METHODS[name]
