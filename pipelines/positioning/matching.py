"""Which marker is which control mark, with the tests of a match.

Markers carry no labels. All is computed in a site frame that is shifted to the middle of the
control marks, so that large coordinates cost no digits.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import comb

import numpy as np

from spheremark.pipelines.config import ResectionConfig
from spheremark.pipelines.errors import (
    AmbiguousMatchError,
    DegenerateGeometryError,
    NoMatchError,
    SolveError,
)
from spheremark.pipelines.estimation.least_squares import (
    Observations,
    Solution,
    Solutions,
    solve,
    solve_each,
)
from spheremark.pipelines.estimation.linear_algebra import invert_each
from spheremark.pipelines.geometry import (
    by_motion,
    levelling_rotation,
    rigid,
    rot_z,
    skew,
    transform,
    unit,
    up_by_lean,
)
from spheremark.pipelines.model import Array, ControlMarks, Index, MarkerFits
from spheremark.pipelines.positioning.hypotheses import (
    IDENTITY,
    Hypotheses,
    Spans,
    agreements,
    align,
    assign,
    pairs_far_first,
)

_N_SOLUTIONS = 6  # that are refined: the best, and alternatives enough to see an ambiguity
_N_ROUNDS = 8  # of adjusting and matching again; two or three are the rule
_ALTERNATIVE = (
    14.0  # -2 ln(0.001): how much better, in the weighted sum of squares, the best must be
)
_ALTERNATIVE_SHARE = 0.5  # of the matches of the best that an alternative needs to be refined
_N_DISSENT = 3  # other markers that agree on another place: control contradicts itself
_PAIR = 25.0  # weighted sum of squares (2 dof) above which two markers are not those two marks
_CHANCE = 0.01  # expected number of chance agreements above which a match is none
_SHARED = 0.55  # of the variance along a line of sight, at most, that all centres share
_SHARED_REPORTED = 0.98  # the same where fits report how much
_SHARE = 0.4  # of markers or marks, the fewer: of mirrored fields five in fourteen may still fit


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Scene:
    """The observations and control of a station, as arrays."""

    names: tuple[str, ...]  # of the control marks
    centres_base: Array  # (n, 3) fitted centres [m]
    cov_centres: Array  # (n, 3, 3) their covariances in base, ``sigma_common`` included [m^2]
    marks_site: Array  # (m, 3) control marks relative to ``middle`` [m]
    cov_marks: Array  # (m, 3, 3) their covariances [m^2]
    middle: Array  # (3,) middle of the control marks in the site frame [m]
    R_station_base: Array  # (3, 3) the measured levelling; its last row is the up direction in base
    J_up: Array  # (3, 2) derivative of the up direction by roll and pitch
    sigma_level: float  # standard deviation of each of the two angles [rad]
    is_levelled: bool  # whether they were measured
    # standard deviation of the heading that mounting, encoder and clocks leave unknown [rad]
    sigma_heading: float
    # (n, 3, k) factors of the errors that centres have in common, in base: the covariance of two is
    # the product of theirs; and the part of it that the covariances of the centres contain [m]
    shared_base: Array
    included_base: Array

    @property
    def cov_own(self) -> Array:
        """Covariances of the centres without what they have in common, (n, 3, 3) [m^2]."""
        included = self.included_base
        return np.asarray(self.cov_centres - included @ np.swapaxes(included, 1, 2))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Match:
    """Which fit is which mark, and the pose that goes with it."""

    marks: Index  # (n,) place of each fit's mark among the control marks; -1 for none
    T_site_base: Array  # (4, 4) pose of base, relative to the middle of the marks [m]
    vtpv: float  # weighted sum of squares of the residuals, gravity included
    dof: int  # degrees of freedom
    largest_residual: float  # of the matched fits [m]
    # (k, 3) where base would stand, relative to the middle of the marks, by other matches of two
    # markers that explain them about as well; no rows for three or more [m]
    alternatives: Array = field(default_factory=lambda: np.zeros((0, 3)))
    # (k, 4) how many other markers agree on another place than these, and where base would stand by
    # them, relative to the middle of the marks [m]: control that contradicts itself
    dissent: Array = field(default_factory=lambda: np.zeros((0, 4)))

    @property
    def n(self) -> int:
        """Number of matched fits."""
        return int(np.sum(self.marks >= 0))

    @property
    def pairs(self) -> Index:
        """Places among fits and marks, (n, 2)."""
        fits = np.flatnonzero(self.marks >= 0)
        return np.stack([fits, self.marks[fits]], axis=1)


def gather(fits: MarkerFits, marks: ControlMarks, config: ResectionConfig) -> Scene:
    """Gather observations and control of a station.

    Parameters
    ----------
    fits : MarkerFits
        Centres in base; at least one.
    marks : ControlMarks
        Known places; at least one.
    config : ResectionConfig
        The sigma that all centres have in common.

    Returns
    -------
    Scene
        Both as arrays.
    """
    levelling = fits.levelling
    middle = marks.p_site.mean(axis=0)
    p_base = np.stack([fit.p_base for fit in fits.fits])
    cov_p_base = np.stack([fit.cov_p_base for fit in fits.fits])
    cov_p_base += config.sigma_common**2 * np.eye(3)
    shared, included = _in_common(fits, p_base, cov_p_base, config)
    R_station_base = levelling_rotation(levelling)
    of_heights = np.tile(config.sigma_height * R_station_base[2], (len(p_base), 1))
    return Scene(
        names=marks.names,
        centres_base=p_base,
        cov_centres=cov_p_base,
        marks_site=marks.p_site - middle,
        cov_marks=marks.cov_p_site,
        middle=middle,
        R_station_base=R_station_base,
        J_up=up_by_lean(levelling),
        sigma_level=levelling.sigma,
        is_levelled=levelling.is_measured,
        sigma_heading=levelling.sigma_heading_station,
        shared_base=np.concatenate([shared, of_heights[:, :, None]], axis=2),
        included_base=included,
    )


def _in_common(
    fits: MarkerFits, p_base: Array, cov_p_base: Array, config: ResectionConfig
) -> tuple[Array, Array]:
    """Return factors of what centres have in common, and of what their covariances hold of it.

    Fits report both in full, or a sigma of range, or nothing.
    """
    v = unit(p_base)[..., None]
    if len({fit.shared_base.shape for fit in fits.fits}) == 1 and fits.fits[0].shared_base.size:
        factors = np.stack([fit.shared_base for fit in fits.fits])
        if config.sigma_range:
            return factors, factors
        return factors - v @ (np.swapaxes(v, 1, 2) @ factors), factors
    sigmas = np.array([fit.sigma_range_shared for fit in fits.fits])
    variances = shared_variances(p_base, cov_p_base, sigmas, config)
    is_reported = bool(np.isfinite(sigmas).all()) and config.sigma_range > 0.0
    sigma = float(np.median(sigmas)) if is_reported else config.sigma_range
    return sigma * v, np.sqrt(variances)[:, None, None] * v


def shared_variances(
    p_base: Array, cov_p_base: Array, sigmas_shared: Array, config: ResectionConfig
) -> Array:
    """Return how much of the variance of centres is an error of range that they all share.

    Parameters
    ----------
    p_base : (n, 3)
        Centres [m].
    cov_p_base : (n, 3, 3)
        Their covariances [m^2].
    sigmas_shared : (n,)
        The sigma of range that they share, from their fits; NaN where these have none [m].
    config : ResectionConfig
        The same sigma for those without.

    Returns
    -------
    (n,)
        Variance along each line of sight, less than what the centre has if all else of it were
        known [m^2].

    Notes
    -----
    The covariance of a centre says how far it may be off, biases of lasers included. Those are the
    same for all centres: taken as independent, they would seem to blur the place of a station
    among marks on all sides, where they cancel.
    """
    v = unit(p_base)
    own = 1.0 / np.einsum("ni,ni->n", v, (invert_each(cov_p_base)[0] @ v[..., None])[..., 0])
    is_reported = np.isfinite(sigmas_shared)
    sigmas = np.where(is_reported, sigmas_shared, config.sigma_range_shared)
    most = np.where(is_reported, _SHARED_REPORTED, _SHARED)
    return np.asarray(np.minimum(sigmas**2, most * own))


def own_covariances(p_base: Array, cov_p_base: Array, variances: Array) -> Array:
    """Return the covariances of centres without the error of range that all of them share.

    Parameters
    ----------
    p_base : (n, 3)
        Centres [m].
    cov_p_base : (n, 3, 3)
        Their covariances in full [m^2].
    variances : (n,)
        How much of each is shared, from ``shared_variances`` [m^2].

    Returns
    -------
    (n, 3, 3)
        Covariances of what is each centre's own [m^2].
    """
    v = unit(p_base)
    return np.asarray(cov_p_base - variances[:, None, None] * v[:, :, None] * v[:, None, :])


def cov_of_shared(scene: Scene, fits: Index, effects: Array) -> Array:
    """Return the correction of a covariance for errors common to all centres.

    ``effects``, (..., k, p, 3), are the derivatives of the estimates by the centres ``fits``,
    (..., k), in base.

    Notes
    -----
    Errors of ranges and of the mounting are in the covariance of each centre, as if they were its
    own; an error of all heights is not. The estimate is the same: only how sure it is, changes.
    """
    together = (effects @ scene.shared_base[fits]).sum(axis=-3)
    own = effects @ scene.included_base[fits]
    cov = together @ np.swapaxes(together, -1, -2)
    return np.asarray(cov - (own @ np.swapaxes(own, -1, -2)).sum(axis=-3))


def match_marks(scene: Scene, config: ResectionConfig, spans: Spans | None = None) -> Match:
    """Match fits to marks.

    Parameters
    ----------
    scene : Scene
        Centres and marks.
    config : ResectionConfig
        How far a marker may be from its mark.
    spans : Spans, optional
        Distances between these marks, up to the largest between fits plus a tolerance; computed
        once where many stations are matched to the same marks.

    Returns
    -------
    Match
        Two matched fits or more, refined by an adjustment.

    Raises
    ------
    DegenerateGeometryError
        If all markers or all marks stand on one plumb line.
    NoMatchError
        If the markers do not agree with the marks better than chance.
    AmbiguousMatchError
        If they agree in two different ways equally well.

    Notes
    -----
    Two fits and two marks with the same distance and the same difference of height give a heading
    and a translation; a mirror image never does. The poses with most votes are tried on all fits,
    the best are refined and compared. Two marks, or two markers, have one distance and one
    difference of height: the pair that keeps both best is taken, and ``Match.alternatives`` holds
    where else it would fit. Cost grows with the square of the fits times the pairs of marks that
    are no farther apart than they, to 300,000 pairs of pairs, then no more.
    """
    levelled = scene.centres_base @ scene.R_station_base.T
    _refuse_plumb_line(levelled, "markers", config)
    _refuse_plumb_line(scene.marks_site, "control marks", config)
    if min(len(levelled), len(scene.marks_site)) == 2:
        return _matched_pair(levelled, scene, config)
    slope = 3.0 * scene.sigma_level
    hypotheses = align(levelled, scene.marks_site, config.match_tolerance, slope, spans)
    solutions = _solutions(hypotheses, levelled, scene, config)
    if not solutions:
        raise NoMatchError(
            f"No two of the {len(levelled)} markers have the distance and the difference of height "
            f"of any two of the {len(scene.marks_site)} control marks (within "
            f"{config.match_tolerance} m): these are marks of another field, or in other units or "
            "axes, or false markers."
        )
    best = solutions[0]
    _refuse_chance(best, scene, config)
    n_others = sum(_is_alternative(other, best) for other in solutions[1:])
    if n_others:
        raise AmbiguousMatchError(
            f"{best.n} of {len(levelled)} markers fit the control marks in {n_others + 1} or "
            "more different ways equally well: several pairs of marks have the same distances "
            "(a symmetric field). Survey more markers, or move one so that no distance repeats."
        )
    return replace(best, dissent=_contradicting_matches(best, solutions[1:], scene))


def contradiction(match: Match, scene: Scene) -> str:
    """Return that other markers agree on another place of the station; empty if none do."""
    if not len(match.dissent):
        return ""
    n, *place = match.dissent[0]
    x, y, z = np.array(place) + scene.middle
    off = float(np.linalg.norm(np.array(place) - match.T_site_base[:3, 3]))
    return (
        f"the control marks contradict each other: {match.n} markers fit here, and {n:.0f} others "
        f"fit at ({x:.2f}, {y:.2f}, {z:.2f}) m, {off:.2f} m away"
    )


def observe(scene: Scene, pairs: Index, T: Array) -> tuple[Observations, Observations]:
    """Linearise centres and gravity at a pose of base, or at many."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    turned, back = R[..., None, :, :], np.swapaxes(R, -1, -2)
    p_site = scene.centres_base[pairs[..., 0]] @ back + t[..., None, :]
    centres = Observations(
        residuals=p_site - scene.marks_site[pairs[..., 1]],
        J=by_motion(p_site),
        cov=turned @ scene.cov_centres[pairs[..., 0]] @ back[..., None, :, :]
        + scene.cov_marks[pairs[..., 1]],
    )
    up = R @ scene.R_station_base[2]
    J_up = scene.sigma_level * (R @ scene.J_up)[..., :2, :]
    J = np.zeros((*up.shape[:-1], 1, 2, 6))
    J[..., 0, :, :3] = -skew(up)[..., :2, :]
    gravity = Observations(
        residuals=up[..., None, :2],
        J=J,
        cov=(J_up @ np.swapaxes(J_up, -1, -2))[..., None, :, :],
    )
    return centres, gravity


