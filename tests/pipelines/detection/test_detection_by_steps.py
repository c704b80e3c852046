"""Markers in scans of a gimbal that goes by steps, whose angle is sampled seldom."""

import numpy as np
import pytest

from spheremark.pipelines.config import ExtractionConfig, StitchingConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.detection.cells import cells_of
from spheremark.pipelines.detection.evidence import gather_evidence
from spheremark.pipelines.detection.ground import ground_of
from spheremark.pipelines.detection.target import Target
from spheremark.pipelines.geometry import inverse, transform
from spheremark.pipelines.scan.interpolation import errors_of_interpolation
from spheremark.pipelines.scan.stitching import stitch
from spheremark.pipelines.simulation import SimulationConfig, scenario, simulate_stop
from spheremark.pipelines.simulation.rig import nominal_rig

CONFIG = SimulationConfig(step=np.radians(2.0), move=0.06, joint_rate=30.0)
EXTRACTION = ExtractionConfig()


@pytest.fixture(scope="module")
def scan():
    field = scenario("paper-field", 2)
    stop = simulate_stop(field, "lane3-stop4", CONFIG)
    cloud = stitch(stop.log, nominal_rig(CONFIG), StitchingConfig())
    return cloud, transform(inverse(stop.truth.T_site_base), field.marks.p_site), field


def test_lines_whose_angle_is_not_known_are_neither_evidence_nor_silent(scan):
    cloud, marks, field = scan
    cells = cells_of(cloud, EXTRACTION)
    target = Target(field.marker_radius, cells.R_station_base[2], 0.003)
    ground = ground_of(cloud, cells, EXTRACTION, field.marker_radius)
    evidence, _ = gather_evidence(cloud, cells, ground, marks, target)
    n_left_out = 0
    for mark, seen in zip(marks, evidence, strict=True):
        limit = 0.1 * field.marker_radius / np.linalg.norm(mark)
        assert errors_of_interpolation(cloud.gimbal_angles, seen.rows).max() <= limit
        about = np.flatnonzero(np.linalg.norm(cloud.p_base - mark, axis=1) < field.marker_radius)
        n_left_out += np.setdiff1d(about, seen.rows).size
        across, up, _ = seen.silent
        n_silent = np.sum(np.hypot(across, up) < 0.8 * field.marker_radius)
        assert n_silent < 0.01 * seen.n_on  # drop-outs alone
    assert n_left_out > 50


def test_all_markers_are_found_by_the_lines_whose_angle_is_known(scan):
    cloud, marks, field = scan
    found = extract(cloud, EXTRACTION, field.marker_radius)
    rough = np.array([c.p_base_rough for c in found.candidates])
    gaps = np.linalg.norm(rough[:, None] - marks, axis=2)
    assert (gaps.min(axis=0) < field.marker_radius).all()
    assert (gaps.min(axis=1) < field.marker_radius).all()
