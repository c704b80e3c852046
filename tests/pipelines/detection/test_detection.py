"""Markers among what looks like them, in one small crowded world."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from spheremark.pipelines.config import ExtractionConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.detection.cells import cells_of, rows_about
from spheremark.pipelines.detection.ground import ground_of, planes_below
from spheremark.pipelines.geometry import levelling_rotation
from spheremark.pipelines.model import RING_UNKNOWN, Levelling
from tests.pipelines.synthetic_stop import RADIUS, World, ring_of_markers, scan

CONFIG = ExtractionConfig()
GROUND = -0.8
MARKERS = np.vstack(
    [
        ring_of_markers(),
        [[13.9, 1.4, 0.3], [4.8, 17.3, 0.3]],  # 35 and 20 returns
        [[2.9, -1.6, GROUND + 0.45]],  # lower than the study's, and near
    ]
)
FEW = MARKERS[-2]  # it has 19 in a cloud whose pulses without a return are not known
POST, SLIM = (3.0, 3.0, GROUND), (-4.0, -3.0, GROUND)  # ends of posts of radius 0.1 and 0.03 m
BIG, SMALL = (-1.5, 4.5, 0.2), (2.0, 5.0, 0.1)  # balls of radius 0.16 and 0.06 m
PERCHED = (5.5, -3.0, GROUND + 0.2)  # a stone of a marker's own size, half a radius off the ground


@pytest.fixture(scope="module")
def cloud():
    rng = np.random.default_rng(1)
    phi, d = rng.uniform(0, 2 * np.pi, 250), rng.uniform(3, 20, 250)
    radii = np.minimum(rng.exponential(0.12, 250) + 0.03, 0.5)
    z = GROUND + radii * rng.uniform(-0.2, 0.8, 250)
    stones = np.column_stack([d * np.cos(phi), d * np.sin(phi), z])
    # a stone in front of or upon a marker would be a different test; one as large would be a marker
    azimuths = np.arctan2(MARKERS[:, 1], MARKERS[:, 0])
    off = np.abs((phi[:, None] - azimuths + np.pi) % (2 * np.pi) - np.pi) * d[:, None]
    clear = (off.min(axis=1) > radii + 0.35) & (np.abs(radii / RADIUS - 1.0) > 0.15)
    world = World(
        balls=(*((tuple(p), RADIUS) for p in MARKERS), (BIG, 0.16), (SMALL, 0.06)),
        boulders=(
            *((tuple(p), r) for p, r in zip(stones[clear], radii[clear], strict=True)),
            (PERCHED, RADIUS),
        ),
        posts=((POST, 0.1, 1.4), (SLIM, 0.03, 1.0)),
        ground=GROUND,
    )
    return scan(world, rng, sigma=0.01)


@pytest.fixture(scope="module")
def found(cloud):
    return extract(cloud, CONFIG, RADIUS)


def gaps(found, places):
    """Distance from each candidate to the nearest of some places."""
    rough = np.array([c.p_base_rough for c in found.candidates])
    return np.linalg.norm(rough[:, None] - np.atleast_2d(places)[None], axis=2)


def test_every_marker_is_found_and_nothing_else(found):
    assert_allclose(gaps(found, MARKERS).min(axis=0), 0, atol=0.025)
    assert len(found.candidates) == len(MARKERS)


@pytest.mark.parametrize("intensity", [0.0, 1.0, 900.0])
def test_markers_are_found_in_a_cloud_that_has_no_intensities(cloud, intensity):
    """Readers of files set them to 0; others may set them to any constant."""
    grey = replace(cloud, intensities=np.full_like(cloud.intensities, intensity))
    found_in_grey = extract(grey, CONFIG, RADIUS)
    assert_allclose(gaps(found_in_grey, MARKERS).min(axis=0), 0, atol=0.025)
    assert len(found_in_grey.candidates) == len(MARKERS)


def test_candidates_come_in_the_order_of_azimuth(found):
    rough = np.array([c.p_base_rough for c in found.candidates])
    assert (np.diff(np.arctan2(rough[:, 1], rough[:, 0])) > 0).all()


def test_no_marker_loses_points_to_the_ground(cloud, found):
    for candidate in found.candidates:
        gap = np.linalg.norm(cloud.p_base - candidate.p_base_rough, axis=1)
        on_it = np.flatnonzero(np.abs(gap - RADIUS) < 0.03)
        assert np.isin(on_it, candidate.members).all()
        assert (np.diff(candidate.members) > 0).all()


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ((*POST[:2], GROUND + 1.3), "free|post|Post"),
        ((*SLIM[:2], GROUND + 0.9), "post|cylinder|box|Box|Post"),
        (BIG, "radius|free"),
        (SMALL, "radius|small"),
    ],
)
def test_what_looks_like_a_marker_is_refused_with_a_reason(found, place, words):
    near = [r for r in found.rejected if np.linalg.norm(r.p_base - place) < 0.2]
    assert near
    assert any(word in near[0].reason for word in words.split("|"))


def test_heights_of_places_are_above_the_plane_of_the_ground_among_stones(cloud):
    cells = cells_of(cloud, CONFIG)
    planes = planes_below(ground_of(cloud, cells, CONFIG, RADIUS), cells, MARKERS)
    heights, sigmas = np.sum(planes[:, :3] * MARKERS, axis=1) + planes[:, 3], planes[:, 4]
    assert (np.abs(heights - (MARKERS[:, 2] - GROUND)) < 3.0 * sigmas).all()
    assert sigmas.max() < 0.2


def test_heights_of_places_follow_mounds_that_are_wider_than_a_few_cells(cloud):
    cells = cells_of(cloud, CONFIG)
    ground, height, half = ground_of(cloud, cells, CONFIG, RADIUS), 0.3, 1.5  # [m] of the mounds
    axis = (np.arange(len(ground.lowest)) + 0.5 - len(ground.lowest) // 2) * cells.edge
    for place in MARKERS:
        x, y, _ = cells.R_station_base @ place
        gaps2 = (axis[:, None] - x) ** 2 + (axis - y) ** 2
        mound = height * np.exp(-gaps2 / half**2)
        (plane,) = planes_below(ground._replace(lowest=ground.lowest + mound), cells, place[None])
        found = plane[:3] @ place + plane[3]
        assert abs(found - (place[2] - GROUND - height)) < 0.1


def test_spheres_are_found_as_far_as_they_have_returns():
    places = np.array([[40.0, 0.0, 1.2], [0.0, 48.0, 1.2], [-55.0, 0.0, 1.2]])
    world = World(balls=tuple((tuple(p), 0.4) for p in places), ground=GROUND)
    far = extract(scan(world, np.random.default_rng(3), sigma=0.01), CONFIG, 0.4)
    assert len(far.candidates) == len(places)
    assert_allclose(gaps(far, places).min(axis=0), 0, atol=0.06)


def test_a_ball_of_another_size_is_no_marker(found):
    assert gaps(found, [BIG, SMALL]).min() > 0.3


def test_the_highest_ground_is_that_of_the_plane(found):
    # low stones count as ground: their tops are cut by the study's method too
    assert GROUND < found.ground_height_max < GROUND + CONFIG.ground_clearance


@pytest.fixture(scope="module")
def found_bare(cloud):
    """What is found where rings, times and reflectivities are not known."""
    bare = replace(
        cloud,
        rings=np.full(len(cloud.rings), RING_UNKNOWN, np.uint8),
        times=np.zeros_like(cloud.times),
        intensities=np.zeros_like(cloud.intensities),
    )
    return extract(bare, CONFIG, RADIUS)


def test_rings_and_times_are_not_needed(found, found_bare):
    """But where fewer than 20 returns show a shape, and no paint is known, it may be in doubt."""
    places = [one.p_base_rough for one in found.candidates]
    expected = [place for place in places if np.linalg.norm(place - FEW) > RADIUS]
    seen = [one.p_base_rough for one in found_bare.candidates]
    assert len(expected) >= len(MARKERS) - 1
    assert gaps(found_bare, expected).min(axis=0).max() == 0.0
    seen += [one.p_base for one in found_bare.possible]
    assert len(seen) == len(MARKERS)
    assert np.linalg.norm(np.array(seen)[:, None] - MARKERS, axis=2).min(axis=0).max() < 0.025


def test_the_order_of_returns_does_not_matter(cloud, found):
    mixed = np.random.default_rng(2).permutation(len(cloud.p_base))
    names = ("p_base", "gimbal_angles", "intensities", "rings", "times")
    other = replace(cloud, **{name: getattr(cloud, name)[mixed] for name in names})
    again = extract(other, CONFIG, RADIUS)
    assert_allclose(gaps(again, MARKERS).min(axis=0), 0, atol=0.025)
    for one, two in zip(found.candidates, again.candidates, strict=True):
        assert np.array_equal(np.sort(mixed[two.members]), one.members)


def test_a_leaning_base_changes_nothing():
    lean = Levelling(roll=0.08, pitch=-0.05, sigma=1e-3, is_measured=True)
    places = ring_of_markers(n=5)
    world = World(balls=tuple((tuple(p), RADIUS) for p in places), ground=GROUND)
    found = extract(scan(world, np.random.default_rng(3), levelling=lean), CONFIG, RADIUS)
    rough = np.array([c.p_base_rough for c in found.candidates])
    level = rough @ levelling_rotation(lean).T
    assert len(level) == 5
    assert np.linalg.norm(level[:, None] - places[None], axis=2).min(axis=0).max() < 0.025


def test_a_marker_in_the_air_with_no_ground_in_sight_is_kept(cloud):
    near = np.linalg.norm(cloud.p_base - MARKERS[5], axis=1) < 0.3
    names = ("p_base", "gimbal_angles", "intensities", "rings", "times")
    alone = replace(cloud, **{name: getattr(cloud, name)[near] for name in names})
    found = extract(alone, CONFIG, RADIUS)
    assert len(found.candidates) == 1
    assert found.ground_height_max == -np.inf


def test_an_empty_cloud_has_no_markers(cloud):
    names = ("p_base", "gimbal_angles", "intensities", "rings", "times")
    empty = replace(cloud, **{name: getattr(cloud, name)[:0] for name in names})
    found = extract(empty, CONFIG, RADIUS)
    assert found.candidates == ()
    assert found.rejected == ()


@pytest.mark.parametrize("azimuth", [0.0, 1.0, np.pi / 2, 3.1, np.pi, -np.pi / 2, -0.003])
@pytest.mark.parametrize("elevation", [-1.55, -0.5, 0.0, 1.2])
@pytest.mark.parametrize("deep", [0.5, np.inf])
def test_returns_about_a_place_are_those_of_a_search_through_all(cloud, azimuth, elevation, deep):
    rng = np.random.default_rng(6)
    level = np.cos(elevation)
    c = 3.0 * np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    p = (c + rng.normal(0.0, 1.0, (20_000, 3))).astype(np.float32)
    names = ("gimbal_angles", "intensities", "rings", "times")
    some = replace(cloud, p_base=p, **{name: getattr(cloud, name)[: len(p)] for name in names})
    rows = rows_about(p, cells_of(some, CONFIG), c, 4.0 * RADIUS, deep)
    distances = np.linalg.norm(p.astype(np.float64), axis=1)
    angles = np.arccos(p.astype(np.float64) @ c / (3.0 * distances))
    is_in = (angles < np.arctan(4.0 * RADIUS / 3.0)) & (np.abs(distances - 3.0) < deep)
    assert 0 < is_in.sum() < len(p)
    np.testing.assert_array_equal(np.sort(rows), np.flatnonzero(is_in))
