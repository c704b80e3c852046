"""Markers among ground, rocks, poles and people: which returns of a stop may be a sphere.

``extract`` finds them. Inside,

- ``target`` is the sphere that is searched for,
- ``cells`` sorts returns by place and direction,
- ``ground`` separates the ground, ``seeds`` picks the places to examine,
- ``features`` measures the shape of the returns about a place,
- ``evidence`` gathers the beams towards and about a group, ``pulses`` those without a return,
- ``faces`` are the two sides from which a turn sweeps each place, ``latency`` is how late the
  angles of a gimbal are that goes by steps,
- ``beams`` chooses those to compare, and describes what stands behind and beside,
- ``support`` is what holds an object up,
- ``shapes`` are what may stand there, ``search`` finds the likeliest of each kind by ``maxima`` of
  the likelihood, and ``volumes`` says how much of its prior that leaves,
- ``hypotheses`` compares the sphere with the others,
- ``decision`` says what a group is, and how surely.

Works in the base frame with the levelled vertical. The sensor is taken as one point (the origin of
the base): a few centimetres of axis offset do not change which returns look like a sphere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from spheremark.pipelines.config import ExtractionConfig
from spheremark.pipelines.detection.beams import GATES
from spheremark.pipelines.detection.cells import Cells, cells_of
from spheremark.pipelines.detection.decision import (
    UNDECIDED,
    Judgement,
    distinct,
    gates_of,
    is_resolved,
    judgement_of,
    noise_of,
    paint_of,
    posteriors_of,
    reason_by_evidence,
    reason_by_features,
    shared_of,
    stones_of,
    sure_ones,
)
from spheremark.pipelines.detection.evidence import Evidence, gather_evidence
from spheremark.pipelines.detection.faces import Apart, apart_of, joined
from spheremark.pipelines.detection.features import (
    N_RESOLVED,
    NOISE_MIN,
    Features,
    measure_features,
)
from spheremark.pipelines.detection.ground import Ground, ground_of
from spheremark.pipelines.detection.hypotheses import (
    SIGMAS,
    STONES,
    USUAL,
    Physics,
    log_likelihoods,
    shown_by,
    usual_stones,
)
from spheremark.pipelines.detection.latency import late_by, on_time
from spheremark.pipelines.detection.pulses import Hearing
from spheremark.pipelines.detection.seeds import find_seeds
from spheremark.pipelines.detection.shapes import (
    BOULDER,
    N_PARAMETERS,
    NAMES,
    NOISE,
    POLE,
    SHIFT,
    SPHERE,
)
from spheremark.pipelines.detection.target import Target, blur_at
from spheremark.pipelines.model import (
    Array,
    Column,
    Index,
    MarkerCandidate,
    MarkerCandidates,
    Rejection,
    StitchedCloud,
    marker_name,
)
from spheremark.pipelines.threads import side_by_side

__all__ = ["extract"]

_MIDDLE = 0.87  # radii: incidence up to 60 degrees, as ASTM E3125-17 takes them
_SHARP = 0.06  # radii: scatter of scanners whose returns at a limb err by more than their noise
_POSSIBLE = 0.9  # probability from which a group that is no sure marker is a possible one
_N_REJECTED, _N_NOT_COMPARED = 200, 100  # groups, the likeliest first, kept with their reason
_COUNTS = 1e-3  # least probability of a marker that shows what markers have in common
_SIGMAS_LOG_NOISE = (0.3, 0.6)  # of one marker about the others of a scan; of a scan about a group

_N_ABOUT = 16  # returns about a refused group that show where it is by another mounting


class _Compared(NamedTuple):
    """A group that is compared: its features and its evidence."""

    features: Features
    evidence: Evidence


_Group = tuple[_Compared, Judgement, Array]


def extract(
    cloud: StitchedCloud, config: ExtractionConfig, marker_radius: float
) -> MarkerCandidates:
    """Find the groups of returns that may be spherical markers.

    Parameters
    ----------
    cloud : StitchedCloud
        One stop; rings and times are not needed.
    config : ExtractionConfig
        Ground grid, first tests, level of decision.
    marker_radius : float
        Radius of the spheres [m].

    Returns
    -------
    MarkerCandidates
        Candidates in the order of azimuth; possible ones; of the groups that passed the first test
        of size and were then rejected, the 200 most probable ones and 100 that were not compared,
        at most, with the reason; and the height of the highest ground point within 10 m, where the
        published method cuts its clouds.

    Notes
    -----
    A marker is a sphere of known radius, most often on a pole. Each place where a surface ends
    upward and to a side is a seed: mean shift of a disc of the sphere's size, a robust fit along
    the beams; then the beams about it are compared under nine hypotheses. Ground is the opening of
    the lowest point per cell. Where no ground was seen, nothing is cut. Cost grows linearly with
    the returns; it doubles where the two faces of the scan show the markers apart, or a gimbal that
    goes by steps is late, for the search is then done again with a mounting and a clock by which
    all agree.
    """
    if not cloud.intensities.any():  # not recorded: all things are as bright
        cloud = replace(cloud, intensities=np.ones_like(cloud.intensities))
    found, apart = _extracted(cloud, config, marker_radius)
    late = late_by(cloud, found.candidates, marker_radius)
    if apart is None and not late:
        return found
    again = on_time(cloud if apart is None else joined(cloud, apart), late)
    found, _ = _extracted(again, config, marker_radius)
    return _moved_back(found, again.p_base, cloud.p_base)


def _extracted(
    cloud: StitchedCloud, config: ExtractionConfig, marker_radius: float
) -> tuple[MarkerCandidates, Apart | None]:
    """Return what is found in a scan, and how far apart its faces show it."""
    cells = cells_of(cloud, config)
    target = Target(marker_radius, cells.R_station_base[2], float(cloud.rig.divergence.max()))
    ground = ground_of(cloud, cells, config, marker_radius)
    seeds = find_seeds(ground.points_above, target, config.n_points_min)
    groups = distinct(measure_features(cloud, cells, seeds, target), config, marker_radius)
    compared, not_compared, hearing = _sifted(groups, cloud, (cells, ground), target)
    noise = noise_of([one.features for one in compared if one.evidence.shows_below], target.radius)
    logs, shifts = _log_likelihoods(compared, noise, hearing, config, target)
    by_shape = np.exp(_posteriors(compared, logs, marker_radius)[:, SPHERE]).tolist()
    places = np.array([one.features.p_base for one in compared]).reshape(-1, 3)
    evidence = [one.evidence for one in compared]
    log_ratios, by_paint = paint_of(evidence, places, by_shape, marker_radius)
    logs[:, 0] += log_ratios
    judgements = [judgement_of(own, NAMES) for own in _posteriors(compared, logs, marker_radius)]
    is_sure = sure_ones([one.probability for one in judgements], config.false_rate)
    markers, possible, rejected = list[_Group](), list[Rejection](), list[Rejection]()
    for one, judgement, paint, sure, own in zip(
        compared, judgements, by_paint, is_sure, logs, strict=True
    ):
        if sure:
            markers.append((one, judgement, own))
            continue
        refused = replace(
            _rejection(one.features, judgement.reason + paint),
            probability=judgement.probability,
            log_likelihoods=own.copy(),
        )
        if judgement.probability >= _POSSIBLE:
            members = _members(one.features, one.evidence, target)
            possible.append(replace(refused, members=members))
        else:
            rejected.append(refused)
    rejected.sort(key=lambda one: -one.probability)
    found = MarkerCandidates(
        candidates=_candidates(markers, target),
        possible=tuple(possible),
        rejected=(*rejected[:_N_REJECTED], *not_compared[:_N_NOT_COMPARED]),
        ground_height_max=ground.height_max,
    )
    is_shown = np.array(is_sure, np.bool_) & shifts.any(axis=1)
    distances = np.linalg.norm(places[is_shown], axis=1)
    return found, apart_of(marker_radius * shifts[is_shown], distances)


def _sifted(
    groups: list[Features], cloud: StitchedCloud, known: tuple[Cells, Ground], target: Target
) -> tuple[list[_Compared], list[Rejection], Hearing]:
    """Return the groups to compare; the others, those that came farthest first; the hearing."""
    reasons = [reason_by_features(features, target.radius) for features in groups]
    passed = [i for i, reason in enumerate(reasons) if not reason]
    centres = np.array([groups[i].p_base for i in passed]).reshape(-1, 3)
    gathered, hearing = gather_evidence(cloud, *known, centres, target)
    compared, rejected = list[_Compared](), list[Rejection]()
    for i, evidence in zip(passed, gathered, strict=True):
        reason = reason_by_evidence(groups[i], evidence, target)
        if reason:
            rejected.append(_rejection(groups[i], reason))
            continue
        compared.append(_Compared(groups[i], evidence))
    rejected += [_rejection(groups[i], reason) for i, reason in enumerate(reasons) if reason]
    return compared, rejected, hearing


def _moved_back(found: MarkerCandidates, points: Column, others: Column) -> MarkerCandidates:
    """Return all groups with their places as other points of the same returns show them."""

    def moved(p: Array, rows: Index) -> Array:
        return np.asarray(p + np.mean(others[rows] - points[rows], axis=0))

    places = np.array([one.p_base for one in found.rejected]).reshape(-1, 3)
    seen = np.flatnonzero(np.isfinite(points).all(axis=1))  # no return is at no place
    nearest = seen[KDTree(points[seen]).query(places, k=range(1, min(_N_ABOUT, len(seen)) + 1))[1]]
    return replace(
        found,
        candidates=tuple(
            replace(one, p_base_rough=moved(one.p_base_rough, one.members))
            for one in found.candidates
        ),
        possible=tuple(
            replace(one, p_base=moved(one.p_base, one.members)) for one in found.possible
        ),
        rejected=tuple(
            replace(one, p_base=moved(one.p_base, rows))
            for one, rows in zip(found.rejected, nearest, strict=True)
        ),
    )


def _rejection(features: Features, reason: str) -> Rejection:
    """Return a group that is not used."""
    return Rejection(p_base=features.p_base, n_points=features.n_points, reason=reason)


def _log_likelihoods(
    compared: list[_Compared],
    noise: float,
    hearing: Hearing,
    config: ExtractionConfig,
    target: Target,
) -> tuple[Array, Array]:
    """Return the logarithms of the likelihoods of some groups by all hypotheses, (n, k).

    And how far apart the faces show the best spheres, (n, 3) radii; zero where one does alone. What
    markers have in common, as noise, where beams come to hit an outline and how far echoes merge,
    is known from all of the scan, by how probably each is one; and how rough its stones are.
    """
    n = len(compared)
    found, shapes = np.empty((n, len(NAMES))), [np.empty((0, N_PARAMETERS))] * n
    physics = [_physics(one.features, noise, hearing, config, target.radius) for one in compared]

    def compare(rows: Sequence[int]) -> None:
        for i in rows:
            features, evidence = compared[i]
            found[i], shapes[i] = log_likelihoods(
                evidence, features.p_base, target, physics[i], shapes[i]
            )

    side_by_side(lambda first, end: compare(range(first, end)), n, threaded_from=4)
    if n:
        physics = _as_others_show(compared, found, np.array(shapes), physics, target)
    again = np.flatnonzero(found[:, 0] > found.max(axis=1, initial=-np.inf) - UNDECIDED)
    side_by_side(lambda first, end: compare(again[first:end].tolist()), len(again), threaded_from=4)
    return found, np.array([own[SPHERE, SHIFT:POLE] for own in shapes]).reshape(-1, 3)


def _as_others_show(
    compared: list[_Compared],
    found: Array,
    shapes: Array,
    physics: list[Physics],
    target: Target,
) -> list[Physics]:
    """Return the physics of each group as all others show it, by the best shapes of all kinds."""
    shares = np.exp(_posteriors(compared, found, target.radius))
    shared = np.array([one.shared for one in physics])
    covs = np.array([np.diag(one.sigmas**2) for one in physics])  # it shows nothing
    by_gate = np.zeros((len(compared), len(GATES)))
    rows = np.flatnonzero(shares[:, SPHERE] > _COUNTS)

    def show(first: int, end: int) -> None:
        for i in rows[first:end]:
            (features, evidence), sphere = compared[i], shapes[i, SPHERE]
            shared[i], covs[i], by_gate[i] = shown_by(
                evidence, features.p_base, target, physics[i], sphere
            )

    side_by_side(show, len(rows), threaded_from=4)
    probabilities = shares[:, SPHERE].tolist()
    half_widths = np.array([one.evidence.blur.mean() for one in compared])
    known = shared_of((shared, covs), probabilities, physics, half_widths)
    gates = gates_of(by_gate, probabilities)
    usual = np.array([usual_stones(own[0], target.radius) for own in known[0]])
    n_returns = [one.features.n_points for one in compared]
    scatters = shapes[:, BOULDER, NOISE]
    stones = stones_of(scatters, n_returns, shares[:, BOULDER], physics, usual)
    return [
        one._replace(shared=means, sigmas=sigmas, gates=gates, stones=np.array(own))
        for one, means, sigmas, *own in zip(physics, *known, *stones, strict=True)
    ]


def _posteriors(compared: list[_Compared], logs: Array, radius: float) -> Array:
    """Return the logarithms of the probabilities of all hypotheses, of each group, (n, k)."""
    n_returns = [one.features.n_points for one in compared]
    return posteriors_of(logs, n_returns, [one.evidence.stands_free(radius) for one in compared])


def _physics(
    features: Features, noise: float, hearing: Hearing, config: ExtractionConfig, radius: float
) -> Physics:
    """Return what a scan shows of its physics, at a group."""
    least = 0.0 if features.n_points >= N_RESOLVED else NOISE_MIN
    own = min(max(features.scatter, least), config.scatter_max)
    log_noise, sigma = (
        np.log(own if np.isnan(noise) else noise),
        _SIGMAS_LOG_NOISE[int(np.isnan(noise))],
    )
    means, sigmas = np.array([log_noise, *USUAL]), np.array([sigma, *SIGMAS])
    stones = np.array([usual_stones(log_noise, radius), np.hypot(*STONES)])
    return Physics(means, sigmas, *hearing, stones)


def _candidates(found: list[_Group], target: Target) -> tuple[MarkerCandidate, ...]:
    """Return candidates M01, M02 ... by azimuth."""
    ordered = sorted(found, key=lambda group: np.arctan2(group[0].features.y, group[0].features.x))
    return tuple(
        MarkerCandidate(
            name=marker_name(place),
            members=_members(one.features, one.evidence, target),
            p_base_rough=one.features.p_base,
            probability=judgement.probability,
            hypothesis=judgement.hypothesis,
            log_likelihoods=logs.copy(),
        )
        for place, (one, judgement, logs) in enumerate(ordered)
    )


def _members(features: Features, evidence: Evidence, target: Target) -> Index:
    """Return the rows on and about a sphere, ascending: its limb, and the pole that touches it.

    Of a resolved sphere that noise hardly blurs, only its middle: the returns at its limb, which
    belong partly to the background, would weigh more than the noise of all the others.
    """
    across, along, depth = evidence.seen
    reach = 1.5 * target.radius + blur_at(features.p_base, target)
    if is_resolved(features, target.radius) and features.scatter < _SHARP * target.radius:
        reach = _MIDDLE * target.radius
    is_about = across * across + along * along < reach * reach
    is_level = (depth > -2.2 * target.radius) & (depth < 1.6 * target.radius)
    return np.asarray(evidence.rows[is_about & is_level], dtype=np.intp)
