from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from spheremark.pipelines.geometry import rigid, rot_z
from spheremark.pipelines.simulation import SimulationConfig
from spheremark.pipelines.simulation.echo import Echoes
from spheremark.pipelines.simulation.rig import even_turn, nominal_rig
from spheremark.pipelines.simulation.sensor import aim, fire, may_pass, record

N_FIRINGS = 4008
CONFIG = SimulationConfig()


@pytest.fixture(scope="module")
def pulses():
    return fire(0, N_FIRINGS, 1.0, even_turn(CONFIG, 0.2), CONFIG.spin_rpm)


def recorded(pulses, ranges, shade, **changes):
    config = SimulationConfig.perfect(**changes)
    n = len(pulses.rings)
    echoes = Echoes(
        ranges=np.full(n, ranges), reflectivities=np.full(n, shade), spheres=np.full(n, -1)
    )
    return record(pulses, echoes, nominal_rig(config), config, np.random.default_rng(4))


def ranges_of(returns):
    """Return the distances from where the beams leave the spin axis."""
    rig = nominal_rig(CONFIG)
    origins = np.zeros((len(returns.rings), 3))
    origins[:, 2] = rig.laser_heights[returns.rings]
    return np.linalg.norm(returns.p_lidar - origins, axis=1)


def test_lasers_fire_every_2304_ns_and_all_of_them_every_55296_ns(pulses):
    assert_array_equal(pulses.offsets_ns[:16], np.arange(16) * 2304)
    assert_array_equal(pulses.offsets_ns[::16], np.arange(N_FIRINGS) * 55296)


def test_lasers_fire_in_the_order_of_the_manual(pulses):
    degrees = np.round(np.degrees(nominal_rig(CONFIG).laser_elevations[pulses.rings[:16]]))
    order = [-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15]
    assert_array_equal(degrees, order)


def test_firings_go_on_where_the_last_ended(pulses):
    later = fire(100, 5, 1.0, even_turn(CONFIG, 0.2), CONFIG.spin_rpm)
    for name in ("offsets_ns", "azimuths", "gimbal_angles"):
        assert_array_equal(getattr(later, name), getattr(pulses, name)[1600:1680])


def test_lidar_and_gimbal_turn_at_their_speeds(pulses):
    seconds = pulses.offsets_ns[-1] * 1e-9
    assert_allclose(np.ptp(pulses.azimuths), 20 * np.pi * seconds, rtol=0, atol=1e-9)
    assert_allclose(np.ptp(pulses.gimbal_angles), 2 * np.pi * seconds / 13.2, rtol=0, atol=1e-9)


def test_beams_aim_as_the_frames_are_defined(pulses):
    rig = nominal_rig(CONFIG)
    pose = np.eye(4)
    pose[:3, 3] = (3.0, -2.0, 1.0)
    aims = aim(pulses, rig, pose)
    for i in (0, 7, 5000):
        e, az, angle = (
            rig.laser_elevations[pulses.rings[i]],
            pulses.azimuths[i],
            pulses.gimbal_angles[i],
        )
        lidar = [np.cos(e) * np.cos(az), -np.cos(e) * np.sin(az), np.sin(e)]
        turn = np.array(
            [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
        )
        origin = rig.T_head_lidar @ [0, 0, rig.laser_heights[pulses.rings[i]], 1]
        assert_allclose(
            aims.directions_site[i], turn @ rig.T_head_lidar[:3, :3] @ lidar, atol=1e-12
        )
        assert_allclose(aims.origins_site[i], pose[:3, 3] + turn @ origin[:3], atol=1e-12)
        assert_allclose(aims.spin_axes_site[i], turn[:, 0], atol=1e-12)


@pytest.mark.parametrize("rpm", [300.0, 1200.0])
def test_no_shot_that_passes_a_point_closely_is_overlooked(rpm):
    rng, near = np.random.default_rng(5), 0.35
    points = rng.uniform([-9, -9, -2], [9, 9, 3], (40, 3))
    pulses = fire(0, 20_000, 1.0, even_turn(replace(CONFIG, turn=1.0), 0.2), rpm)
    rig, pose = nominal_rig(CONFIG), rigid(rot_z(0.3), (0.2, -0.1, 0.5))
    aims, chosen = aim(pulses, rig, pose), may_pass(pulses, rig, pose, points, near)
    passes = np.zeros(len(chosen), dtype=bool)
    for p in points:
        w = p - aims.origins_site
        along = np.sum(w * aims.directions_site, axis=1)
        passes |= (along > 0) & (np.sum(w**2, axis=1) - along**2 <= near**2)
    assert passes.mean() > 0.01
    assert not np.any(passes & ~chosen)
    assert chosen.mean() < 10 * passes.mean()


def test_ranges_are_multiples_of_2_mm(pulses):
    ranges = ranges_of(recorded(pulses, 7.1234, 0.5, range_step=0.002, sigma_range=0.02))
    assert_allclose(ranges, np.round(ranges / 0.002) * 0.002, rtol=0, atol=2e-6)
    assert len(np.unique(np.round(ranges / 0.002))) > 20


def test_azimuths_are_multiples_of_a_hundredth_of_a_degree(pulses):
    returns = recorded(pulses, 7.0, 0.5, azimuth_step=np.radians(0.01))
    x, y = returns.p_lidar[:, :2].astype(np.float64).T
    hundredths = np.degrees(np.arctan2(-y, x)) * 100
    # Rounding moves each float32 coordinate by at most half an ulp of the horizontal distance
    # and the point across the beam by at most 0.71 ulp.
    distances = np.hypot(x, y)
    one_ulp = np.degrees(np.spacing(distances.astype(np.float32)) / distances) * 100
    assert np.all(np.abs(hundredths - np.round(hundredths)) <= one_ulp)
    assert np.max(one_ulp) < 0.01  # else a hundredth could be missed


@pytest.mark.parametrize(
    ("shade", "sigma"), [(0.03, 0.0137), (0.10, 0.0107), (0.30, 0.0089), (0.60, 0.0067)]
)
def test_noise_follows_reflectivity(pulses, shade, sigma):
    ranges = ranges_of(recorded(pulses, 5.0, shade, sigma_range=None))
    assert_allclose(np.std(ranges), sigma, rtol=0.01)
    assert_allclose(np.mean(ranges), 5.0, rtol=0, atol=5 * sigma / np.sqrt(len(ranges)))


def test_intensity_is_calibrated_reflectivity_in_percent(pulses):
    intensities = recorded(pulses, 5.0, 0.5).intensities
    assert_allclose(np.mean(intensities), 50.0, atol=0.1)
    assert 1.0 < np.std(intensities) < 6.0
    assert_array_equal(intensities, np.round(intensities))


def test_drop_outs_are_as_frequent_as_asked(pulses):
    n = len(recorded(pulses, 5.0, 0.5, drop_out=0.1).rings)
    assert_allclose(n / len(pulses.rings), 0.9, rtol=0, atol=0.005)


def test_dark_things_vanish_far_away_before_bright_ones(pulses):
    def share(distance, shade):
        return len(recorded(pulses, distance, shade).rings) / len(pulses.rings)

    assert share(10.0, 0.1) > 0.999
    assert share(80.0, 0.1) < 0.1
    assert share(80.0, 0.5) > 0.9
    assert share(120.0, 1.0) == share(0.5, 0.5) == 0.0
