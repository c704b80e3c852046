"""Markers among ground, rocks, poles and people: which returns of a stop may be a sphere on a pole.

``extract`` finds them. Inside,

- ``ball`` says what is looked for,
- ``cells`` sorts returns by place and direction,
- ``ground`` tells the ground, ``seeds`` picks the places that are worth a look,
- ``patches`` gathers the returns about a place, ``looks`` measures what they look like,
- ``sights`` counts where the beams towards and about a group end,
- ``rivals`` compares the ball with other shapes that may have stopped them,
- ``verdicts`` says why a group is no marker.

Works in the base frame with the levelled vertical. The sensor is taken as one point (the origin of
the base): a few centimetres of axis offset do not change which returns look like a sphere.
"""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.config import ExtractionConfig
from spheremark.pipelines.detection.cells import Cells, cells_of
from spheremark.pipelines.detection.decision import (
    Peers,
    among_peers,
    distinct,
    is_resolved,
    peers_among,
    score,
    spread_expected,
    verdict,
    verdict_among_peers,
    verdict_on_rivals,
    verdict_on_sight,
)
from spheremark.pipelines.detection.evidence import Sight, sights
from spheremark.pipelines.detection.features import NOISE_MIN, Look, look_at
from spheremark.pipelines.detection.ground import ground_of
from spheremark.pipelines.detection.hypotheses import rivals
from spheremark.pipelines.detection.seeds import find_seeds
from spheremark.pipelines.detection.target import Ball
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
        Candidates in the order of azimuth; of the groups that passed the first gate of size and
        were then refused, the (at most 200) most like a ball, with the reason; and the height of
        the highest ground point within 10 m, where the study cuts its clouds.

    Notes
    -----
    A marker is a ball of known radius that stands free on a pole, so each place where something
    ends upward and to a side is tried: mean shift of a disc of the ball's size, then a robust fit
    along the beams, then the tests, which have their sentences in ``verdict``. Ground is the
    opening of the lowest point per cell. Where no ground was seen it is unknown, and nothing is
    cut. Cost grows linearly with the returns.
    """
    cells = cells_of(cloud, config)
    ball = Ball(marker_radius, cells.R_station_base[2], float(cloud.rig.divergence.max()))
    ground = ground_of(cloud, cells, config)
    seeds = find_seeds(ground.points_above, ball, config.n_points_min)
    looks = distinct(look_at(cloud, cells, seeds, ball), config, marker_radius)
    found, refused = _judged(cloud, cells, looks, config, ball)
    return MarkerCandidates(
        candidates=_candidates(found, ball, config),
        rejected=tuple(
            Rejection(p_base=look.p_base, n_points=look.n_points, reason=reason)
            for look, reason in refused[:_REJECTIONS_MAX]
        ),
        ground_height_max=ground.height_max,
    )


def _judged(
    cloud: StitchedCloud, cells: Cells, looks: list[Look], config: ExtractionConfig, ball: Ball
) -> tuple[list[tuple[Look, Sight]], list[tuple[Look, str]]]:
    """Return the groups that may be markers with what is seen of them, and why the others are not.

    What is left after a first look is looked at again, at all beams towards and about it.
    """
    verdicts = [verdict(look, config, ball) for look in looks]
    left = [look for look, reason in zip(looks, verdicts, strict=True) if not reason]
    centres = np.array([look.p_base for look in left]).reshape(-1, 3)
    seen = sights(cloud, cells.directions, centres, ball)
    found, later = _sighted(left, seen, config, ball)
    in_turn = iter(later)
    reasons = [reason or next(in_turn) for reason in verdicts]
    return found, [(look, reason) for look, reason in zip(looks, reasons, strict=True) if reason]


def _sighted(
    looks: list[Look], seen: list[Sight], config: ExtractionConfig, ball: Ball
) -> tuple[list[tuple[Look, Sight]], list[str]]:
    """Return what may be a marker by all that is seen, and the verdicts on all.

    First each by what is seen of it alone; then by other shapes and by those that are left, among
    which none is seen more closely than the others.
    """
    groups = list(zip(looks, seen, strict=True))
    reasons = [verdict_on_sight(look, sight, ball) for look, sight in groups]
    peers = peers_among([one for one, reason in zip(groups, reasons, strict=True) if not reason])
    groups = [(among_peers(look, peers), sight) for look, sight in groups]
    reasons = [
        reason or _verdict_again(look, sight, peers, config, ball)
        for (look, sight), reason in zip(groups, reasons, strict=True)
    ]
    return [one for one, reason in zip(groups, reasons, strict=True) if not reason], reasons


def _verdict_again(
    look: Look, sight: Sight, peers: Peers, config: ExtractionConfig, ball: Ball
) -> str:
    """Return why a group that passed alone is refused among the others of the scan."""
    return (
        verdict(look, config, ball)
        or verdict_on_sight(look, sight, ball)
        or _rivalled(look, sight, ball, peers.noise)
        or verdict_among_peers(look, sight, peers)
    )


def _rivalled(look: Look, sight: Sight, ball: Ball, noise: float) -> str:
    """Return why something else explains a group better; its own noise if there are no others."""
    spread = sight.spread / spread_expected(look, ball)
    own = max(look.scatter, NOISE_MIN)
    return verdict_on_rivals(
        rivals(look, sight.seen, spread, ball, own if np.isnan(noise) else noise)
    )


def _candidates(
    found: list[tuple[Look, Sight]], ball: Ball, config: ExtractionConfig
) -> tuple[MarkerCandidate, ...]:
    """Return candidates M01, M02 ... by azimuth, from looks and the returns about them."""
    in_turn = sorted(found, key=lambda one: np.arctan2(one[0].y, one[0].x))
    return tuple(
        MarkerCandidate(
            name=marker_name(place),
            members=_members(look, sight, ball),
            p_base_rough=look.p_base,
            score=score(look, config, ball),
        )
        for place, (look, sight) in enumerate(in_turn)
    )


def _members(look: Look, sight: Sight, ball: Ball) -> Index:
    """Return the rows on and about a ball, ascending: its outline, and what of its pole touches it.

    Of a ball that is seen very closely, only its middle: there the returns at its outline, which
    belong partly to what lies behind, would weigh more than the noise of all the others.
    """
    across, along, depth = sight.seen
    reach = _MIDDLE * ball.radius if is_resolved(look, ball) else 1.5 * ball.radius + look.blur
    is_about = across * across + along * along < reach * reach
    is_level = (depth > -2.2 * ball.radius) & (depth < 1.6 * ball.radius)
    return np.asarray(sight.rows[is_about & is_level], dtype=np.intp)
