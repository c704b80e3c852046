"""Recordings that cannot be used, each the smallest that deserves it, and the preflight report."""

import io
import json
import math
import os
from dataclasses import replace

import numpy as np
import pytest
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from spheremark.pipelines.errors import (
    MissingGimbalAngleError,
    MissingLidarError,
    NotFoundError,
    NotMcapError,
    RecordingError,
    SpheremarkError,
    TruncatedRecordingError,
)
from spheremark.pipelines.model import Origin, ScanLog
from spheremark.pipelines.scan.rigs import tilted_vlp16
from spheremark.storage.recordings import LogOptions, inspect_log, read_log, write_log
from spheremark.storage.recordings.records import MAGIC
from spheremark.storage.recordings.sources import opened
from tests.storage.recorder import T0, cloud, joints, record, small_log, turning, velodyne


def test_a_file_that_is_not_there_is_not_found(tmp_path):
    with pytest.raises(NotFoundError, match="no recording"):
        read_log(tmp_path / "none.mcap")
    with pytest.raises(NotFoundError):
        inspect_log(tmp_path / "none.mcap")


def test_a_pipe_is_refused_before_anybody_waits_for_it(tmp_path):
    os.mkfifo(tmp_path / "log.mcap")
    with pytest.raises(RecordingError, match=r"log\.mcap is no regular file.*Save it"):
        read_log(tmp_path / "log.mcap")


def test_a_folder_without_a_log_is_refused_with_its_files(tmp_path):
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(NotMcapError, match=r"holds no log. Found: notes.txt"):
        read_log(tmp_path)


@pytest.mark.parametrize("octets", [b"", b"#ROSBAG V1.2\n", MAGIC[:5]])
def test_what_is_not_mcap_is_refused(tmp_path, octets):
    (tmp_path / "a.mcap").write_bytes(octets)
    with pytest.raises(NotMcapError):
        read_log(tmp_path / "a.mcap")
    report = inspect_log(tmp_path / "a.mcap")
    assert (report.verdict, report.code) == ("refused", NotMcapError.code)


def test_packets_without_times_are_named_with_what_would_help(tmp_path):
    (tmp_path / "a.bin").write_bytes(b"\xff\xee" + bytes(1204))
    with pytest.raises(NotMcapError, match=r"without the times.*PCAP.*--pcap"):
        read_log(tmp_path / "a.bin")


def test_a_recording_cut_anywhere_is_truncated(tmp_path):
    whole = record(tmp_path / "a.mcap", small_log(np.random.default_rng(1)), chunk_size=700)
    octets = whole.read_bytes()
    cut = tmp_path / "cut.mcap"
    for size in {*range(8, len(octets), 487), len(octets) - 1, len(octets) - 8, len(octets) - 30}:
        cut.write_bytes(octets[:size])
        with pytest.raises(TruncatedRecordingError, match="readable up to byte"):
            read_log(cut)


def test_a_truncated_recording_says_how_far_it_is_readable(tmp_path):
    whole = record(tmp_path / "a.mcap", small_log(np.random.default_rng(2)), chunk_size=700)
    whole.write_bytes(whole.read_bytes()[:6000])
    with pytest.raises(TruncatedRecordingError) as caught:
        read_log(whole)
    readable = int(str(caught.value).split("byte ")[1].split(" of")[0].replace(",", ""))
    assert 5000 < readable <= 6000
    report = inspect_log(whole)
    assert (report.verdict, report.code) == ("refused", TruncatedRecordingError.code)
    assert report.reasons[0] == str(caught.value)
    assert [topic.topic for topic in report.topics] == ["/joint_states", "/points"]
    assert report.n_returns == 64


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_flipped_bit_is_noticed(tmp_path, compression):
    path = record(tmp_path / "a.mcap", small_log(np.random.default_rng(3)), compression=compression)
    octets = bytearray(path.read_bytes())
    octets[900] ^= 4
    path.write_bytes(octets)
    with pytest.raises(TruncatedRecordingError, match="a chunk is damaged"):
        read_log(path)


