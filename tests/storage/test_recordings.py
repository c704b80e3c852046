"""Logs written and read back, and read from what others write."""

import json
import math
import struct
from itertools import product

import fsspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType
from mcap_ros2.decoder import DecoderFactory
from numpy.testing import assert_allclose, assert_array_equal
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from spheremark.pipelines.errors import ConfigError
from spheremark.pipelines.geometry import rigid, rot_x, rot_y, rot_z
from spheremark.pipelines.model import RING_UNKNOWN, ImuMount, Origin, ScanLog
from spheremark.pipelines.scan.rigs import tilted_vlp16, vlp16
from spheremark.storage.recordings import file_digest, read_log, write_log
from spheremark.storage.recordings.container import Container
from spheremark.storage.recordings.sources import opened
from tests.real_scans import recordings
from tests.storage.recorder import (
    DEFINITIONS,
    STORE,
    T0,
    cloud,
    encoded,
    frames,
    imu,
    joints,
    record,
    small_log,
    turning,
    velodyne,
)

FLOAT_TIME = 10  # [ns] of a float32 time within a revolution
TURN = Rotation.from_euler("y", 90, degrees=True).as_quat()
STILL = (0.0, 0.0, 0.0, 1.0)


def scan_log(rng, n=3000, duration=0.75, **changes):
    stamps = T0 + np.sort(rng.integers(0, int(duration * 1e9), n))
    samples = T0 + np.arange(-1, int(duration * 100) + 2) * 10_000_000
    tilt = Rotation.from_euler("xyz", rng.uniform(-0.1, 0.1, (len(samples), 3)))
    values = {
        "p_lidar": rng.normal(0, 8, (n, 3)).astype(np.float32),
        "intensities": rng.integers(0, 256, n).astype(np.float32),
        "rings": rng.integers(0, 16, n).astype(np.uint8),
        "stamps_lidar_ns": stamps,
        "has_pulse_times": True,
        "gimbal_angles": 0.3 + 4.0 * (samples - T0) * 1e-9,
        "stamps_gimbal_ns": samples,
        "quaternions_imu": tilt.as_quat(),
        "stamps_imu_ns": samples + 3_000_000,
        "rig": tilted_vlp16("study", (0.05, 0.02), 1.58),
        "origin": Origin(name="stop", digest=""),
    }
    return ScanLog(**values | changes)


def assert_same_log(found, expected):
    for name in (
        "p_lidar",
        "intensities",
        "rings",
        "gimbal_angles",
        "stamps_gimbal_ns",
        "stamps_imu_ns",
    ):
        assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    assert_allclose(found.stamps_lidar_ns - expected.stamps_lidar_ns, 0, rtol=0, atol=FLOAT_TIME)
    assert_allclose(found.quaternions_imu, expected.quaternions_imu, rtol=0, atol=1e-15)
    assert found.has_pulse_times == expected.has_pulse_times


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_a_log_comes_back_as_it_was_written(tmp_path, compression):
    log = scan_log(np.random.default_rng(1))
    write_log(log, tmp_path / "stop.mcap", compression=compression)
    found = read_log(tmp_path / "stop.mcap")
    assert_same_log(found, log)
    assert_allclose(found.rig.T_head_lidar, log.rig.T_head_lidar, rtol=0, atol=1e-15)
    assert found.rig.imu_mount is ImuMount.BASE
    assert found.notes == ()
    assert found.origin.name == "stop"
    assert found.origin.digest == file_digest(tmp_path / "stop.mcap")


def test_a_log_without_ahrs_rig_and_shot_times_comes_back(tmp_path):
    rng = np.random.default_rng(2)
    stamps = T0 + np.repeat(np.arange(5) * 100_000_000, 100)
    log = scan_log(
        rng,
        n=500,
        stamps_lidar_ns=stamps,
        has_pulse_times=False,
        rig=None,
        quaternions_imu=np.empty((0, 4)),
        stamps_imu_ns=np.empty(0, np.int64),
    )
    write_log(log, tmp_path / "a.mcap")
    found = read_log(tmp_path / "a.mcap")
    assert_same_log(found, log)
    assert found.rig is None
    assert any("no time of their own" in note for note in found.notes)
    assert any("give a rig" in note for note in found.notes)


