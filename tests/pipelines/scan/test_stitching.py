import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spheremark.pipelines.config import StitchingConfig
from spheremark.pipelines.errors import (
    MissingGimbalAngleError,
    MissingPulseTimesError,
    MissingRigError,
    RecordingError,
    RigError,
)
from spheremark.pipelines.model import RING_UNKNOWN, ImuMount
from spheremark.pipelines.scan.stitching import beams, choose_rig, level, split_stops, stitch
from tests.synthetic import NS, crooked_rig, scan_log, turn_z

FLOAT32 = 3e-6  # [m] below 32 m: half an ulp on each axis in, and one out, make 2.6e-6
CONFIG = StitchingConfig()


@pytest.fixture
def rng():
    return np.random.default_rng(20)


def subset(log, rows, **changes):
    """The log with some of its returns only."""
    return replace(
        log,
        p_lidar=log.p_lidar[rows].copy(),
        intensities=log.intensities[rows].copy(),
        rings=log.rings[rows].copy(),
        stamps_lidar_ns=log.stamps_lidar_ns[rows].copy(),
        **changes,
    )


def joints(log, times, angles):
    """The log with another motion of the gimbal, times [s] from the first return."""
    stamps = log.stamps_lidar_ns.min() + np.round(np.asarray(times) * NS).astype(np.int64)
    return replace(log, stamps_gimbal_ns=stamps, gimbal_angles=np.array(angles, float))


@pytest.mark.parametrize("carried", [True, False])
def test_noise_free_returns_come_back_to_where_they_were(rng, carried):
    rig = crooked_rig(
        rng,
        cloud_carries_heights=carried,
        laser_range_biases=rng.normal(0, 0.01, 16),
        encoder_eccentricity=np.array([2e-3, -1e-3]),
        gimbal_clock_offset=0.004,
    )
    log, p_base = scan_log(rng, rig)
    cloud = stitch(log, rig, CONFIG)
    np.testing.assert_allclose(cloud.p_base, p_base, rtol=0, atol=FLOAT32)


def test_columns_keep_the_order_of_the_log(rng):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig)
    cloud = stitch(log, rig, CONFIG)
    np.testing.assert_array_equal(cloud.rings, log.rings)
    np.testing.assert_array_equal(cloud.intensities, log.intensities)
    expected = (log.stamps_lidar_ns - log.stamps_lidar_ns[0]) / NS
    np.testing.assert_allclose(cloud.times, expected, rtol=0, atol=1e-6)


def test_what_is_not_changed_is_shared_with_the_log(rng):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig)
    cloud = stitch(log, rig, CONFIG)
    assert np.shares_memory(cloud.intensities, log.intensities)
    assert np.shares_memory(cloud.rings, log.rings)


def test_angles_and_times_are_those_of_the_rows_that_are_asked_for(rng):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig)
    cloud = stitch(log, rig, replace(CONFIG, range_min=5.0))
    times, angles = cloud.times[:].astype(float), cloud.gimbal_angles[:].astype(float)
    truth = 0.7 + 2 * np.pi * times / 13.2
    first = (log.stamps_lidar_ns[0] - (1_700_000_000 * NS + 123_456_789)) / NS
    off = np.exp(1j * (angles - truth - 2 * np.pi * first / 13.2))
    np.testing.assert_allclose(np.angle(off), 0, atol=2e-6)
    assert angles.min() >= -np.float32(np.pi)
    assert angles.max() <= np.float32(np.pi)
    rows = rng.permutation(len(cloud.p_base))[:100]
    for column in (cloud.times, cloud.gimbal_angles):
        np.testing.assert_array_equal(column[rows], column[:][rows])
        np.testing.assert_array_equal(pickle.loads(pickle.dumps(column))[rows], column[rows])


def test_a_cloud_sorted_by_ring_gives_the_same_points(rng):
    rig = crooked_rig(rng)
    log, p_base = scan_log(rng, rig)
    order = np.argsort(log.rings, kind="stable")
    cloud = stitch(subset(log, order), rig, CONFIG)
    np.testing.assert_allclose(cloud.p_base, p_base[order], rtol=0, atol=FLOAT32)