def observe_together(scene: Scene, pairs: Index, T: Array) -> tuple[Observations, Observations]:
    """Linearise centres as one block, with what they have in common, and gravity at many poses.

    Parameters
    ----------
    scene : Scene
        Centres and marks.
    pairs : (s, k, 2)
        Places among fits and marks of each pose.
    T : (s, 4, 4)
        Poses of base, relative to the middle of the marks [m].

    Returns
    -------
    tuple of Observations
        One block of 3 k coordinates, and one of gravity.
    """
    alone, gravity = observe(replace(scene, cov_centres=scene.cov_own), pairs, T)
    shared = T[:, None, :3, :3] @ scene.shared_base[pairs[..., 0]]
    n = len(T)
    return Observations(
        residuals=alone.residuals.reshape(n, 1, -1),
        J=alone.J.reshape(n, 1, -1, alone.J.shape[-1]),
        cov=cov_together(alone.cov, shared)[:, None],
    ), gravity


def cov_together(own: Array, shared: Array) -> Array:
    """Return the covariance of k centres in one matrix.

    Parameters
    ----------
    own : (..., k, 3, 3)
        Covariances of what is each centre's own [m^2].
    shared : (..., k, 3, q)
        Factors of what they have in common [m].

    Returns
    -------
    (..., 3 k, 3 k)
        Their covariance [m^2].
    """
    *problems, k, _, q = shared.shape
    factors = shared.reshape(*problems, 3 * k, q)
    cov = np.asarray(factors @ np.swapaxes(factors, -1, -2))
    blocks, i = cov.reshape(*problems, k, 3, k, 3), np.arange(k)
    blocks[..., i, :, i, :] += np.moveaxis(own, -3, 0)
    return cov