def test_an_ahrs_on_the_head_comes_back_on_the_head(tmp_path):
    rig = vlp16(
        "r", rigid(rot_y(1.5), (0.1, 0, 0)), R_mount_imu=rot_z(0.4), imu_mount=ImuMount.HEAD
    )
    write_log(scan_log(np.random.default_rng(3), rig=rig), tmp_path / "a.mcap")
    found = read_log(tmp_path / "a.mcap").rig
    assert found.imu_mount is ImuMount.HEAD
    assert_allclose(found.R_mount_imu, rot_z(0.4), rtol=0, atol=1e-15)


def test_a_log_longer_than_one_chunk_comes_back(tmp_path):
    log = scan_log(np.random.default_rng(4), n=150_000)
    write_log(log, tmp_path / "a.mcap", revolution=0.05)
    assert_same_log(read_log(tmp_path / "a.mcap"), log)


def decoded(path):
    """What the official library makes of a file: topic, time of recording, message."""
    with path.open("rb") as file:
        for item in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            yield item.channel.topic, item.message.log_time, item.decoded_message


def test_mcap_ros2_support_reads_what_we_write(tmp_path):
    log = scan_log(np.random.default_rng(5), n=400)
    write_log(log, tmp_path / "a.mcap")
    found = {
        topic: [] for topic in ("/velodyne_points", "/joint_states", "/imu/data", "/tf_static")
    }
    times = []
    for topic, time, message in decoded(tmp_path / "a.mcap"):
        found[topic].append(message)
        times.append(time)
    assert times == sorted(times)
    first = found["/velodyne_points"][0]
    assert (first.header.frame_id, first.point_step, first.height) == ("velodyne", 22, 1)
    assert first.header.stamp.sec * 10**9 + first.header.stamp.nanosec == log.stamps_lidar_ns[0]
    point = struct.unpack("<ffffHf", bytes(first.data[22 * 7 : 22 * 8]))
    assert_array_equal(np.float32(point[:3]), log.p_lidar[7])
    assert point[3:5] == (log.intensities[7], log.rings[7])
    assert_allclose(
        point[5] * 1e9, log.stamps_lidar_ns[7] - log.stamps_lidar_ns[0], atol=FLOAT_TIME
    )
    assert sum(m.width for m in found["/velodyne_points"]) == 400
    assert [m.position[0] for m in found["/joint_states"]] == log.gimbal_angles.tolist()
    assert found["/joint_states"][0].name == ["gimbal_joint"]
    q = found["/imu/data"][3].orientation
    assert_array_equal([q.x, q.y, q.z, q.w], log.quaternions_imu[3])
    g = found["/imu/data"][3].linear_acceleration
    up = Rotation.from_quat(log.quaternions_imu[3]).apply([g.x, g.y, g.z])
    assert_allclose(up, [0, 0, 9.80665], rtol=0, atol=1e-12)
    links = [(t.header.frame_id, t.child_frame_id) for t in found["/tf_static"][0].transforms]
    assert links == [("gimbal_link", "velodyne"), ("base_link", "imu_link")]


def test_rosbags_reads_what_we_write(tmp_path):
    log = scan_log(np.random.default_rng(6), n=200, duration=0.09)
    write_log(log, tmp_path / "a.mcap", compression="zstd")
    with AnyReader([tmp_path / "a.mcap"], default_typestore=STORE) as reader:
        messages = {
            connection.topic: reader.deserialize(raw, connection.msgtype)
            for connection, _, raw in reader.messages()
        }
    data = messages["/velodyne_points"].data.tobytes()
    x = [struct.unpack_from("<f", data, 22 * row)[0] for row in range(200)]
    assert_array_equal(np.float32(x), log.p_lidar[:, 0])
    assert messages["/joint_states"].position[0] == log.gimbal_angles[-1]


def test_angular_velocity_is_that_of_the_orientations(tmp_path):
    samples = T0 + np.arange(100) * 10_000_000
    spin = Rotation.from_rotvec(np.arange(100)[:, None] * 0.01 * np.array([[0.1, -0.2, 0.3]]))
    log = scan_log(np.random.default_rng(7), quaternions_imu=spin.as_quat(), stamps_imu_ns=samples)
    write_log(log, tmp_path / "a.mcap")
    rates = [
        [m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z]
        for topic, _, m in decoded(tmp_path / "a.mcap")
        if topic == "/imu/data"
    ]
    assert_allclose(rates, np.tile([0.1, -0.2, 0.3], (100, 1)), rtol=0, atol=1e-9)


