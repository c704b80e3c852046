"""Elevation models: what the ground is, what stands on it, and how sure a height is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spheremark.pipelines.errors import ConfigError, NoGroundError
from spheremark.pipelines.geometry import exp_motion, rigid, rot_y, rot_z, turn_in_place
from spheremark.pipelines.ground_model import (
    ElevationConfig,
    StationPose,
    Terrain,
    pose_of_fix,
    pose_of_points,
    station_points,
)
from spheremark.pipelines.model import Levelling, StitchedCloud
from spheremark.pipelines.scan.rigs import tilted_vlp16

MAST = 1.05


def ground(x, y):
    """A slope of 5 percent with a hollow."""
    return 0.05 * x - 0.3 * np.exp(-((x - 4) ** 2 + y**2) / 8)


def pose(T=None, sigma=0.0):
    return StationPose(
        name="stop",
        T_site_station=np.eye(4) if T is None else T,
        cov_T_site_station=np.diag([0.0, 0.0, 0.0, 0.0, 0.0, sigma**2]),
    )


def cloud_of(p_station, name="stop"):
    n = len(p_station)
    return StitchedCloud(
        p_base=np.asarray(p_station, dtype=np.float32),
        gimbal_angles=np.zeros(n, np.float32),
        intensities=np.full(n, 10.0, np.float32),
        rings=(np.arange(n) % 16).astype(np.uint8),
        times=np.linspace(0, 13, n).astype(np.float32),
        levelling=Levelling(roll=0.0, pitch=0.0, sigma=0.003, is_measured=True),
        rig=tilted_vlp16("rig", (0.0, 0.0)),
        coverage=6.283,
        duration=13.0,
        name=name,
    )


def scanned(rng, n=120_000, reach=8.0, sigma=0.01, shape=ground):
    """Returns on smooth ground in the station frame: noise along the beam, no shadows."""
    x, y = rng.uniform(-reach, reach, (2, n))
    p = np.column_stack([x, y, shape(x, y) - MAST])
    p = p[np.hypot(p[:, 0], p[:, 1]) > 0.9]
    lengths = np.linalg.norm(p, axis=1, keepdims=True)
    return p + p / lengths * rng.normal(0, sigma, (len(p), 1))


def model_of(p_station, config=None, where=None):
    config = config or ElevationConfig(range_max=8.0)
    where = where or pose()
    terrain = Terrain([where], config)
    terrain.add(cloud_of(p_station), where)
    return terrain.model()


def errors(model, shape=ground):
    x, y = np.meshgrid(model.xs, model.ys)
    return model.heights - (shape(x, y) - MAST)


def test_smooth_ground_is_found_to_a_millimetre():
    model = model_of(scanned(np.random.default_rng(1)))
    off = errors(model)[np.isfinite(model.heights)]
    assert model.share_known > 0.75  # the corners of a square are farther than the range
    assert abs(off.mean()) < 0.0003
    assert np.sqrt(np.mean(off**2)) < 0.0015


def test_a_site_keeps_its_place_when_station_and_heading_change():
    points = scanned(np.random.default_rng(2))
    T = rigid(rot_z(0.8), [500.3, -77.7, 31.2])
    model = model_of(points, where=pose(T))
    x, y = np.meshgrid(model.xs, model.ys)
    back = np.linalg.inv(T) @ np.stack([x, y, x * 0, x * 0 + 1]).reshape(4, -1)
    true = ground(back[0], back[1]).reshape(x.shape) - MAST + 31.2
    off = (model.heights - true)[np.isfinite(model.heights)]
    assert np.sqrt(np.mean(off**2)) < 0.002


def test_rocks_poles_and_markers_are_not_ground():
    rng = np.random.default_rng(3)
    bare = scanned(rng)
    rocks = []
    lattice = np.stack(np.meshgrid(np.arange(-5, 6, 2.0), np.arange(-5, 6, 2.0)), -1).reshape(-1, 2)
    for x, y in lattice + rng.uniform(-0.5, 0.5, lattice.shape):
        inside = np.hypot(bare[:, 0] - x, bare[:, 1] - y) < 0.2
        bare = bare[~inside]  # a rock hides the ground under it
        u = rng.uniform(-0.2, 0.2, (400, 2))
        u = u[np.hypot(*u.T) < 0.2]
        top = np.sqrt(0.05 - np.sum(u**2, axis=1)) + ground(x + u[:, 0], y + u[:, 1]) - MAST
        rocks.append(np.column_stack([x + u[:, 0], y + u[:, 1], top]))
    pole = np.column_stack([np.full(300, 3.0), np.zeros(300), np.linspace(-MAST, 0, 300)])
    ball = rng.normal(size=(500, 3))
    ball = [3.0, 0.0, 0.1] + 0.1 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    model = model_of(np.vstack([bare, *rocks, pole, ball]))
    off = errors(model)[np.isfinite(model.heights)]
    assert np.quantile(np.abs(off), 0.99) < 0.012
    assert np.abs(off).max() < 0.06
    assert abs(off.mean()) < 0.001


def test_a_wall_is_not_ground_however_wide():
    rng = np.random.default_rng(4)
    ledge = lambda x, y: np.where((x > 3) & (np.abs(y) < 3), 1.5, 0.0)  # noqa: E731
    model = model_of(scanned(rng, shape=ledge))
    x, y = np.meshgrid(model.xs, model.ys)
    near_edge = (x > 3.1) & (x < 4.0) & (np.abs(y) < 2)
    assert np.isnan(model.heights[near_edge]).all()


def test_the_error_of_a_pose_is_in_every_height():
    points = scanned(np.random.default_rng(5))
    exact, vague = model_of(points), model_of(points, where=pose(sigma=0.02))
    known = np.isfinite(exact.sigmas)
    added = np.sqrt(vague.sigmas[known] ** 2 - exact.sigmas[known] ** 2)
    np.testing.assert_allclose(added, 0.02, rtol=0.01)


def test_an_uncertain_lean_of_a_station_grows_with_the_distance():
    points = scanned(np.random.default_rng(6))
    lean = StationPose(
        name="stop",
        T_site_station=np.eye(4),
        cov_T_site_station=np.diag([0.0, 0.003**2, 0.0, 0.0, 0.0, 0.0]),
    )
    exact, vague = model_of(points), model_of(points, where=lean)
    added = np.sqrt(np.maximum(vague.sigmas**2 - exact.sigmas**2, 0.0))
    column = int(np.argmin(np.abs(vague.xs - 6.0)))
    expected = 0.003 * vague.xs[column]
    assert abs(np.nanmedian(added[:, column]) - expected) < 0.1 * expected


def test_a_heading_that_clocks_leave_unknown_is_in_no_height():
    points, T = scanned(np.random.default_rng(6)), rigid(rot_z(0.4), np.array([30.0, -20.0, 1.0]))
    axis = rot_y(0.05)[:, 2]  # of a gimbal that leans
    own, turn = np.diag([1e-8, 1e-8, 1e-8, 1e-6, 1e-6, 1e-6]), turn_in_place(T, axis)
    vague = pose_of_points("stop", T, own + 0.014**2 * np.outer(turn, turn), (0.014, axis))
    sharp = StationPose(name="stop", T_site_station=T, cov_T_site_station=own)
    expected = model_of(points, where=sharp).sigmas
    np.testing.assert_allclose(model_of(points, where=vague).sigmas, expected, rtol=1e-6)


def test_stops_that_agree_make_heights_surer():
    rng = np.random.default_rng(7)
    poses = [pose(sigma=0.01), replace(pose(sigma=0.01), name="second")]
    terrain = Terrain(poses, ElevationConfig(range_max=8.0))
    terrain.add(cloud_of(scanned(rng)), poses[0])
    first = terrain.model()
    terrain.add(cloud_of(scanned(rng), "second"), poses[1])
    both = terrain.model()
    ratio = np.nanmedian(both.sigmas) / np.nanmedian(first.sigmas)
    assert abs(ratio - np.sqrt(0.5)) < 0.05
    assert both.counts.sum() > 1.9 * first.counts.sum()


def test_where_one_stop_sees_a_thing_and_another_the_ground_it_is_the_ground():
    rng = np.random.default_rng(8)
    bare = scanned(rng)
    hidden = np.hypot(bare[:, 0] - 4, bare[:, 1]) < 0.5
    covered = bare.copy()
    covered[hidden, 2] += 0.3
    poses = [pose(), replace(pose(), name="second")]
    for first, second in ((bare, covered), (covered, bare)):
        terrain = Terrain(poses, ElevationConfig(range_max=8.0))
        terrain.add(cloud_of(first), poses[0])
        terrain.add(cloud_of(second, "second"), poses[1])
        off = errors(terrain.model())
        assert np.nanmax(np.abs(off)) < 0.02


def test_holes_stay_unless_they_are_to_be_filled_and_then_say_so():
    points = scanned(np.random.default_rng(9))
    points = points[np.hypot(points[:, 0] + 4, points[:, 1] - 1) > 0.6]
    bare = model_of(points)
    filled = model_of(points, ElevationConfig(range_max=8.0, gap_max=0.5))
    j, i = np.argmin(np.abs(bare.xs + 4)), np.argmin(np.abs(bare.ys - 1))
    assert np.isnan(bare.heights[i, j])
    assert not bare.is_filled.any()
    x, y = np.meshgrid(filled.xs, filled.ys)
    hole = np.hypot(x + 4, y - 1) < 0.5
    assert filled.is_filled[hole].mean() > 0.8
    assert (filled.counts[filled.is_filled] == 0).all()
    off = errors(filled)[filled.is_filled & hole]
    assert np.abs(off).max() < 4 * np.nanmax(filled.sigmas[filled.is_filled & hole])
    assert np.median(filled.sigmas[filled.is_filled]) > 2 * np.nanmedian(bare.sigmas)


def uneven(rng, n=150):
    """Ground that differs the more the farther apart, as terrain does; centimetres at a cell."""
    waves = np.exp(rng.uniform(np.log(0.03), np.log(1.0), n))  # [1/m]
    heading, phase = rng.uniform(0, 2 * np.pi, (2, n))
    k = 2 * np.pi * waves[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    size = 0.03 / np.sqrt(n) * waves**-1.0

    def shape(x, y):
        out = np.zeros_like(x)
        for (kx, ky), a, b in zip(k, size, phase, strict=True):
            out += a * np.cos(kx * x + ky * y + b)
        return out

    return shape


def test_heights_of_filled_holes_are_as_good_as_they_say():
    rng = np.random.default_rng(12)
    shape = uneven(rng)
    points = scanned(rng, n=150_000, reach=12.0, sigma=0.002, shape=shape)
    holes = np.abs((points[:, :2] + 1.25) % 2.5 - 1.25)  # one each two and a half metres
    points = points[np.hypot(*holes.T) > 0.9]
    config = ElevationConfig(range_max=12.0, sigma_range=0.002, gap_max=1.0)
    model = model_of(points, config)
    x, y = np.meshgrid(model.xs, model.ys)
    inside = model.is_filled & (np.hypot(x, y) < 11.0)
    assert inside.sum() > 800
    scaled = errors(model, shape)[inside] / model.sigmas[inside]
    assert 0.8 < np.sqrt(np.mean(scaled**2)) < 1.2


def test_cells_that_are_too_many_are_refused_before_memory_is_taken():
    far = [pose(), replace(pose(rigid(np.eye(3), [5000.0, 5000.0, 0.0])), name="far")]
    with pytest.raises(ConfigError, match="larger cells"):
        Terrain(far, ElevationConfig(cell=0.1))


def test_a_cloud_without_ground_is_refused():
    with pytest.raises(NoGroundError, match="ground"):
        model_of(np.full((100, 3), 30.0))


def test_a_cloud_of_a_site_can_be_thinned_and_cut():
    points = scanned(np.random.default_rng(10), n=30_000)
    whole = cloud_of(points)
    cut = station_points(whole, pose(), range_max=5.0)
    assert len(cut.p_station) == np.sum(np.linalg.norm(whole.p_base, axis=1) <= 5.0)
    thin = station_points(whole, pose(rigid(rot_z(0.3), [7.0, 8.0, 9.0])), voxel=0.5)
    cubes = np.floor(thin.p_site / 0.5)
    assert len(np.unique(cubes, axis=0)) == len(thin.p_station)
    everything = np.floor(station_points(whole, pose(thin.T_site_station)).p_site / 0.5)
    assert len(np.unique(everything, axis=0)) == len(thin.p_station)
    with pytest.raises(ConfigError, match="edge"):
        station_points(whole, pose(), voxel=-1.0)


@pytest.mark.slow
def test_heights_of_simulated_ground_are_as_good_as_they_say():
    """Six stops of two surveys: rocks, shadows, poses with their errors; truth is the terrain."""
    from spheremark.pipelines.config import SurveyConfig
    from spheremark.pipelines.simulation import SimulationConfig, scenario, simulate_stop
    from spheremark.pipelines.survey import process

    config = SurveyConfig.from_mapping({"fitting": {"methods": ["along_beam"]}})
    found = []
    for seed, names in (
        (41, ("lane1-stop2", "lane3-stop4", "lane5-stop6")),
        (42, ("lane2-stop5",)),
    ):
        field = scenario("paper-field", seed)
        stops = []
        for name in names:
            log = simulate_stop(field, name, SimulationConfig()).log
            (result,) = process(log, config=config, marks=field.marks)
            fix = result.fixes["along_beam", "free_station"]
            stops.append((result.cloud, pose_of_fix(name, fix)))
        terrain = Terrain([where for _, where in stops], ElevationConfig())
        for cloud, where in stops:
            terrain.add(cloud, where)
        model = terrain.model()
        off = model.heights - true_means(field.terrain, model)
        found.append(np.stack([off, model.sigmas])[:, np.isfinite(off)])
    off, sigmas = np.concatenate(found, axis=1)
    assert 0.90 < np.mean(np.abs(off) < 1.96 * sigmas) < 0.98
    assert abs(off.mean()) < 0.002
    assert np.median(np.abs(off)) < 0.003
    for one in found:
        assert 0.88 < np.mean(np.abs(one[0]) < 1.96 * one[1]) < 0.99


def true_means(terrain, model):
    """Mean of the true height over each cell, by 64 places in it."""
    steps = (np.arange(8) + 0.5) / 8 - 0.5
    x, y = np.meshgrid(model.xs, model.ys)
    shifts = [(a, b) for a in steps for b in steps]
    return np.mean(
        [
            terrain.height_at(np.stack([x + a * model.cell, y + b * model.cell], -1))
            for a, b in shifts
        ],
        axis=0,
    )


def test_the_pose_of_a_fix_is_used_as_it_is():
    """A station whose pose is off by a known motion gives heights that are off by it."""
    points = scanned(np.random.default_rng(11))
    T = exp_motion([0.0, 0.0, 0.0, 0.0, 0.0, 0.05])
    off = errors(model_of(points, where=pose(T)))
    assert abs(np.nanmean(off) - 0.05) < 0.0005