def moved(T: Array, xi: Array) -> Array:
    """Move poses on the left by small motions, to first order.

    Parameters
    ----------
    T : (..., 4, 4)
        Poses [m].
    xi : (..., 6)
        Rotation [rad] and translation [m].

    Returns
    -------
    (..., 4, 4)
        ``Exp(xi) T`` up to the square of ``xi``; rotations stay rotations (Cayley's transform).
    """
    turn = skew(xi[..., :3])
    square = np.sum(xi[..., :3] ** 2, axis=-1)[..., None, None]
    out = np.array(T)
    out[..., :3, :] += (turn + 0.5 * turn @ turn) @ T[..., :3, :] / (1.0 + 0.25 * square)
    out[..., :3, 3] += xi[..., 3:]
    return out


def solve_pose(scene: Scene, pairs: Index, start: Array) -> Solution:
    """Find the pose of base, (4, 4), from some pairs, (k, 2), and gravity."""
    return solve(lambda T: observe(scene, pairs, T), moved, start)


def solve_poses(scene: Scene, pairs: Index, start: Array) -> Solutions:
    """Find a pose of base from each of many sets of pairs, what they share, and gravity.

    Parameters
    ----------
    scene : Scene
        Centres and marks.
    pairs : (s, k, 2)
        Places among fits and marks of each set.
    start : (4, 4)
        Approximate pose of base, common to all, relative to the middle of the marks [m].

    Returns
    -------
    Solutions
        Poses with covariances of small motions on the left.
    """
    starts = np.tile(start, (len(pairs), 1, 1))
    return solve_each(lambda T, rows: observe_together(scene, pairs[rows], T), moved, starts)


