"""Far posts and smaller balls, whose few returns lie on a sphere of the known radius too."""

import numpy as np
import pytest

from spheremark.pipelines.config import ExtractionConfig
from spheremark.pipelines.detection import extract
from tests.pipelines.synthetic_stop import RADIUS, World, scan

GROUND = -0.8


def around(distances, height, turn):
    """Places in the directions of a clock, at these distances [m]."""
    phi = 2 * np.pi * (np.arange(len(distances)) + turn) / len(distances)
    return np.column_stack(
        [distances * np.cos(phi), distances * np.sin(phi), np.full(len(distances), height)]
    )


MARKERS = around(np.array([6.0, 8.0, 10.0, 13.0, 15.0, 17.0, 19.0, 22.0]), 0.35, 0.1)
SMALL = around(np.array([12.0, 13.0, 14.0, 15.0, 16.0]), 0.45, 0.45)
POSTS = around(np.array([12.0, 14.0, 16.0, 18.0, 19.0, 20.0]), GROUND, 0.72)
POST_RADII = (0.1, 0.06, 0.045, 0.1, 0.06, 0.045)


@pytest.fixture(scope="module")
def found():
    world = World(
        balls=(*((tuple(p), RADIUS) for p in MARKERS), *((tuple(p), 0.06) for p in SMALL)),
        posts=tuple((tuple(p), r, 1.3) for p, r in zip(POSTS, POST_RADII, strict=True)),
        ground=GROUND,
    )
    return extract(scan(world, np.random.default_rng(41), sigma=0.01), ExtractionConfig(), RADIUS)


def gaps(places, others):
    return np.linalg.norm(np.asarray(places)[:, None] - np.asarray(others)[None], axis=2)


def reasons_within(found, places, reach):
    return [
        [r.reason for r in found.rejected if np.linalg.norm(r.p_base - place) < reach]
        for place in places
    ]


def test_far_markers_are_found_and_no_rival_of_theirs(found):
    rough = [candidate.p_base_rough for candidate in found.candidates]
    assert len(rough) == len(MARKERS)
    assert gaps(MARKERS, rough).min(axis=1).max() < 0.5 * RADIUS


def test_far_smaller_balls_are_refused_for_their_size(found):
    near = reasons_within(found, SMALL, 0.15)
    assert all(near)
    said = [reason for reasons in near for reason in reasons]
    by_size = ("small", "radius", "lets beams through")
    assert sum(any(word in reason for word in by_size) for reason in said) >= len(SMALL) - 1
    likely = [reason for reason in said if "explains its returns exp(" in reason]
    assert likely
    assert all(40 <= float(reason.split("radius ")[1].split(" mm")[0]) <= 70 for reason in likely)


def test_far_posts_are_refused_where_they_end(found):
    tops = POSTS + np.array([0.0, 0.0, 1.25])
    assert all(reasons_within(found, tops, 0.3))