def test_unknown_ways_of_writing_are_refused(tmp_path):
    log = scan_log(np.random.default_rng(8), n=10)
    with pytest.raises(ConfigError, match="none, lz4 or zstd"):
        write_log(log, tmp_path / "a.mcap", compression="gzip")
    with pytest.raises(ConfigError, match="revolution"):
        write_log(log, tmp_path / "a.mcap", revolution=0.0)


@pytest.mark.parametrize(
    "options",
    [
        {"use_chunking": False},
        {"use_chunking": False, "enable_data_crcs": True},
        {"index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False},
        {"repeat_channels": False, "repeat_schemas": False},
        {"chunk_size": 500, "compression": CompressionType.ZSTD, "enable_crcs": False},
        {"chunk_size": 500, "compression": CompressionType.LZ4},
    ],
)
def test_any_valid_container_gives_the_same_log(tmp_path, options):
    items = small_log(np.random.default_rng(9))
    plain = read_log(record(tmp_path / "plain.mcap", items))
    assert_same_log(read_log(record(tmp_path / "other.mcap", items, **options)), plain)
    assert len(plain.p_lidar) == 64
    assert len(plain.gimbal_angles) == 50


def layout_of(order, kinds, gaps):
    """A point type with the fields in a drawn order, of drawn types, with gaps between them."""
    names, formats, offsets, at = [], [], [], 0
    for name, gap in zip(order, gaps, strict=False):
        if kinds[name] is None:
            continue
        names.append(name)
        formats.append(kinds[name])
        offsets.append(at + gap)
        at = offsets[-1] + np.dtype(kinds[name]).itemsize
    return {"names": names, "formats": formats, "offsets": offsets, "itemsize": at + gaps[-1]}


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    order=st.permutations(["x", "y", "z", "intensity", "ring", "time"]),
    coordinate=st.sampled_from(["f4", "f8"]),
    intensity=st.sampled_from([None, "f4", "f8", "u1", "u2", "i4"]),
    ring=st.sampled_from([None, "u1", "u2", "i1", "i4", "u4", "f4"]),
    time=st.sampled_from([None, "f4", "f8", "u4", "i4"]),
    gaps=st.lists(st.integers(0, 5), min_size=7, max_size=7),
    endian=st.sampled_from("<>"),
    little_endian=st.booleans(),
)
def test_any_layout_of_points_is_read(
    tmp_path, order, coordinate, intensity, ring, time, gaps, endian, little_endian
):
    kinds = {**dict.fromkeys("xyz", coordinate), "intensity": intensity, "ring": ring, "time": time}
    kinds = {name: kind and endian + kind for name, kind in kinds.items()}
    rng = np.random.default_rng(10)
    points = np.zeros(40, layout_of(order, kinds, gaps))
    for axis in "xyz":
        points[axis] = rng.uniform(1, 9, 40)
    if intensity:
        points["intensity"] = np.arange(40)
    if ring:
        points["ring"] = np.arange(40) % 16
    seconds = np.arange(40) * 1e-3
    if time:
        points["time"] = seconds * (1e9 if time in ("u4", "i4") else 1)
    message = encoded(cloud(points), little_endian=little_endian)
    log = read_log(record(tmp_path / "a.mcap", [("/p", T0, message), *turning()]))
    expected = np.stack([points[axis] for axis in "xyz"], axis=1).astype(np.float32)
    assert_array_equal(log.p_lidar, expected)
    assert_array_equal(log.intensities, np.arange(40) if intensity else np.zeros(40))
    assert_array_equal(log.rings, np.arange(40) % 16 if ring else np.full(40, RING_UNKNOWN))
    assert log.has_pulse_times == (time is not None)
    offsets = log.stamps_lidar_ns - T0
    assert_allclose(offsets, seconds * 1e9 if time else 0, rtol=0, atol=FLOAT_TIME)