def _refuse_plumb_line(p: Array, kind: str, config: ResectionConfig) -> None:
    """Raise DegenerateGeometryError if no two points are apart enough to give a heading."""
    apart = float(np.linalg.norm(np.ptp(p[:, :2], axis=0)))
    if apart <= 2.0 * config.match_tolerance:
        raise DegenerateGeometryError(
            f"All {kind} stand on one plumb line (within {apart:.2f} m; more than "
            f"{2.0 * config.match_tolerance} m is needed): the heading stays open."
        )


def _matched_pair(levelled: Array, scene: Scene, config: ResectionConfig) -> Match:
    """Return the match of two markers and two marks that keeps distance and height best."""
    pairs, misfits = _pair_misfits(levelled, scene, config)
    best = int(np.argmin(misfits)) if len(misfits) else -1
    has_choice = max(len(levelled), len(scene.marks_site)) > 2
    if best < 0 or (has_choice and misfits[best] > _PAIR):
        raise NoMatchError(
            f"No two of the {len(levelled)} markers have the distance and the difference of height "
            f"of any two of the {len(scene.marks_site)} control marks (within "
            f"{config.match_tolerance} m, and what their sigmas allow): these are marks of another "
            "field, or false markers."
        )
    alternatives = np.flatnonzero(misfits <= misfits[best] + _ALTERNATIVE)
    poses = [
        _pair_pose(levelled, scene, pairs[k]) for k in (best, *alternatives[alternatives != best])
    ]
    solution = solve_pose(scene, pairs[best], poses[0])
    marks = np.full(len(levelled), -1, dtype=np.intp)
    marks[pairs[best, :, 0]] = pairs[best, :, 1]
    return Match(
        marks=marks,
        T_site_base=solution.estimate,
        vtpv=solution.vtpv,
        dof=2,
        largest_residual=float(np.linalg.norm(solution.groups[0].residuals, axis=1).max()),
        alternatives=np.array([T[:3, 3] for T in poses[1:]]).reshape(-1, 3),
    )


