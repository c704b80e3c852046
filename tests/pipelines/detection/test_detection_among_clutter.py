"""Precision and recall of extraction in worlds that the simulator has made."""

import re
from dataclasses import replace

import numpy as np
import pytest

from spheremark.pipelines.config import ExtractionConfig, StitchingConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.evaluation.detection import CLASSES, DETECTION_PLAN, extraction
from spheremark.pipelines.model import RING_UNKNOWN
from spheremark.pipelines.scan.stitching import choose_rig, stitch
from spheremark.pipelines.simulation import SimulationConfig, simulate_stop
from spheremark.pipelines.simulation.lane import range_lane
from tests.pipelines.synthetic_stop import RADIUS, World, ring_of_markers, scan

COLUMNS = ("p_base", "gimbal_angles", "intensities", "rings", "times")


@pytest.fixture(scope="module")
def few():
    world = World(balls=tuple((tuple(p), RADIUS) for p in ring_of_markers(n=5)), ground=-0.8)
    return scan(world, np.random.default_rng(5))


def near(places):
    gaps = np.linalg.norm(places[:, None] - ring_of_markers(n=5)[None], axis=2)
    return gaps.min(axis=0) < 0.03


def rough(found):
    return np.array([c.p_base_rough for c in found.candidates]).reshape(-1, 3)


def test_returns_that_are_none_change_nothing(few):
    p = np.vstack([few.p_base, np.full((50, 3), np.nan), np.full((50, 3), np.inf)])
    p[-1] = (3.0, np.nan, 0.0)
    columns = {name: np.append(getattr(few, name), np.zeros(100)) for name in COLUMNS[1:]}
    columns = {k: v.astype(getattr(few, k).dtype) for k, v in columns.items()}
    spoilt = replace(few, p_base=p.astype(np.float32), **columns)
    again = extract(spoilt, ExtractionConfig(), RADIUS)
    np.testing.assert_array_equal(rough(again), rough(extract(few, ExtractionConfig(), RADIUS)))


def test_markers_are_found_without_any_ground(few):
    high = few.p_base[:, 2] > -0.60
    alone = replace(few, **{name: getattr(few, name)[high] for name in COLUMNS})
    found = extract(alone, ExtractionConfig(), RADIUS)
    assert near(rough(found)).all()


def test_a_marker_half_of_which_is_hidden_is_found(few):
    place = ring_of_markers(n=5)[0]
    side = np.cross([0.0, 0.0, 1.0], place)
    hidden = (few.p_base @ side > 0.0) & (few.p_base @ place > 0.8 * place @ place)
    half = replace(few, p_base=np.where(hidden[:, None], 0.5, 1.0).astype(np.float32) * few.p_base)
    assert near(rough(extract(half, ExtractionConfig(), RADIUS)))[0]


def aside(cloud, place):
    """How far to a side of a centre each beam passes, in radii; far for those behind."""
    side = np.cross([0.0, 0.0, 1.0], place)
    along = cloud.p_base @ place
    passes = (cloud.p_base @ (side / np.linalg.norm(side))) / along * (place @ place) / RADIUS
    return np.where(along > 0.0, passes, -np.inf)


@pytest.mark.parametrize("height", [0.18, 0.22, 0.28])  # [m] above the ground
@pytest.mark.parametrize("distance", [2.5, 5.0])
def test_a_marker_close_above_the_ground_is_found(height, distance):
    """Beams that pass below it end on the ground at about its distance: that is no body."""
    place = np.array([distance, -0.3 * distance, -0.8 + height])
    balls = (*((tuple(p), RADIUS) for p in ring_of_markers(n=5)), (tuple(place), RADIUS))
    found = extract(
        scan(World(balls=balls, ground=-0.8), np.random.default_rng(6)), ExtractionConfig(), RADIUS
    )
    assert np.linalg.norm(rough(found) - place, axis=1).min() < 0.03
    assert len(found.candidates) == 6


