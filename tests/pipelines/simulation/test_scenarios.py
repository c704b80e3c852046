from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from spheremark.pipelines.simulation import SimulationConfig, scenario, simulate_stop, survey_truth
from spheremark.pipelines.simulation.bodies import box, cylinder, ellipsoid, leaves
from spheremark.pipelines.simulation.lane import LANE_DISTANCES
from spheremark.pipelines.simulation.scene import Mesh, Poles, Scene, Spheres, caster
from spheremark.pipelines.simulation.visibility import visible_shares


@pytest.fixture(scope="module")
def clutter():
    return scenario("clutter-field", 3)


@pytest.fixture(scope="module")
def lane():
    return scenario("range-lane", 3)


def nothing():
    empty = np.zeros((0, 3))
    return Poles(feet_site=empty, tops_site=empty.copy(), radii=np.zeros(0))


def volume(mesh):
    """Return the volume inside a closed mesh whose triangles all face outwards."""
    a, b, c = (mesh.p_site[mesh.triangles[:, k]] for k in range(3))
    return np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6


def test_bodies_are_closed_and_as_large_as_asked():
    assert_allclose(volume(box((1, 2, 3), (0.5, 2.0, 3.0), 0.7, 0.3)), 3.0, rtol=1e-9)
    pipe = cylinder((1.0, 0.0, 0.5), (1.0, 2.0, 0.5), 0.3, 0.3)
    assert_allclose(volume(pipe), np.pi * 0.09 * 2.0, rtol=0.01)
    egg = ellipsoid((3.0, 1.0, 1.0), (0.1, 0.2, 0.3), 0.2, 0.3)
    assert_allclose(volume(egg), 4 / 3 * np.pi * 0.006, rtol=0.02)


def test_leaves_fill_their_crown():
    crown = leaves(np.random.default_rng(0), (0.0, 0.0, 2.0), (1.0, 1.0, 0.5), 4000, 0.08)
    middles = crown.p_site[crown.triangles].mean(axis=1) - [0.0, 0.0, 2.0]
    depth = np.linalg.norm(middles / [1.0, 1.0, 0.5], axis=1)
    assert_allclose(np.mean(depth < 0.5), 0.125, atol=0.02)  # even in volume
    assert np.mean(depth < 1.1) > 0.97


def test_clutter_leaves_markers_and_stops_of_the_paper_field_as_they_are(clutter, paper_field):
    assert_array_equal(clutter.marks.p_site, paper_field.marks.p_site)
    assert [stop.name for stop in clutter.stops] == [stop.name for stop in paper_field.stops]
    assert_array_equal(clutter.scene.spheres.p_site[:14], clutter.marks.p_site)


def test_clutter_holds_everything_that_a_finder_might_take_for_a_marker(clutter):
    kinds = Counter(decoy.kind for decoy in clutter.decoys)
    assert set(kinds) == {
        "panel", "screen", "wall", "corner", "tree", "person", "barrel", "pipe", "pole",
        "wrong ball", "rock", "perched rock",
    }  # fmt: skip
    assert kinds["person"] >= 3
    extra = clutter.scene.spheres.radii[14:]
    assert set(np.round(extra, 3)) >= {0.06, 0.15, 0.25}
    assert ((extra >= 0.10) & (extra <= 0.12)).sum() == kinds["person"]


def test_decoys_stand_clear_of_stops_and_no_decoy_is_a_marker(clutter):
    places = np.array([decoy.p_site for decoy in clutter.decoys])
    stops = np.array([stop.p_site for stop in clutter.stops])
    away = np.linalg.norm(places[:, None, :2] - stops[:, :2], axis=2)
    assert away.min() > 0.9
    to_marks = np.linalg.norm(places[:, None] - clutter.marks.p_site, axis=2)
    assert to_marks.min() > 0.25


