"""Random worlds: families, priors, seeds, and what a log must not hold."""

from collections import Counter
from dataclasses import fields

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from spheremark.pipelines.errors import ConfigError
from spheremark.pipelines.model import RING_UNKNOWN
from spheremark.pipelines.scan.rigs import rig_digest
from spheremark.pipelines.simulation import (
    FAMILIES,
    commensurability,
    draw_config,
    draw_world,
    random_world,
)
from spheremark.pipelines.simulation.objects import Site, cube, drum, wrong_ball
from spheremark.pipelines.simulation.options import Optics, Profile, SimulationConfig
from spheremark.pipelines.simulation.rig import nominal_rig, true_rig
from spheremark.pipelines.simulation.scene import caster
from spheremark.pipelines.simulation.stands import draw_stand
from spheremark.pipelines.simulation.terrain import rough_terrain
from spheremark.pipelines.simulation.worlds import PRIORS, family_of
from spheremark.storage.recordings import write_log


@pytest.fixture(scope="module")
def scan():
    return random_world(10)


@pytest.fixture(scope="module")
def worlds():
    """One world of each family, not simulated."""
    return {name: draw_world(2 * i + 32, name) for i, name in enumerate(FAMILIES)}


def test_every_family_is_drawn_by_even_and_by_odd_seeds_alike():
    for parity in (0, 1):
        drawn = Counter(family_of(seed) for seed in range(parity, 2 * len(FAMILIES), 2))
        assert drawn == dict.fromkeys(FAMILIES, 1)


def test_a_family_has_what_it_is_named_after(worlds):
    of = {name: world.config for name, world in worlds.items()}
    kinds = {name: {d.kind for d in world.field.decoys} for name, world in worlds.items()}
    assert commensurability(of["lattice"])
    assert of["step-and-shoot"].step > 0
    assert of["one face"].sweep < 1.2 * np.pi
    assert not of["bare"].has_rings
    assert abs(of["clock"].gimbal_clock_offset) >= 0.005
    assert of["dust"].optics.dust > 0
    assert of["plain"].optics.profile is Profile.EVEN
    assert not worlds["empty"].field.marks.names
    assert len(worlds["empty"].field.decoys) > 20
    assert {"person", "bush", "tree"} <= kinds["clutter"]
    assert kinds["panels"] & {"panel", "wall beside", "post beside", "screen"}
    assert {"cube", "cylinder", "wrong ball"} <= kinds["decoys"]
    assert sum(d.kind == "rock" for d in worlds["rocks"].field.decoys) > 20
    assert [name for name, config in of.items() if not config.shot_times] in ([], ["bare"])


def test_a_rover_has_masts_near_its_lidar_that_hide_some_of_the_field():
    n_near = 0
    for seed in range(0, 12, 2):
        field = draw_world(seed, "clutter").field
        masts = [d for d in field.decoys if d.kind == "mast"]
        away = [np.linalg.norm((d.p_site - field.stops[0].p_site)[:2]) for d in masts]
        assert len(masts) <= 3
        assert all(0.3 < one < 1.3 for one in away)
        n_near += sum(one < 0.9 for one in away)
    assert n_near > 0, "nearer than the least range that is used"


def test_every_quantity_has_a_prior_that_widens_in_its_families():
    for name, prior in PRIORS.items():
        assert prior.usual[0] < prior.usual[1], name
        assert prior.wide[0] < prior.wide[1], name
        assert set(prior.families) <= set(FAMILIES), name
        assert np.ptp(prior.wide) >= np.ptp(prior.usual), name
        rng = np.random.default_rng(0)
        drawn = [prior.draw(rng, "plain") for _ in range(200)]
        assert prior.usual[0] <= min(drawn) < max(drawn) <= prior.usual[1], name


def test_beams_are_drawn_rounder_and_flatter_than_by_the_data_sheet():
    def drawn(family):
        return np.log([draw_config(seed, family).optics.roundness for seed in range(40)])

    usual, wide = drawn("plain"), drawn("optics")
    assert abs(usual).max() < 0.2
    assert wide.min() < -0.2
    assert wide.max() > 0.5
    config = SimulationConfig(optics=Optics(divergence_scale=1.2, roundness=1.5))
    true, by_sheet = true_rig(config, np.random.default_rng(1)), nominal_rig(config)
    assert true.divergence == pytest.approx(by_sheet.divergence * [1.2, 1.8])


def test_radii_go_from_three_centimetres_to_two_and_a_half_metres_at_fitting_distances():
    found = [draw_world(seed, "radius").field for seed in range(0, 24, 2)]
    radii = np.array([field.marker_radius for field in found])
    assert radii.min() < 0.1
    assert radii.max() > 0.8
    for field in found:
        eye = field.stops[0].p_site
        distances = np.linalg.norm(field.marks.p_site - eye, axis=1)
        assert (distances > 4 * field.marker_radius).all()
        assert (distances < 400 * field.marker_radius + 2).all()
        above = field.marks.p_site[:, 2] - field.terrain.height_at(field.marks.p_site)
        assert (above > field.marker_radius).all()


def test_decoys_of_wrong_size_are_never_of_the_markers_size(worlds):
    for world in worlds.values():
        n, radius = len(world.field.marks.names), world.field.marker_radius
        wrong = [d.p_site for d in world.field.decoys if d.kind == "wrong ball"]
        for p in wrong:
            i = np.argmin(np.linalg.norm(world.field.scene.spheres.p_site - p, axis=1))
            ratio = world.field.scene.spheres.radii[i] / radius
            assert i >= n
            assert 0.7 <= ratio <= 0.9 or 1.1 <= ratio <= 1.5