def _pair_misfits(levelled: Array, scene: Scene, config: ResectionConfig) -> tuple[Index, Array]:
    """Return pairs of fits on pairs of marks, (h, 2, 2), and how badly each keeps its shape.

    The misfit is the weighted sum of squares of distance and difference of height, (h,).
    """
    first, second = pairs_far_first(len(levelled))
    a, b = np.nonzero(~np.eye(len(scene.marks_site), dtype=np.bool_))
    rows, columns = (k.ravel() for k in np.indices((len(first), len(a))))
    pairs = np.stack(
        [
            np.stack([first[rows], a[columns]], axis=1),
            np.stack([second[rows], b[columns]], axis=1),
        ],
        axis=1,
    )
    spans = levelled[pairs[:, 1, 0]] - levelled[pairs[:, 0, 0]]
    targets = scene.marks_site[pairs[:, 1, 1]] - scene.marks_site[pairs[:, 0, 1]]
    level = np.hypot(spans[:, 0], spans[:, 1])
    cov = scene.cov_centres[pairs[..., 0]].sum(axis=1) + scene.cov_marks[pairs[..., 1]].sum(axis=1)
    variance = np.trace(cov, axis1=1, axis2=2)  # of any direction at most
    stretch = np.linalg.norm(spans, axis=1) - np.linalg.norm(targets, axis=1)
    rise = spans[:, 2] - targets[:, 2]
    misfits = stretch**2 / variance + rise**2 / (variance + (level * scene.sigma_level) ** 2)
    tolerance = config.match_tolerance
    usable = (level > 2.0 * tolerance) & (np.abs(stretch) <= tolerance)
    usable &= np.abs(rise) <= tolerance + 3.0 * scene.sigma_level * level
    return pairs[usable], misfits[usable]