@pytest.mark.parametrize(
    ("name", "kind", "values"),
    [
        ("t", "u4", lambda s: s * 1e9),
        ("offset_time", "u4", lambda s: s * 1e9),
        ("timestamp", "f8", lambda s: T0 * 1e-9 + s),
        ("timestamp", "f8", lambda s: T0 + s * 1e9),
        ("time_stamp", "u8i", lambda s: s * 1e9),
        ("time", "f4", lambda s: s - 0.1),
    ],
)
def test_the_times_of_other_drivers_are_understood(tmp_path, name, kind, values):
    seconds = np.arange(40) * 2.5e-3
    points = np.zeros(
        40, [("x", "f4"), ("y", "f4"), ("z", "f4"), (name, kind.replace("u8i", "u4"))]
    )
    points["x"], points[name] = 1.0, values(seconds)
    log = read_log(record(tmp_path / "a.mcap", [("/p", T0, cloud(points)), *turning()]))
    assert log.has_pulse_times
    found = log.stamps_lidar_ns - T0 + (100_000_000 if kind == "f4" else 0)
    assert_allclose(found, seconds * 1e9, rtol=0, atol=250)  # float64 seconds since 1970: 240 ns


def test_absolute_times_of_another_clock_are_taken_since_the_stamp(tmp_path):
    points = np.zeros(40, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("timestamp", "f8")])
    points["x"], points["timestamp"] = 1.0, 2_000_000.0 + np.arange(40) * 1e-3
    log = read_log(record(tmp_path / "a.mcap", [("/p", T0, cloud(points)), *turning()]))
    assert_allclose(log.stamps_lidar_ns - T0, np.arange(40) * 1e6, rtol=0, atol=FLOAT_TIME)


def useless_times(kind):
    times = np.linspace(0, 0.1, 64)
    return {
        "zero": times * 0,
        "constant": times * 0 + 0.05,
        "half": np.where(np.arange(64) < 32, times, 0),
        "huge": times * 1e12,
        "nan": np.where(np.arange(64) < 3, np.nan, times),
    }[kind]


@pytest.mark.parametrize("kind", ["zero", "constant", "half", "huge", "nan"])
def test_senseless_times_count_as_none_and_are_noted(tmp_path, kind):
    points = velodyne(np.random.default_rng(11))
    points["time"] = useless_times(kind)
    log = read_log(record(tmp_path / "a.mcap", [("/points", T0, cloud(points)), *turning()]))
    assert not log.has_pulse_times
    assert set(log.stamps_lidar_ns.tolist()) == {T0}
    assert any("/points carry no time of their own" in note for note in log.notes)


def test_returns_that_are_none_are_dropped(tmp_path):
    points = velodyne(np.random.default_rng(12), n=96)
    points["x"][5], points["y"][17], points["z"][29] = np.nan, np.inf, -np.inf
    for axis in "xyz":
        points[axis][41] = 0.0
    points["z"][53] = 0.0
    kept = np.setdiff1d(np.arange(96), [5, 17, 29, 41])
    for height, padding in product((1, 16), (0, 7)):
        message = cloud(points, height=height, row_padding=padding)
        log = read_log(record(tmp_path / "a.mcap", [("/p", T0, message), *turning()]))
        assert_array_equal(log.p_lidar[:, 2], points["z"][kept])
        assert_array_equal(log.rings, points["ring"][kept])


def test_returns_that_are_none_are_dropped_wherever_they_are_in_a_long_cloud(tmp_path):
    rng = np.random.default_rng(32)
    points = velodyne(rng, n=3000)
    is_none = rng.random(3000) < 0.01
    is_none[[0, 511, 512, 2999]] = True
    is_none[1024:1536] = True
    points["y"][is_none] = np.where(np.arange(is_none.sum()) % 2, np.nan, -np.inf)
    points["intensity"][5::7] = np.nan
    log = read_log(record(tmp_path / "a.mcap", [("/p", T0, cloud(points)), *turning()]))
    kept = points[~is_none]
    assert_array_equal(log.p_lidar, np.column_stack([kept[axis] for axis in "xyz"]))
    assert_array_equal(log.intensities, np.nan_to_num(kept["intensity"]))
    assert_array_equal(log.rings, kept["ring"])
    times = kept["time"].astype(np.float64) * 1e9
    assert_allclose(log.stamps_lidar_ns - T0, times, rtol=0, atol=FLOAT_TIME)


