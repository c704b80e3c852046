"""Markers in scans of a gimbal that goes by steps, whose angles are late."""

from dataclasses import replace

import numpy as np
import pytest

from spheremark.pipelines.config import ExtractionConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.detection.latency import late_by, on_time
from spheremark.pipelines.model import Timed
from tests.pipelines.synthetic_stop import RADIUS, World, scan, turned

TURN, STEPS, MOVING = 26.4, 120, 0.5  # [s]; of a turn; share of the time of a step
MARKERS = np.array(
    [[3.0, 1.0, 0.1], [-3.0, 3.5, 0.4], [6.5, -5.0, 0.2], [-9.0, -7.0, 0.5], [2.0, 14.0, 0.6]]
)
LATE = 0.004  # [s]


def stepped(times):
    """Angles of a gimbal that rests, then goes on smoothly to its next step."""
    step, within = np.divmod(times * STEPS / TURN, 1.0)
    part = np.clip((within - 1.0 + MOVING) / MOVING, 0.0, 1.0)
    return (step + 0.5 - 0.5 * np.cos(np.pi * part)) * 2 * np.pi / STEPS


def even(times):
    return times * 2 * np.pi / TURN


def recorded(cloud, angles_at, late, hertz=200.0):
    """The same scan, stitched with samples of the angle that are late [s]."""
    samples = np.arange(-0.1, TURN + 0.1, 1.0 / hertz)
    values = angles_at(samples - late)
    stamps_ns, samples_ns = (
        np.round(1e9 * t.astype(np.float64)).astype(np.int64) for t in (cloud.times, samples)
    )
    rates = np.append(np.diff(values) / np.diff(samples_ns), 0.0)
    angles = Timed(stamps_ns, samples_ns, values, rates, is_angle=True)
    off = angles.exact(slice(None)) - np.asarray(cloud.gimbal_angles, np.float64)
    p = turned(cloud.p_base.astype(np.float64), off)
    return replace(cloud, p_base=p.astype(np.float32), gimbal_angles=angles)


def scan_by(angles_at):
    world = World(balls=tuple((tuple(p), RADIUS) for p in MARKERS))
    rng = np.random.default_rng(8)
    return scan(world, rng, sigma=0.003, turn=TURN, angles_at=angles_at)


@pytest.fixture(scope="module")
def on_time_scan():
    return scan_by(stepped)


@pytest.fixture(scope="module")
def late_scan(on_time_scan):
    return recorded(on_time_scan, stepped, LATE)


def spheres(cloud):
    return extract(recorded(cloud, stepped, 0.0), ExtractionConfig(), RADIUS).candidates


@pytest.mark.parametrize("late", [LATE, -0.003, 0.0])
def test_spheres_show_how_late_the_angles_are(on_time_scan, late):
    found = late_by(recorded(on_time_scan, stepped, late), spheres(on_time_scan), RADIUS)
    assert found == pytest.approx(late, abs=3e-4)


def test_an_even_turn_shows_nothing():
    cloud = recorded(scan_by(even), even, 0.03)
    found = extract(cloud, ExtractionConfig(), RADIUS).candidates
    assert len(found) == len(MARKERS)
    assert late_by(cloud, found, RADIUS) == 0.0


def test_a_scan_on_time_is_as_if_it_had_been_recorded_so(on_time_scan, late_scan):
    p = on_time(late_scan, LATE).p_base
    before, after = (
        np.linalg.norm(own - on_time_scan.p_base, axis=1) for own in (late_scan.p_base, p)
    )
    assert np.quantile(before, 0.95) > 0.01
    assert np.quantile(after, 0.99) < 0.002


def test_markers_are_found_where_the_recorded_angles_show_them(late_scan):
    found = extract(late_scan, ExtractionConfig(), RADIUS).candidates
    assert len(found) == len(MARKERS)
    for one in found:
        assert np.linalg.norm(one.p_base_rough - MARKERS, axis=1).min() < RADIUS
        middle = late_scan.p_base[one.members].mean(axis=0)
        assert np.linalg.norm(one.p_base_rough - middle) < 1.2 * RADIUS