def _pair_pose(levelled: Array, scene: Scene, pair: Index) -> Array:
    """Return the pose of base, (4, 4), that lays two fits on two marks as well as a heading can."""
    p, q = levelled[pair[:, 0]], scene.marks_site[pair[:, 1]]
    span, target = p[1] - p[0], q[1] - q[0]
    R = rot_z(np.arctan2(target[1], target[0]) - np.arctan2(span[1], span[0]))
    return rigid(R @ scene.R_station_base, q.mean(axis=0) - R @ p.mean(axis=0))


def _solutions(
    hypotheses: Hypotheses, levelled: Array, scene: Scene, config: ResectionConfig
) -> list[Match]:
    """Return refined matches that differ from each other, the best first."""
    if not len(hypotheses.yaws):
        return []
    reach = float(np.linalg.norm(levelled, axis=1).max())
    slack = 1.0 + 3.0 * scene.sigma_level * reach / config.match_tolerance
    marks, scores = assign(levelled, hypotheses, scene.marks_site, config.match_tolerance, slack)
    counts = np.count_nonzero(marks >= 0, axis=1)
    solutions: list[tuple[float, Match]] = []
    for _ in range(_N_SOLUTIONS):
        best = int(np.argmax(scores))
        if scores[best] <= 0:
            break
        refined = None
        if counts[best] >= _ALTERNATIVE_SHARE * max((m.n for _, m in solutions), default=0):
            yaw, translation = hypotheses.yaws[best], hypotheses.translations[best]
            T = rigid(rot_z(yaw) @ scene.R_station_base, translation)
            refined = _refined(marks[best], T, scene, config)
        shared = agreements(marks, marks[best])
        if refined is not None:
            solutions.append(refined)
            shared = np.maximum(shared, agreements(marks, refined[1].marks))
        scores[2 * shared >= counts] = 0.0
        scores[best] = 0.0
    return [match for _, match in sorted(solutions, key=lambda item: -item[0])]