@pytest.mark.parametrize("compression", list(CompressionType))
def test_what_comes_before_a_damaged_chunk_is_given(tmp_path, compression):
    items = [
        ("/points", T0 + k * 10**8, cloud(velodyne(np.random.default_rng(k)), T0 + k * 10**8))
        for k in range(40)
    ]
    path = record(tmp_path / "a.mcap", items, compression=compression, chunk_size=3000)
    octets = bytearray(path.read_bytes())
    records = StreamReader(io.BytesIO(octets), emit_chunks=True).records
    chunks = [one for one in records if isinstance(one, Chunk)]
    octets[octets.index(chunks[9].data) + len(chunks[9].data) // 2] ^= 1
    path.write_bytes(octets)
    times = []
    with opened(path) as container:
        batches = container.batches()
        with pytest.raises(TruncatedRecordingError, match="is damaged"):
            times.extend(time for batch in batches for time in batch.log_times_ns.tolist())
    messages = [one for chunk in chunks[:9] for one in breakup_chunk(chunk)]
    assert times == [one.log_time for one in messages if isinstance(one, Message)]


def test_a_flipped_bit_outside_chunks_is_noticed_by_the_checksum_of_the_data(tmp_path):
    options = {"use_chunking": False, "enable_data_crcs": True}
    path = record(tmp_path / "a.mcap", small_log(np.random.default_rng(4)), **options)
    octets = path.read_bytes()
    place = octets.index(b"gimbal_joint") + 40  # in the angle
    path.write_bytes(octets[:place] + bytes([octets[place] ^ 1]) + octets[place + 1 :])
    with pytest.raises(TruncatedRecordingError, match="checksum of the data"):
        read_log(path)


def test_declared_lengths_are_not_believed(tmp_path):
    """A chunk that declares an exabyte, and a record longer than the file."""
    path = record(
        tmp_path / "a.mcap", small_log(np.random.default_rng(5)), compression=CompressionType.ZSTD
    )
    octets = path.read_bytes()
    size = octets.index(b"zstd") - 16  # before the checksum and the length of this name
    huge = (1 << 60).to_bytes(8, "little")
    path.write_bytes(octets[:size] + huge + octets[size + 8 :])
    with pytest.raises(TruncatedRecordingError, match="more than 536,870,912"):
        read_log(path)
    path.write_bytes(octets[:9] + huge + octets[17:])
    with pytest.raises(TruncatedRecordingError, match="a record is cut"):
        read_log(path)


def test_whatever_bytes_are_wrong_the_answer_is_a_log_or_a_reason(tmp_path):
    rng = np.random.default_rng(11)
    path = record(tmp_path / "a.mcap", small_log(rng), chunk_size=1500, enable_crcs=False)
    octets = np.frombuffer(path.read_bytes(), np.uint8)
    outcomes = set()
    for _ in range(200):
        wrong = octets.copy()
        places = rng.integers(8, len(octets), rng.integers(1, 6))
        wrong[places] = rng.integers(0, 256, len(places))
        path.write_bytes(wrong.tobytes())
        try:
            outcomes.add(type(read_log(path)))
        except SpheremarkError as error:
            outcomes.add(type(error))
        assert inspect_log(path).verdict in ("ok", "weak", "refused")
    assert {ScanLog, TruncatedRecordingError} <= outcomes


def test_a_recording_without_lidar_lists_what_it_has(tmp_path):
    path = record(tmp_path / "a.mcap", turning())
    with pytest.raises(MissingLidarError, match=r"/joint_states \(sensor_msgs/msg/JointState\)"):
        read_log(path)
    assert inspect_log(path).code == MissingLidarError.code


def test_a_lidar_without_returns_is_refused(tmp_path):
    points = velodyne(np.random.default_rng(6))
    points["x"] = np.nan
    path = record(tmp_path / "a.mcap", [("/points", T0, cloud(points)), *turning()])
    with pytest.raises(MissingLidarError, match="hold no returns: /points"):
        read_log(path)


def test_clouds_without_coordinates_are_refused_with_their_fields(tmp_path):
    points = np.zeros(4, [("x", "f4"), ("y", "f4"), ("depth", "f4")])
    path = record(tmp_path / "a.mcap", [("/points", T0, cloud(points)), *turning()])
    with pytest.raises(MissingLidarError, match="no field 'z', only x, y, depth"):
        read_log(path)


@pytest.mark.parametrize("step", [2**31, 2**32 - 1, 2**17])
def test_points_of_senseless_size_cost_their_message(tmp_path, step):
    rng = np.random.default_rng(2)
    message = cloud(velodyne(rng)[:0])
    message.point_step = step
    items = [("/p", T0, message), ("/q", T0, cloud(velodyne(rng))), *turning()]
    log = read_log(record(tmp_path / "a.mcap", items))
    assert len(log.p_lidar) == 64
    with pytest.raises(MissingLidarError, match=f"its points would have {step:,} bytes"):
        read_log(tmp_path / "a.mcap", LogOptions(topic=("/p",)))


def test_a_recording_without_gimbal_angle_is_refused(tmp_path):
    path = record(tmp_path / "a.mcap", small_log(np.random.default_rng(7))[:1])
    with pytest.raises(MissingGimbalAngleError, match="No topic holds the angle"):
        read_log(path)
    assert inspect_log(path).code == MissingGimbalAngleError.code


def test_joints_that_could_all_be_the_gimbal_are_named(tmp_path):
    items = [
        (topic, at, joints(at, left=0.1 * k, right=0.2 * k))
        for k, (topic, at, _) in enumerate(turning())
    ]
    path = record(tmp_path / "a.mcap", [*small_log(np.random.default_rng(8))[:1], *items])
    with pytest.raises(MissingGimbalAngleError, match=r"left of /joint_states, right of /joint"):
        read_log(path)


def test_clocks_that_do_not_overlap_are_refused_with_both_spans(tmp_path):
    items = [("/p", T0, cloud(velodyne(np.random.default_rng(9)), ns=12 * 10**9)), *turning()]
    with pytest.raises(RecordingError, match=r"from 1970-01-01T00:00:12.*from 2023-11-14"):
        read_log(record(tmp_path / "a.mcap", items))


def test_a_topic_that_is_not_there_is_refused(tmp_path):
    path = record(tmp_path / "a.mcap", small_log(np.random.default_rng(10)))
    with pytest.raises(RecordingError, match=r"no topic /other; it has /joint_states"):
        read_log(path, topics=["/other"])


def turn_log(*, turn=10.0, share=1.0, spin=10.0, **changes):
    """A turn of the gimbal with a LiDAR that sees a sphere of 5 m around it, and an AHRS."""
    duration = turn * share
    times = np.arange(0.0, duration, 2e-4)
    azimuth = 2 * math.pi * spin * times
    rings = np.arange(len(times)) % 16
    elevation = np.radians(-15.0 + 2.0 * rings)
    p = 5.0 * np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            -np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        axis=1,
    )
    samples = np.arange(-0.01, duration + 0.02, 0.01)
    values = {
        "p_lidar": p.astype(np.float32),
        "intensities": np.zeros(len(times), np.float32),
        "rings": rings.astype(np.uint8),
        "stamps_lidar_ns": T0 + np.rint(times * 1e9).astype(np.int64),
        "has_pulse_times": True,
        "gimbal_angles": 2 * math.pi * samples / turn,
        "stamps_gimbal_ns": T0 + np.rint(samples * 1e9).astype(np.int64),
        "quaternions_imu": Rotation.identity(len(samples)).as_quat(),
        "stamps_imu_ns": T0 + np.rint(samples * 1e9).astype(np.int64),
        "rig": tilted_vlp16("study", (0.05, 0.0)),
        "origin": Origin(name="stop", digest=""),
    }
    return ScanLog(**values | changes)