@pytest.mark.parametrize("height", [0.22, 0.28])  # [m] above the ground
def test_the_ground_carries_no_marker_however_much_its_returns_scatter(height):
    """A ground that scatters is known less exactly: more of what lies above its plane is ground."""
    place = np.array([2.5, -0.75, -0.8 + height])
    balls = (*((tuple(p), RADIUS) for p in ring_of_markers(n=5)), (tuple(place), RADIUS))
    cloud = scan(World(balls=balls, ground=-0.8), np.random.default_rng(6), sigma=0.025)
    found = extract(cloud, ExtractionConfig(), RADIUS)
    assert np.linalg.norm(rough(found) - place, axis=1).min() < 0.03
    assert len(found.candidates) == 6


@pytest.mark.parametrize(
    ("seen_to", "is_found"), [(0.5, True), (0.0, True), (-0.5, False), (-0.7, False)]
)
def test_a_marker_at_the_edge_of_a_partial_turn_is_found_if_half_of_it_is_seen(
    few, seen_to, is_found
):
    place = ring_of_markers(n=5)[0]
    seen = aside(few, place) <= seen_to
    part = {name: getattr(few, name)[seen] for name in COLUMNS}
    part["rings"] = np.full(seen.sum(), RING_UNKNOWN, np.uint8)  # no pulse beyond the edge
    found = extract(replace(few, **part), ExtractionConfig(), RADIUS)
    assert near(rough(found))[0] == is_found
    refused = [r.reason for r in found.rejected if np.linalg.norm(r.p_base - place) < 2 * RADIUS]
    assert bool(refused) != is_found


@pytest.mark.parametrize("k", range(5))
def test_a_strip_of_a_marker_is_found_where_returns_on_both_sides_show_that_the_scan_looked(few, k):
    """As of a cloud without rings whose scan lines lie apart. The last stands before the sky."""
    place = ring_of_markers(n=5)[k]
    passes = np.abs(aside(few, place))
    seen = (passes <= 0.35) | (passes >= 1.1)
    part = {name: getattr(few, name)[seen] for name in COLUMNS}
    part["rings"] = np.full(seen.sum(), RING_UNKNOWN, np.uint8)
    found = extract(replace(few, **part), ExtractionConfig(), RADIUS)
    reasons = [r.reason for r in found.rejected if np.linalg.norm(r.p_base - place) < RADIUS]
    assert near(rough(found))[k] == (k < 4)
    assert any("lie on a strip" in reason for reason in reasons) == (k == 4)


def test_a_marker_most_of_which_is_behind_something_is_refused_with_a_reason(few):
    place = ring_of_markers(n=5)[0]
    passes, p = aside(few, place), few.p_base.copy()
    is_behind = (passes > -0.4) & (passes < 2.0)  # 70 % of its width
    p[is_behind] *= 0.5
    found = extract(replace(few, p_base=p), ExtractionConfig(), RADIUS)
    assert not near(rough(found))[0]
    assert any(np.linalg.norm(r.p_base - place) < 2 * RADIUS for r in found.rejected)
    assert near(rough(found))[1:].all()


@pytest.mark.parametrize("towards", ["left", "right", "up", "down"])
def test_a_marker_with_a_part_behind_something_nearer_is_found_beside_its_whole_ground(
    few, towards
):
    place = ring_of_markers(n=5)[0]  # four radii above the ground, which most beams still reach
    turn = {"left": (-1.0, 0.0), "right": (1.0, 0.0), "up": (0.0, 1.0), "down": (0.0, -1.0)}
    p = few.p_base.astype(np.float64)
    distance = np.linalg.norm(place)
    side = np.cross([0.0, 0.0, 1.0], place)
    side /= np.linalg.norm(side)
    up = np.cross(place, side) / distance
    passes = (
        np.column_stack([p @ side, p @ up]) * (distance / (p @ place) * distance / RADIUS)[:, None]
    )
    is_near = (p @ place > 0.0) & (np.hypot(*passes.T) < 1.5)
    for hidden_from in (0.5, 0.1):  # radii from its middle: a fifth of its disc, and 44 %
        is_behind = is_near & (passes @ turn[towards] > hidden_from)
        q = few.p_base.copy()
        q[is_behind] *= 0.5 * distance / np.linalg.norm(p[is_behind], axis=1)[:, None]
        found = extract(replace(few, p_base=q), ExtractionConfig(), RADIUS)
        assert near(rough(found)).all()
        assert len(found.candidates) == 5


