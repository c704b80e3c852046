"""Markers in scans whose rig says badly how the LiDAR is mounted: the two faces lie apart."""

from dataclasses import replace

import numpy as np
import pytest

from spheremark.pipelines.config import ExtractionConfig
from spheremark.pipelines.detection import _moved_back, extract
from spheremark.pipelines.detection.faces import apart_of, faces_of, joined
from spheremark.pipelines.geometry import rot_z
from spheremark.pipelines.model import MarkerCandidates, Rejection
from tests.pipelines.synthetic_stop import RADIUS, RIG, World, scan, turned

MARKERS = np.array(
    [[3.0, 1.0, 0.1], [-3.0, 3.5, 0.4], [6.5, -5.0, 0.2], [-9.0, -7.0, 0.5], [2.0, 14.0, 0.6]]
)
TURNED, MOVED = 0.006, 0.006  # [rad] about the spin axis, [m] square to it: half of what is between


@pytest.fixture(scope="module")
def true_scan():
    balls = tuple((tuple(p), RADIUS) for p in MARKERS)
    return scan(World(balls=balls), np.random.default_rng(5), sigma=0.008, turn=26.4)


@pytest.fixture(scope="module")
def rough_scan(true_scan):
    """The same, of which the rig says that the LiDAR sits otherwise."""
    T = RIG.T_head_lidar
    moved = T.copy()
    moved[:3, :3] = T[:3, :3] @ rot_z(TURNED)
    spin = T[:3, 2]
    moved[:3, 3] += MOVED * np.cross([0.0, 0.0, 1.0], spin)
    p = true_scan.p_base.astype(np.float64)
    angles = np.asarray(true_scan.gimbal_angles, np.float64)
    p_lidar = (turned(p, -angles) - T[:3, 3]) @ T[:3, :3]
    p_base = turned(p_lidar @ moved[:3, :3].T + moved[:3, 3], angles)
    return replace(
        true_scan, p_base=p_base.astype(np.float32), rig=replace(RIG, T_head_lidar=moved)
    )


@pytest.fixture(scope="module")
def found(rough_scan):
    return extract(rough_scan, ExtractionConfig(), RADIUS)


def test_far_markers_that_the_faces_show_apart_are_found(found):
    gaps = [min(np.linalg.norm(one.p_base_rough - p) for one in found.candidates) for p in MARKERS]
    assert len(found.candidates) == len(MARKERS)
    assert max(gaps) < RADIUS


def test_places_are_those_of_the_given_rig(found, rough_scan):
    """What is fitted next starts from the returns as the given rig shows them."""
    for one in found.candidates:
        middle = rough_scan.p_base[one.members].mean(axis=0)
        assert np.linalg.norm(one.p_base_rough - middle) < 1.2 * RADIUS


def test_returns_that_are_none_move_no_marker(found, rough_scan):
    p = np.vstack([rough_scan.p_base, np.full((50, 3), np.nan), np.full((50, 3), np.inf)])
    columns = {
        name: np.append(np.asarray(getattr(rough_scan, name)), np.zeros(100, dtype))
        for name, dtype in (
            ("gimbal_angles", np.float32),
            ("intensities", np.float32),
            ("rings", np.uint8),
            ("times", np.float32),
        )
    }
    spoilt = replace(rough_scan, p_base=p.astype(np.float32), **columns)
    again = extract(spoilt, ExtractionConfig(), RADIUS)
    places, before = ([one.p_base_rough for one in own.candidates] for own in (again, found))
    np.testing.assert_allclose(places, before, rtol=0, atol=1e-3)


@pytest.mark.parametrize(("faces", "share"), [((0.5,), 1.0), ((-0.5,), 1.0), ((0.5, -0.5), 0.0)])
def test_refused_groups_too_are_where_the_given_rig_shows_them(true_scan, rough_scan, faces, share):
    """Away by half of what lies between the faces where one shows them, not where both do."""
    place = MARKERS[4]
    is_near = np.linalg.norm(true_scan.p_base - place, axis=1) < 1.5 * RADIUS
    own = np.isin(faces_of(RIG, true_scan.gimbal_angles, place), faces)
    none = np.array([[np.nan] * 3, [np.inf] * 3], np.float32)  # returns that are none
    points, others = (
        np.vstack([none, one.p_base[is_near & own]]) for one in (true_scan, rough_scan)
    )
    refused = Rejection(p_base=place, n_points=9, reason="")
    found = MarkerCandidates(candidates=(), rejected=(refused,), ground_height_max=0.0)
    (back,) = _moved_back(found, points, others).rejected
    moved = np.linalg.norm(back.p_base - place)
    assert moved == pytest.approx(share * 14.2 * TURNED, abs=0.03)


def test_a_scan_is_joined_by_what_lies_between_its_faces(true_scan, rough_scan):
    shifts = np.array([[0.0, 2.0 * TURNED * d, 2.0 * MOVED] for d in (3.0, 5.0, 8.0, 14.0)])
    between = apart_of(shifts, np.array([3.0, 5.0, 8.0, 14.0]))
    gaps = np.abs(joined(rough_scan, between).p_base - true_scan.p_base)
    assert gaps.max() < 1e-4


def test_faces_that_agree_are_left():
    rng = np.random.default_rng(1)
    distances = np.geomspace(3.0, 20.0, 8)
    assert apart_of(rng.normal(0.0, 2e-3, (8, 3)), distances) is None
    assert apart_of(np.full((1, 3), 0.1), distances[:1]) is None, "too few spheres"


def test_two_spheres_show_faces_far_apart_and_no_others():
    distances = np.array([10.0, 15.0])
    near, far = (np.outer(distances, [0.0, higher, 0.0]) for higher in (2e-3, 6e-3))
    assert apart_of(near, distances) is None
    assert apart_of(far, distances).higher == pytest.approx(6e-3)
