"""Logs in the containers, encodings and types of others, written by the libraries of others."""

import base64
import json
import re
import shutil
import sqlite3
import struct
import zipfile
from contextlib import closing

import dpkt
import numpy as np
import pytest
import velodyne_decoder
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from mcap.writer import Writer as McapWriter
from mcap_protobuf.writer import Writer as ProtobufWriter
from mcap_ros1.writer import Writer as Ros1Mcap
from numpy.testing import assert_allclose, assert_array_equal
from rosbags.rosbag1 import Writer as Bag1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Bag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from spheremark.pipelines.errors import (
    ConfigError,
    MissingGimbalAngleError,
    MissingLidarError,
    NotMcapError,
    RecordingError,
    TruncatedRecordingError,
)
from spheremark.pipelines.model import ImuMount, Origin
from spheremark.storage.imports.uploads import inspect_upload, read_upload
from spheremark.storage.recordings import (
    LogOptions,
    file_digest,
    inspect_log,
    lasers,
    packets,
    read_log,
    transforms,
)
from spheremark.storage.recordings.definitions import definition
from tests.storage.recorder import (
    DEFINITIONS,
    STORE,
    T0,
    cloud,
    frames,
    header,
    imu,
    joints,
    quaternion,
    record,
    small_log,
    turning,
    vector,
    velodyne,
)