def test_the_log_holds_the_nominal_rig_and_nothing_of_the_truth(scan, tmp_path):
    log, about = scan.log, scan.truth.about
    assert rig_digest(log.rig) == rig_digest(nominal_rig(scan.world.config))
    assert rig_digest(log.rig) != rig_digest(scan.truth.rig)
    write_log(log, tmp_path / "log.mcap")
    written = (tmp_path / "log.mcap").read_bytes()
    words = {about["family"], "random", "range_bias", "sigma_weak", "decoy", "visible"}
    words |= {kind for decoy in about["decoys"] if len(kind := decoy["kind"]) > 5}
    assert not [word for word in words if word.encode() in written]


def test_the_truth_lists_family_decoys_returns_and_shares(scan):
    about, names = scan.truth.about, scan.world.field.marks.names
    assert about["family"] == "panels"
    assert {"kind", "p_site_m", "reach_m"} <= set(about["decoys"][0])
    returns = about["returns"][scan.log.origin.name]
    assert set(returns) == set(names)
    for i, name in enumerate(names):
        assert returns[name]["n"] == np.sum(scan.stop.marks == i)
        assert returns[name]["n_lines"] <= returns[name]["n"]


def test_visible_shares_and_returns_agree(scan):
    about, name = scan.truth.about, scan.log.origin.name
    for mark, share in about["visible_shares"][name].items():
        assert (about["returns"][name][mark]["n"] > 0) == (share > 0.02), mark


def test_a_seed_gives_one_world_and_another_seed_another(scan):
    again, other = random_world(10), draw_world(12)
    for one in fields(scan.log):
        found, wanted = getattr(again.log, one.name), getattr(scan.log, one.name)
        if isinstance(wanted, np.ndarray):
            assert_array_equal(found, wanted)
    assert other.config == draw_config(12) != scan.world.config
    assert other.field.marks.names != scan.world.field.marks.names or not np.array_equal(
        other.field.marks.p_site, scan.world.field.marks.p_site
    )


def test_three_in_ten_raised_markers_stand_on_something_wide_right_below_them():
    kinds = Counter[str]()
    for seed in range(0, 80, 2):
        field = draw_world(seed).field
        marks, radius = field.marks.p_site, field.marker_radius
        kinds.update(field.stands)
        down = np.column_stack([marks, np.tile([0.0, 0.0, -1.0], (len(marks), 1))])
        below = caster(field.scene.mesh)(down.astype(np.float32))[0] - radius
        for kind, gap in zip(field.stands, below, strict=True):
            limit = {"pole": np.inf, "rock": 0.5}.get(kind, 0.16)
            assert -0.01 < gap < limit, f"seed {seed}: a marker hangs above its {kind}"
        stops = np.array([stop.p_site[:2] for stop in field.stops])
        near = np.linalg.norm(marks[:, None, :2] - stops, axis=2) - radius
        assert near.min(initial=np.inf) > 1.7
    wide = {"crate", "drum", "rock", "table", "tripod"}
    assert set(kinds) == wide | {"pole", "ground"}
    n = sum(kinds[kind] for kind in wide)
    assert n / (n + kinds["pole"]) == pytest.approx(0.3, abs=0.07)
    assert min(kinds[kind] for kind in wide) > 0.1 * n


def test_what_a_marker_stands_on_lies_below_it_and_nowhere_in_it():
    rng = np.random.default_rng(3)
    ground = rough_terrain(rng)
    for _ in range(60):
        centre = np.append(rng.uniform(-9.0, 9.0, 2), 0.0)
        centre[2] = ground.height_at(centre) + rng.uniform(0.4, 1.7)
        lowest = centre - np.array([0.0, 0.0, 0.1])
        stand = draw_stand(rng, ground, lowest, 0.1, 0.02)
        assert stand.kind != "ground"
        for mesh in stand.meshes:
            assert np.linalg.norm(mesh.p_site - centre, axis=1).min() > 0.095
            assert mesh.p_site[:, 2].max() < lowest[2] + 0.05
            away = np.linalg.norm((mesh.p_site - centre)[:, :2], axis=1).max()
            assert away < 1.5, "stops keep 1.8 m away from a marker"
        for foot, top, radius in stand.sticks:
            assert radius < 0.05
            assert foot[2] < top[2] < centre[2]
    centre[2] = ground.height_at(centre) + 0.02
    assert draw_stand(rng, ground, centre, 0.1, 0.02).kind == "ground"


def test_decoys_stand_on_the_same_things_as_markers():
    site = Site(terrain=rough_terrain(np.random.default_rng(1)))
    for builder in (wrong_ball, cube, drum):
        rngs = (np.random.default_rng([seed, 7]) for seed in range(60))
        raised = [item for rng in rngs if (item := builder(rng, np.zeros(3), site)).sticks]
        n_legs = Counter(len(item.sticks) - 1 for item in raised)
        assert set(n_legs) == {0, 3, 4}, "on a pole, a tripod and a table"
        assert n_legs[0] > 3 * (n_legs[3] + n_legs[4])


def test_the_truth_says_what_each_marker_stands_on(scan):
    stands = scan.truth.about["stands"]
    assert list(stands) == list(scan.world.field.marks.names)
    assert tuple(stands.values()) == scan.world.field.stands


def test_a_bare_log_has_no_rings():
    log = random_world(24).log
    assert set(np.unique(log.rings)) == {RING_UNKNOWN}


def test_an_unknown_family_is_refused():
    with pytest.raises(ConfigError, match="no family 'moon'; there are: plain, "):
        draw_world(0, "moon")
