"""Raw packets of a VLP-16: written, read back, and decoded as velodyne-decoder does."""

import sqlite3
from itertools import pairwise

import numpy as np
import pytest
import velodyne_decoder as vd
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from numpy.testing import assert_allclose, assert_array_equal
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from spheremark.pipelines.errors import MissingLidarError
from spheremark.pipelines.model import Firings
from spheremark.pipelines.scan.rigs import FIRING_ORDER
from spheremark.pipelines.scan.spin import stamps_by_spin
from spheremark.pipelines.simulation import SimulationConfig, scenario, simulate_stop
from spheremark.pipelines.simulation.rig import nominal_rig
from spheremark.storage.recordings import inspect_log, read_log, write_log
from spheremark.storage.recordings.definitions import definition
from spheremark.storage.recordings.packets import SCHEMA, encoded, punctual
from tests.real_scans import REAL, needs
from tests.storage.recorder import DEFINITIONS, T0, cloud, joints, record, turning, velodyne

PACKETS = REAL / "vlp16_packets"
SINGLE = 1e-4  # [m] of a range of 100 m with the decoder's seven digits of an elevation
CLOCK = 2e-6  # [s] the decoder counts by the sensor's clock of whole microseconds
HOUR = 3_600_000_000_000
PACKET = 24 * 55_296  # [ns]
STORE = get_typestore(Stores.ROS2_HUMBLE)
DEFINITION = definition(SCHEMA)
STORE.register(get_types_from_msg(DEFINITION, SCHEMA))

needs_real = needs("vlp16_packets")


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def firings(rng, n_packets=4, start_ns=T0):
    """Shots of which a third have no return, at 600 revolutions per minute."""
    shape = (12 * n_packets, 32)
    distances = rng.integers(500, 50_000, shape).astype(np.uint16)
    distances[rng.random(shape) < 1 / 3] = 0
    return Firings(
        azimuths=np.round(35_800 + 39.81312 * np.arange(len(distances))).astype(np.int64)
        .astype(np.uint16) % 36_000,
        distances=distances,
        reflectivities=rng.integers(0, 256, shape).astype(np.uint8),
        start_ns=start_ns,
    )  # fmt: skip


