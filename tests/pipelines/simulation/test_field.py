import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from spheremark.pipelines.errors import ConfigError
from spheremark.pipelines.simulation import SimulationConfig, scenario, simulate_stop
from spheremark.pipelines.simulation.field import PAPER_DISTANCES
from spheremark.pipelines.simulation.rocks import draw_rocks
from spheremark.pipelines.simulation.terrain import rough_terrain

FIRED = 16 * 13.3 / 55.296e-6  # half a revolution before and after the turn included


@pytest.fixture(scope="module", params=[0, 1])
def field(request):
    return scenario("paper-field", request.param)


def hits(field, stop, stitched, rig):
    """Count the returns of each sphere, the limb included, and say how far it is."""
    away = stitched(stop, rig)[:, None] - field.marks.p_site
    is_hit = (np.abs(np.linalg.norm(away, axis=2) - 0.1) < 0.045) & (away[..., 2] > -0.095)
    distances = np.linalg.norm(field.marks.p_site - stop.truth.T_site_base[:3, 3], axis=1)
    return is_hit.sum(axis=0), distances


def test_distances_from_the_centre_stop_are_those_of_the_study(paper_field):
    distances = np.linalg.norm(
        paper_field.marks.p_site - paper_field.stop("lane3-stop4").p_site, axis=1
    )
    assert_allclose(np.sort(distances), PAPER_DISTANCES, rtol=0, atol=1e-9)


def test_there_are_five_lanes_of_seven_stops_about_a_metre_up(paper_field):
    names = [f"lane{lane}-stop{stop}" for lane in range(1, 6) for stop in range(1, 8)]
    assert [stop.name for stop in paper_field.stops] == names
    p_site = np.array([stop.p_site for stop in paper_field.stops])
    assert_array_equal(p_site[17, :2], [0.0, 0.0])
    assert_array_equal(np.abs(p_site[:, :2]).max(axis=0), [4.5, 4.0])
    above = p_site[:, 2] - paper_field.terrain.height_at(p_site)
    assert above.min() > 0.9
    assert above.max() < 1.2


def test_markers_stand_outside_the_lanes_as_high_as_designed(field):
    above = field.marks.p_site[:, 2] - field.terrain.height_at(field.marks.p_site)
    assert above.min() >= 0.6
    assert above.max() <= 1.5
    gaps = [np.linalg.norm(field.marks.p_site - stop.p_site, axis=1).min() for stop in field.stops]
    assert min(gaps) > 2.0
    between = np.linalg.norm(field.marks.p_site[:, None] - field.marks.p_site, axis=2)
    assert between[np.triu_indices(14, 1)].min() > 1.0


def test_the_cut_at_the_highest_ground_takes_parts_of_spheres_and_no_whole_one(field):
    cuts = np.array([field.terrain.highest_near(stop.p_site, 10.0) for stop in field.stops])
    left = (field.marks.p_site[:, 2] + 0.1 - cuts[:, None]) / 0.2  # of the sphere's height
    assert left.min() > 0.25
    assert (left < 1.0).mean() > 0.3


def test_the_ground_is_gentle_and_level():
    for seed in range(3):
        terrain = rough_terrain(np.random.default_rng(seed))
        middle = np.abs(terrain.xs) < 14.0
        heights = terrain.heights[np.ix_(middle, middle)]
        step = terrain.xs[middle][14] - terrain.xs[middle][0]
        slope = np.sqrt(np.mean((heights[:, 14:] - heights[:, :-14]) ** 2)) / step
        assert 2.0 < np.degrees(np.arctan(slope)) < 5.0
        assert abs(heights.mean()) < 0.1


def test_the_ground_is_rougher_over_longer_lags_as_a_fractal_is():
    heights = rough_terrain(np.random.default_rng(1)).heights
    middle = heights[80:-80, 80:-80]
    rises = [np.sqrt(np.mean((middle[:, n:] - middle[:, :-n]) ** 2)) for n in (7, 14)]
    assert 0.5 < np.log2(rises[1] / rises[0]) < 0.95  # the Hurst exponent, craters included


