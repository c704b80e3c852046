from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from spheremark.pipelines.config import StitchingConfig
from spheremark.pipelines.errors import InputError, NotFoundError
from spheremark.pipelines.model import ImuMount
from spheremark.pipelines.scan.rigs import rig_digest, tilted_vlp16
from spheremark.pipelines.scan.stitching import stitch
from spheremark.pipelines.simulation import SimulationConfig, simulate_stop, survey_truth

FLOAT32 = 2e-6  # [m] what is left of a range of up to 30 m in single precision
POLE_FLAT = 2e-4  # [m] a pole is a prism of 24 sides


def off_surfaces(p_site, field):
    """Return the distance of points from ground, spheres and poles, whichever is nearest."""
    from_spheres = np.linalg.norm(p_site[:, None] - field.marks.p_site, axis=2) - 0.1
    from_axes = np.linalg.norm(p_site[:, None, :2] - field.marks.p_site[:, :2], axis=2)
    from_poles = np.maximum(np.abs(from_axes - 0.015) - POLE_FLAT, 0.0)
    each = np.hstack([np.abs(p_site[:, 2:]), np.abs(from_spheres), from_poles])
    return each.min(axis=1)


def test_a_perfect_rig_sees_every_surface_where_it_is(plain, stitched):
    stop = simulate_stop(plain, "first", SimulationConfig.perfect(turn=1.0))
    p_site = stitched(stop, stop.log.rig)
    assert len(p_site) > 100_000
    assert off_surfaces(p_site, plain).max() < 10 * FLOAT32


def test_a_leaning_rig_with_a_skewed_clock_is_undone_by_its_true_parameters(plain, stitched):
    config = SimulationConfig.perfect(
        turn=1.0,
        sigma_tilt=0.03,
        sigma_misalignment=0.005,
        sigma_axis_offset=0.003,
        sigma_laser_bias=0.004,
        sigma_eccentricity=0.001,
        gimbal_clock_offset=0.02,
    )
    stop = simulate_stop(plain, "second", config)
    off_true = off_surfaces(stitched(stop, stop.rig), plain)
    off_nominal = off_surfaces(stitched(stop, stop.log.rig), plain)
    assert np.quantile(off_true, 0.999) < 1e-4  # the angle is linear only between joint samples
    assert np.median(off_nominal) > 2e-3


def test_quantisation_moves_points_by_less_than_its_steps(plain, stitched):
    config = SimulationConfig.perfect(turn=1.0, range_step=0.002, azimuth_step=np.radians(0.01))
    stop = simulate_stop(plain, "first", config)
    p_site = stitched(stop, stop.log.rig)
    ranges = np.linalg.norm(p_site - stop.truth.T_site_base[:3, 3], axis=1)
    off = off_surfaces(p_site, plain)
    # block and shot are rounded, each to half a hundredth of a degree
    assert (off <= 0.001 + ranges * np.radians(0.01) + FLOAT32).all()
    assert np.median(off) > 1e-4


def test_noise_is_as_large_as_asked(plain, stitched):
    config = SimulationConfig.perfect(turn=1.0, sigma_range=0.020)
    p_site = stitched(simulate_stop(plain, "first", config), tilted_vlp16("", config.axis_offset))
    down = p_site[np.linalg.norm(p_site[:, :2] - [0.0, 0.2], axis=1) < 0.8]  # seen from 1 m above
    slant = np.linalg.norm(down - [0.0, 0.2, 1.0], axis=1) / (1.0 - down[:, 2])
    assert_allclose(np.std(down[:, 2] * slant), 0.020, rtol=0.02)


def test_the_same_seed_gives_the_same_log(plain, brief, noisy):
    again = simulate_stop(plain, "first", brief).log
    for name in ("p_lidar", "stamps_lidar_ns", "gimbal_angles", "quaternions_imu", "intensities"):
        assert_array_equal(getattr(again, name), getattr(noisy.log, name))


def test_stops_share_the_rig_but_not_their_noise(plain, brief, noisy):
    other = simulate_stop(replace(plain, stops=plain.stops[::-1]), "first", brief)
    assert rig_digest(other.rig) == rig_digest(noisy.rig)
    assert not np.array_equal(other.truth.T_site_base, noisy.truth.T_site_base)
    assert not np.array_equal(other.log.p_lidar[:100], noisy.log.p_lidar[:100])


def test_another_seed_gives_another_rig(plain, brief, noisy):
    assert rig_digest(simulate_stop(plain, "first", brief, seed=9).rig) != rig_digest(noisy.rig)


def test_the_log_tells_the_nominal_rig_only(noisy, brief):
    nominal = tilted_vlp16("tilted-vlp16", brief.axis_offset)
    assert rig_digest(noisy.log.rig) == rig_digest(nominal)
    assert rig_digest(noisy.rig) != rig_digest(nominal)


def test_heading_of_the_rover_is_not_in_the_log(plain):
    config = SimulationConfig.perfect(turn=1.0)
    here = simulate_stop(plain, "first", config)
    turned = replace(plain, stops=tuple(replace(stop, heading=1.3) for stop in plain.stops))
    there = simulate_stop(turned, "first", config)
    assert_array_equal(here.log.quaternions_imu, there.log.quaternions_imu)
    assert not np.allclose(here.truth.T_site_base, there.truth.T_site_base)


def test_encoder_and_ahrs_bracket_all_shots_at_100_hz(noisy):
    log = noisy.log
    for stamps in (log.stamps_gimbal_ns, log.stamps_imu_ns):
        assert stamps[0] < log.stamps_lidar_ns[0]
        assert stamps[-1] > log.stamps_lidar_ns[-1]
        assert_allclose(np.diff(stamps), 1e7, rtol=0, atol=1)