def message(packets, *, stamps_ns=None, little_endian=True, header_ns=None):
    """Schema and bytes of a VelodyneScan by rosbags, of packets as ours are encoded."""
    own = packets["sec"].astype(np.int64) * 10**9 + packets["nanosec"]
    stamps_ns = own if stamps_ns is None else np.asarray(stamps_ns)
    time, header = STORE.types["builtin_interfaces/msg/Time"], STORE.types["std_msgs/msg/Header"]

    def at(ns):
        return time(sec=int(ns) // 10**9, nanosec=int(ns) % 10**9)

    scan = STORE.types[SCHEMA](
        header=header(stamp=at(own[0] if header_ns is None else header_ns), frame_id="velodyne"),
        packets=[
            STORE.types["velodyne_msgs/msg/VelodynePacket"](
                stamp=at(ns), data=np.frombuffer(one["data"].tobytes(), np.uint8)
            )
            for ns, one in zip(stamps_ns, packets, strict=True)
        ],
    )
    return SCHEMA, bytes(STORE.serialize_cdr(scan, SCHEMA, little_endian=little_endian))


def read(tmp_path, *messages, log_ns=T0, start_ns=T0):
    """Read messages of packets, with a gimbal that turns meanwhile."""
    items = [("/velodyne_packets", log_ns, one) for one in messages]
    items += [
        ("/joint_states", log_ns, joints(int(start_ns) + k * 10**7, gimbal_joint=0.1 * k))
        for k in range(-1, 100)
    ]
    return read_log(
        record(tmp_path / "a.mcap", items, definitions={**DEFINITIONS, SCHEMA: DEFINITION})
    )


def decoded(stamps_ns, packets):
    """Points and instants by velodyne-decoder; packets are rows of 1206 bytes."""
    scan = vd.PacketVector()
    for stamp, data in zip(stamps_ns, packets, strict=True):
        scan.append(vd.VelodynePacket(stamp * 1e-9, data.tolist()))
    config = vd.Config(model=vd.Model.VLP16, timestamp_first_packet=True, min_range=0.0)
    start, points = vd.ScanDecoder(config).decode(scan)
    return points, start.host + points[:, 4].astype(float)


def octets(packets):
    """Return the 1206 bytes of each packet."""
    return np.frombuffer(packets["data"].tobytes(), np.uint8).reshape(-1, 1206)


def require_equal(log, points, instants):
    assert_allclose(log.p_lidar, points[:, :3], rtol=0, atol=SINGLE)
    assert_array_equal(log.rings, points[:, 6])
    assert_array_equal(log.intensities, points[:, 3])
    assert_allclose(log.stamps_lidar_ns * 1e-9, instants, rtol=0, atol=CLOCK)


@pytest.fixture(scope="module")
def stop():
    return simulate_stop(scenario("range-lane", 2), "centre", SimulationConfig(turn=0.5))


@pytest.fixture(scope="module")
def written(stop, tmp_path_factory):
    path = tmp_path_factory.mktemp("packets") / "stop.mcap"
    write_log(stop.log, path, firings=stop.firings, compression="zstd")
    return path


def test_simulated_packets_are_the_same_points_as_the_simulated_cloud(stop, written):
    log = read_log(written)
    assert_allclose(log.p_lidar, stop.log.p_lidar, rtol=0, atol=1e-5)  # an ulp of 128 m is 7.6e-6
    assert_array_equal(log.rings, stop.log.rings)
    assert_array_equal(log.intensities, stop.log.intensities)
    assert_allclose(log.stamps_lidar_ns, stop.log.stamps_lidar_ns, rtol=0, atol=1)
    assert log.has_pulse_times
    assert log.has_heights


def test_velodyne_decoder_finds_the_simulated_points_in_simulated_packets(stop, written):
    points, instants = [], []
    with written.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for *_, scan in reader.iter_decoded_messages(topics=["/velodyne_packets"]):
            stamps = np.array([p.stamp.sec * 10**9 + p.stamp.nanosec for p in scan.packets])
            data = np.array([np.frombuffer(p.data, np.uint8) for p in scan.packets])
            assert scan.header.stamp.nanosec == scan.packets[0].stamp.nanosec
            for into, what in zip((points, instants), decoded(stamps, data), strict=True):
                into.append(what)
    require_equal(stop.log, np.concatenate(points), np.concatenate(instants))


def test_packets_hold_every_shot_and_zeros_where_nothing_answered(stop):
    packets = encoded(stop.firings)
    pulses = packets["data"]["blocks"]["pulses"]
    assert packets["data"].dtype.itemsize == 1206
    assert pulses["distance"].size == len(stop.firings.azimuths) // 12 * 384
    silent = pulses["distance"] == 0
    assert 0.2 < silent.mean() < 0.8  # the sky
    assert (~silent).sum() == len(stop.log.rings)
    assert not pulses["reflectivity"][silent].any()
    assert set(octets(packets)[:, 1204]) == {0x37}
    assert set(octets(packets)[:, 1205]) == {0x22}


def test_preflight_says_that_a_log_holds_packets(written):
    report = inspect_log(written)
    assert report.verdict != "refused"
    assert any("raw packets of a VLP-16 (strongest return)" in note for note in report.notes)
    assert SCHEMA in {topic.schema for topic in report.topics}


@pytest.mark.parametrize("little_endian", [True, False])
def test_made_up_packets_decode_as_velodyne_decoder_does(rng, tmp_path, little_endian):
    packets = encoded(firings(rng))
    log = read(tmp_path, message(packets, little_endian=little_endian))
    stamps = T0 + np.arange(4) * PACKET
    require_equal(log, *decoded(stamps, octets(packets)))


def strongest(tmp_path):
    """The log of a thousand real packets, with their instants and bytes."""
    data = np.fromfile(PACKETS / "strongest_1000_packets.bin", np.uint8).reshape(-1, 1206)
    packets = encoded(firings(np.random.default_rng(0), n_packets=1000))
    packets["data"] = data.view(packets["data"].dtype).ravel()
    stamps = T0 // HOUR * HOUR + packets["data"]["micros"].astype(np.int64) * 1000
    stamps += T0 - stamps[0]
    return read(tmp_path, message(packets, stamps_ns=stamps)), stamps, data


@needs_real
def test_real_strongest_returns_decode_as_velodyne_decoder_does(tmp_path):
    log, stamps, data = strongest(tmp_path)
    assert len(log.rings) == 203_034
    require_equal(log, *decoded(stamps, data))


@needs_real
@pytest.mark.parametrize("lasting_ns", [100_000_000, PACKET])
def test_the_spin_of_a_real_sensor_shows_when_each_pulse_was_fired(tmp_path, lasting_ns):
    log, _, _ = strongest(tmp_path)
    begin = log.stamps_lidar_ns[0]
    of_messages = begin + (log.stamps_lidar_ns - begin) // lasting_ns * lasting_ns
    rests = np.ones(len(log.rings), np.bool_)
    rig = nominal_rig(SimulationConfig())
    off = stamps_by_spin(log.p_lidar, log.rings, of_messages, rests, rig) - log.stamps_lidar_ns
    assert_allclose(1e-9 * (off - np.median(off)), 0.0, rtol=0, atol=CLOCK)


def by_pulse(rings, instants, p):
    """Return points in the order of lasers, pulses and ranges."""
    keys = np.linalg.norm(p, axis=1), np.round((instants - instants.min()) * 1e5), rings
    return p[np.lexsort(keys)]


@needs_real
def test_real_dual_returns_decode_as_velodyne_decoder_does(tmp_path):
    file = PACKETS / "dual_return_603_packets.db3"
    with sqlite3.connect(f"file:{file}?mode=ro", uri=True) as base:
        rows = base.execute("select data from messages order by timestamp").fetchall()
    for (data,) in rows:
        scan = STORE.deserialize_cdr(data, SCHEMA)
        stamps = [p.stamp.sec * 10**9 + p.stamp.nanosec for p in scan.packets]
        points, instants = decoded(stamps, np.array([p.data for p in scan.packets]))
        log = read(tmp_path, (SCHEMA, data), start_ns=stamps[0])
        mine = by_pulse(log.rings, log.stamps_lidar_ns * 1e-9, log.p_lidar)
        assert_allclose(mine, by_pulse(points[:, 6], instants, points[:, :3]), rtol=0, atol=SINGLE)
        since = np.sort(instants - instants.min())
        mine = (log.stamps_lidar_ns - log.stamps_lidar_ns[0]) * 1e-9
        assert_allclose(mine, since, rtol=0, atol=CLOCK)
        assert abs(log.stamps_lidar_ns[0] * 1e-9 - instants.min()) < 3e-4  # jitter of one stamp
        assert any("dual return" in note for note in log.notes)


def test_equal_dual_returns_are_one_and_different_ones_are_two(rng, tmp_path):
    packets = encoded(firings(rng, n_packets=1))
    packets["data"]["mode"] = 0x39
    blocks = packets["data"]["blocks"]
    blocks["azimuth"][0] = np.repeat(np.arange(6) * 40, 2)
    blocks["pulses"]["distance"] = 5000
    log = read(tmp_path, message(packets))
    assert len(log.rings) == 6 * 32
    blocks["pulses"]["distance"][0, 1, 3] = 4000  # the strongest of the second ring fired
    log = read(tmp_path, message(packets))
    assert len(log.rings) == 6 * 32 + 1
    pair = np.linalg.norm(log.p_lidar[3:5], axis=1)
    assert_allclose(pair, [10.0, 8.0], rtol=0, atol=0.02)
    assert_array_equal(log.rings[3:5], FIRING_ORDER[3])
    assert log.stamps_lidar_ns[3] == log.stamps_lidar_ns[4]
    assert (np.diff(log.stamps_lidar_ns) >= 0).all()


def test_the_turn_of_the_hour_leaves_no_mark_in_the_instants(rng):
    start = T0 // HOUR * HOUR + HOUR - 2 * PACKET - 700
    packets = encoded(firings(rng, n_packets=5, start_ns=start))
    micros = packets["data"]["micros"]
    assert micros[0] > 3_599_000_000
    assert micros[-1] < 10_000
    jitter = rng.integers(0, 3_000_000, 5)
    instants, note = punctual(start + np.arange(5) * PACKET + jitter, micros.astype(np.int64))
    assert not note
    steps = np.diff(instants)
    assert np.abs(steps - steps.mean()).max() < 2_000  # [ns]; the clock counts microseconds


def test_stamps_that_jitter_are_set_to_the_even_clock_of_the_sensor(rng):
    n = 8000
    truth = T0 + np.arange(n) * PACKET
    micros = (truth + 123_456_789_000) % HOUR // 1000  # an hour that began when it was switched on
    drift = 20e-6 * (truth - T0)
    late = rng.exponential(1e6, n) + drift
    instants, note = punctual(truth + late.astype(np.int64), micros)
    assert not note
    assert_allclose(instants - truth - drift, 1e6, rtol=0, atol=0.1e6)


def test_a_sensor_clock_that_jumps_is_not_believed():
    stamps = T0 + np.arange(100) * PACKET
    micros = (stamps % HOUR // 1000) + np.where(np.arange(100) > 50, 5_000_000, 0)
    instants, note = punctual(stamps, micros)
    assert_array_equal(instants, stamps)
    assert "clock jumps" in note


def test_packets_without_stamps_take_those_of_their_messages(rng, tmp_path):
    packets = encoded(firings(rng))
    log = read(tmp_path, message(packets, stamps_ns=np.zeros(4)))
    expected = read(tmp_path, message(packets))
    assert_allclose(log.stamps_lidar_ns, expected.stamps_lidar_ns, rtol=0, atol=1000)
    assert any("have no stamps" in note for note in log.notes)
    bare = read(
        tmp_path, message(packets, stamps_ns=np.zeros(4), header_ns=0), log_ns=T0 + 4 * PACKET
    )
    assert_allclose(bare.stamps_lidar_ns, expected.stamps_lidar_ns, rtol=0, atol=1000)


def test_packets_stamped_at_another_age_are_left_out_and_counted(rng, tmp_path):
    packets = encoded(firings(rng))
    stamps = T0 + np.arange(4) * PACKET
    stamps[2] = 5
    log = read(tmp_path, message(packets, stamps_ns=stamps))
    distances = packets["data"]["blocks"]["pulses"]["distance"]
    assert len(log.rings) == (distances[[0, 1, 3]] > 0).sum()
    assert any("more than a day off" in note for note in log.notes)
    assert inspect_log(tmp_path / "a.mcap").n_returns == len(log.rings)


def test_packets_of_another_model_are_refused_by_name(rng, tmp_path):
    packets = encoded(firings(rng))
    packets["data"]["model"] = 0x28
    with pytest.raises(MissingLidarError, match=r"a VLP-32C \(0x28\).*VLP-16"):
        read(tmp_path, message(packets))


def test_clouds_serve_where_the_packets_are_of_another_model(rng, tmp_path):
    packets = encoded(firings(rng))
    packets["data"]["model"] = 0xA1
    items = [("/points", T0 + 10**8, cloud(velodyne(rng))), ("/packets", T0, message(packets))]
    definitions = {**DEFINITIONS, SCHEMA: DEFINITION}
    log = read_log(record(tmp_path / "both.mcap", [*items, *turning()], definitions=definitions))
    assert len(log.rings) == 64
    assert any("/points is used" in note for note in log.notes)


def test_a_block_that_does_not_begin_as_one_ends_its_packet(rng, tmp_path):
    packets = encoded(firings(rng, n_packets=2))
    packets["data"]["blocks"]["flag"][0, 5] = 0xDDFF
    log = read(tmp_path, message(packets))
    distances = packets["data"]["blocks"]["pulses"]["distance"]
    assert len(log.rings) == (distances[0, :5] > 0).sum() + (distances[1] > 0).sum()


def test_a_message_that_is_cut_is_left_out_and_counted(rng, tmp_path):
    packets = encoded(firings(rng))
    schema, data = message(packets)
    log = read(tmp_path, (schema, data), (schema, data[:-1300]))
    assert len(log.rings) == (packets["data"]["blocks"]["pulses"]["distance"] > 0).sum()
    assert any("declares 4 packets" in note for note in log.notes)


def test_messages_of_many_lengths_decode_as_each_of_them_does_alone(rng, tmp_path):
    """Of both byte orders, some cut, some without packets, and some with dual returns."""
    packets = encoded(firings(rng, n_packets=500))
    packets["data"]["mode"][150:400] = 0x39
    edges = np.r_[0, np.sort(rng.integers(0, 500, 60)), 500]
    messages = [message(packets[a:b], little_endian=k % 7 > 1) if a < b else None
                for k, (a, b) in enumerate(pairwise(edges))]  # fmt: skip
    whole = [one for one in messages if one is not None]
    cut = [(schema, data[:-50]) if k % 9 == 4 else (schema, data)
           for k, (schema, data) in enumerate(whole)]  # fmt: skip
    together = read(tmp_path, *cut)
    alone = [read(tmp_path, one) for k, one in enumerate(whole) if k % 9 != 4]
    for name in ("p_lidar", "intensities", "rings", "stamps_lidar_ns"):
        expected = np.concatenate([getattr(log, name) for log in alone])
        assert_array_equal(getattr(together, name), expected, err_msg=name)


def test_a_message_without_packets_holds_nothing(rng, tmp_path):
    packets = encoded(firings(rng))
    empty = (SCHEMA, b"\0\1\0\0" + bytes(8) + b"\1\0\0\0\0\0\0\0" + bytes(4))
    assert len(read(tmp_path, empty, message(packets)).rings) > 0
    with pytest.raises(MissingLidarError, match="no returns"):
        read(tmp_path, empty)
