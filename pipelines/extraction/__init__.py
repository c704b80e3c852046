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
from numpy.typing import NDArray

from pipelines.config import ExtractionConfig
from pipelines.extraction.ball import Ball, blur_at, seen_from, view_of
from pipelines.extraction.cells import Cells, cells_of
from pipelines.extraction.ground import ground_of
from pipelines.extraction.looks import NOISE_MIN, Look, look_at
from pipelines.extraction.rivals import rivals
from pipelines.extraction.seeds import find_seeds
from pipelines.extraction.sights import Sight, sights
from pipelines.extraction.verdicts import (
    distinct,
    is_resolved,
    noise_among,
    score,
    spread_expected,
    verdict,
    verdict_among_others,
    verdict_on_rivals,
    verdict_on_sight,
)
from pipelines.geometry import levelling_rotation
from pipelines.values import (
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
    up = levelling_rotation(cloud.levelling)[2].copy()
    ball = Ball(marker_radius, up, float(cloud.rig.divergence.max()))
    cells = cells_of(cloud, config)
    ground = ground_of(cloud, cells, config)
    seeds = find_seeds(cloud.p_base, ground.rows_above, ball, config.n_points_min)
    looks = distinct(look_at(cloud, cells, seeds, ball), config, marker_radius)
    verdicts = [verdict(look, config, ball) for look in looks]
    verdicts, rows = _sighted(cloud, cells, looks, verdicts, ball)
    good = [
        (look, mine) for look, mine, reason in zip(looks, rows, verdicts, strict=True) if not reason
    ]
    bad = [(look, reason) for look, reason in zip(looks, verdicts, strict=True) if reason]
    return MarkerCandidates(
        candidates=_candidates(cloud, good, ball, config),
        rejected=tuple(
            Rejection(p_base=look.p_base, n_points=look.n_points, reason=reason)
            for look, reason in bad[:_REJECTIONS_MAX]
        ),
        ground_height_max=ground.height_max,
    )


def _sighted(
    cloud: StitchedCloud, cells: Cells, looks: list[Look], verdicts: list[str], ball: Ball
) -> tuple[list[str], list[NDArray[np.int32]]]:
    """Return the verdicts after a second look, at all beams towards and about what is left.

    With them the returns that were looked at; none of what had been refused before.
    """
    left = [look for look, reason in zip(looks, verdicts, strict=True) if not reason]
    centres = np.array([look.p_base for look in left]).reshape(-1, 3)
    seen = sights(cloud, cells.directions, centres, ball)
    reasons = [verdict_on_sight(look, sight, ball) for look, sight in zip(left, seen, strict=True)]
    good = [
        (look, sight) for look, sight, reason in zip(left, seen, reasons, strict=True) if not reason
    ]
    noise = noise_among([look for look, _ in good])
    later = iter(
        (
            reason
            or _rivalled(look, sight, ball, noise)
            or verdict_among_others(look, sight, good, ball),
            sight.rows,
        )
        for look, sight, reason in zip(left, seen, reasons, strict=True)
    )
    nothing = np.zeros(0, np.int32)
    both = [(reason, nothing) if reason else next(later) for reason in verdicts]
    return [reason for reason, _ in both], [rows for _, rows in both]


def _rivalled(look: Look, sight: Sight, ball: Ball, noise: float) -> str:
    """Return why something else explains a group better; its own noise if there are no others."""
    spread = sight.spread / spread_expected(look, ball)
    own = max(look.scatter, NOISE_MIN)
    return verdict_on_rivals(
        rivals(look, sight.seen, spread, ball, own if np.isnan(noise) else noise)
    )


def _candidates(
    cloud: StitchedCloud,
    found: list[tuple[Look, NDArray[np.int32]]],
    ball: Ball,
    config: ExtractionConfig,
) -> tuple[MarkerCandidate, ...]:
    """Return candidates M01, M02 ... by azimuth, from looks and the returns about them."""
    in_turn = sorted(found, key=lambda one: np.arctan2(one[0].y, one[0].x))
    return tuple(
        MarkerCandidate(
            name=marker_name(place),
            members=_members(cloud, rows, look, ball),
            p_base_rough=look.p_base,
            score=score(look, config, ball),
        )
        for place, (look, rows) in enumerate(in_turn)
    )


def _members(cloud: StitchedCloud, rows: NDArray[np.int32], look: Look, ball: Ball) -> Index:
    """Return the rows on and about a ball, ascending: its outline, and what of its pole touches.

    Of a ball that is seen very closely, only its middle: there the returns at its outline, which
    belong partly to what lies behind, would weigh more than the noise of all the others.
    """
    seen = seen_from(
        cloud.p_base.take(rows, axis=0).T.astype(np.float64), view_of(look.p_base, ball.up)
    )
    blur = blur_at(look.p_base, ball)
    reach = _MIDDLE * ball.radius if is_resolved(look, ball) else 1.5 * ball.radius + blur
    is_about = np.hypot(seen[0], seen[1]) < reach
    is_level = (seen[2] > -2.2 * ball.radius) & (seen[2] < 1.6 * ball.radius)
    return np.asarray(rows[is_about & is_level], dtype=np.intp)