def as_whole_nanoseconds(points):
    """The same points as a driver writes them that counts nanoseconds."""
    kinds = [(name, "<f4") for name in (*"xyz", "intensity")] + [("ring", "u1"), ("t", "<u4")]
    columns = [points[name] for name in (*"xyz", "intensity", "ring")]
    return np.rec.fromarrays([*columns, np.round(points["time"] * 1e9)], dtype=kinds)


def as_absolute_doubles(points, ns):
    """The same points as a driver writes them that knows no single precision."""
    kinds = [(name, "<f8") for name in (*"xyz", "intensity", "timestamp")]
    columns = [points[name] for name in (*"xyz", "intensity")]
    return np.rec.fromarrays([*columns, ns * 1e-9 + points["time"].astype(np.float64)], dtype=kinds)


def test_clouds_of_changing_layouts_come_back_one_behind_the_other(tmp_path):
    """Messages that begin alike are unpacked together, all others alone: it must not show."""
    rng = np.random.default_rng(28)
    items, expected, instants = turning(n=300), [], []
    for k in range(24):
        ns = T0 + k * 200_000_000
        points = velodyne(rng, n=64 + 16 * k)
        points["y"][rng.integers(0, len(points), 9 if k % 3 == 0 else 0)] = np.nan
        keep = np.isfinite(points["y"])
        expected.append(np.column_stack([points[name] for name in (*"xyz", "intensity")])[keep])
        instants.append(ns - T0 + points["time"][keep].astype(np.float64) * 1e9)
        if k % 8 == 5:
            points = as_absolute_doubles(points, ns)
        elif k % 4 == 2:
            points = as_whole_nanoseconds(points)
        height, padding = (8, 5) if k % 5 == 1 else (1, 0)
        message = cloud(points, ns, height=height, row_padding=padding)
        items.append(("/points", ns + 100_000_000, message))
    log = read_log(record(tmp_path / "a.mcap", items))
    found = np.column_stack([log.p_lidar, log.intensities])
    assert_array_equal(found, np.concatenate(expected))
    step = np.spacing(T0 * 1e-9) * 1e9  # [ns] of float64 seconds since 1970
    assert_allclose(log.stamps_lidar_ns - T0, np.concatenate(instants), rtol=0, atol=2 * step)


@pytest.mark.parametrize("size", [64, 20_000])
def test_times_that_are_usable_are_not_lost_by_some_that_are_not(tmp_path, size):
    rng = np.random.default_rng(30)
    clouds = [velodyne(rng, n=size) for _ in range(30)]
    clouds[7]["time"] = 0.0
    items = [
        ("/points", T0 + k * 10**8, cloud(points, T0 + k * 10**8))
        for k, points in enumerate(clouds)
    ]
    log = read_log(record(tmp_path / "a.mcap", [*items, *turning(n=400)]))
    assert log.has_pulse_times
    found = (log.stamps_lidar_ns - T0).reshape(30, size)
    times = np.stack([points["time"] for points in clouds]).astype(np.float64)
    expected = np.sort(np.arange(30)[:, None] * 1e8 + times * 1e9, axis=None).reshape(30, size)
    assert_allclose(found, expected, rtol=0, atol=FLOAT_TIME)


def test_rings_that_cannot_be_are_not_used(tmp_path):
    points = velodyne(np.random.default_rng(13))
    points["ring"][3] = 300
    log = read_log(record(tmp_path / "a.mcap", [("/p", T0, cloud(points)), *turning()]))
    assert set(log.rings.tolist()) == {RING_UNKNOWN}
    assert any("rings outside" in note for note in log.notes)


def test_messages_out_of_order_come_back_in_order(tmp_path):
    rng = np.random.default_rng(14)
    late, early = velodyne(rng, duration=0.09), velodyne(rng, duration=0.09)
    items = [
        ("/p", T0, cloud(late, T0 + 100_000_000)),
        ("/p", T0, cloud(early, T0)),
        *reversed(turning()),
        *turning()[:4],
    ]
    log = read_log(record(tmp_path / "a.mcap", items))
    assert_array_equal(log.p_lidar[:, 0], [*early["x"], *late["x"]])
    assert (np.diff(log.stamps_lidar_ns) >= 0).all()
    assert_allclose(log.gimbal_angles, 0.1 * np.arange(50), rtol=0, atol=1e-12)
    assert any("out of order or double" in note for note in log.notes)