def test_joint_samples_far_apart_lose_nothing_at_even_speed(rng):
    rig = crooked_rig(rng)
    log, p_base = scan_log(rng, rig, joint_rate=2.5)
    cloud = stitch(log, rig, CONFIG)
    np.testing.assert_allclose(cloud.p_base, p_base, rtol=0, atol=FLOAT32)


@settings(max_examples=20, deadline=None)
@given(angle=st.floats(-7, 7), seconds=st.integers(-(10**6), 10**6), seed=st.integers(0, 99))
def test_turning_the_gimbals_zero_turns_the_cloud_and_time_does_not_matter(angle, seconds, seed):
    rng = np.random.default_rng(seed)
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig, n=200)
    moved = replace(
        log,
        gimbal_angles=log.gimbal_angles + angle,
        stamps_gimbal_ns=log.stamps_gimbal_ns + seconds * NS,
        stamps_lidar_ns=log.stamps_lidar_ns + seconds * NS,
        stamps_imu_ns=log.stamps_imu_ns + seconds * NS,
    )
    expected = stitch(log, rig, CONFIG).p_base @ turn_z(np.array(angle)).T
    np.testing.assert_allclose(stitch(moved, rig, CONFIG).p_base, expected, rtol=0, atol=FLOAT32)


def test_rings_that_are_not_recorded_are_inferred_from_clean_elevations(rng):
    rig = crooked_rig(rng, laser_range_biases=rng.normal(0, 0.01, 16))
    log, p_base = scan_log(rng, rig)
    blind = replace(log, rings=np.full_like(log.rings, RING_UNKNOWN))
    cloud = stitch(blind, rig, CONFIG)
    np.testing.assert_array_equal(cloud.rings, log.rings)
    np.testing.assert_allclose(cloud.p_base, p_base, rtol=0, atol=FLOAT32)
    assert any("inferred" in note for note in cloud.notes)


def test_rings_that_elevations_do_not_tell_stay_unknown_and_are_noted(rng):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig)
    shaken = (log.p_lidar + rng.normal(0, 0.1, log.p_lidar.shape)).astype(np.float32)
    blind = replace(log, p_lidar=shaken, rings=np.full_like(log.rings, RING_UNKNOWN))
    cloud = stitch(blind, rig, CONFIG)
    assert np.all(cloud.rings == RING_UNKNOWN)
    assert any("Rings are not recorded" in note for note in cloud.notes)


def test_beams_begin_on_the_spin_axis_and_end_at_the_return(rng):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig)
    cloud = stitch(log, rig, CONFIG)
    members = np.sort(rng.choice(len(cloud.p_base), 500, replace=False))
    lines = beams(cloud, members)
    ends = lines.origins_base + lines.ranges[:, None] * lines.directions_base
    np.testing.assert_allclose(ends, cloud.p_base[members], rtol=0, atol=1e-12)
    angles = cloud.gimbal_angles[members].astype(float)
    back = np.einsum("nji,nj->ni", turn_z(angles), lines.origins_base)
    in_lidar = (back - rig.T_head_lidar[:3, 3]) @ rig.T_head_lidar[:3, :3]
    heights = rig.laser_heights[cloud.rings[members]]
    expected = np.stack([0 * heights, 0 * heights, heights], axis=1)
    np.testing.assert_allclose(in_lidar, expected, rtol=0, atol=1e-12)


def test_beams_leave_at_the_elevation_of_their_laser(rng):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig)
    cloud = stitch(log, rig, CONFIG)
    lines = beams(cloud, np.arange(len(cloud.p_base)))
    spin = turn_z(cloud.gimbal_angles[:].astype(float)) @ rig.T_head_lidar[:3, 2]
    sines = np.sum(spin * lines.directions_base, axis=1)
    np.testing.assert_allclose(
        np.arcsin(sines), rig.laser_elevations[lines.rings], rtol=0, atol=2e-6
    )
    np.testing.assert_allclose(np.sum(lines.across_base * spin, axis=1), 0, atol=1e-12)
    np.testing.assert_allclose(
        np.sum(lines.across_base * lines.directions_base, axis=1), 0, atol=1e-12
    )