MOUNT = ("gimbal_link", "velodyne", (0.05, 0.0, 0.0), (0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)))
ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS1.register(
    {
        name: one
        for name, one in get_types_from_msg(
            definition(transforms.SCHEMA), transforms.SCHEMA
        ).items()
        if name not in ROS1.types
    }
)
STILL = (0.0, 0.0, 0.0, 1.0)
LIVOX = """std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
================================================================================
MSG: livox_ros_driver2/CustomPoint
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""


@pytest.fixture
def rng():
    return np.random.default_rng(2)


@pytest.fixture
def items(rng):
    """A complete small log: frames, two clouds, a turning joint."""
    clouds = [
        ("/points", T0 + k * 10**8, cloud(velodyne(rng), T0 + (k - 1) * 10**8)) for k in (1, 2)
    ]
    return sorted(
        [("/tf_static", T0 - 1, frames(MOUNT)), *clouds, *turning(step=0.01)], key=lambda i: i[1]
    )


@pytest.fixture
def expected(items, tmp_path):
    return read_log(record(tmp_path / "expected.mcap", items))


def assert_same(found, expected):
    for name in ("p_lidar", "intensities", "rings", "stamps_lidar_ns", "stamps_gimbal_ns"):
        assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    assert_allclose(found.gimbal_angles, expected.gimbal_angles, rtol=0, atol=1e-12)
    assert_allclose(found.rig.T_head_lidar, expected.rig.T_head_lidar, rtol=0, atol=1e-12)


def rosbag2(path, items, plugin=StoragePlugin.SQLITE3, compression=None):
    """Write a folder as `ros2 bag record` does."""
    bag = Bag2(path, version=9, storage_plugin=plugin)
    if compression is not None:
        bag.set_compression(compression, CompressionFormat.ZSTD)
    with bag:
        known = {}
        for topic, ns, message in items:
            kind = message.__msgtype__
            if topic not in known:
                known[topic] = bag.add_connection(topic, kind, typestore=STORE)
            bag.write(known[topic], ns, STORE.serialize_cdr(message, kind))
    return path


def as_ros1(message):
    """The bytes of a message in ROS 1."""
    return bytes(
        STORE.cdr_to_ros1(STORE.serialize_cdr(message, message.__msgtype__), message.__msgtype__)
    )


def rosbag1(path, items, compression=None):
    bag = Bag1(path)
    if compression is not None:
        bag.set_compression(compression)
    with bag:
        known = {}
        for topic, ns, message in items:
            kind = message.__msgtype__
            if topic not in known:
                known[topic] = bag.add_connection(topic, kind, typestore=ROS1)
            bag.write(known[topic], ns, as_ros1(message))
    return path


@pytest.mark.parametrize(
    ("plugin", "compression"),
    [
        (StoragePlugin.SQLITE3, None),
        (StoragePlugin.SQLITE3, CompressionMode.FILE),
        (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
        (StoragePlugin.MCAP, None),
        (StoragePlugin.MCAP, CompressionMode.FILE),
    ],
)
def test_a_folder_of_rosbag2_is_a_log(tmp_path, items, expected, plugin, compression):
    found = read_log(rosbag2(tmp_path / "bag", items, plugin, compression))
    assert_same(found, expected)
    assert found.origin.name == "bag"


def test_a_part_of_rosbag2_is_a_log_by_its_bytes_not_its_name(tmp_path, items, expected):
    (part,) = rosbag2(tmp_path / "bag", items).glob("*.db3")
    shutil.copy(part, tmp_path / "log.bin")
    assert_same(read_log(tmp_path / "log.bin"), expected)


@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_split_parts_are_joined_with_the_frames_of_the_first(tmp_path, items, expected, plugin):
    middle = len(items) // 2
    folder = tmp_path / "bag"
    folder.mkdir()
    for number, part in ((9, items[:middle]), (10, items[middle:])):
        (made,) = (
            one
            for one in rosbag2(tmp_path / f"part_{number}", part, plugin).iterdir()
            if one.suffix != ".yaml"
        )
        shutil.copy(made, folder / f"bag_{number}{made.suffix}")
    assert_same(read_log(folder), expected)
    with zipfile.ZipFile(tmp_path / "bag.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for one in sorted(folder.iterdir(), reverse=True):
            archive.write(one, f"bag/{one.name}")
        archive.writestr("bag/metadata.yaml", "rosbag2_bagfile_information:")
    found = read_log(tmp_path / "bag.zip")
    assert_same(found, expected)
    assert found.origin.digest == file_digest(tmp_path / "bag.zip")
    second = inspect_log(folder / f"bag_10.{'db3' if plugin is StoragePlugin.SQLITE3 else 'mcap'}")
    assert any("/tf_static" in reason for reason in second.reasons)


@pytest.mark.parametrize("compression", [None, *Bag1.CompressionFormat])
def test_a_bag_of_ros1_is_a_log(tmp_path, items, expected, compression):
    assert_same(read_log(rosbag1(tmp_path / "a.bag", items, compression)), expected)


def test_mcap_with_messages_of_ros1_is_a_log(tmp_path, items, expected):
    def raw(message):
        kind = message.__msgtype__
        text = ROS1.generate_msgdef(kind)[0]
        made = type("Raw", (), {"_type": kind.replace("/msg/", "/"), "_full_text": text})()
        made.serialize = lambda file: file.write(as_ros1(message))
        return made

    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Ros1Mcap(file)
        for topic, ns, message in items:
            writer.write_message(topic, raw(message), ns)
        writer.finish()
    assert_same(read_log(tmp_path / "a.mcap"), expected)


def foxglove_cloud(message):
    """A PointCloud of foxglove with the points of a PointCloud2."""
    found = PointCloud(frame_id=message.header.frame_id, point_stride=message.point_step)
    found.timestamp.seconds, found.timestamp.nanos = (
        message.header.stamp.sec,
        message.header.stamp.nanosec,
    )
    kinds = {4: PackedElementField.UINT16, 7: PackedElementField.FLOAT32}
    for one in message.fields:
        found.fields.add(name=one.name, offset=one.offset, type=kinds[one.datatype])
    found.data = message.data.tobytes()
    found.pose.orientation.w = 0.0
    return found


def foxglove_link(ns, parent, child, translation, rotation):
    found = FrameTransform(parent_frame_id=parent, child_frame_id=child)
    found.timestamp.FromNanoseconds(ns)
    for name, value in zip("xyz", translation, strict=True):
        setattr(found.translation, name, value)
    for name, value in zip("xyzw", rotation, strict=True):
        setattr(found.rotation, name, value)
    return found


def foxglove_items(items):
    """The log with the types of foxglove; the gimbal is a transform that turns."""
    for topic, ns, message in items:
        kind = message.__msgtype__
        if kind.endswith("PointCloud2"):
            yield topic, ns, foxglove_cloud(message)
        elif kind.endswith("JointState"):
            half = message.position[0] / 2
            turn = (0.0, 0.0, np.sin(half), np.cos(half))
            links = [
                foxglove_link(ns, "base_link", "gimbal_link", (0, 0, 0), turn),
                foxglove_link(ns, *MOUNT),
            ]
            yield "/tf", ns, FrameTransforms(transforms=links)


def test_foxglove_in_protobuf_is_a_log_with_all_frames_on_one_topic(tmp_path, items, expected):
    with (tmp_path / "a.mcap").open("wb") as file, ProtobufWriter(file) as writer:
        for topic, ns, message in foxglove_items(items):
            writer.write_message(topic, message, ns, ns)
    assert_same(read_log(tmp_path / "a.mcap"), expected)


def test_joints_of_foxglove_are_joints(tmp_path, items, expected):
    with (tmp_path / "a.mcap").open("wb") as file, ProtobufWriter(file) as writer:
        for topic, ns, message in foxglove_items(
            items[:1] + [i for i in items if i[0] == "/points"]
        ):
            writer.write_message(topic, message, ns, ns)
        writer.write_message("/link", foxglove_link(T0, *MOUNT), T0, T0)
        for _, ns, message in (i for i in items if i[0] == "/joint_states"):
            found = JointStates()
            found.timestamp.FromNanoseconds(ns)
            found.joints.add(name="wheel", position=1e3 * ns % 7)
            found.joints.add(name="pan", position=message.position[0])
            writer.write_message("/joints", found, ns, ns)
    assert_same(read_log(tmp_path / "a.mcap", LogOptions(joint="pan")), expected)


def test_foxglove_in_json_is_a_log(tmp_path, items, expected):
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        channels = {}

        def put(topic, schema, ns, message):
            if topic not in channels:
                identifier = writer.register_schema(schema, "jsonschema", b'{"type": "object"}')
                channels[topic] = writer.register_channel(topic, "json", identifier)
            writer.add_message(channels[topic], ns, json.dumps(message).encode(), ns)

        for topic, ns, message in items:
            kind = message.__msgtype__
            stamp = {"sec": ns // 10**9, "nsec": ns % 10**9}
            if kind.endswith("TFMessage"):
                parent, child, t, q = MOUNT
                link = {
                    "timestamp": stamp,
                    "parent_frame_id": parent,
                    "child_frame_id": child,
                    "translation": dict(zip("xyz", t, strict=True)),
                    "rotation": dict(zip("xyzw", q, strict=True)),
                }
                put(topic, "foxglove.FrameTransform", ns, link)
            elif kind.endswith("JointState"):
                body = {
                    "header": {
                        "stamp": {"sec": stamp["sec"], "nanosec": stamp["nsec"]},
                        "frame_id": "",
                    }
                }
                body |= {"name": list(message.name), "position": message.position.tolist()}
                put(topic, "sensor_msgs/msg/JointState", ns, body)
            else:
                found = foxglove_cloud(message)
                put(
                    topic,
                    "foxglove.PointCloud",
                    ns,
                    {
                        "timestamp": {
                            "sec": found.timestamp.seconds,
                            "nsec": found.timestamp.nanos,
                        },
                        "frame_id": found.frame_id,
                        "point_stride": found.point_stride,
                        "fields": [
                            {"name": one.name, "offset": one.offset, "type": one.type}
                            for one in found.fields
                        ],
                        "data": base64.b64encode(found.data).decode(),
                    },
                )
        put("/points", "", T0, {"nonsense": [1]})
        writer.finish()
    found = read_log(tmp_path / "a.mcap")
    assert_same(found, expected)
    assert any("1 message of /points could not be decoded" in note for note in found.notes)


def livox(points, ns, store, name):
    kinds = store.types
    stamp = kinds["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
    extra = {"seq": 0} if store is LIVOX1 else {}
    return kinds[f"{name}/msg/CustomMsg"](
        header=kinds["std_msgs/msg/Header"](stamp=stamp, frame_id="livox", **extra),
        timebase=ns,
        point_num=len(points),
        lidar_id=1,
        rsvd=np.zeros(3, np.uint8),
        points=[
            kinds[f"{name}/msg/CustomPoint"](
                offset_time=int(t),
                x=float(x),
                y=float(y),
                z=float(z),
                reflectivity=9,
                tag=0,
                line=3,
            )
            for t, (x, y, z) in points
        ],
    )


LIVOX1, LIVOX2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
LIVOX1.register(
    get_types_from_msg(LIVOX.replace("driver2", "driver"), "livox_ros_driver/msg/CustomMsg")
)
LIVOX2.register(
    {
        name: one
        for name, one in get_types_from_msg(LIVOX, "livox_ros_driver2/msg/CustomMsg").items()
        if name.startswith("livox")
    }
)


@pytest.mark.parametrize("frame", ["livox", "livox_frame_7"])
def test_custom_messages_of_livox_are_clouds(tmp_path, rng, frame):
    p = rng.uniform(1, 9, (40, 3)).astype(np.float32)
    points = list(zip(np.arange(40) * 1_000_000, p, strict=True))
    message = livox(points, T0, LIVOX2, "livox_ros_driver2")
    message.header.frame_id = frame
    kind = message.__msgtype__
    first = (kind, bytes(LIVOX2.serialize_cdr(message, kind)))
    two = read_log(record(tmp_path / "a.mcap", [("/livox", T0, first), *turning(step=0.01)]))
    message = livox(points, T0, LIVOX1, "livox_ros_driver")
    with Bag1(tmp_path / "a.bag") as bag:
        connection = bag.add_connection("/livox", message.__msgtype__, typestore=LIVOX1)
        bag.write(connection, T0, LIVOX1.serialize_ros1(message, message.__msgtype__))
        joint = bag.add_connection("/joints", "sensor_msgs/msg/JointState", typestore=ROS1)
        for _, ns, one in turning(step=0.01):
            bag.write(joint, ns, as_ros1(one))
    for found in (two, read_log(tmp_path / "a.bag")):
        assert_array_equal(found.p_lidar, p)
        assert_array_equal(found.stamps_lidar_ns, T0 + np.arange(40) * 1_000_000)
        assert (found.intensities == 9).all()


def packets_of(rng, n=80):
    """Packets of a VLP-16, and their instants."""
    found = []
    for k in range(n):
        blocks = b"".join(
            struct.pack("<HH", 0xEEFF, (k * 480 + i * 40) % 36000)
            + rng.integers(1, 255, 96, np.uint8).tobytes()
            for i in range(12)
        )
        found.append((T0 + k * 1_327_000, blocks + struct.pack("<IBB", k * 1327, 0x37, 0x22)))
    return found


@pytest.mark.parametrize("kind", [dpkt.pcap.Writer, dpkt.pcapng.Writer])
def test_a_capture_beside_the_log_of_the_gimbal_is_a_log(tmp_path, rng, kind):
    sent = packets_of(rng)
    with (tmp_path / "lidar.pcap").open("wb") as file:
        writer = kind(file)
        for ns, data in sent:
            udp = dpkt.udp.UDP(sport=2368, dport=2368, data=data)
            udp.ulen += len(data)
            ip = dpkt.ip.IP(src=b"\xc0\xa8\1\xc9", dst=b"\xff" * 4, p=17, data=udp)
            writer.writepkt(bytes(dpkt.ethernet.Ethernet(data=ip)), ts=ns / 1e9)
            writer.writepkt(bytes(60), ts=ns / 1e9)
        writer.close()
    gimbal = record(
        tmp_path / "gimbal.mcap", [("/tf_static", T0, frames(MOUNT)), *turning(step=0.01)]
    )
    with pytest.raises(MissingGimbalAngleError, match="--pcap"):
        read_log(tmp_path / "lidar.pcap")
    found = read_log(gimbal, beside=[tmp_path / "lidar.pcap"])
    scan = bytearray(b"\0\1\0\0" + struct.pack("<iII", T0 // 10**9, T0 % 10**9, 9) + b"velodyne\0")
    scan += bytes(-len(scan) % 4) + struct.pack("<I", len(sent))
    for ns, data in sent:
        scan += bytes(-len(scan) % 4) + struct.pack("<iI", ns // 10**9, ns % 10**9) + data
    ros = record(
        tmp_path / "ros.mcap",
        [
            ("/tf_static", T0, frames(MOUNT)),
            ("/packets", T0 + 10**8, ("velodyne_msgs/msg/VelodyneScan", bytes(scan))),
            *turning(step=0.01),
        ],
        definitions=DEFINITIONS | {packets.SCHEMA: definition(packets.SCHEMA)},
    )
    same = read_log(ros)
    assert len(found.p_lidar) == len(same.p_lidar) > 30_000
    assert_array_equal(found.p_lidar, same.p_lidar)
    assert np.abs(found.stamps_lidar_ns - same.stamps_lidar_ns).max() < 2_000  # [ns] of pcap
    assert found.rig is not None
    with zipfile.ZipFile(tmp_path / "both.zip", "w") as archive:
        archive.write(gimbal, "gimbal.mcap")
        archive.write(tmp_path / "lidar.pcap", "lidar.pcap")
    assert len(read_log(tmp_path / "both.zip").p_lidar) == len(found.p_lidar)


@pytest.mark.parametrize("kind", ["mcap", "db3", "bag", "zip"])
def test_a_cut_log_is_read_up_to_the_damage_when_that_is_accepted(tmp_path, items, kind):
    path = tmp_path / f"a.{kind}"
    many = [*items, *((t, n + 10**9, m) for t, n, m in turning(3000, step=1e-4))]
    if kind == "mcap":
        record(path, many, chunk_size=4096)
    elif kind == "bag":
        rosbag1(path, many)
    else:
        (part,) = rosbag2(tmp_path / "bag", many).glob("*.db3")
        shutil.copy(part, path)
    octets = path.read_bytes()
    path.write_bytes(octets[: int(0.8 * len(octets))])
    if kind == "zip":
        cut = path.rename(tmp_path / "cut.db3")
        with zipfile.ZipFile(path, "w") as archive:
            archive.write(cut, "cut.db3")
    with pytest.raises(TruncatedRecordingError, match="--recover"):
        read_log(path)
    found = read_log(path, LogOptions(recover=True))
    assert len(found.p_lidar) == 128
    assert 50 < len(found.gimbal_angles) < 3050
    assert "incomplete" in found.weaknesses[0]
    report = inspect_log(path, LogOptions(recover=True))
    assert any("incomplete" in reason for reason in report.reasons)
    assert report.verdict == "weak" or "gimbal" in report.reasons[0]


def test_a_zip_that_declares_more_than_it_can_hold_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.mcap", bytes(50_000_000))
    with pytest.raises(RecordingError, match="declares 50,000,000 bytes"):
        read_log(tmp_path / "a.zip")
    with zipfile.ZipFile(tmp_path / "b.zip", "w") as archive:
        archive.writestr("../../notes.txt", "no log")
    with pytest.raises(NotMcapError, match=r"b\.zip holds no log"):
        read_log(tmp_path / "b.zip")


@pytest.mark.parametrize("kind", ["mcap", "zip", "bag", "db3"])
def test_an_upload_is_read_in_a_confined_process_to_the_same_log(tmp_path, items, expected, kind):
    path = tmp_path / f"a.{kind}"
    if kind == "bag":
        rosbag1(path, items)
    elif kind == "db3":
        shutil.copy(next(iter(rosbag2(tmp_path / "bag", items).glob("*.db3"))), path)
    else:
        record(tmp_path / "a.mcap", items)
    if kind == "zip":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.write(tmp_path / "a.mcap", "a.mcap")
    assert_same(read_upload(path, LogOptions(), Origin(name="a", digest="b")), expected)
    assert inspect_upload(path).to_mapping() == inspect_log(path).to_mapping()


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_zip_whose_compressed_bytes_are_damaged_is_refused(tmp_path, items, method):
    record(tmp_path / "a.mcap", items)
    with zipfile.ZipFile(tmp_path / "a.zip", "w", method) as archive:
        archive.write(tmp_path / "a.mcap", "a.mcap")
    octets = bytearray((tmp_path / "a.zip").read_bytes())
    octets[200:240] = bytes(40)
    (tmp_path / "a.zip").write_bytes(octets)
    with pytest.raises(RecordingError, match="zip cannot be read"):
        read_log(tmp_path / "a.zip")


def test_mutated_logs_give_a_report_and_never_an_unknown_error(tmp_path, items):
    (part,) = rosbag2(tmp_path / "bag", items).glob("*.db3")
    seeds = [
        record(tmp_path / "a.mcap", items, chunk_size=2000).read_bytes(),
        part.read_bytes(),
        rosbag1(tmp_path / "a.bag", items, next(iter(Bag1.CompressionFormat))).read_bytes(),
    ]
    rng = np.random.default_rng(2)
    path = tmp_path / "mutated"
    for k in range(90):
        octets = bytearray(seeds[k % 3])
        for place in rng.integers(0, len(octets), 3):
            octets[place : place + 4] = rng.choice([b"\xff" * 4, bytes(4), rng.bytes(4)])
        path.write_bytes(octets[: rng.integers(20, len(octets))] if k % 4 == 0 else octets)
        report = inspect_log(path, LogOptions(recover=bool(k % 2)))
        assert report.reasons or report.n_returns


@pytest.mark.parametrize("time", [1e30, -1, float("inf")])
def test_a_message_at_a_time_that_cannot_be_is_damage(tmp_path, items, time):
    (part,) = rosbag2(tmp_path / "bag", items).glob("*.db3")
    with closing(sqlite3.connect(part)) as connection, connection:
        connection.execute(
            "UPDATE messages SET timestamp = ? WHERE id = (SELECT max(id) FROM messages)", (time,)
        )
    with pytest.raises(TruncatedRecordingError, match=f" {len(items) - 1} messages are before"):
        read_log(part)
    assert inspect_log(part).code == TruncatedRecordingError.code
    assert len(read_log(part, LogOptions(recover=True)).p_lidar) == 128


def test_a_database_that_is_no_bag_is_refused(tmp_path):
    with sqlite3.connect(tmp_path / "a.db3") as connection:
        connection.execute("CREATE TABLE topics (id, name, type, serialization_format)")
        connection.execute("CREATE VIEW messages AS SELECT 1 AS id, 1 AS topic_id")
    with pytest.raises(RecordingError, match="no tables topics and messages"):
        read_log(tmp_path / "a.db3")


def wheels(n=50):
    """A state of many joints: wheels that turn, and a pan joint in degrees, clockwise."""
    for k in range(n):
        ns = T0 + (k - 5) * 10_000_000
        yield "/state", ns, joints(ns, wheel_l=0.3 * k, pan_joint=-0.5 * k, wheel_r=-0.3 * k)


def test_any_joint_can_be_named_with_its_sign_unit_and_offset(tmp_path, rng):
    points = [("/points", T0 + 10**8, cloud(velodyne(rng)))]
    path = record(tmp_path / "a.mcap", [*points, *wheels()])
    with pytest.raises(MissingGimbalAngleError, match="--joint"):
        read_log(path)
    with pytest.raises(MissingGimbalAngleError, match="wheel_l of /state"):
        read_log(path, LogOptions(joint="tilt"))
    options = LogOptions(joint="pan_joint", joint_sign=-1, joint_unit="deg", joint_offset_deg=90.0)
    angles = read_log(path, options).gimbal_angles
    assert_allclose(angles, np.radians(0.5 * np.arange(50) + 90.0), rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", ["Int32", "Float64"])
def test_the_number_of_a_servo_is_an_angle_in_steps(tmp_path, rng, kind):
    make = STORE.types[f"std_msgs/msg/{kind}"]
    steps = np.arange(50) * 40 % 4096
    numbers = [
        (
            "/servo",
            T0 + (k - 5) * 10_000_000,
            make(data=int(one) if kind == "Int32" else float(one)),
        )
        for k, one in enumerate(steps)
    ]
    path = record(tmp_path / "a.mcap", [("/points", T0 + 10**8, cloud(velodyne(rng))), *numbers])
    log = read_log(path, LogOptions(joint_unit="4096"))
    assert_allclose(log.gimbal_angles, np.arange(50) * 40 * 2 * np.pi / 4096, rtol=0, atol=1e-12)
    assert_array_equal(log.stamps_gimbal_ns, T0 + (np.arange(50) - 5) * 10_000_000)


@pytest.mark.parametrize(
    ("scale", "wrap"), [(1.0, 2 * np.pi), (1.0, 4 * np.pi), (1.0, None), (4096 / 2 / np.pi, None)]
)
def test_angles_are_unwrapped_but_not_steps_that_are_read_as_radians(tmp_path, rng, scale, wrap):
    angles = np.linspace(0, 14.0, 300)
    shown = np.mod(angles, wrap) if wrap else angles
    items = [
        ("/joints", T0 + k * 10**7, joints(T0 + k * 10**7, pan=scale * a))
        for k, a in enumerate(shown)
    ]
    path = record(tmp_path / "a.mcap", [("/p", T0 + 10**8, cloud(velodyne(rng))), *items])
    assert_allclose(read_log(path).gimbal_angles, scale * angles, rtol=0, atol=1e-9)


def test_an_ahrs_on_the_gimbal_alone_is_enough_without_frames(tmp_path, rng):
    mount = Rotation.from_euler("xyz", [0.4, -0.3, 1.0])
    lean = Rotation.from_euler("xyz", [0.02, -0.03, 0.0])
    angles = np.arange(100) * 0.08
    imus = [
        (
            "/imu",
            T0 + k * 10_000_000,
            imu(T0 + k * 10_000_000, (lean * Rotation.from_euler("z", a) * mount).as_quat()),
        )
        for k, a in enumerate(angles)
    ]
    log = read_log(record(tmp_path / "a.mcap", [("/p", T0 + 10**8, cloud(velodyne(rng))), *imus]))
    turned = np.unwrap(log.gimbal_angles)
    assert_allclose(turned - turned[0], angles, rtol=0, atol=1e-6)
    assert any("is the orientation of /imu" in note for note in log.notes)
    items = [("/tf_static", T0, frames(MOUNT)), ("/p", T0 + 10**8, cloud(velodyne(rng))), *imus]
    rig = read_log(record(tmp_path / "b.mcap", items)).rig
    assert rig.imu_mount is ImuMount.HEAD
    assert_allclose(rig.R_mount_imu[2], mount.inv().apply([0, 0, 1]), rtol=0, atol=1e-6)


def test_scans_of_one_plane_are_named_as_unsupported(tmp_path):
    kinds = STORE.types
    scan = kinds["sensor_msgs/msg/LaserScan"](
        header=header(T0, "laser"),
        **dict.fromkeys(("angle_min", "angle_max", "angle_increment", "time_increment"), 0.1),
        **dict.fromkeys(("scan_time", "range_min", "range_max"), 9.0),
        **dict.fromkeys(("ranges", "intensities"), np.ones(10, np.float32)),
    )
    path = record(tmp_path / "a.mcap", [("/scan", T0, scan), *turning()])
    with pytest.raises(
        MissingLidarError, match=r"/scan \(sensor_msgs/msg/LaserScan\) cannot be read"
    ):
        read_log(path)


@pytest.mark.parametrize(
    ("unit", "said"), [(1e6, "microseconds"), (1e3, "milliseconds"), (1e9, "")]
)
def test_whole_times_are_in_the_unit_that_fills_the_messages(tmp_path, rng, unit, said):
    points = np.zeros(64, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("t", "u4")])
    points["x"] = rng.uniform(1, 9, 64)
    points["t"] = np.round(np.linspace(0, 0.099, 64) * unit)
    clouds = [("/p", T0 + (k + 1) * 10**8, cloud(points, T0 + k * 10**8)) for k in range(4)]
    log = read_log(record(tmp_path / "a.mcap", [*clouds, *turning()]))
    offsets = (log.stamps_lidar_ns - T0).reshape(4, 64) - np.arange(4)[:, None] * 10**8
    assert_allclose(offsets, np.tile(points["t"] * (1e9 / unit), (4, 1)), rtol=0, atol=1)
    assert any(said in note for note in log.notes)


def timed(rng, unit, kind, spans, pause=0):
    """Items of clouds with times in a unit [1/s], one behind the other, each as long as given."""
    items, begin = [], T0
    for span in spans:
        points = np.zeros(64, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("time", kind)])
        points["x"], points["time"] = rng.uniform(1, 9, 64), np.linspace(0, span, 64) * unit
        end = begin + round(span * 1e9)
        items.append(("/p", end, cloud(points, begin)))
        begin = end + pause
    return items


@pytest.mark.parametrize(
    ("unit", "said"),
    [(1.0, ""), (1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")],
)
@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize(
    "spans", [(0.1,) * 4, (0.005, 0.1, 0.1, 0.1), (1.3e-3,) * 40], ids=["all", "begun", "packets"]
)
def test_floating_times_are_in_one_unit_that_fills_the_messages(
    tmp_path, rng, unit, said, kind, spans
):
    items = timed(rng, unit, kind, spans)
    log = read_log(record(tmp_path / "a.mcap", [*items, *turning()]))
    ends = np.cumsum(np.round(np.array(spans) * 1e9))
    offsets = (log.stamps_lidar_ns - T0).reshape(len(spans), 64)
    expected = np.linspace(0, np.round(np.array(spans) * 1e9), 64, axis=1)
    expected += np.append(0, ends[:-1])[:, None]
    assert_allclose(offsets, expected, rtol=0, atol=100)  # [ns] of float32 times
    assert any(said in note for note in log.notes)
    assert any("--time-unit" in note for note in log.notes) == (unit != 1.0)


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e6, 1e9])
def test_absolute_times_may_be_in_any_unit(tmp_path, unit):
    points = np.zeros(64, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("timestamp", "f8")])
    seconds = np.linspace(0, 0.1, 64)
    points["x"], points["timestamp"] = 1.0, (T0 * 1e-9 + seconds) * unit
    log = read_log(record(tmp_path / "a.mcap", [("/p", T0, cloud(points)), *turning()]))
    assert_allclose(log.stamps_lidar_ns - T0, seconds * 1e9, rtol=0, atol=250)


def test_a_unit_of_times_that_cannot_be_found_can_be_named(tmp_path, rng):
    items = timed(rng, 1e9, "u4", (1e-5, 1e-5, 1e-5), pause=10**8)  # as of flashes
    path = record(tmp_path / "a.mcap", [*items, *turning()])
    found = {
        unit: int(np.ptp(read_log(path, LogOptions(time_unit=unit)).stamps_lidar_ns[:64]))
        for unit in ("ns", "us")
    }
    assert found == {"ns": 10**4, "us": 10**7}
    with pytest.raises(ConfigError, match="time_unit"):
        LogOptions(time_unit="minutes")


def late(ns):
    return ns + 2_000_000 + ns // 1000 % 1000


@pytest.mark.parametrize("stamp", ["auto", "start", "end"])
def test_stamps_at_the_end_show_by_points_that_are_later_than_their_recording(tmp_path, rng, stamp):
    items = [
        ("/p", late(T0 + k * 10**8), cloud(velodyne(rng), T0 + k * 10**8)) for k in range(1, 4)
    ]
    items += [(topic, late(ns), message) for topic, ns, message in turning()]
    log = read_log(record(tmp_path / "a.mcap", items), LogOptions(stamp=stamp))
    first = T0 + (10**8 if stamp == "start" else 0)
    assert abs(log.stamps_lidar_ns[0] - first) < 10  # [ns] of a float32 time
    assert any("after they were recorded" in note for note in log.notes) == (stamp == "auto")


def test_stamps_at_the_end_leave_the_named_unit_of_times_as_it_is(tmp_path, rng):
    items = timed(rng, 1e9, "u4", (1e-5, 1e-5, 1e-5), pause=10**8)
    path = record(tmp_path / "a.mcap", [*items, *turning()])
    log = read_log(path, LogOptions(time_unit="ns", stamp="end"))
    assert log.stamps_lidar_ns[[0, 63]].tolist() == [T0 - 10**4, T0]


def test_stamps_at_the_start_are_taken_as_they_are(tmp_path, rng):
    items = [
        ("/p", late(T0 + (k + 1) * 10**8), cloud(velodyne(rng), T0 + k * 10**8)) for k in range(3)
    ]
    items += [(topic, late(ns), message) for topic, ns, message in turning()]
    log = read_log(record(tmp_path / "a.mcap", items))
    assert log.stamps_lidar_ns[0] == T0
    assert read_log(tmp_path / "a.mcap", LogOptions(lidar_offset_s=0.25)).stamps_lidar_ns[0] == (
        T0 + 250_000_000
    )


def spinning(rng, elevations, n=2000):
    """A cloud of a LiDAR with lasers of given elevations, ring by ring [deg]."""
    points = velodyne(rng, n)
    rings = np.arange(n) % len(elevations)
    azimuths, ranges = rng.uniform(0, 2 * np.pi, n), rng.uniform(3, 20, n)
    e = np.radians(np.asarray(elevations, float)[rings])
    points["x"], points["y"] = (
        ranges * np.cos(e) * np.cos(azimuths),
        ranges * np.cos(e) * np.sin(azimuths),
    )
    points["z"], points["ring"] = ranges * np.sin(e), rings
    return points


def test_lasers_of_another_lidar_are_those_of_its_returns(tmp_path, rng):
    elevations = np.linspace(22.5, -22.5, 32)  # Ouster counts from the top
    items = [
        ("/tf_static", T0, frames(MOUNT)),
        ("/p", T0 + 10**8, cloud(spinning(rng, elevations))),
    ]
    log = read_log(record(tmp_path / "a.mcap", [*items, *turning()]))
    assert_allclose(np.degrees(log.rig.laser_elevations), elevations[::-1], rtol=0, atol=1e-3)
    assert_array_equal(log.rig.laser_heights, np.zeros(32))
    found = np.degrees(np.arctan2(log.p_lidar[:, 2], np.hypot(*log.p_lidar[:, :2].T)))
    assert_allclose(found, elevations[::-1][log.rings], rtol=0, atol=1e-3)
    assert "no VLP-16: it has 32 lasers" in log.weaknesses[0]


@pytest.mark.parametrize("model", lasers.MODELS, ids=lambda one: one.name)
@pytest.mark.parametrize("step", [1, -1])
@pytest.mark.parametrize("carries", [False, True])
def test_a_known_model_has_the_optics_of_its_maker(tmp_path, rng, model, step, carries):
    elevations = np.degrees(model.elevations)[::step]
    points = spinning(rng, elevations, 20_000)
    points["z"] += carries * model.heights[::step][points["ring"]]
    items = [("/tf_static", T0, frames(MOUNT)), ("/p", T0 + 10**8, cloud(points))]
    log = read_log(record(tmp_path / "a.mcap", [*items, *turning()]))
    assert_array_equal(log.rig.laser_elevations, model.elevations)
    assert_array_equal(log.rig.laser_heights, model.heights)
    assert_array_equal(log.rig.divergence, model.divergence)
    z = log.p_lidar[:, 2] - carries * model.heights[log.rings]
    found = np.degrees(np.arctan2(z, np.hypot(*log.p_lidar[:, :2].T)))
    assert_allclose(found, np.degrees(model.elevations)[log.rings], rtol=0, atol=1e-3)
    assert log.has_heights is carries
    assert any(model.name in note for note in log.notes)
    assert not log.weaknesses


@pytest.mark.parametrize(
    ("model", "other"),
    list(zip(lasers.MODELS, ("PuckHiRes", "HDL32E", "VLP32C", "AlphaPrime"), strict=True)),
    ids=lambda one: one if isinstance(one, str) else one.name,
)
def test_known_models_are_those_of_velodyne_decoder(model, other):
    calibrations = velodyne_decoder.Calibration.default_calibs
    text = calibrations[getattr(velodyne_decoder.Model, other)].to_string()
    found = [re.findall(rf"{key}: (\S+)", text) for key in ("vert_correction", "vert_offset_\\w+")]
    elevations, heights = np.array(
        sorted(zip(*found, strict=True), key=lambda one: float(one[0])), float
    ).T
    # Rounded to 0.01 deg in the maker's tables; the drawing of the Hi-Res has even steps.
    assert_allclose(np.degrees(model.elevations), np.degrees(elevations), rtol=0, atol=0.006)
    limit = 5e-4 if other == "PuckHiRes" else 1e-4
    assert_allclose(model.heights, heights, rtol=0, atol=limit)


@pytest.mark.parametrize("lag", [1, 32])
@pytest.mark.parametrize("has_times", [True, False])
def test_equal_dual_returns_of_a_cloud_are_one_and_different_ones_are_two(
    tmp_path, rng, lag, has_times
):
    single = velodyne(rng, 640)
    last = single.copy()
    last["x"][::5] += 0.5
    both = np.stack([single.reshape(-1, lag), last.reshape(-1, lag)], axis=1).ravel()
    names = list(both.dtype.names) if has_times else list(both.dtype.names)[:-1]
    points = np.zeros(len(both), [(name, both.dtype[name].str) for name in names])
    for name in names:
        points[name] = both[name]
    later = T0 + 10**8  # the same place in the next revolution is another return
    items = [("/p", later, cloud(points)), ("/p", later + 10**8, cloud(points, later))]
    log = read_log(record(tmp_path / "a.mcap", [*items, *turning()]))
    assert len(log.p_lidar) == 2 * (640 + 128)
    assert any("1,024 of 2,560 returns of /p are both" in note for note in log.notes)
    assert len(np.unique(log.p_lidar, axis=0)) == 640 + 128


def test_lasers_are_found_whatever_the_pace_of_their_rings(tmp_path, rng):
    model = lasers.MODELS[0]
    points = spinning(rng, np.degrees(model.elevations), 16 * 5_000 * 2)  # a stride of 32 rows
    items = [("/tf_static", T0, frames(MOUNT)), ("/p", T0 + 10**8, cloud(points))]
    log = read_log(record(tmp_path / "a.mcap", [*items, *turning()]))
    assert_array_equal(log.rig.laser_elevations, model.elevations)


@pytest.mark.parametrize("has_rig", [True, False])
@pytest.mark.parametrize("carries", [True, False, None])
def test_points_show_whether_they_include_the_offsets_of_their_beams(
    tmp_path, rng, carries, has_rig
):
    points = spinning(rng, np.arange(-15, 16, 2), 4000)
    if carries:
        points["z"] += -0.04191 * np.tan(np.radians(np.arange(-15, 16, 2)))[points["ring"]]
    if carries is None:  # noise across the beams, as no LiDAR has it, leaves it open
        points["z"] += rng.normal(0, 0.3, len(points))
    items = [("/p", T0 + 10**8, cloud(points)), *turning()]
    items = [("/tf_static", T0, frames(MOUNT)), *items] if has_rig else items
    log = read_log(record(tmp_path / "a.mcap", items))
    assert log.has_heights is carries
    assert any("without the vertical offsets" in n for n in log.notes) == (carries is False)


def test_rings_from_the_top_down_are_turned_over_where_the_log_has_no_rig(tmp_path, rng):
    path = record(
        tmp_path / "a.mcap",
        [("/p", T0 + 10**8, cloud(spinning(rng, np.linspace(22.5, -22.5, 32)))), *turning()],
    )
    log = read_log(path)
    assert log.rig is None
    found = np.degrees(np.arctan2(log.p_lidar[:, 2], np.hypot(*log.p_lidar[:, :2].T)))
    assert_allclose(found, np.linspace(-22.5, 22.5, 32)[log.rings], rtol=0, atol=1e-3)


def test_rings_of_a_vlp16_from_the_top_down_are_turned_over(tmp_path, rng):
    items = [
        ("/tf_static", T0, frames(MOUNT)),
        ("/p", T0 + 10**8, cloud(spinning(rng, np.arange(15, -16, -2)))),
    ]
    log = read_log(record(tmp_path / "a.mcap", [*items, *turning()]))
    assert log.weaknesses == ()
    assert_allclose(log.rig.laser_heights[0], 0.0112, rtol=0, atol=1e-3)
    lowest = log.p_lidar[log.rings == 0]
    assert (lowest[:, 2] < 0).all()


def test_a_base_without_orientation_is_levelled_by_gravity(tmp_path, rng):
    lean = Rotation.from_euler("xyz", [0.03, -0.05, 0.7])
    up = lean.inv().apply([0, 0, 9.81])
    items = [*small_log(rng), ("/tf_static", T0, frames(MOUNT))]
    for k in range(300):
        ns = T0 + k * 10_000_000
        message = imu(ns, STILL, covariance=-1.0)
        message.linear_acceleration = vector(up + rng.normal(0, 0.2, 3))
        items.append(("/imu", ns, message))
    log = read_log(record(tmp_path / "a.mcap", items))
    found = Rotation.from_quat(log.quaternions_imu).inv().apply([0, 0, 1])
    assert_allclose(found, np.tile(up / 9.81, (3, 1)), rtol=0, atol=0.01)
    assert log.sigma_levelling == pytest.approx(0.005)


@pytest.mark.parametrize(
    "wrong", [{"joint_sign": 0}, {"joint_unit": "gon"}, {"stamp": "middle"}, {"joint_unit": "-1"}]
)
def test_options_that_cannot_be_are_refused(wrong):
    with pytest.raises(ConfigError):
        LogOptions(**wrong)


def test_options_come_back_from_plain_values():
    options = LogOptions(topic=("/a", "/b"), joint="pan", joint_unit="4096", recover=True)
    assert LogOptions.from_mapping(json.loads(json.dumps(options.to_mapping()))) == options
    assert LogOptions().to_mapping() == {}


def test_quaternions_are_written_as_others_read_them():
    assert quaternion(STILL).w == 1.0