def test_shots_come_in_order_and_span_the_turn(noisy, brief):
    log = noisy.log
    assert (np.diff(log.stamps_lidar_ns) > 0).all()
    angles = np.interp(log.stamps_lidar_ns[[0, -1]], log.stamps_gimbal_ns, log.gimbal_angles)
    assert 2 * np.pi - 0.02 < np.ptp(angles) < 2 * np.pi * (1.0 + 0.1 / brief.turn) + 0.02


@pytest.mark.parametrize("mount", list(ImuMount))
def test_the_ahrs_tells_how_the_base_leans(plain, mount):
    config = SimulationConfig.perfect(turn=1.0, sigma_tilt=0.03, imu_mount=mount)
    stop = simulate_stop(plain, "first", config)
    log = stop.log
    up = Rotation.from_quat(log.quaternions_imu).inv().apply([0.0, 0.0, 1.0])
    if mount is ImuMount.HEAD:
        angles = np.interp(log.stamps_imu_ns, log.stamps_gimbal_ns, log.gimbal_angles)
        inside = slice(2, -2)  # the two kinds of samples do not begin together
        up, angles = up[inside], angles[inside]
        up = Rotation.from_euler("z", angles[:, None]).apply(up)
    assert_allclose(up, np.tile(stop.truth.T_site_base[2, :3], (len(up), 1)), rtol=0, atol=1e-7)


def test_only_near_spheres_keeps_what_the_spheres_return(plain, stitched):
    config = SimulationConfig.perfect(turn=1.0)
    whole = simulate_stop(plain, "first", config)
    part = simulate_stop(plain, "first", replace(config, only_near_spheres=True))
    assert len(part.log.rings) < 0.2 * len(whole.log.rings)
    counts = [
        (
            np.abs(
                np.linalg.norm(stitched(s, s.log.rig)[:, None] - plain.marks.p_site, axis=2) - 0.1
            )
            < 1e-5
        ).sum(axis=0)
        for s in (whole, part)
    ]
    assert_array_equal(*counts)


STEPPED = SimulationConfig.perfect(step=np.radians(45.0), move=0.2, only_near_spheres=True)


def test_a_stepping_scan_puts_every_point_on_a_surface(plain, stitched):
    stop = simulate_stop(plain, "first", STEPPED)
    off = off_surfaces(stitched(stop, stop.log.rig), plain)
    assert np.quantile(off, 0.99) < 10 * FLOAT32  # the encoder cuts the corners of a move
    assert len(stop.log.rings) > 1000


def test_points_without_times_are_stamped_with_their_revolution(plain):
    with_times = simulate_stop(plain, "first", STEPPED).log
    without = simulate_stop(plain, "first", replace(STEPPED, shot_times=False)).log
    assert not without.has_pulse_times
    assert_array_equal(without.p_lidar, with_times.p_lidar)
    late = with_times.stamps_lidar_ns - without.stamps_lidar_ns
    assert late.min() >= 0
    assert late.max() < 100_000_000
    assert_array_equal(np.unique(np.diff(without.stamps_lidar_ns)) % 100_000_000, 0)


def test_a_stepping_scan_without_times_is_stitched_from_its_rests(plain):
    stop = simulate_stop(plain, "first", replace(STEPPED, shot_times=False))
    cloud = stitch(stop.log, stop.log.rig, StitchingConfig())
    p_base = cloud.p_base.astype(float)
    T = stop.truth.T_site_base
    off = off_surfaces(p_base @ T[:3, :3].T + T[:3, 3], plain)
    assert off.max() < 1e-3  # [m]; a joint sample may lie a little beyond the rest
    assert len(p_base) > 0.2 * len(stop.log.rings)
    assert cloud.coverage > np.radians(359.0)


def test_packets_and_points_hold_the_same_returns(noisy):
    firings, log = noisy.firings, noisy.log
    assert len(firings.azimuths) % 12 == 0
    assert (firings.distances > 0).sum() == len(log.rings)
    heights = noisy.log.rig.laser_heights[log.rings]
    ranges = np.linalg.norm(log.p_lidar - np.outer(heights, [0.0, 0.0, 1.0]), axis=1)
    assert_allclose(firings.distances[firings.distances > 0] * 0.002, ranges, rtol=0, atol=1e-5)
    assert_array_equal(firings.reflectivities[firings.distances > 0], log.intensities)
    assert firings.start_ns <= log.stamps_lidar_ns[0]
    assert firings.azimuths.max() < 36_000


def test_an_unknown_stop_is_refused_with_the_names_of_the_known(plain, brief):
    with pytest.raises(NotFoundError, match=r"'third'.*first, second"):
        simulate_stop(plain, "third", brief)


def test_progress_is_told_and_may_cancel(plain, brief):
    heard = []

    def cancel(fraction, message):
        heard.append((fraction, message))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_stop(plain, "first", brief, progress=cancel)
    assert heard == [(0.0, "Casting beams")]


def test_the_truth_of_a_survey_holds_marks_poses_and_the_true_rig(plain, brief, noisy):
    truth = survey_truth(plain, [noisy], brief, 5)
    assert truth.marks is plain.marks
    assert truth.rig is noisy.rig
    assert [stop.name for stop in truth.stops] == ["first"]
    assert truth.about["simulation"]["turn"] == brief.turn


def test_the_truth_of_stops_with_different_rigs_is_refused(plain, brief, noisy):
    other = simulate_stop(plain, "second", brief, seed=9)
    with pytest.raises(InputError, match="2 rigs"):
        survey_truth(plain, [noisy, other], brief, 5)