@pytest.mark.parametrize("mount", [ImuMount.BASE, ImuMount.HEAD])
def test_levelling_finds_roll_and_pitch_whatever_the_heading(rng, mount):
    rig = crooked_rig(rng, imu_mount=mount)
    log, _ = scan_log(rng, rig, lean=(0.08, -0.05))
    levelling = level(log, rig, CONFIG)
    assert levelling.is_measured
    np.testing.assert_allclose([levelling.roll, levelling.pitch], [0.08, -0.05], rtol=0, atol=1e-7)
    assert levelling.sigma == pytest.approx(CONFIG.sigma_levelling, rel=1e-6)


def test_levelling_is_not_moved_by_wild_samples_and_says_its_scatter(rng):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig, lean=(0.02, 0.03))
    wild = log.quaternions_imu.copy()
    wild[::9] = [0.5, 0.5, 0.5, 0.5]
    wild[5] = np.nan
    wild[::2] += rng.normal(0, 1e-3, wild[::2].shape)
    levelling = level(replace(log, quaternions_imu=wild), rig, CONFIG)
    np.testing.assert_allclose([levelling.roll, levelling.pitch], [0.02, 0.03], rtol=0, atol=3e-4)
    assert levelling.sigma > CONFIG.sigma_levelling


def test_without_an_ahrs_the_base_is_assumed_level_and_it_is_said(rng):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig)
    log = replace(log, quaternions_imu=np.zeros((0, 4)), stamps_imu_ns=np.zeros(0, np.int64))
    cloud = stitch(log, rig, CONFIG)
    assert not cloud.levelling.is_measured
    assert cloud.levelling.sigma > np.radians(1)
    assert any("No AHRS" in note for note in cloud.notes)


@pytest.mark.parametrize(
    ("degrees", "sentence"), [(360, None), (270, "one face"), (150, "turn under 180 deg")]
)
def test_a_turn_that_is_not_full_is_said(rng, degrees, sentence):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig, turn=np.radians(degrees))
    cloud = stitch(log, rig, CONFIG)
    assert np.degrees(cloud.coverage) == pytest.approx(degrees, abs=0.5)
    assert [note for note in cloud.notes if sentence and sentence in note] == list(cloud.notes)
    assert bool(cloud.notes) == (sentence is not None)


def test_a_gimbal_that_never_turns_is_a_weak_stop_and_no_crash(rng):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig, turn=0.0)
    (stop,) = split_stops(log, CONFIG)
    cloud = stitch(stop, rig, CONFIG)
    assert cloud.coverage == 0
    assert any("turn under 180 deg" in note for note in cloud.notes)


def test_returns_that_are_not_finite_are_left_out_and_counted(rng):
    rig = crooked_rig(rng)
    log, p_base = scan_log(rng, rig)
    broken = log.p_lidar.copy()
    broken[[3, 700], [0, 2]] = np.nan, np.inf
    cloud = stitch(replace(log, p_lidar=broken), rig, CONFIG)
    kept = np.delete(p_base, [3, 700], axis=0)
    np.testing.assert_allclose(cloud.p_base, kept, rtol=0, atol=FLOAT32)
    assert any(note.startswith("2 returns are not finite") for note in cloud.notes)


def test_returns_outside_the_limits_of_range_are_left_out(rng):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig)
    cloud = stitch(log, rig, replace(CONFIG, range_min=5.0, range_max=10.0))
    ranges = beams(cloud, np.arange(len(cloud.p_base))).ranges
    assert 0 < len(ranges) < len(log.p_lidar)
    assert ranges.min() >= 5.0 - FLOAT32
    assert ranges.max() <= 10.0 + FLOAT32
    reach = beams(stitch(log, rig, replace(CONFIG, range_min=0.0)), np.arange(len(log.p_lidar)))
    is_near = reach.ranges < 5.0
    np.testing.assert_array_equal(cloud.near_rings, log.rings[is_near])
    since = (log.stamps_lidar_ns[is_near] - log.stamps_lidar_ns.min()) / NS
    np.testing.assert_allclose(cloud.near_times, since, rtol=0, atol=1e-9)