def inspected(tmp_path, log):
    write_log(log, tmp_path / "stop.mcap")
    report = inspect_log(tmp_path / "stop.mcap")
    assert json.loads(json.dumps(report.to_mapping(), allow_nan=False))["verdict"] == report.verdict
    return report


def test_the_preflight_of_a_good_log_tells_its_speeds_and_coverage(tmp_path):
    report = inspected(tmp_path, turn_log(turn=13.2))
    assert (report.verdict, report.code, report.reasons) == ("ok", "", ())
    assert (report.n_stops, report.has_shot_times, report.has_orientation) == (1, True, True)
    assert_allclose(report.lidar_speed_rpm, 600.0, rtol=0, atol=1e-3)
    assert_allclose(report.gimbal_speed_deg_per_s, 360 / 13.2, rtol=0, atol=1e-6)
    assert_allclose(report.gimbal_coverage_deg, 360.0, rtol=0, atol=0.1)
    assert_allclose(report.clock_skew_s, 0.0, rtol=0, atol=0.02)
    rates = {topic.topic: topic.rate_hz for topic in report.topics}
    assert_allclose(rates["/joint_states"], 100.0, rtol=0, atol=0.01)


def test_the_preflight_sorts_the_times_of_each_topic_as_often_however_many_there_are(
    tmp_path, monkeypatch
):
    log = small_log(np.random.default_rng(12))
    others = [(f"/other{k}", *message) for k in range(20) for _, *message in turning(3)]
    sorts, sort = [], np.sort
    monkeypatch.setattr(np, "sort", lambda *a, **k: sorts.append(a) or sort(*a, **k))
    n_sorts = []
    for items in (log, [*log, *others]):
        sorts.clear()
        inspect_log(record(tmp_path / "a.mcap", items))
        n_sorts.append(len(sorts))
    assert n_sorts[1] - n_sorts[0] < 5 * 20