def test_without_stamps_the_times_of_recording_are_used(tmp_path):
    points = velodyne(np.random.default_rng(15))
    items = [
        (topic, log_time, joints(0, gimbal_joint=0.1 * k))
        for k, (topic, log_time, _) in enumerate(turning())
    ]
    items.append(("/p", T0 + 100_000_000, cloud(points, 0)))
    log = read_log(record(tmp_path / "a.mcap", items))
    assert_allclose(log.stamps_lidar_ns - T0, points["time"] * 1e9, rtol=0, atol=FLOAT_TIME)
    assert log.stamps_gimbal_ns[5] == T0
    assert sum("times of recording" in note for note in log.notes) == 2


def test_stamps_that_cannot_be_are_left_out(tmp_path):
    """A node that has no time yet stamps by 1970."""
    rng = np.random.default_rng(28)
    items = small_log(rng)
    items.insert(0, ("/joint_states", T0, joints(0, gimbal_joint=9.0)))
    items.insert(1, ("/points", T0 + 100_000_000, cloud(velodyne(rng, n=33), ns=10**9)))
    items.append(("/points", T0 + 200_000_000, cloud(velodyne(rng, n=40), ns=T0 + 100_000_000)))
    log = read_log(record(tmp_path / "a.mcap", items))
    assert (len(log.p_lidar), len(log.gimbal_angles)) == (104, 50)
    assert log.has_pulse_times
    assert sum("more than a day off" in note for note in log.notes) == 2


def test_joints_are_unwrapped_and_chosen_by_name_and_by_motion(tmp_path):
    points = ("/p", T0 + 100_000_000, cloud(velodyne(np.random.default_rng(16))))
    angles = np.arange(50) * 0.2
    wrapped = (angles + math.pi) % math.tau - math.pi

    def log_of(**signals):
        items = [
            (
                "/joint_states",
                T0 + k * 10_000_000,
                joints(T0 + k * 10_000_000, **{n: float(v[k]) for n, v in signals.items()}),
            )
            for k in range(50)
        ]
        return record(tmp_path / "a.mcap", [points, *items])

    still = np.zeros(50)
    for signals in (
        {"anything": wrapped},
        {"wheel": angles * 3, "gimbal_joint": wrapped},
        {"left": still, "pan": wrapped, "right": still},
        {"gimbal_tilt": still, "gimbal_pan": wrapped, "wheel": angles},
    ):
        assert_allclose(read_log(log_of(**signals)).gimbal_angles, angles, rtol=0, atol=1e-12)
    path = log_of(left=angles * 2, pan=wrapped)
    assert_allclose(read_log(path, joint="pan").gimbal_angles, angles, rtol=0, atol=1e-12)


def test_joints_may_come_in_messages_of_their_own(tmp_path):
    items = small_log(np.random.default_rng(17))
    items += [("/joint_states", T0 + k, joints(T0 + k, a=1.0, b=float(k))) for k in range(9)]
    assert_allclose(read_log(record(tmp_path / "a.mcap", items)).gimbal_angles, 0.1 * np.arange(50))


def test_the_angle_may_be_a_transform(tmp_path):
    items = [("/p", T0 + 100_000_000, cloud(velodyne(np.random.default_rng(18))))]
    items.append(
        (
            "/tf_static",
            T0,
            frames(
                ("head", "plate", (0.1, 0, 0), STILL), ("plate", "velodyne", (0, 0.2, 0.3), TURN)
            ),
        )
    )
    for k in range(50):
        q = Rotation.from_euler("z", 0.2 * k).as_quat()
        items.append(
            (
                "/tf",
                T0 + k * 10_000_000,
                frames(("stand", "head", (0, 0, 1), q), ns=T0 + k * 10_000_000),
            )
        )
    log = read_log(record(tmp_path / "a.mcap", items))
    assert_allclose(log.gimbal_angles, 0.2 * np.arange(50), rtol=0, atol=1e-12)
    assert_allclose(
        log.rig.T_head_lidar, rigid(rot_y(math.pi / 2), (0.1, 0.2, 0)), rtol=0, atol=1e-12
    )