def test_returns_without_a_gimbal_angle_are_left_out_and_counted(rng):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig)
    times = (log.stamps_gimbal_ns - log.stamps_lidar_ns[0]) / NS
    keep = (times > 2) & ~((times > 6) & (times < 7))
    gappy = replace(
        log,
        gimbal_angles=log.gimbal_angles[keep].copy(),
        stamps_gimbal_ns=log.stamps_gimbal_ns[keep].copy(),
    )
    shots = (log.stamps_lidar_ns - log.stamps_lidar_ns[0]) / NS
    lost = np.sum(shots < times[keep][0]) + np.sum(
        (shots >= times[times <= 6][-1]) & (shots < times[times >= 7][0])
    )
    cloud = stitch(gappy, rig, CONFIG)
    assert len(cloud.p_base) == len(log.p_lidar) - lost
    assert any(note.startswith(f"{lost:,} returns have no gimbal angle") for note in cloud.notes)


def test_clocks_leave_the_heading_uncertain_by_what_the_gimbal_turns_in_their_offset(rng):
    rig, times = crooked_rig(rng), np.arange(0.0, 10.01, 0.01)
    log = joints(scan_log(rng, rig, duration=10.0, n=20000)[0], times, 2 * np.pi * times / 10.0)
    levelling = stitch(log, rig, replace(CONFIG, sigma_clock=0.004)).levelling
    assert levelling.sigma_clock == pytest.approx(2 * np.pi / 10.0 * 0.004, rel=1e-6)
    assert levelling.sigma_heading_station == pytest.approx(
        np.hypot(rig.sigma_heading, levelling.sigma_clock)
    )
    known = stitch(log, rig, replace(CONFIG, sigma_clock=0.0)).levelling
    assert known.sigma_heading_station == rig.sigma_heading


def test_stamps_of_the_end_of_a_revolution_make_the_heading_uncertain_by_what_it_turned(rng):
    rig, times = crooked_rig(rng), np.arange(0.0, 10.01, 0.01)
    log, _ = scan_log(rng, rig, duration=10.0, n=20000)
    log = joints(log, times, 2 * np.pi * times / 10.0)
    assert not stitch(log, rig, CONFIG).weaknesses
    late = replace(log, stamps_lidar_ns=log.stamps_lidar_ns + NS // 10)
    cloud = stitch(late, rig, CONFIG)
    (weakness,) = cloud.weaknesses
    assert "give gimbal_clock_offset_s +0.1" in weakness
    turned = 2 * np.pi / 10.0 * 0.1
    assert cloud.levelling.sigma_heading == pytest.approx(turned, rel=0.05)
    longer = replace(log, stamps_gimbal_ns=log.stamps_gimbal_ns + NS // 10)
    assert not stitch(longer, rig, CONFIG).weaknesses  # joints that go on for longer are no sign


def by_message(log):
    """The log with the times of its messages only, ten a second."""
    begin = log.stamps_lidar_ns[0]
    stamps = begin + (log.stamps_lidar_ns - begin) // (NS // 10) * (NS // 10)
    return replace(log, stamps_lidar_ns=stamps, has_pulse_times=False)


def test_a_continuous_turn_without_shot_times_is_refused(rng):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig)
    with pytest.raises(MissingPulseTimesError, match=r"2\.73 deg during a message"):
        stitch(by_message(log), rig, CONFIG)


def test_step_and_shoot_without_shot_times_keeps_what_was_made_at_rest(rng):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig, duration=36.0, n=20000)
    times = np.arange(0, 36, 0.01)
    angles = np.radians(10) * (np.floor(times) + np.clip((times % 1 - 0.9) / 0.1, 0, 1))
    log = joints(by_message(log), times, angles)
    cloud = stitch(log, rig, CONFIG)
    off = np.degrees(cloud.gimbal_angles) % 10
    assert np.all(np.minimum(off, 10 - off) < 1e-3)
    assert len(cloud.p_base) > 0.6 * len(log.p_lidar)
    assert any("while the gimbal moved" in note for note in cloud.notes)


