"""Footprints, echoes, thresholds and noise against what is derived for them apart from the code."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from spheremark.pipelines.simulation import SimulationConfig, simulate_stop
from spheremark.pipelines.simulation.echo import Aims, Echoes, footprint, trace
from spheremark.pipelines.simulation.options import Optics, Pick, Profile
from spheremark.pipelines.simulation.rig import even_turn, horizon_lines, nominal_rig
from spheremark.pipelines.simulation.scene import Mesh, Poles, Scene, Spheres
from spheremark.pipelines.simulation.sensor import fire, record

WIDE = np.array([20e-3, 10e-3])  # [rad] so wide that a mean range differs clearly from the middle's
DISTANCE, RADIUS = 7.5, 0.1
MOMENTS = {  # mean squares across and along, in half widths
    Profile.EVEN: (0.25, 0.25),
    Profile.GAUSSIAN: (0.25, 0.25),
    Profile.TWO_LOBES: (0.55**2 + 0.45**2 / 4, 0.25),
}


def nothing():
    empty = np.zeros((0, 3))
    return (
        Spheres(p_site=empty, radii=np.zeros(0), reflectivities=np.zeros(0)),
        Poles(feet_site=empty.copy(), tops_site=empty.copy(), radii=np.zeros(0)),
    )


def wall(x, tilt=0.0, shade=0.3):
    """A wall that the x axis meets at x, turned about z."""
    across = np.array([np.sin(tilt), np.cos(tilt), 0.0]) * 9.0
    up = np.array([0.0, 0.0, 9.0])
    middle = np.array([x, 0.0, 0.0])
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    corners = np.array([middle + i * across + j * up for i, j in signs])
    return Mesh.even(corners, np.array([[0, 1, 2], [0, 2, 3]]), shade)


def ball_before(x, shade=0.3):
    """A sphere with a wall behind."""
    spheres = Spheres(
        p_site=np.array([[DISTANCE, 0.0, 0.0]]),
        radii=np.array([RADIUS]),
        reflectivities=np.array([0.5]),
    )
    return Scene(mesh=wall(x, shade=shade), spheres=spheres, poles=nothing()[1])


def seen(scene, y=0.0, divergence=WIDE, **optics):
    """Echo of a beam along x that passes y at the sphere; sweeps along y."""
    target = np.array([DISTANCE, y, 0.0])
    aims = Aims(
        origins_site=np.zeros((16, 3)),
        directions_site=np.tile(target / np.linalg.norm(target), (16, 1)),
        spin_axes_site=np.tile([0.0, 0.0, 1.0], (16, 1)),
    )
    echoes = trace(scene, aims, divergence, optics=Optics(**optics))
    return echoes.ranges[0], echoes.reflectivities[0], echoes.spheres[0]


@pytest.mark.parametrize("profile", list(Profile))
def test_a_profile_has_the_moments_that_define_it(profile):
    found = (footprint(profile, 2001) ** 2).mean(axis=0)
    assert_allclose(found, MOMENTS[profile], rtol=0.02)


def test_a_gaussian_profile_falls_to_its_share_within_every_radius():
    reach = np.hypot(*footprint(Profile.GAUSSIAN, 4001).T)
    for rho in (0.3, 0.7, 1.0, 1.5):
        assert_allclose(np.mean(reach < rho), 1 - np.exp(-2 * rho**2), atol=0.002)


@pytest.mark.parametrize("profile", list(Profile))
@pytest.mark.parametrize("incidence", [0.0, 1.0])
def test_the_mean_range_on_a_tilted_plane_follows_from_the_moments(profile, incidence):
    """With c the cosine of incidence, ranges are D / c and energies c^(2 + p)."""
    tilt = np.radians(70.0)
    spheres, poles = nothing()
    got, _, _ = seen(
        Scene(mesh=wall(DISTANCE, tilt), spheres=spheres, poles=poles),
        profile=profile,
        incidence=incidence,
        gate=2.0,
    )
    across2, along2 = np.array(MOMENTS[profile]) * (WIDE / 2) ** 2
    steep = np.tan(tilt)
    curved = across2 * (0.5 - (1.0 + incidence) * steep**2) + 0.5 * along2
    off_middle = footprint(profile, 61)[:, 0].mean() * WIDE[0] / 2  # of the rays of a bundle
    assert_allclose(got / DISTANCE - 1.0, curved - off_middle * steep, rtol=0.05)


@pytest.mark.parametrize("profile", list(Profile))
def test_the_mean_range_in_the_middle_of_a_sphere_follows_from_the_moments(profile):
    got, _, of = seen(ball_before(50.0), divergence=np.array([3e-3, 1.5e-3]), profile=profile)
    half = np.array([3e-3, 1.5e-3]) / 2 * (DISTANCE - RADIUS)
    depth = (np.array(MOMENTS[profile]) * half**2).sum() / 2 * (1 / RADIUS + 1 / DISTANCE)
    assert of == 0
    assert_allclose(got - (DISTANCE - RADIUS), depth, rtol=0.1)


def test_a_beam_that_is_wide_at_the_window_touches_what_its_axis_misses():
    aside = RADIUS + 0.010
    narrow = seen(ball_before(50.0, 0.001), aside, np.zeros(2))
    wide = seen(ball_before(50.0, 0.001), aside, np.zeros(2), window=(0.03, 0.03))
    assert narrow[0] > 50.0 - DISTANCE
    assert wide[0] < DISTANCE
    assert wide[2] == 0


def test_first_strongest_and_last_echo_are_what_they_say():
    limb = RADIUS + 0.01  # the sphere has the smaller share of this footprint
    ranges = {pick: seen(ball_before(DISTANCE + 3.0, 0.9), limb, pick=pick)[0] for pick in Pick}
    assert ranges[Pick.FIRST] < DISTANCE + 0.01
    assert ranges[Pick.STRONGEST] > DISTANCE + 2.9
    inside = RADIUS - 0.01
    assert seen(ball_before(DISTANCE + 3.0, 0.9), inside, pick=Pick.LAST)[0] > DISTANCE + 2.9


def test_an_echo_too_weak_to_be_heard_is_neither_first_nor_last():
    limb = RADIUS + 0.01
    first, _, _ = seen(ball_before(DISTANCE + 3.0, 0.9), limb, pick=Pick.FIRST, range_half=5.0)
    assert first > DISTANCE + 2.9


def test_the_gate_says_which_surfaces_merge():
    inside = RADIUS - 0.005
    mixed, _, _ = seen(ball_before(DISTANCE + 0.3, 0.5), inside, gate=0.8)
    single, _, _ = seen(ball_before(DISTANCE + 0.3, 0.5), inside, gate=0.05)
    assert DISTANCE + 0.02 < mixed < DISTANCE + 0.28
    assert single < DISTANCE + 0.01


def test_the_cosine_of_incidence_dims_a_tilted_plane():
    spheres, poles = nothing()
    tilted = Scene(mesh=wall(DISTANCE, np.radians(60.0)), spheres=spheres, poles=poles)
    _, dimmed, _ = seen(tilted, divergence=np.zeros(2), incidence=1.0)
    assert_allclose(dimmed, 0.3 * 0.5, rtol=1e-5)


def recorded(ranges, shade, **optics):
    config = SimulationConfig.perfect(optics=Optics(**optics), drop_out=0.0)
    pulses = fire(0, 6000, 1.0, even_turn(config, 0.2), config.spin_rpm)
    n = len(pulses.rings)
    echoes = Echoes(
        ranges=np.full(n, ranges), reflectivities=np.full(n, shade), spheres=np.full(n, -1)
    )
    returns = record(pulses, echoes, nominal_rig(config), config, np.random.default_rng(3))
    return returns, len(returns.rings) / n


@pytest.mark.parametrize("odds", [1 / 3, 1.0, 3.0])
def test_the_threshold_misses_the_share_that_its_logistic_gives(odds):
    softness, reach = 0.2, 20.0
    _, share = recorded(
        reach, 0.1 * odds**softness, range_half=reach, softness=softness, sigma_weak=0.0
    )
    assert_allclose(share, odds / (1 + odds), atol=0.007)


def test_noise_grows_as_one_over_the_energy():
    strong, _ = recorded(5.0, 0.8, range_half=20.0, sigma_weak=0.02)
    weak, _ = recorded(15.0, 0.1, range_half=20.0, sigma_weak=0.02)
    for returns, ratio in ((strong, 0.8 / 0.1 * 16.0), (weak, 16.0 / 9.0)):
        assert_allclose(returns.sigmas, 0.02 / ratio, rtol=1e-9)
    assert_allclose(np.std(np.linalg.norm(weak.p_lidar, axis=1)), 0.02 * 9 / 16, rtol=0.02)


def ranges_of(stop):
    """Return the distances from where the beams leave the spin axis."""
    heights = stop.rig.laser_heights[stop.log.rings]
    return np.linalg.norm(stop.log.p_lidar - np.outer(heights, [0.0, 0.0, 1.0]), axis=1)


def test_scale_and_bias_of_ranges_add_up(plain):
    config = SimulationConfig.perfect(turn=0.5, optics=Optics(range_scale=1e-3, range_bias=0.01))
    clean = simulate_stop(plain, "first", SimulationConfig.perfect(turn=0.5))
    off = simulate_stop(plain, "first", config)
    ranges = [ranges_of(stop) for stop in (clean, off)]
    assert_allclose(ranges[1], 1.001 * ranges[0] + 0.01, rtol=0, atol=1e-5)
    assert_allclose(off.rig.laser_range_biases, 0.01)


def test_dust_comes_first_and_as_often_as_its_rate_says(plain):
    dust = 0.01
    config = SimulationConfig.perfect(turn=0.5, optics=Optics(dust=dust))
    stop = simulate_stop(plain, "first", config)
    dusty = ranges_of(stop)
    n_up = len(stop.log.rings) - len(
        simulate_stop(plain, "first", SimulationConfig.perfect(turn=0.5)).log.rings
    )
    n_pulses = stop.firings.distances.size
    assert dusty.min() >= 0.9
    # about half of all beams meet nothing; of these, dust answers from 0.9 to 15 m
    assert 0.3 < n_up / (n_pulses * (np.exp(-0.9 * dust) - np.exp(-15.0 * dust))) < 0.7


@pytest.mark.parametrize(("turn", "gap"), [(12.0, 0.5), (9.0, 2.0), (18.0, 1.0)])
def test_lines_fall_on_lines_as_the_speeds_say(turn, gap):
    """Channels lie at odd degrees; a revolution moves them by 36/turn deg, a face by half of it."""
    step = 36.0 / turn
    k = np.arange(round(10 * turn))[:, None, None]
    faces, channels = np.arange(2)[:, None], np.arange(-15, 16, 2)
    derived = np.unique(np.round((step * (k + faces / 2) + channels) % 360.0, 6) % 360.0)
    assert_allclose(np.diff(derived), gap)
    lines = np.degrees(horizon_lines(SimulationConfig(turn=turn)))
    assert_allclose(np.unique(np.round(lines, 6) % 360.0), derived, atol=1e-5)


def test_a_rippling_turn_is_undone_by_its_joint_samples(plain, stitched):
    config = SimulationConfig.perfect(turn=2.0, ripples=((2e-3, 3.0), (1e-3, 7.0)))
    stop, even = (
        simulate_stop(plain, "first", one) for one in (config, replace(config, ripples=()))
    )
    assert np.abs(stop.log.gimbal_angles - even.log.gimbal_angles).max() > 2e-3
    p_site = stitched(stop, stop.log.rig)
    on_ground = np.abs(p_site[:, 2])
    assert np.median(on_ground) < 1e-4


def test_half_a_turn_has_half_of_the_returns(plain):
    whole, half = (
        simulate_stop(
            plain, "first", SimulationConfig.perfect(turn=12.6, sweep=s, only_near_spheres=True)
        )
        for s in (2 * np.pi, np.pi)
    )
    ratios = [n / m for (n, _), (m, _) in zip(half.counts, whole.counts, strict=True)]
    assert_allclose(ratios, 0.5, atol=0.1)


def test_returns_of_a_marker_are_those_on_its_surface(plain, stitched):
    stop = simulate_stop(plain, "first", SimulationConfig.perfect(turn=6.0, only_near_spheres=True))
    p_site = stitched(stop, stop.rig)
    off = np.linalg.norm(p_site[:, None] - plain.marks.p_site, axis=2) - plain.marker_radius
    for mark, (n, n_lines) in enumerate(stop.counts):
        is_own = stop.marks == mark
        assert n == is_own.sum() > 20
        assert np.abs(off[is_own, mark]).max() < 1e-4
        assert (np.abs(off[~is_own, mark]) < 1e-4).sum() <= 0.02 * n  # where the pole ends
        assert 2 <= n_lines <= n
