"""Markers behind something that hides them from one place of the turning head, but not another."""

from dataclasses import replace

import numpy as np
import pytest

from spheremark.pipelines.config import ExtractionConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.detection.faces import faces_of
from spheremark.pipelines.scan.firings import clock_of, heard_of, pulses_about
from spheremark.pipelines.sphere.pulses import passing_of
from tests.pipelines.synthetic_stop import RADIUS, RIG, World, fire, passing, ring_of_markers, scan

MARKERS = ring_of_markers(n=5)
GROUND = -0.8
MAST, POST = (0.55, 0.02), (2.1, 0.04)  # [m] how far away, and radius


def obstacles(away):
    """Where things of the rover or field stand that hide each marker in one face of the scan."""
    feet = []
    for marker in MARKERS:
        along, gap2 = passing(fire(), marker)
        row = np.argmin(np.where((along > 0) & (fire().angles > 0), gap2, np.inf))
        place = fire().origins[row] + away * fire().directions[row]
        feet.append((*place[:2], GROUND))
    return feet


def hidden_by(obstacle):
    away, radius = obstacle
    world = World(
        balls=tuple((tuple(p), RADIUS) for p in MARKERS),
        posts=tuple((foot, radius, 3.0) for foot in obstacles(away)),
        ground=GROUND,
    )
    return scan(world, np.random.default_rng(2))


@pytest.fixture(scope="module")
def by_mast():
    return hidden_by(MAST)


@pytest.fixture(scope="module", params=["mast", "post"])
def hidden(request, by_mast):
    return by_mast if request.param == "mast" else hidden_by(POST)


def silent(cloud, place):
    """Of the pulses that pass a place by less than the radius, which are without a return."""
    clock, _ = clock_of(cloud)
    pulses, _, _ = pulses_about(clock, place, 0.9 * RADIUS)
    return ~np.isin(pulses.numbers, heard_of(cloud, clock))


def test_pulses_that_something_before_a_marker_stopped_are_not_without_a_return(hidden):
    for place in MARKERS:
        assert len(silent(hidden, place)) > 50
        assert not silent(hidden, place).any()


def test_the_limb_is_not_sought_by_pulses_that_a_mast_stopped(by_mast):
    clock, _ = clock_of(by_mast)
    for passed in passing_of(by_mast, clock, MARKERS, RADIUS):
        is_inside = np.linalg.norm(passed.places, axis=1) < 0.8 * RADIUS
        assert is_inside.sum() > 10
        assert passed.has_hit[is_inside].all()


def test_markers_that_are_hidden_in_one_face_are_found_by_the_other(hidden):
    found = extract(hidden, ExtractionConfig(), RADIUS)
    rough = np.array([c.p_base_rough for c in found.candidates])
    gaps = np.linalg.norm(rough[:, None] - MARKERS, axis=2)
    assert gaps.min(axis=0).max() < 0.025
    assert len(rough) == len(MARKERS)


def test_a_mast_that_sends_no_return_hides_a_face_and_the_other_shows_the_marker(by_mast):
    """As of what is nearer than a sensor can measure."""
    unknown = replace(by_mast, near_times=np.zeros(0), near_rings=np.zeros(0, np.uint8))
    assert all(np.mean(silent(unknown, place)) > 0.3 for place in MARKERS)
    found = extract(unknown, ExtractionConfig(), RADIUS)
    rough = np.array([c.p_base_rough for c in found.candidates])
    assert len(rough) == len(MARKERS)
    assert np.linalg.norm(rough[:, None] - MARKERS, axis=2).min(axis=0).max() < 0.025


@pytest.mark.parametrize("turn", [0.5, 1.7, -2.0])
def test_faces_are_the_same_however_the_head_of_a_gimbal_counts_its_angle(turn):
    angles, c = np.linspace(-3.0, 3.0, 50), np.array([4.0, 3.0, 1.0])
    T = np.eye(4)
    T[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    other = replace(RIG, T_head_lidar=T @ RIG.T_head_lidar)
    faces = faces_of(RIG, angles, c)
    np.testing.assert_array_equal(faces_of(other, angles - turn, c), faces)
    assert 15 < np.sum(faces > 0) < 35
