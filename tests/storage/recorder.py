"""Recordings made message by message with rosbags and mcap, which share nothing with our reader."""

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from spheremark.storage.recordings import joint_states, orientations, pointclouds, transforms
from spheremark.storage.recordings.definitions import definition

STORE = get_typestore(Stores.ROS2_HUMBLE)
DEFINITIONS = {
    module.SCHEMA: definition(module.SCHEMA)
    for module in (joint_states, orientations, pointclouds, transforms)
}
T0 = 1_700_000_000_000_000_000
_DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def _type(name, /, **fields):
    return STORE.types[name](**fields)


def stamp(ns):
    return _type("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)


def header(ns, frame):
    return _type("std_msgs/msg/Header", stamp=stamp(ns), frame_id=frame)


def cloud(points, ns=T0, frame="velodyne", height=1, row_padding=0):
    """A PointCloud2 of a structured array; its byte order is that of the array's types."""
    kinds = {name: points.dtype.fields[name] for name in points.dtype.names}
    rows = points.reshape(height, -1)
    data = b"".join(row.tobytes() + bytes(row_padding) for row in rows)
    return _type(
        "sensor_msgs/msg/PointCloud2",
        header=header(ns, frame),
        height=height,
        width=rows.shape[1],
        fields=[
            _type(
                "sensor_msgs/msg/PointField",
                name=name,
                offset=offset,
                datatype=_DATATYPES[kind.str[1:]],
                count=1,
            )
            for name, (kind, offset) in kinds.items()
        ],
        is_bigendian=any(kind.byteorder == ">" for kind, _ in kinds.values()),
        point_step=points.dtype.itemsize,
        row_step=points.dtype.itemsize * rows.shape[1] + row_padding,
        data=np.frombuffer(data, np.uint8),
        is_dense=True,
    )


def joints(ns, **angles):
    return _type(
        "sensor_msgs/msg/JointState",
        header=header(ns, ""),
        name=list(angles),
        position=np.array(list(angles.values()), np.float64),
        velocity=np.array([], np.float64),
        effort=np.array([], np.float64),
    )


def quaternion(q):
    x, y, z, w = map(float, q)
    return _type("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def vector(v):
    x, y, z = map(float, v)
    return _type("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def imu(ns, q, frame="imu_link", covariance=0.0):
    return _type(
        "sensor_msgs/msg/Imu",
        header=header(ns, frame),
        orientation=quaternion(q),
        orientation_covariance=np.full(9, covariance),
        angular_velocity=vector((0, 0, 0)),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector((0, 0, 9.8)),
        linear_acceleration_covariance=np.zeros(9),
    )


def frames(*links, ns=T0):
    """A TFMessage of (parent, child, translation, quaternion)."""
    return _type(
        "tf2_msgs/msg/TFMessage",
        transforms=[
            _type(
                "geometry_msgs/msg/TransformStamped",
                header=header(ns, parent),
                child_frame_id=child,
                transform=_type(
                    "geometry_msgs/msg/Transform", translation=vector(t), rotation=quaternion(q)
                ),
            )
            for parent, child, t, q in links
        ],
    )


def encoded(message, *, little_endian=True):
    """Schema and bytes of a message."""
    kind = message.__msgtype__
    return kind, bytes(STORE.serialize_cdr(message, kind, little_endian=little_endian))


def record(path, items, *, compression=CompressionType.NONE, definitions=DEFINITIONS, **options):
    """Write (topic, log time, message or (schema, bytes)) as they come."""
    with path.open("wb") as file:
        writer = Writer(file, compression=compression, **options)
        writer.start(profile="ros2")
        channels = {}
        for topic, log_time, message in items:
            schema, data = message if isinstance(message, tuple) else encoded(message)
            if (topic, schema) not in channels:
                text = definitions.get(schema, "uint8 x").encode()
                identifier = writer.register_schema(schema, "ros2msg", text)
                channels[topic, schema] = writer.register_channel(topic, "cdr", identifier)
            writer.add_message(channels[topic, schema], log_time, data, log_time)
        writer.finish()
    return path


def velodyne(rng, n=64, duration=0.1):
    """Points as the Velodyne driver writes them."""
    points = np.zeros(
        n,
        [
            ("x", "<f4"),
            ("y", "<f4"),
            ("z", "<f4"),
            ("intensity", "<f4"),
            ("ring", "<u2"),
            ("time", "<f4"),
        ],
    )
    for axis in "xyz":
        points[axis] = rng.uniform(1, 20, n)
    points["intensity"], points["ring"] = rng.integers(0, 256, n), rng.integers(0, 16, n)
    points["time"] = np.linspace(0, duration, n)
    return points


def turning(n=50, step=0.1):
    """Joint messages at 100 Hz around ``T0``."""
    times = T0 + np.arange(-5, n - 5) * 10_000_000
    return [
        ("/joint_states", int(ns), joints(int(ns), gimbal_joint=step * k))
        for k, ns in enumerate(times)
    ]


def small_log(rng):
    """The items of a complete recording: one cloud, a turning joint."""
    return [("/points", T0 + 100_000_000, cloud(velodyne(rng))), *turning()]