def test_a_pause_of_the_lidar_in_a_turn_is_weak(tmp_path):
    log = turn_log(turn=13.2)
    since = (log.stamps_lidar_ns - log.stamps_lidar_ns[0]) * 1e-9
    kept = (since < 5.0) | (since > 6.5)
    columns = ("p_lidar", "intensities", "rings", "stamps_lidar_ns")
    report = inspected(
        tmp_path, replace(log, **{name: getattr(log, name)[kept] for name in columns})
    )
    assert report.verdict == "weak"
    assert "silent for 1.5 s while the gimbal turned by 41 deg" in report.reasons[0]


def horizon_gap(turn, spin):
    """The largest gap by counting: where lasers cross the horizon, up and down, in one turn."""
    elevations = np.radians(np.arange(-15.0, 16.0, 2.0))
    k = np.arange(round(turn * spin))
    step = 2 * math.pi / turn / spin
    up = (step * k)[:, None] + math.pi / 2 - elevations
    down = (step * (k + 0.5))[:, None] - math.pi / 2 + elevations
    found = np.sort(np.concatenate([up.ravel(), down.ravel()]) % (2 * math.pi))
    return math.degrees(np.diff(found, append=found[0] + 2 * math.pi).max())


@pytest.mark.parametrize(("turn", "expected"), [(13.2, "ok"), (9.0, "weak")])
def test_commensurate_speeds_are_weak_for_their_gaps(tmp_path, turn, expected):
    report = inspected(tmp_path, turn_log(turn=turn))
    assert_allclose(report.coverage_gap_deg, horizon_gap(turn, 10.0), rtol=0, atol=0.05)
    assert report.verdict == expected
    assert any("gaps" in reason for reason in report.reasons) == (expected == "weak")


def test_a_turn_under_half_is_weak(tmp_path):
    report = inspected(tmp_path, turn_log(share=0.4))
    assert report.verdict == "weak"
    assert any("turn under 180 deg" in reason for reason in report.reasons)


def test_a_log_without_rig_or_level_is_weak(tmp_path):
    log = turn_log(rig=None, quaternions_imu=np.empty((0, 4)), stamps_imu_ns=np.empty(0, np.int64))
    report = inspected(tmp_path, log)
    assert report.verdict == "weak"
    assert [word in " ".join(report.reasons) for word in ("--rig", "level")] == [True, True]


def test_a_continuous_turn_without_shot_times_is_refused(tmp_path):
    log = turn_log()
    stamps = T0 + (log.stamps_lidar_ns - T0) // 100_000_000 * 100_000_000
    report = inspected(tmp_path, replace(log, stamps_lidar_ns=stamps, has_pulse_times=False))
    assert (report.verdict, report.code) == ("refused", "input.recording.no_shot_times")
    assert (report.lidar_speed_rpm, report.coverage_gap_deg) == (None, None)
