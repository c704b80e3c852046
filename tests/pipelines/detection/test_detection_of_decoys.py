"""Balls of other radii, cylinders, cubes and posts: returns that lie nearly on a sphere too."""

from dataclasses import replace

import numpy as np
import pytest

from spheremark.pipelines.config import ExtractionConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.scan.stitching import beams
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


def sure_or_few(found):
    """Markers, and possible ones with fewer than 20 returns: near decoys these are that at best."""
    few = [one.p_base for one in found.possible if one.n_points < 20]
    return [candidate.p_base_rough for candidate in found.candidates] + few


def test_far_markers_are_found_and_no_rival_of_theirs(found):
    rough = [candidate.p_base_rough for candidate in found.candidates]
    assert len(rough) == len(MARKERS)
    assert gaps(MARKERS, rough).min(axis=1).max() < 0.5 * RADIUS


def test_far_markers_but_the_farthest_are_found_and_no_rival_of_theirs(found):
    rough = [candidate.p_base_rough for candidate in found.candidates]
    assert gaps(rough, MARKERS).min(axis=1).max() < 0.5 * RADIUS
    assert gaps(MARKERS[:-1], rough).min(axis=1).max() < 0.5 * RADIUS  # the farthest: 14 returns


def test_far_smaller_balls_are_refused_for_their_size(found):
    near = [
        [r for r in found.rejected if np.linalg.norm(r.p_base - place) < 0.15] for place in SMALL
    ]
    assert sum(not places for places in near) <= len(found.possible) <= 1
    by_size = [one for places in near for one in places if "another radius" in one.reason]
    assert len(by_size) >= len(SMALL) // 2


def test_far_posts_are_refused_where_they_end(found):
    tops = POSTS + np.array([0.0, 0.0, 1.25])
    assert all(reasons_within(found, tops, 0.3))


LOW = -0.3  # [m] of decoys: beams past them end on the ground
DISTANCES = np.array([7.0, 8.0, 9.0, 10.0, 11.0, 12.0])
OTHERS = around(DISTANCES, LOW, 0.5)


def extracted(**shapes):
    """What is found among markers and some others, and how many of the places of others are ok."""
    balls = (*((tuple(p), RADIUS) for p in MARKERS), *shapes.pop("balls", ()))
    cloud = scan(World(balls=balls, ground=GROUND, **shapes), np.random.default_rng(43), sigma=0.01)
    return extract(cloud, ExtractionConfig(), RADIUS)


def n_taken(found):
    rough = [candidate.p_base_rough for candidate in found.candidates]
    assert gaps(MARKERS, sure_or_few(found)).min(axis=1).max() < 0.5 * RADIUS
    return int((gaps(OTHERS, rough).min(axis=1) < 2 * RADIUS).sum())


@pytest.mark.parametrize("share", [0.7, 0.8, 1.5])
def test_balls_of_other_radii_are_no_markers(share):
    found = extracted(balls=tuple((tuple(p), share * RADIUS) for p in OTHERS))
    assert n_taken(found) == 0


def test_all_markers_among_balls_of_another_radius_are_sure_ones():
    found = extracted(balls=tuple((tuple(p), 1.5 * RADIUS) for p in OTHERS))
    rough = [candidate.p_base_rough for candidate in found.candidates]
    assert gaps(MARKERS, rough).min(axis=1).max() < 0.5 * RADIUS


def test_markers_beside_a_post_are_found():
    """On one side beams go past the marker: what holds those on the other does not carry it."""
    near = MARKERS[:5]
    aside = np.column_stack([-near[:, 1], near[:, 0], np.zeros(len(near))])
    feet = near + 0.27 * aside / np.linalg.norm(aside, axis=1, keepdims=True)
    feet[:, 2] = GROUND
    found = extracted(posts=tuple((tuple(p), 0.08, 1.6) for p in feet))
    rough = [candidate.p_base_rough for candidate in found.candidates]
    assert gaps(near, rough).min(axis=1).max() < 0.5 * RADIUS


def test_short_cylinders_are_no_markers():
    feet = OTHERS - [0.0, 0.0, RADIUS]
    found = extracted(posts=tuple((tuple(p), RADIUS, 2 * RADIUS) for p in feet))
    assert n_taken(found) == 0


def in_front(cloud, box, turn):
    """The cloud with an upright cube in it, turned about its vertical."""
    rows = np.flatnonzero(cloud.p_base @ box > 0.0)
    lines = beams(cloud, rows)
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    origins, directions = (lines.origins_base - box) @ R.T, lines.directions_base @ R.T
    with np.errstate(divide="ignore"):
        ends = np.stack([(side * HALF - origins) / directions for side in (-1.0, 1.0)])
    enters, leaves = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
    hit = (enters < leaves) & (enters < lines.ranges)
    noise = np.random.default_rng(7).normal(0.0, 0.01, hit.sum())
    p = cloud.p_base.copy()
    p[rows[hit]] = (
        lines.origins_base[hit] + (enters[hit] + noise)[:, None] * (lines.directions_base[hit])
    )
    return replace(cloud, p_base=p)


HALF = 0.09  # [m] of a cube's edge


@pytest.mark.parametrize("turn", [0.0, 0.4, 0.785])
def test_cubes_are_no_markers(turn):
    cloud = scan(
        World(balls=tuple((tuple(p), RADIUS) for p in MARKERS), ground=GROUND),
        np.random.default_rng(44),
        sigma=0.01,
    )
    for place in OTHERS:
        cloud = in_front(cloud, place, turn + np.arctan2(place[1], place[0]))
    assert n_taken(extract(cloud, ExtractionConfig(), RADIUS)) == 0


@pytest.mark.parametrize("gap", [0.15, 0.3, 1.0])
def test_a_marker_close_before_a_panel_is_found(gap):
    """Alone in its scan: in one of five the radius may be doubtful, but the panel is no reason."""
    place, n_sure = np.array([7.0, 0.0, LOW]), 0
    for seed in range(45, 50):
        rng = np.random.default_rng(seed)
        cloud = scan(World(balls=((tuple(place), RADIUS),), ground=GROUND), rng)
        p = cloud.p_base.astype(np.float64)
        behind = (p[:, 0] > place[0] + RADIUS + gap) & (np.abs(p[:, 1]) < 0.07 * p[:, 0])
        p[behind] *= ((place[0] + RADIUS + gap) / p[behind, 0])[:, None]
        found = extract(replace(cloud, p_base=p.astype(np.float32)), ExtractionConfig(), RADIUS)
        assert len(found.candidates) + len(found.possible) == 1
        assert all("another radius" in group.reason for group in found.possible)
        for marker in found.candidates:
            assert gaps([place], [marker.p_base_rough]).max() < 0.3 * RADIUS
            n_sure += marker.probability > 0.99
    assert n_sure >= 4


def test_a_decoy_is_refused_with_the_hypothesis_and_its_odds():
    found = extracted(balls=tuple((tuple(p), 0.7 * RADIUS) for p in OTHERS))
    near = [r for r in found.rejected if np.linalg.norm(OTHERS - r.p_base, axis=1).min() < RADIUS]
    assert near
    assert all("times likelier than a marker" in r.reason for r in near)