def _refined(
    marks: Index, T: Array, scene: Scene, config: ResectionConfig
) -> tuple[float, Match] | None:
    """Adjust a hypothesis to its matches and match again until nothing changes; with its score."""
    for _ in range(_N_ROUNDS):
        fits = np.flatnonzero(marks >= 0)
        if len(fits) < 2:
            return None
        try:
            solution = solve_pose(scene, np.stack([fits, marks[fits]], axis=1), T)
        except SolveError:
            return None
        T = solution.estimate
        placed = transform(T, scene.centres_base)
        again, scores = assign(placed, IDENTITY, scene.marks_site, config.match_tolerance, 1.0)
        if np.array_equal(again[0], marks):
            residuals = solution.groups[0].residuals
            return float(scores[0]), Match(
                marks=marks,
                T_site_base=T,
                vtpv=solution.vtpv,
                dof=3 * len(fits) - 4,
                largest_residual=float(np.linalg.norm(residuals, axis=1).max()),
            )
        marks = again[0]
    return None


def _is_alternative(other: Match, best: Match) -> bool:
    """Return whether another match differs and explains as many markers about as well."""
    if _n_others(other, best) * 2 > other.n:
        return False
    shared = int(np.sum((other.marks == best.marks) & (best.marks >= 0)))
    worse = (other.vtpv - best.vtpv) / max(1.0, best.vtpv / best.dof)
    return other.n >= best.n and 2 * shared < best.n and worse <= _ALTERNATIVE


def _contradicting_matches(best: Match, others: list[Match], scene: Scene) -> Array:
    """Return number of markers and position of each significant contradicting match, (k, 4)."""
    rows = []
    for other in others:
        n = _n_others(other, best)
        if n >= _N_DISSENT and 2 * n > other.n and _n_by_chance(other, scene) <= _CHANCE:
            rows.append([n, *other.T_site_base[:3, 3]])
    return np.array(sorted(rows, reverse=True)).reshape(-1, 4)


def _n_others(other: Match, best: Match) -> int:
    """Return how many markers another match explains that the best one does not."""
    return int(np.sum((other.marks >= 0) & (best.marks < 0)))


def _refuse_chance(match: Match, scene: Scene, config: ResectionConfig) -> None:
    """Raise NoMatchError if marks strewn at random would agree as well."""
    n, m, k = len(scene.centres_base), len(scene.marks_site), match.n
    if k < _SHARE * min(n, m):
        raise NoMatchError(
            f"Only {k} of {n} markers fit the {m} control marks within {config.match_tolerance} m, "
            f"and at least {int(np.ceil(_SHARE * min(n, m)))} must: these are marks of another "
            "field or in other axes, or too many markers are false."
        )
    expected = _n_by_chance(match, scene)
    if expected > _CHANCE:
        raise NoMatchError(
            f"Only {k} of {n} markers fit the {m} control marks within {config.match_tolerance} m, "
            f"and by chance {expected:.2g} such agreements are expected (at most {_CHANCE} is "
            "accepted): these are marks of another field, or too many markers are false."
        )


def _n_by_chance(match: Match, scene: Scene) -> float:
    """Return how many matches as good are expected of marks strewn at random.

    They are counted a contrario (Moisan and Stival 2004): pairs of fits on pairs of marks, times
    the ways to choose the others, times the share of the field's volume that lies as near to a mark
    as the worst of them.
    """
    n, m, k = len(scene.centres_base), len(scene.marks_site), match.n
    near = max(match.largest_residual, 3.0 * float(np.sqrt(scene.cov_centres.trace(0, 1, 2).min())))
    reach = float(np.linalg.norm(scene.centres_base, axis=1).max())
    near_height = near + 3.0 * scene.sigma_level * reach
    extent = np.maximum(np.ptp(scene.marks_site, axis=0), 2.0 * near)
    share_height = min(1.0, 2.0 * near_height / extent[2])
    share = min(1.0, m * np.pi * near**2 / (extent[0] * extent[1]) * share_height)
    share_pair = 2.0 * near / np.hypot(extent[0], extent[1]) * share_height
    return float(comb(n, 2) * m * (m - 1) * share_pair * comb(n - 2, k - 2) * share ** (k - 2))