def test_the_angle_may_be_the_orientation_of_an_ahrs_on_the_head(tmp_path):
    """Up to the heading, which only a joint would fix."""
    items = [("/p", T0 + 100_000_000, cloud(velodyne(np.random.default_rng(19))))]
    mount = Rotation.from_euler("x", 180, degrees=True)
    links = (
        ("gimbal_link", "velodyne", (0, 0, 0), TURN),
        ("gimbal_link", "imu_link", (0, 0, 0), mount.as_quat()),
    )
    items.append(("/tf_static", T0, frames(*links)))
    lean = Rotation.from_matrix(rot_y(0.05) @ rot_x(-0.03))
    angles = np.linspace(0, 2 * math.pi, 50)
    for k, angle in enumerate(angles):
        q = (lean * Rotation.from_euler("z", angle) * mount).as_quat()
        items.append(("/imu", T0, imu(T0 + k * 10_000_000, q)))
    log = read_log(record(tmp_path / "a.mcap", items))
    assert_allclose(log.gimbal_angles - log.gimbal_angles[0], angles, rtol=0, atol=2e-3)
    assert log.rig.imu_mount is ImuMount.HEAD
    assert any("orientation of /imu" in note for note in log.notes)


def test_the_mounting_of_the_ahrs_is_found_through_other_frames(tmp_path):
    items = small_log(np.random.default_rng(20))
    links = (
        ("gimbal_link", "mount", (0.1, 0, 0), STILL),
        ("mount", "velodyne", (0, 0, 0), TURN),
        ("base_link", "shelf", (0, 0, 1), STILL),
        ("shelf", "imu_link", (0, 0, 0), Rotation.from_euler("z", 90, degrees=True).as_quat()),
    )
    items += [("/tf_static", T0, frames(link)) for link in links]
    rig = read_log(record(tmp_path / "a.mcap", [*items, ("/imu", T0, imu(T0, STILL))])).rig
    assert rig.imu_mount is ImuMount.BASE
    assert_allclose(rig.R_mount_imu, rot_z(math.pi / 2), rtol=0, atol=1e-12)
    at_base = [*items, ("/imu", T0, imu(T0, STILL, frame="base_link"))]
    assert_array_equal(read_log(record(tmp_path / "a.mcap", at_base)).rig.R_mount_imu, np.eye(3))
    unknown = [*items, ("/imu", T0, imu(T0, STILL, frame="elsewhere"))]
    assert any("elsewhere" in n for n in read_log(record(tmp_path / "a.mcap", unknown)).notes)


def test_orientations_that_the_device_does_not_know_are_left_out(tmp_path):
    items = small_log(np.random.default_rng(21))
    items += [
        ("/imu", T0, imu(T0, TURN, covariance=-1.0)),
        ("/imu", T0, imu(T0 + 1, (0, 0, 0, 0))),
    ]
    log = read_log(record(tmp_path / "a.mcap", items))
    assert_array_equal(log.quaternions_imu, [STILL])  # by the accelerations
    assert any("levelled by the accelerations of /imu" in note for note in log.notes)
    assert log.sigma_levelling > 0


def test_broken_messages_cost_themselves_only(tmp_path):
    rng = np.random.default_rng(22)
    items = small_log(rng)
    schema, good = encoded(cloud(velodyne(rng)))
    items += [
        ("/points", T0, (schema, data)) for data in (b"", good[:40], good[:-500], b"\xff" * 90)
    ]
    joint_schema, joint = encoded(joints(T0, gimbal_joint=1.0))
    items += [("/joint_states", T0, (joint_schema, joint[:9]))]
    log = read_log(record(tmp_path / "a.mcap", items))
    assert (len(log.p_lidar), len(log.gimbal_angles)) == (64, 50)
    assert any("4 messages of /points could not be decoded" in note for note in log.notes)
    assert any("1 message of /joint_states could not be decoded" in note for note in log.notes)


