"""Markers in turns whose scan lines fall on scan lines: two or three lines show a sphere."""

from dataclasses import replace

import numpy as np
import pytest

from spheremark.pipelines.config import ExtractionConfig, StitchingConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.detection.pulses import unheard_about
from spheremark.pipelines.geometry import inverse, transform
from spheremark.pipelines.model import RING_UNKNOWN
from spheremark.pipelines.scan.firings import clock_of, heard_of
from spheremark.pipelines.scan.stitching import stitch
from spheremark.pipelines.simulation import SimulationConfig, scenario, simulate_stop
from spheremark.pipelines.simulation.rig import nominal_rig

CONFIG = SimulationConfig(turn=12.0)  # lines one degree apart


@pytest.fixture(scope="module")
def scan():
    field = scenario("paper-field", 0)
    stop = simulate_stop(field, "lane3-stop4", CONFIG)
    cloud = stitch(stop.log, nominal_rig(CONFIG), StitchingConfig())
    return cloud, transform(inverse(stop.truth.T_site_base), field.marks.p_site), field


def n_silent(scan, place):
    cloud, _, field = scan
    clock = clock_of(cloud)[0]
    upward, radius = np.array([0.0, 0.0, 1.0]), field.marker_radius
    across, up, _ = unheard_about(clock, heard_of(cloud, clock), place, upward, 3.0 * radius)
    return int(np.sum(np.hypot(across, up) < 0.8 * radius))


def test_no_marker_is_refused_for_the_width_that_the_lines_show_and_nothing_else_is_found(scan):
    cloud, marks, field = scan
    found = extract(cloud, ExtractionConfig(), field.marker_radius)
    rough = np.array([c.p_base_rough for c in found.candidates])
    assert (np.linalg.norm(rough[:, None] - marks, axis=2).min(axis=1) < field.marker_radius).all()
    near = [
        r.reason
        for r in found.rejected
        if np.linalg.norm(marks - r.p_base, axis=1).min() < field.marker_radius
    ]
    assert not any("slim" in reason for reason in near), near


def test_no_pulse_at_a_marker_is_silent_and_all_are_in_the_sky(scan):
    _, marks, _ = scan
    assert max(n_silent(scan, mark) for mark in marks) <= 3
    assert (
        min(n_silent(scan, 7.0 * mark / np.linalg.norm(mark) + [0, 0, 4.0]) for mark in marks) > 5
    )


def test_without_rings_there_is_no_clock(scan):
    cloud, _, _ = scan
    bare = replace(cloud, rings=np.full(len(cloud.rings), RING_UNKNOWN, np.uint8))
    assert clock_of(bare)[0] is None


def test_limbs_of_markers_stay_in_the_fit_of_a_vlp16(scan):
    cloud, places, field = scan
    found = extract(cloud, ExtractionConfig(), field.marker_radius)
    near = [one for one in found.candidates if len(one.members) > 100]
    assert len(near) > 3
    for one in near:
        place = places[np.linalg.norm(places - one.p_base_rough, axis=1).argmin()]
        rays = cloud.p_base[one.members].astype(np.float64)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        passing = np.linalg.norm(place - (rays @ place)[:, None] * rays, axis=1)
        assert passing.max() > 0.97 * field.marker_radius