def test_rocks_cover_a_hundredth_of_the_ground_and_keep_clear():
    keep_clear = np.array([[0.0, 0.0, 2.0], [5.0, 5.0, 1.0]])
    rocks = np.concatenate(
        [draw_rocks(np.random.default_rng(seed), keep_clear) for seed in range(8)]
    )
    near = rocks[np.abs(rocks[:, :2]).max(axis=1) < 14.0]
    cover = (np.pi / 4 * near[:, 2] ** 2).sum() / 28.0**2 / 8
    assert_allclose(cover, 0.01, rtol=0.2)
    assert near[:, 2].min() < 0.06
    assert near[:, 2].max() > 0.6
    for x, y, radius in keep_clear:
        assert (np.hypot(rocks[:, 0] - x, rocks[:, 1] - y) > radius + rocks[:, 2] / 2).all()


def test_the_same_seed_gives_the_same_world_and_another_another(paper_field):
    again, other = scenario("paper-field", 3), scenario("paper-field", 4)
    assert_array_equal(again.scene.mesh.p_site, paper_field.scene.mesh.p_site)
    assert_array_equal(again.marks.p_site, paper_field.marks.p_site)
    assert not np.array_equal(other.marks.p_site, paper_field.marks.p_site)
    assert not np.array_equal(other.terrain.heights, paper_field.terrain.heights)


def test_the_world_is_small_enough_to_cast_rays_in(paper_field):
    assert len(paper_field.scene.mesh.triangles) < 750_000


def test_aimed_beams_meet_the_spheres_as_often_as_geometry_says(paper_field, stitched):
    config = SimulationConfig.perfect(only_near_spheres=True)
    stop = simulate_stop(paper_field, "lane3-stop4", config)
    counts, distances = hits(paper_field, stop, stitched, stop.rig)
    expected = FIRED * 0.1**2 / (2 * np.pi)
    assert_allclose(np.mean(counts * distances**2), expected, rtol=0.03)


def test_the_footprint_brings_the_counts_of_the_study(paper_field, stitched):
    config = SimulationConfig(only_near_spheres=True)
    stop = simulate_stop(paper_field, "lane3-stop4", config)
    counts, distances = hits(paper_field, stop, stitched, stop.rig)
    assert abs(np.mean(counts * distances**2) - 6860) < 770


@pytest.mark.parametrize("name", ["lane1-stop1", "lane1-stop7", "lane5-stop1", "lane5-stop7"])
def test_nearly_all_markers_are_seen_from_the_corners(paper_field, stitched, name):
    config = SimulationConfig.perfect(turn=6.6, only_near_spheres=True)
    stop = simulate_stop(paper_field, name, config)
    counts, distances = hits(paper_field, stop, stitched, stop.rig)
    expected = FIRED / 2 * 0.1**2 / (2 * np.pi * distances**2)
    assert (counts > 0.5 * expected).sum() >= 13


def test_an_unknown_scenario_or_seed_is_refused(paper_field):
    with pytest.raises(ConfigError, match="there are: paper-field, "):
        scenario("moon", 1)
    with pytest.raises(ConfigError, match="seed is -1"):
        scenario("paper-field", -1)
    with pytest.raises(ConfigError, match="seed is -2"):
        simulate_stop(paper_field, "lane1-stop1", SimulationConfig(), seed=-2)


@pytest.mark.benchmark
def test_a_stop_simulates_in_about_the_time_that_it_lasts(paper_field):
    import time

    config = SimulationConfig()
    simulate_stop(paper_field, "lane3-stop4", config)  # compiles, and grows the search tree
    start = time.perf_counter()
    simulate_stop(paper_field, "lane3-stop4", config)
    assert time.perf_counter() - start < config.turn