def test_packets_know_better_than_a_rig_whether_heights_are_included(rng):
    rig = crooked_rig(rng)
    log, p_base = scan_log(rng, rig)
    wrong = replace(rig, cloud_carries_heights=not rig.cloud_carries_heights)
    flagged = replace(log, has_heights=rig.cloud_carries_heights)
    assert choose_rig(log, wrong) is wrong
    cloud = stitch(flagged, choose_rig(flagged, wrong), CONFIG)
    np.testing.assert_allclose(cloud.p_base, p_base, rtol=0, atol=FLOAT32)


def stepping(rng, rests, rest=0.3, move=0.1):
    """A log whose messages of 0.1 s are made during short rests and the moves between them."""
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig, duration=rests * (rest + move), n=20000)
    begins = np.arange(rests) * (rest + move)
    knots = np.column_stack([begins, begins + rest]).ravel()
    times = np.arange(0, rests * (rest + move), 0.01)
    angles = np.interp(times, knots, np.repeat(np.radians(10) * np.arange(rests), 2))
    return joints(by_message(log), times, angles), rig


@pytest.mark.parametrize("rest", [0.3, 0.5])
def test_short_rests_without_shot_times_are_enough_when_there_are_many(rng, rest):
    log, rig = stepping(rng, 30, rest)
    cloud = stitch(log, rig, CONFIG)
    off = np.degrees(cloud.gimbal_angles) % 10
    assert np.all(np.minimum(off, 10 - off) < 0.05)
    assert len(np.unique(np.round(np.degrees(cloud.gimbal_angles) / 10))) == 30
    assert len(cloud.p_base) > 0.2 * len(log.p_lidar)


def test_two_rests_around_a_turn_do_not_stand_for_a_scan(rng):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig, duration=13.0, n=20000)
    times = np.arange(0, 13, 0.01)
    log = joints(by_message(log), times, np.interp(times, [1, 12], [0.0, 2 * np.pi]))
    with pytest.raises(MissingPulseTimesError, match="let the gimbal rest"):
        stitch(log, rig, CONFIG)


def test_clocks_that_do_not_overlap_are_refused(rng):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig)
    late = replace(log, stamps_gimbal_ns=log.stamps_gimbal_ns + 100 * NS)
    with pytest.raises(RecordingError, match="clocks"):
        stitch(late, rig, CONFIG)


def test_a_log_without_joint_samples_is_refused(rng):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig)
    log = replace(log, gimbal_angles=np.zeros(0), stamps_gimbal_ns=np.zeros(0, np.int64))
    with pytest.raises(MissingGimbalAngleError):
        stitch(log, rig, CONFIG)


def test_a_log_without_returns_is_refused(rng):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig)
    with pytest.raises(RecordingError, match="no LiDAR return"):
        stitch(subset(log, slice(0, 0)), rig, CONFIG)


def test_a_log_with_all_returns_too_near_is_refused(rng):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig)
    with pytest.raises(RecordingError, match=r"from 0\.9 to 100\.0 m"):
        stitch(replace(log, p_lidar=log.p_lidar / 100), rig, CONFIG)


def test_a_laser_that_the_rig_does_not_know_is_refused(rng):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig)
    with pytest.raises(RigError, match="laser 31"):
        stitch(replace(log, rings=log.rings + np.uint8(16)), rig, CONFIG)


def test_a_given_rig_wins_and_none_at_all_is_refused(rng):
    recorded, given_rig = crooked_rig(rng), crooked_rig(rng)
    log, _ = scan_log(rng, recorded)
    assert choose_rig(replace(log, rig=recorded), given_rig) is given_rig
    assert choose_rig(replace(log, rig=recorded), None) is recorded
    with pytest.raises(MissingRigError, match="--rig"):
        choose_rig(log, None)


def walk(rng, times, angles, n=20000):
    """A log over the time of a given motion of the gimbal."""
    log, _ = scan_log(rng, crooked_rig(rng), duration=times[-1], n=n)
    return joints(log, times, angles)


