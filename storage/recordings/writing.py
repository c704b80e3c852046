"""From a ``ScanLog`` to a file, as a ROS 2 recorder would write it."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from mcap.writer import CompressionType, Writer

from spheremark.pipelines.errors import ConfigError, RecordingError
from spheremark.pipelines.model import Array, Firings, ImuMount, Nanos, Rig, ScanLog
from spheremark.storage.recordings import (
    joint_states,
    messages,
    orientations,
    packets,
    pointclouds,
    transforms,
)
from spheremark.storage.recordings.definitions import definition

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

LIDAR_FRAME, IMU_FRAME, HEAD_FRAME, BASE_FRAME = "velodyne", "imu_link", "gimbal_link", "base_link"
JOINT = "gimbal_joint"
_COMPRESSIONS = {
    "none": CompressionType.NONE,
    "lz4": CompressionType.LZ4,
    "zstd": CompressionType.ZSTD,
}
_GRAVITY = 9.80665  # [m/s^2] that an accelerometer at rest shows upwards (REP-145)
_POINT = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("intensity", "<f4"),
        ("ring", "<u2"),
        ("time", "<f4"),
    ]
)
_FIELDS = [
    messages.PointField(name, 4 * place if name != "time" else 18, 4 if name == "ring" else 7)
    for place, name in enumerate(("x", "y", "z", "intensity", "ring", "time"))
]
_QOS = (
    "- history: 3\n  depth: 0\n  reliability: 1\n  durability: {durability}\n"
    "  deadline:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  liveliness: 1\n  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  avoid_ros_namespace_conventions: false"
)

Item = tuple[int, str, bytes]  # log time [ns], topic, message


def write_log(
    log: ScanLog,
    path: str | Path,
    *,
    revolution: float = 0.1,
    compression: str = "none",
    firings: Firings | None = None,
) -> None:
    """Write a log as MCAP with the topics of a ROS 2 recording.

    Parameters
    ----------
    log : ScanLog
        What to write; its notes and the name of its rig are not part of a recording.
    path : str or Path
        The file; replaced if it exists.
    revolution : float
        Time that one point cloud, or one message of packets, spans [s].
    compression : str
        ``none``, ``lz4`` or ``zstd``.
    firings : Firings, optional
        All pulses of the LiDAR: they are written as raw packets, in place of the points.

    Raises
    ------
    ConfigError
        If the compression or the time is unknown or out of range.
    RecordingError
        If an instant is negative, which ROS 2 cannot represent.

    Notes
    -----
    ``/velodyne_points`` (x y z intensity ring time, stamped with the start of its revolution) or
    ``/velodyne_packets``, ``/joint_states``, ``/imu/data`` and ``/tf_static``, interleaved in the
    order of recording.
    """
    if compression not in _COMPRESSIONS:
        raise ConfigError(f"compression is {compression!r}; it must be none, lz4 or zstd.")
    if not 1e-3 <= revolution <= 10.0:
        raise ConfigError(f"revolution is {revolution!r}; it must be from 0.001 to 10 s.")
    if min((int(s.min()) for s in _stamps(log) if len(s)), default=0) < 0:
        raise RecordingError("The log has instants before 1970, which ROS 2 cannot write.")
    with Path(path).open("wb") as file:
        writer = Writer(file, compression=_COMPRESSIONS[compression])
        writer.start(profile="ros2", library="spheremark")
        _write_messages(writer, log, round(revolution * 1e9), firings)
        writer.finish()  # type: ignore[no-untyped-call]


def _stamps(log: ScanLog) -> tuple[Nanos, Nanos, Nanos]:
    """Return the instants of all sensors."""
    return log.stamps_lidar_ns, log.stamps_gimbal_ns, log.stamps_imu_ns


def _write_messages(
    writer: Writer, log: ScanLog, revolution_ns: int, firings: Firings | None
) -> None:
    """Write all topics that the log has something for, merged by time."""
    channels: dict[str, int] = {}

    def topic(name: str, schema: str, durability: int = 2) -> str:
        schema_id = writer.register_schema(schema, "ros2msg", definition(schema).encode())
        metadata = {"offered_qos_profiles": _QOS.format(durability=durability)}
        channels[name] = writer.register_channel(name, "cdr", schema_id, metadata)
        return name

    items: list[Iterator[Item]] = []
    if log.rig is not None:
        name = topic("/tf_static", transforms.SCHEMA, durability=1)
        first = min((int(s.min()) for s in _stamps(log) if len(s)), default=0)
        items.append(iter([(first, name, _static_transforms(log.rig, first))]))
    if firings is not None:
        name = topic("/velodyne_packets", packets.SCHEMA)
        items.append(packets.scans(name, LIDAR_FRAME, firings, revolution_ns))
    elif len(log.p_lidar):
        name = topic("/velodyne_points", pointclouds.SCHEMA)
        items.append(_clouds(name, log, revolution_ns))
    if len(log.gimbal_angles):
        name = topic("/joint_states", joint_states.SCHEMA)
        items.append(_joints(name, log))
    if len(log.quaternions_imu):
        name = topic("/imu/data", orientations.SCHEMA)
        items.append(_imus(name, log))
    counts = dict.fromkeys(channels, 0)
    for log_time, name, data in heapq.merge(*items, key=lambda item: item[0]):
        counts[name] += 1
        writer.add_message(channels[name], log_time, data, log_time, counts[name])


def _clouds(topic: str, log: ScanLog, revolution_ns: int) -> Iterator[Item]:
    """Give one cloud per revolution; it is recorded when its last point has been measured."""
    stamps = log.stamps_lidar_ns
    order = np.argsort(stamps, kind="stable") if (np.diff(stamps) < 0).any() else slice(None)
    stamps = stamps[order]
    points = np.zeros(len(stamps), _POINT)
    for place, axis in enumerate("xyz"):
        points[axis] = log.p_lidar[order, place]
    points["intensity"], points["ring"] = log.intensities[order], log.rings[order]
    turns = (stamps - stamps[0]) // revolution_ns
    edges = [*(np.flatnonzero(np.diff(turns, prepend=-1))).tolist(), len(stamps)]
    fields = [field for field in _FIELDS if field.name != "time" or log.has_pulse_times]
    for begin, end in pairwise(edges):
        stamp = (
            int(stamps[0] + turns[begin] * revolution_ns)
            if log.has_pulse_times
            else int(stamps[begin])
        )
        points["time"][begin:end] = (stamps[begin:end] - stamp) * 1e-9
        data = points[begin:end].tobytes()
        message = messages.cloud(stamp, LIDAR_FRAME, fields, _POINT.itemsize, data)
        yield int(stamps[end - 1]), topic, message


def _joints(topic: str, log: ScanLog) -> Iterator[Item]:
    """Give one joint state per sample."""
    for stamp, angle in zip(log.stamps_gimbal_ns.tolist(), log.gimbal_angles.tolist(), strict=True):
        yield stamp, topic, messages.joint_state(stamp, (JOINT,), (angle,))


def _imus(topic: str, log: ScanLog) -> Iterator[Item]:
    """Give one IMU message per orientation, with the rates and the gravity that belong to it."""
    from scipy.spatial.transform import Rotation  # slow to import

    rotations = Rotation.from_quat(log.quaternions_imu)
    rates = _rates(rotations, log.stamps_imu_ns)
    up = rotations.inv().apply([0.0, 0.0, _GRAVITY])
    columns = np.hstack([log.quaternions_imu, rates, up]).tolist()
    for stamp, row in zip(log.stamps_imu_ns.tolist(), columns, strict=True):
        yield stamp, topic, messages.imu(stamp, IMU_FRAME, row[:4], row[4:7], row[7:])


def _rates(rotations: Rotation, stamps_ns: Nanos) -> Array:
    """Return the angular velocity at each orientation in the sensor's frame, (n, 3) [rad/s]."""
    if len(stamps_ns) < 2:
        return np.zeros((len(stamps_ns), 3))
    turns = (rotations[:-1].inv() * rotations[1:]).as_rotvec()
    seconds = np.maximum(np.diff(stamps_ns), 1) * 1e-9
    rates = turns / seconds[:, None]
    return np.vstack([rates, rates[-1:]])


def _static_transforms(rig: Rig, stamp: int) -> bytes:
    """Encode how LiDAR and AHRS are mounted."""
    from scipy.spatial.transform import Rotation  # slow to import

    mount = HEAD_FRAME if rig.imu_mount is ImuMount.HEAD else BASE_FRAME
    T_mount_imu = np.eye(4)
    T_mount_imu[:3, :3] = rig.R_mount_imu
    links = ((HEAD_FRAME, LIDAR_FRAME, rig.T_head_lidar), (mount, IMU_FRAME, T_mount_imu))
    return messages.transforms(
        [
            messages.Transform(
                stamp, parent, child, T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat()
            )
            for parent, child, T in links
        ]
    )