@pytest.mark.parametrize(("dimmed", "is_found"), [(1.0, True), (0.4, False)])
def test_what_nothing_shows_a_pole_of_must_be_painted_as_the_markers(few, dimmed, is_found):
    place = ring_of_markers(n=5)[0]
    own = np.linalg.norm(few.p_base - place, axis=1) < 1.5 * RADIUS
    height = few.p_base[:, 2] / np.linalg.norm(few.p_base, axis=1)
    is_below = height < place[2] / np.linalg.norm(place)
    left = own | ~(is_below & (np.abs(aside(few, place)) < 4.0))  # against the sky
    painted = np.where(own, dimmed, 1.0) * few.intensities
    unknown = np.full(len(few.rings), RING_UNKNOWN, np.uint8)  # nor do silent pulses show it
    cloud = replace(few, intensities=painted.astype(few.intensities.dtype), rings=unknown)
    found = extract(
        replace(cloud, **{name: getattr(cloud, name)[left] for name in COLUMNS}),
        ExtractionConfig(),
        RADIUS,
    )
    assert near(rough(found))[0] == is_found
    others = (*found.possible, *found.rejected)
    unused = [r.reason for r in others if np.linalg.norm(r.p_base - place) < 2 * RADIUS]
    assert any("reflectivity" in reason for reason in unused) != is_found


def recall(scenario, place):
    """The share of the markers of a class that was found."""
    (row,) = (one for one in scenario["markers"] if one["kind"] == CLASSES[place])
    return row["n_found"] / row["n"]


@pytest.mark.long
def test_a_stepped_scan_takes_no_crest_for_a_marker():
    stepped = extraction(
        {"paper-field": DETECTION_PLAN["clutter-field"]},
        (930, 931),
        SimulationConfig(step=np.radians(5.0)),
    )
    found = stepped.run()["scenarios"]["paper-field"]
    assert found["n_false"] == 0
    # a ball that one line of a stepped scan meets at its limb alone shows no shape
    assert recall(found, 0) > 0.97


@pytest.fixture(scope="module")
def clutter():
    """What is found in worlds of clutter, in fields of rocks and along a lane."""
    return extraction(DETECTION_PLAN, (22,)).run()["scenarios"]


@pytest.mark.slow
def test_markers_are_found_and_nothing_else_in_worlds_of_clutter(clutter):
    assert recall(clutter["clutter-field"], 0) > 0.97
    assert recall(clutter["rock-field"], 0) == 1.0
    assert recall(clutter["range-lane"], 1) > 0.4  # the surest of 88: 0.01 false ones in a scan
    assert clutter["rock-field"]["n_false"] == clutter["range-lane"]["n_false"] == 0
    assert clutter["clutter-field"]["n_false_worst_scan"] <= 1
    for row in (row for one in clutter.values() for row in one["markers"] + one["decoys"]):
        assert sum(row["reasons"].values()) == row["n"] - row["n_found"]
        assert not any(re.search(r"\d", reason) for reason in row["reasons"])


@pytest.mark.slow
def test_of_the_markers_of_a_lane_all_but_one_are_found(clutter):
    assert recall(clutter["range-lane"], 0) > 0.97


def test_far_balls_of_the_right_size_are_not_refused_for_their_size():
    """Of 20 to 60 returns, beams as wide as half a radius: their size is uncertain."""
    n_lost = n_balls = 0
    for seed in range(940, 944):
        world = range_lane(seed, np.array([12.5, 15.0, 17.5]), 30)
        simulated = simulate_stop(
            world, "centre", SimulationConfig(only_near_spheres=True, sigma_range=0.02)
        )
        cloud = stitch(simulated.log, choose_rig(simulated.log, None), StitchingConfig())
        found = extract(cloud, ExtractionConfig(), world.marker_radius)
        reasons = [rejection.reason for rejection in found.rejected]
        n_lost += sum("another radius" in reason for reason in reasons)
        n_balls += len(found.candidates)
    assert n_balls > 350
    assert n_lost <= 1


@pytest.mark.slow
def test_all_markers_of_a_lane_are_found(clutter):
    assert recall(clutter["range-lane"], 0) == 1.0
    assert recall(clutter["range-lane"], 1) > 0.7