def test_screens_hide_some_markers_in_part_and_nothing_hides_others_from_the_centre(clutter):
    eye = clutter.stop("lane3-stop4").p_site
    shares = np.sort(visible_shares(clutter.scene, clutter.marks.p_site, 0.1, eye))
    assert ((shares > 0.45) & (shares < 0.85)).sum() == 3
    assert (shares[3:] > 0.98).all()


def test_the_visible_share_of_a_half_hidden_ball_is_a_half():
    ball = np.array([[5.0, 0.0, 0.0]])
    world = Scene(
        mesh=box((4.0, 1.0, 0.0), (0.01, 2.0, 2.0), 0.0, 0.3),
        spheres=Spheres(p_site=ball, radii=np.array([0.1]), reflectivities=np.array([0.5])),
        poles=nothing(),
    )
    assert_allclose(visible_shares(world, ball, 0.1, np.zeros(3)), [0.5], atol=0.01)
    assert_allclose(visible_shares(world, ball, 0.1, np.array([9.0, 0.0, 0.0])), [1.0])


def test_a_ball_in_front_hides_the_ball_behind():
    p_site = np.array([[5.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    world = Scene(
        mesh=Mesh.merged([]),
        spheres=Spheres(p_site=p_site, radii=np.full(2, 0.1), reflectivities=np.full(2, 0.5)),
        poles=nothing(),
    )
    assert_allclose(visible_shares(world, p_site, 0.1, np.zeros(3)), [0.0, 1.0])


def test_rock_fields_hold_many_rocks_of_marker_size_and_no_other_ball():
    world = scenario("rock-field", 3)
    kinds = Counter(decoy.kind for decoy in world.decoys)
    assert set(kinds) == {"rock", "perched rock"}
    assert kinds["rock"] > 150
    assert kinds["perched rock"] > 30
    assert len(world.scene.spheres.radii) == 14
    eye = world.stop("lane3-stop4").p_site
    down = np.array([0.0, 0.0, -1.0])
    above = np.array([decoy.p_site for decoy in world.decoys if decoy.kind == "perched rock"])
    above[:, 2] += 1.0
    rays = np.hstack([above, np.tile(down, (len(above), 1))]).astype(np.float32)
    tops, _ = caster(world.scene.mesh)(rays)
    assert ((tops > 0.87) & (tops < 0.93)).all()  # the rock's own top, 7 to 13 cm above its middle
    assert (np.hypot(*(above[:, :2] - eye[:2]).T) > 2.0).all()


def test_the_range_lane_has_eight_markers_at_each_distance_all_in_sight(lane):
    eye = lane.stops[0].p_site
    distances = np.linalg.norm(lane.marks.p_site - eye, axis=1)
    assert_allclose(np.sort(distances), np.repeat(LANE_DISTANCES, 8), rtol=0, atol=1e-9)
    assert (visible_shares(lane.scene, lane.marks.p_site, 0.1, eye) > 0.99).all()
    assert lane.marks.names[0] == "D050-1"
    assert len(set(lane.marks.names)) == 88


def test_the_truth_tells_decoys_and_visible_shares_beside_the_marks(lane, clutter):
    config = SimulationConfig(turn=0.5, only_near_spheres=True)
    bare = replace(clutter, scene=lane.scene)  # quick to cast
    made = simulate_stop(bare, "lane3-stop4", config)
    about = survey_truth(clutter, [made], config, 3).about
    assert len(about["decoys"]) == len(clutter.decoys)
    assert about["decoys"][0]["kind"] == "panel"
    assert set(about["visible_shares"]["lane3-stop4"]) == set(clutter.marks.names)


def test_worlds_are_drawn_from_their_seed(clutter, lane):
    assert_array_equal(scenario("clutter-field", 3).scene.mesh.p_site, clutter.scene.mesh.p_site)
    assert_array_equal(scenario("range-lane", 3).marks.p_site, lane.marks.p_site)
    assert not np.array_equal(scenario("range-lane", 4).marks.p_site, lane.marks.p_site)