def test_a_definition_of_another_type_costs_its_channel_only(tmp_path):
    items = small_log(np.random.default_rng(23))
    odd = {"sensor_msgs/msg/Imu": "float64 something\nint8 else"}
    items.append(("/imu", T0, imu(T0, STILL)))
    log = read_log(record(tmp_path / "a.mcap", items, definitions=DEFINITIONS | odd))
    assert len(log.quaternions_imu) == 0
    assert any(note.startswith("/imu is left out") for note in log.notes)


def test_topics_can_be_named(tmp_path):
    rng = np.random.default_rng(24)
    more = ("/more", T0 + 100_000_000, cloud(velodyne(rng, n=200)))
    path = record(tmp_path / "a.mcap", [*small_log(rng), more])
    assert len(read_log(path).p_lidar) == 200
    assert any("/points could be chosen" in note for note in read_log(path).notes)
    assert len(read_log(path, topics=["/points"]).p_lidar) == 64


def test_xcdr2_aligns_at_four_bytes(tmp_path):
    items = small_log(np.random.default_rng(25))[:1]
    for k in range(20):
        ns = T0 + k * 10_000_000
        body = struct.pack("<iI", *divmod(ns, 10**9)) + struct.pack("<I1s3x", 1, b"\0")
        body += struct.pack("<I", 1) + struct.pack("<I4s", 4, b"pan\0") + struct.pack("<I", 1)
        body += struct.pack("<dII", 0.1 * k, 0, 0)
        items.append(("/joint_states", ns, ("sensor_msgs/msg/JointState", b"\0\x07\0\0" + body)))
    log = read_log(record(tmp_path / "a.mcap", items))
    assert_allclose(log.gimbal_angles, 0.1 * np.arange(20), rtol=0, atol=1e-12)


def test_a_recording_elsewhere_is_fetched(tmp_path):
    path = record(tmp_path / "a.mcap", small_log(np.random.default_rng(26)))
    files = fsspec.filesystem("memory")
    files.pipe("/logs/stop-7.mcap", path.read_bytes())
    log = read_log("memory://logs/stop-7.mcap")
    assert log.origin.name == "stop-7"
    assert log.origin.digest == file_digest(path)
    assert_same_log(log, read_log(path))


def test_a_known_digest_is_believed(tmp_path):
    path = record(tmp_path / "a.mcap", small_log(np.random.default_rng(27)))
    assert read_log(path, digest="abc").origin.digest == "abc"


@pytest.mark.parametrize(
    "path", recordings("mcap_container", "*.mcap"), ids=lambda p: getattr(p, "stem", "none")
)
def test_the_container_suite_gives_its_messages(path):
    records = json.loads(path.with_suffix(".json").read_text())["records"]
    expected = [dict(r["fields"]) for r in records if r["type"] == "Message"]
    with opened(path) as container:
        found = [
            (bytes(data), log_time, batch.channel.topic)
            for batch in container.batches()
            for data, log_time in batch
        ]
    assert found == [(bytes(map(int, m["data"])), int(m["log_time"]), "example") for m in expected]


@pytest.mark.parametrize(
    "path", recordings("ros2_bags", "*.mcap"), ids=lambda p: getattr(p, "stem", "none")
)
def test_real_bags_give_as_many_messages_as_the_library_finds(path):
    with path.open("rb") as file:
        expected = [(m.log_time, m.data) for _, _, m in make_reader(file).iter_messages()]
    with opened(path) as container:
        found = [(time, bytes(data)) for batch in container.batches() for data, time in batch]
    assert sorted(found) == sorted(expected)


def test_channels_without_a_schema_are_known_by_their_topic():
    head = b"\x89MCAP0\r\n"
    channel = struct.pack("<HHI1sI0sI", 7, 0, 1, b"t", 0, b"", 0)
    message = struct.pack("<HIQQ", 7, 0, 5, 5) + b"abc"
    octets = head + b"".join(
        struct.pack("<BQ", code, len(body)) + body
        for code, body in ((4, channel), (5, message), (0x0F, bytes(4)), (2, bytes(20)))
    )
    container = Container(np.frombuffer(octets + head, np.uint8))
    (batch,) = container.batches()
    assert (batch.channel.topic, batch.channel.schema) == ("t", "")
    assert [bytes(data) for data, _ in batch] == [b"abc"]