def test_two_turns_with_a_rest_between_are_two_stops(rng):
    times = np.arange(0, 46, 0.01)
    angles = np.interp(times, [5, 18, 28, 41], np.radians([0, 360, 360, 0]))
    stops = split_stops(walk(rng, times, angles), CONFIG)
    assert [stop.origin.name for stop in stops] == ["walk-1", "walk-2"]
    for stop, start in zip(stops, (5, 28), strict=True):
        seconds = np.ptp(stop.stamps_lidar_ns) / NS
        assert seconds == pytest.approx(13, abs=0.6)
        assert np.ptp(stop.gimbal_angles) > np.radians(359)
        offset = (stop.stamps_lidar_ns[0] - stops[0].stamps_lidar_ns[0]) / NS
        assert offset == pytest.approx(start - 5, abs=0.6)
        assert any("belong to no stop" in note for note in stop.notes)


def test_rests_of_a_step_and_shoot_scan_do_not_split_it(rng):
    times = np.arange(0, 90, 0.01)
    angles = np.radians(10) * (np.floor(times / 2.5) + np.clip(times % 2.5 - 1.5, 0, 1))
    log = walk(rng, times, angles)
    assert split_stops(log, CONFIG) == (log,)


def test_a_pause_of_the_lidar_after_half_a_turn_ends_a_stop(rng):
    times = np.arange(0, 40, 0.01)
    log = walk(rng, times, 2 * np.pi * times / 15)
    seconds = (log.stamps_lidar_ns - log.stamps_lidar_ns[0]) / NS
    stops = split_stops(subset(log, (seconds < 15) | (seconds > 25)), CONFIG)
    assert [len(stop.stamps_lidar_ns) for stop in stops] == [
        np.sum(seconds < 15),
        np.sum(seconds > 25),
    ]


def test_a_rest_before_the_turn_is_trimmed_and_the_name_kept(rng):
    times = np.arange(0, 25, 0.01)
    angles = np.interp(times, [10, 23], np.radians([0, 360]))
    (stop,) = split_stops(walk(rng, times, angles), CONFIG)
    assert stop.origin.name == "walk"
    assert np.ptp(stop.stamps_lidar_ns) / NS == pytest.approx(15, abs=0.6)
    assert any("belong to no stop" in note for note in stop.notes)


def test_a_gimbal_that_only_finds_its_place_after_the_turn_makes_no_stop(rng):
    times = np.arange(0, 35, 0.01)
    angles = np.interp(times, [0, 13, 20, 21], np.radians([0, 360, 360, 370]))
    (stop,) = split_stops(walk(rng, times, angles), CONFIG)
    assert np.ptp(stop.stamps_lidar_ns) / NS == pytest.approx(13, abs=0.6)


def test_stops_are_cut_alike_when_the_cloud_is_not_in_order_of_time(rng):
    times = np.arange(0, 46, 0.01)
    angles = np.interp(times, [5, 18, 28, 41], np.radians([0, 360, 360, 0]))
    log = walk(rng, times, angles)
    swapped = np.arange(len(log.rings)).reshape(-1, 10)[:, ::-1].ravel()
    expected = [len(stop.rings) for stop in split_stops(log, CONFIG)]
    assert [len(stop.rings) for stop in split_stops(subset(log, swapped), CONFIG)] == expected


def test_packets_without_times_keep_all_returns_whatever_gaps_follow_them(rng):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig, n=60_000)  # a few returns in each packet
    first = log.stamps_lidar_ns.min()
    packet = 1_330_000  # [ns]; the gimbal turns by less than 0.05 deg in one
    starts = first + (log.stamps_lidar_ns - first) // packet * packet
    kept = (starts - first) // packet % 5 != 2  # every fifth one is lost on its way
    turn = np.linspace(-1, 1 + np.ptp(log.stamps_lidar_ns) / NS, 500)
    packets = joints(subset(log, kept), turn, np.radians(27.0) * turn)
    packets = replace(packets, stamps_lidar_ns=starts[kept], has_pulse_times=False)
    cloud = stitch(packets, rig, CONFIG)
    assert len(cloud.p_base) == kept.sum()


def test_a_gimbal_that_turns_faster_than_any_is_refused_with_the_option_for_its_unit(rng):
    rig = crooked_rig(rng)
    log, _ = scan_log(rng, rig)
    fast = replace(log, gimbal_angles=np.degrees(log.gimbal_angles))
    with pytest.raises(RecordingError, match=r"deg/s; at most 900.*--joint-unit deg"):
        stitch(fast, rig, CONFIG)
