"""Scans that show markers badly: thinned, noisy, stepped, among leaves, beside stones."""

from dataclasses import replace

import numpy as np
import pytest

from spheremark.pipelines.config import ExtractionConfig, StitchingConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.geometry import inverse, transform
from spheremark.pipelines.model import StitchedCloud
from spheremark.pipelines.scan.stitching import choose_rig, stitch
from spheremark.pipelines.simulation import random_world
from spheremark.pipelines.simulation.stands import POLE
from spheremark.pipelines.simulation.worlds import family_of
from tests.pipelines.synthetic_stop import RADIUS, World, scan

GROUND = -0.8
COLUMNS = ("p_base", "gimbal_angles", "intensities", "rings", "times")


def around(distances, height, turn):
    """Places in the directions of a clock, at these distances [m]."""
    phi = 2 * np.pi * (np.arange(len(distances)) + turn) / len(distances)
    return np.column_stack(
        [distances * np.cos(phi), distances * np.sin(phi), np.full(len(distances), height)]
    )


MARKERS = around(np.array([5.0, 7.0, 9.0, 11.0, 13.0]), 0.3, 0.1)


@pytest.fixture(scope="module")
def cloud():
    """Five markers and twelve round stones, half in the ground, 12 to 26 m away."""
    stones = around(np.linspace(12.0, 26.0, 12), GROUND, 0.55)
    rng = np.random.default_rng(60)
    heights = GROUND + RADIUS * rng.uniform(0.0, 0.5, len(stones))
    world = World(
        balls=tuple((tuple(p), RADIUS) for p in MARKERS),
        boulders=tuple(
            ((x, y, z), RADIUS * size)
            for (x, y, _), z, size in zip(stones, heights, rng.uniform(0.9, 1.1, 12), strict=True)
        ),
        ground=GROUND,
    )
    return scan(world, rng, sigma=0.01)


def gaps(places, found):
    rough = np.array([c.p_base_rough for c in found.candidates]).reshape(-1, 3)
    return np.linalg.norm(np.asarray(places)[:, None] - rough[None], axis=2)


def assert_found_alone(places, found, within):
    assert len(found.candidates) == len(places)
    assert gaps(places, found).min(axis=1).max() < within


def test_markers_are_found_and_stones_of_their_size_on_the_ground_are_not(cloud):
    assert_found_alone(MARKERS, extract(cloud, ExtractionConfig(), RADIUS), 0.3 * RADIUS)


def test_markers_of_a_thinned_log_are_found_though_most_pulses_seem_silent(cloud):
    """Of those with fewer than 20 returns the size is not sure: they may be possible ones."""
    kept = np.random.default_rng(61).random(len(cloud.rings)) < 0.4
    thinned = replace(cloud, **{name: getattr(cloud, name)[kept] for name in COLUMNS})
    found = extract(thinned, ExtractionConfig(), RADIUS)
    all_found = [c.p_base_rough for c in found.candidates] + [c.p_base for c in found.possible]
    offs = np.linalg.norm(MARKERS[:, None] - np.array(all_found), axis=2)
    assert len(all_found) == len(MARKERS)
    assert offs.min(axis=1).max() < 0.5 * RADIUS
    assert all(possible.n_points < 20 for possible in found.possible)
    assert len(found.candidates) >= len(MARKERS) - 1


def test_all_markers_of_a_thinned_log_are_sure_ones(cloud):
    kept = np.random.default_rng(61).random(len(cloud.rings)) < 0.4
    thinned = replace(cloud, **{name: getattr(cloud, name)[kept] for name in COLUMNS})
    assert_found_alone(MARKERS, extract(thinned, ExtractionConfig(), RADIUS), 0.5 * RADIUS)


def behind_leaves(cloud: StitchedCloud, middle, rng) -> StitchedCloud:
    """The cloud with a crown of leaves, 0.6 m in radius, that cover a third of its outline."""
    p, distance = cloud.p_base.astype(np.float64), np.linalg.norm(middle)
    rows = np.flatnonzero(p @ middle > 0.97 * np.linalg.norm(p, axis=1) * distance)
    rays = p[rows] / np.linalg.norm(p[rows], axis=1)[:, None]
    for leaf in middle + 0.6 * rng.normal(0.0, 0.5, (150, 3)):
        reach = np.linalg.norm(leaf)
        hit = np.arccos(np.clip(rays @ leaf / reach, -1.0, 1.0)) < rng.uniform(0.02, 0.06) / reach
        hit &= np.linalg.norm(p[rows], axis=1) > reach
        p[rows[hit]] = rays[hit] * (reach + rng.normal(0.0, 0.01, hit.sum()))[:, None]
    return replace(cloud, p_base=p.astype(np.float32))


def test_tufts_between_the_gaps_of_a_crown_are_no_markers(cloud):
    rng, crowns = np.random.default_rng(62), around(np.array([6.0, 8.0, 10.0, 12.0]), 1.2, 0.75)
    for crown in crowns:
        cloud = behind_leaves(cloud, crown, rng)
    found = extract(cloud, ExtractionConfig(), RADIUS)
    assert not len(found.candidates) or gaps(crowns, found).min() > 1.5
    assert gaps(MARKERS, found).min(axis=1).max() < 0.5 * RADIUS


def test_spheres_of_two_metres_are_found_though_ranges_scatter_by_eight_centimetres():
    places = around(np.array([18.0, 24.0, 30.0]), 3.0, 0.2)
    world = World(balls=tuple((tuple(p), 2.0) for p in places), ground=-1.5)
    found = extract(scan(world, np.random.default_rng(63), sigma=0.077), ExtractionConfig(), 2.0)
    assert_found_alone(places, found, 0.2)


@pytest.mark.slow
def test_markers_of_a_stepped_scan_are_found_and_nothing_else():
    seed = 18
    assert family_of(seed) == "step-and-shoot"
    world = random_world(seed)
    field, cloud = (
        world.world.field,
        stitch(world.log, choose_rig(world.log, None), StitchingConfig()),
    )
    config = ExtractionConfig()
    found = extract(cloud, config, field.marker_radius)
    places = transform(inverse(world.stop.truth.T_site_base), field.marks.p_site)
    well_seen = np.array([n >= 20 and lines > 2 for n, lines in world.stop.counts])
    well_seen &= np.linalg.norm(places, axis=1) < config.range_max
    on_pole = np.array([stand == POLE for stand in field.stands])
    assert sum(well_seen & on_pole) > 1
    assert gaps(places[well_seen & on_pole], found).min(axis=1).max() < field.marker_radius
    possible = np.array([one.p_base for one in found.possible]).reshape(-1, 3)
    rough = np.vstack([possible, *(one.p_base_rough for one in found.candidates)])
    away = np.linalg.norm(places[well_seen, None] - rough, axis=2).min(axis=1)
    assert away.max() < field.marker_radius, "on a drum it is a possible one at least"
    assert gaps(places, found).min(axis=0).max() < field.marker_radius
    compared = [one.probability for one in found.rejected if not np.isnan(one.probability)]
    assert len(compared) > 5
    assert compared == sorted(compared, reverse=True)  # what a user may look for is not cut
