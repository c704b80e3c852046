"""Markers among ground, rocks, poles and people: which returns of a stop may be a sphere on a pole.

``extract`` finds them. Inside,

- ``target`` is the sphere that is searched for,
- ``cells`` sorts returns by place and direction,
- ``ground`` separates the ground, ``seeds`` picks the places to examine,
- ``neighbourhoods`` gathers the returns about a place, ``features`` measures their shape,
- ``evidence`` counts where the beams towards and about a group end, ``pulses`` those of which no
  return shows it,
- ``hypotheses`` compares the sphere with other shapes,
- ``decision`` gives the reasons why a group is no marker.

Works in the base frame with the levelled vertical. The sensor is taken as one point (the origin of
the base): a few centimetres of axis offset do not change which returns look like a sphere.
"""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.config import ExtractionConfig
from spheremark.pipelines.detection.cells import cells_of
from spheremark.pipelines.detection.decision import (
    Reference,
    distinct,
    is_resolved,
    reason_among_markers,
    reason_by_evidence,
    reason_by_features,
    reason_by_hypotheses,
    reference_of,
    spread_expected,
    with_reference_scatter,
)
from spheremark.pipelines.detection.evidence import Evidence, gather_evidence
from spheremark.pipelines.detection.features import NOISE_MIN, Features, measure_features
from spheremark.pipelines.detection.ground import ground_of
from spheremark.pipelines.detection.hypotheses import compare_hypotheses
from spheremark.pipelines.detection.seeds import find_seeds
from spheremark.pipelines.detection.target import Target
from spheremark.pipelines.model import (
    Index,
    MarkerCandidate,
    MarkerCandidates,
    Rejection,
    StitchedCloud,
    marker_name,
)

__all__ = ["extract"]

_MIDDLE = 0.87  # radii: incidence up to 60 degrees, as ASTM E3125-17 takes them
_REJECTIONS_MAX = 200  # the most sphere-like groups that are kept with their reason

_Group = tuple[Features, Evidence]


def extract(
    cloud: StitchedCloud, config: ExtractionConfig, marker_radius: float
) -> MarkerCandidates:
    """Find the groups of returns that may be spherical markers.

    Parameters
    ----------
    cloud : StitchedCloud
        One stop; rings and times are not needed.
    config : ExtractionConfig
        Ground grid, limits of the tests.
    marker_radius : float
        Radius of the spheres [m].

    Returns
    -------
    MarkerCandidates
        Candidates in the order of azimuth; of the groups that passed the first test of size and
        were then rejected, the (at most 200) most like a sphere, with the reason; and the height of
        the highest ground point within 10 m, where the published method cuts its clouds.

    Notes
    -----
    A marker is a sphere of known radius that stands free on a pole. Each place where a surface ends
    upward and to a side is a seed: mean shift of a disc of the sphere's size, a robust fit along
    the beams, then the tests of ``decision``. Ground is the opening of the lowest point per cell.
    Where no ground was seen, nothing is cut. Cost grows linearly with the returns.
    """
    cells = cells_of(cloud, config)
    target = Target(marker_radius, cells.R_station_base[2], float(cloud.rig.divergence.max()))
    ground = ground_of(cloud, cells, config)
    seeds = find_seeds(ground.points_above, target, config.n_points_min)
    groups = distinct(measure_features(cloud, cells, seeds, target), config, marker_radius)
    reasons = [reason_by_features(features, config, target) for features in groups]
    passed = [features for features, reason in zip(groups, reasons, strict=True) if not reason]
    centres = np.array([features.p_base for features in passed]).reshape(-1, 3)
    evidence = gather_evidence(cloud, cells.directions, centres, target)
    found, later = _decided(list(zip(passed, evidence, strict=True)), config, target)
    following = iter(later)
    reasons = [reason or next(following) for reason in reasons]
    rejected = [one for one in zip(groups, reasons, strict=True) if one[1]]
    return MarkerCandidates(
        candidates=_candidates(found, target),
        rejected=tuple(
            Rejection(p_base=features.p_base, n_points=features.n_points, reason=reason)
            for features, reason in rejected[:_REJECTIONS_MAX]
        ),
        ground_height_max=ground.height_max,
    )


def _decided(
    groups: list[_Group], config: ExtractionConfig, target: Target
) -> tuple[list[_Group], list[str]]:
    """Return the groups that may be markers, and for every group the reason against it.

    First each group by its own evidence; then against other shapes and the remaining groups, among
    which none scatters less than the others.
    """
    reasons = [reason_by_evidence(*group, target) for group in groups]
    reference = reference_of(
        [group for group, reason in zip(groups, reasons, strict=True) if not reason]
    )
    groups = [(with_reference_scatter(group[0], reference), group[1]) for group in groups]
    reasons = [
        reason or _reason_in_context(*group, reference, config, target)
        for group, reason in zip(groups, reasons, strict=True)
    ]
    return [group for group, reason in zip(groups, reasons, strict=True) if not reason], reasons


def _reason_in_context(
    features: Features,
    evidence: Evidence,
    reference: Reference,
    config: ExtractionConfig,
    target: Target,
) -> str:
    """Return why a group that passed alone is rejected among the others of the scan."""
    return (
        reason_by_features(features, config, target)
        or reason_by_evidence(features, evidence, target)
        or _reason_by_shape(features, evidence, target, reference.noise)
        or reason_among_markers(features, evidence, reference)
    )


def _reason_by_shape(features: Features, evidence: Evidence, target: Target, noise: float) -> str:
    """Return why another shape explains a group better; NaN noise stands for the group's own."""
    spread = evidence.spread / spread_expected(features, target)
    noise = max(features.scatter, NOISE_MIN) if np.isnan(noise) else noise
    return reason_by_hypotheses(compare_hypotheses(features, evidence.seen, spread, target, noise))


def _candidates(found: list[_Group], target: Target) -> tuple[MarkerCandidate, ...]:
    """Return candidates M01, M02 ... by azimuth."""
    ordered = sorted(found, key=lambda group: np.arctan2(group[0].y, group[0].x))
    return tuple(
        MarkerCandidate(
            name=marker_name(place),
            members=_members(features, evidence, target),
            p_base_rough=features.p_base,
        )
        for place, (features, evidence) in enumerate(ordered)
    )


def _members(features: Features, evidence: Evidence, target: Target) -> Index:
    """Return the rows on and about a sphere, ascending: its limb, and the pole that touches it.

    Of a resolved sphere, only its middle: the returns at its limb, which belong partly to the
    background, would weigh more than the noise of all the others.
    """
    across, along, depth = evidence.seen
    reach = 1.5 * target.radius + features.blur
    if is_resolved(features, target):
        reach = _MIDDLE * target.radius
    is_about = across * across + along * along < reach * reach
    is_level = (depth > -2.2 * target.radius) & (depth < 1.6 * target.radius)
    return np.asarray(evidence.rows[is_about & is_level], dtype=np.intp)
