"""Messages of other encodings and types, rewritten as those that the decoders read.

ROS 1, protobuf and JSON are decoded by rosbags, protobuf and Python; types come from libraries or
from this module, never from the recorded text, because rosbags makes code of definitions.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, Protocol, cast

import numpy as np

from spheremark.storage.recordings import (
    joint_states,
    messages,
    orientations,
    packets,
    pointclouds,
    transforms,
)
from spheremark.storage.recordings.container import Batch, Channel
from spheremark.storage.recordings.definitions import store
from spheremark.storage.recordings.families import BrokenMessageError

Translate = Callable[[bytes], bytes]

_ROS_KINDS = {2: 1, 1: 2, 4: 3, 3: 4, 6: 5, 5: 6, 7: 7, 8: 8}  # PointField's for foxglove's type
_NUMBERS = ("Float32", "Float64", "Int8", "Int16", "Int32", "Int64", "UInt8", "UInt16", "UInt32")
_LIVOX = ("livox_ros_driver/CustomMsg", "livox_ros_driver2/CustomMsg", "livox_interfaces/CustomMsg")
_LIVOX_POINT = 19  # [bytes]: offset_time, x, y, z, reflectivity, tag, line
_LIVOX_FIELDS = (
    messages.PointField("offset_time", 0, 6),
    messages.PointField("x", 4, 7),
    messages.PointField("y", 8, 7),
    messages.PointField("z", 12, 7),
    messages.PointField("reflectivity", 16, 2),  # its line keeps no elevation: it is no ring
)
_AS_THEY_ARE = {  # types of ROS that a decoder reads in CDR, by their names without "msg"
    schema.replace("/msg/", "/"): schema
    for schema in (
        pointclouds.SCHEMA,
        packets.SCHEMA,
        joint_states.SCHEMA,
        transforms.SCHEMA,
        orientations.SCHEMA,
    )
} | {"tf/tfMessage": transforms.SCHEMA}
_BROKEN = (AttributeError, IndexError, KeyError, TypeError, ValueError, OverflowError, struct.error)


class _Message(Protocol):
    """Any decoded message: fields by name."""

    def __getattr__(self, name: str) -> Any: ...


class Translator:
    """Rewrites the messages of one channel for a decoder; counts those that cannot be parsed."""

    def __init__(self, channel: Channel, schema: str, translate: Translate) -> None:
        self.topic = channel.topic
        self.channel = replace(
            channel, encoding="cdr", schema=schema, schema_encoding="", definition=b""
        )
        self._translate = translate
        self.n_broken = 0
        self.reason = ""

    def translated(self, batch: Batch) -> Batch:
        """Return the messages of a batch that could be parsed, as the decoder reads them."""
        parts, log_times = [], []
        for octets, log_time in batch:
            try:
                parts.append(self._translate(octets.tobytes()))
            except (BrokenMessageError, RecursionError, *_BROKEN) as error:
                self.n_broken += 1
                self.reason = self.reason or str(error).strip(" .") or type(error).__name__
            else:
                log_times.append(log_time)
        return batch_of(self.channel, parts, log_times)


def batch_of(channel: Channel, parts: Sequence[bytes], log_times_ns: Sequence[int]) -> Batch:
    """Put messages into one buffer."""
    lengths = np.array([len(part) for part in parts], np.int64)
    return Batch(
        channel=channel,
        octets=np.frombuffer(b"".join(parts), np.uint8),
        starts=np.cumsum(lengths) - lengths,
        lengths=lengths,
        log_times_ns=np.array(log_times_ns, np.int64),
    )


def translator_of(channel: Channel) -> Translator | None:
    """Return what rewrites the messages of a channel; None if they are of no use."""
    name = channel.schema.replace("/msg/", "/")
    if channel.encoding == "ros1" and name in _AS_THEY_ARE:
        schema = _AS_THEY_ARE[name]
        return Translator(channel, schema, lambda data: _from_ros1(data, schema))
    if channel.encoding in ("ros1", "cdr") and name in _LIVOX:
        return Translator(channel, pointclouds.SCHEMA, _LIVOX_READERS[channel.encoding])
    if name not in _BUILDERS or (name in _AS_THEY_ARE and channel.encoding == "cdr"):
        return None
    decode = _decoder_of(channel)
    if decode is None:
        return None
    schema, build = _BUILDERS[name]
    return Translator(channel, schema, lambda data: build(decode(data), channel.topic))


def _from_ros1(data: bytes, schema: str) -> bytes:
    """Rewrite a message of ROS 1 in CDR."""
    from rosbags.serde.errors import SerdeError

    try:
        return bytes(store().ros1_to_cdr(data, schema))
    except SerdeError as error:
        raise BrokenMessageError(str(error)) from error


def _decoder_of(channel: Channel) -> Callable[[bytes], _Message] | None:
    """Return what parses the messages of a channel; None if its description cannot be used."""
    if channel.encoding == "json":
        return _from_json
    if channel.encoding == "protobuf":
        return _protobuf_decoder(channel)
    package, name = channel.schema.split("/")[0], channel.schema.split("/")[-1]
    kind = f"{package}/msg/{name}"
    if channel.encoding == "ros1":
        return lambda data: _parsed(_from_ros1(data, kind), kind)
    return (lambda data: _parsed(data, kind)) if channel.encoding == "cdr" else None


def _parsed(data: bytes, kind: str) -> _Message:
    """Parse a message in CDR."""
    from rosbags.serde.errors import SerdeError

    try:
        return cast("_Message", store().deserialize_cdr(data, kind))
    except SerdeError as error:
        raise BrokenMessageError(str(error)) from error


def _from_json(data: bytes) -> _Message:
    """Parse a message in JSON."""
    found: _Message = json.loads(data, object_hook=lambda values: SimpleNamespace(**values))
    return found


def _protobuf_decoder(channel: Channel) -> Callable[[bytes], _Message] | None:
    """Return the parser of a description in protobuf."""
    from google.protobuf.message import DecodeError
    from mcap.exceptions import McapError
    from mcap.records import Schema
    from mcap_protobuf.decoder import DecoderFactory

    schema = Schema(1, channel.definition, channel.schema_encoding, channel.schema)
    try:
        decode = DecoderFactory().decoder_for("protobuf", schema)
    except (DecodeError, McapError, RecursionError, *_BROKEN):
        return None
    if decode is None:
        return None

    def parse(data: bytes) -> _Message:
        try:
            message: _Message = decode(data)
        except DecodeError as error:
            raise BrokenMessageError(str(error)) from error
        return message

    return parse


def _first(message: _Message, *names: str) -> Any:
    """Return the first field that a message has."""
    for name in names:
        if hasattr(message, name):
            return getattr(message, name)
    raise BrokenMessageError(f"it has no field {names[0]!r}")


def _instant(stamp: _Message) -> int:
    """Return a time in nanoseconds, however its parts are called."""
    seconds = int(_first(stamp, "sec", "secs", "seconds"))
    return seconds * 1_000_000_000 + int(_first(stamp, "nanosec", "nsec", "nsecs", "nanos"))


def _xyz(vector: _Message) -> tuple[float, float, float]:
    """Return the components of a vector."""
    return float(vector.x), float(vector.y), float(vector.z)


def _xyzw(quaternion: _Message) -> tuple[float, float, float, float]:
    """Return the components of a quaternion."""
    return (*_xyz(quaternion), float(quaternion.w))


def _bytes(data: Any) -> bytes:
    """Return binary data; JSON holds it in base 64 or as a list of numbers."""
    if isinstance(data, str):
        return base64.b64decode(data, validate=True)
    return bytes(data)


def _foxglove_cloud(message: _Message, _: str) -> bytes:
    """Rewrite a foxglove.PointCloud."""
    pose = getattr(message, "pose", None)
    if pose is not None and (any(_xyz(pose.position)) or any(_xyz(pose.orientation))):
        raise BrokenMessageError("its pose moves it in its frame; only clouds in it are read")
    fields = [
        messages.PointField(
            str(one.name), int(getattr(one, "offset", 0)), _ROS_KINDS[int(one.type)]
        )
        for one in message.fields
    ]
    step = int(message.point_stride)
    if step < 1:
        raise BrokenMessageError(f"its points have {step} bytes")
    stamp, frame = _instant(message.timestamp), str(message.frame_id)
    return messages.cloud(stamp, frame, fields, step, _bytes(message.data))


def _ros_cloud(message: _Message, _: str) -> bytes:
    """Rewrite a PointCloud2 in JSON or protobuf."""
    fields = [
        messages.PointField(str(one.name), int(one.offset), int(one.datatype))
        for one in message.fields
    ]
    if message.is_bigendian or int(message.point_step) < 1:
        raise BrokenMessageError("its points are big endian or have no size")
    stamp, frame = _instant(message.header.stamp), str(message.header.frame_id)
    return messages.cloud(stamp, frame, fields, int(message.point_step), _bytes(message.data))


def _links(links: Iterable[_Message]) -> bytes:
    """Rewrite foxglove.FrameTransform messages."""
    return messages.transforms(
        [
            messages.Transform(
                _instant(one.timestamp),
                str(one.parent_frame_id),
                str(one.child_frame_id),
                _xyz(one.translation),
                _xyzw(one.rotation),
            )
            for one in links
        ]
    )


def _ros_links(links: Iterable[_Message]) -> bytes:
    """Rewrite TransformStamped messages."""
    return messages.transforms(
        [
            messages.Transform(
                _instant(one.header.stamp),
                str(one.header.frame_id),
                str(one.child_frame_id),
                _xyz(one.transform.translation),
                _xyzw(one.transform.rotation),
            )
            for one in links
        ]
    )


def _ros_joints(message: _Message, _: str) -> bytes:
    """Rewrite a JointState in JSON or protobuf."""
    positions = [float(one) for one in message.position]
    return messages.joint_state(_instant(message.header.stamp), list(message.name), positions)


def _foxglove_joints(message: _Message, _: str) -> bytes:
    """Rewrite a foxglove.JointStates."""
    names = [str(one.name) for one in message.joints]
    positions = [float(one.position) for one in message.joints]
    return messages.joint_state(_instant(message.timestamp), names, positions)


def _ros_imu(message: _Message, _: str) -> bytes:
    """Rewrite an Imu in JSON or protobuf."""
    return messages.imu(
        _instant(message.header.stamp),
        str(message.header.frame_id),
        _xyzw(message.orientation),
        _xyz(message.angular_velocity),
        _xyz(message.linear_acceleration),
        has_orientation=float(next(iter(message.orientation_covariance), 0.0)) != -1.0,
    )


def _number(message: _Message, topic: str) -> bytes:
    """Rewrite a number as the angle of a joint that is called like its topic."""
    return messages.joint_state(0, (topic,), (float(message.data),))


def _livox_in_ros1(data: bytes) -> bytes:
    """Rewrite a CustomMsg of ROS 1, whose numbers follow each other without gaps."""
    seconds, nanoseconds, length = struct.unpack_from("<III", data, 4)
    at = 16 + length
    n = struct.unpack_from("<I", data, at + 16)[0]
    return _livox(seconds * 1_000_000_000 + nanoseconds, data[16:at], data[at + 20 :], n, 19)


def _livox_in_cdr(data: bytes) -> bytes:
    """Rewrite a CustomMsg of ROS 2, whose numbers are aligned."""
    if data[:2] != b"\0\1":
        raise BrokenMessageError("it is not in little-endian CDR")
    seconds, nanoseconds, length = struct.unpack_from("<III", data, 4)
    at = 4 + (12 + length + 7) // 8 * 8  # of the time base, which is aligned to 8 bytes
    n = struct.unpack_from("<I", data, at + 16)[0]
    frame = data[16 : 16 + length].rstrip(b"\0")
    return _livox(seconds * 1_000_000_000 + nanoseconds, frame, data[at + 20 :], n, 20)


def _livox(stamp: int, frame: bytes, points: bytes, n: int, step: int) -> bytes:
    """Write the points of a CustomMsg as a cloud."""
    if n and (n - 1) * step + _LIVOX_POINT > len(points):
        raise BrokenMessageError(f"it declares {n:,} points and has {len(points):,} bytes")
    data = points[: n * step].ljust(n * step, b"\0")
    return messages.cloud(stamp, frame.decode("utf-8", "replace"), _LIVOX_FIELDS, step, data)


_LIVOX_READERS: dict[str, Translate] = {"ros1": _livox_in_ros1, "cdr": _livox_in_cdr}
_BUILDERS: dict[str, tuple[str, Callable[[_Message, str], bytes]]] = {
    "foxglove.PointCloud": (pointclouds.SCHEMA, _foxglove_cloud),
    "sensor_msgs/PointCloud2": (pointclouds.SCHEMA, _ros_cloud),
    "foxglove.FrameTransform": (transforms.SCHEMA, lambda message, _: _links([message])),
    "foxglove.FrameTransforms": (transforms.SCHEMA, lambda message, _: _links(message.transforms)),
    "tf2_msgs/TFMessage": (transforms.SCHEMA, lambda message, _: _ros_links(message.transforms)),
    "geometry_msgs/TransformStamped": (transforms.SCHEMA, lambda one, _: _ros_links([one])),
    "foxglove.JointStates": (joint_states.SCHEMA, _foxglove_joints),
    "sensor_msgs/JointState": (joint_states.SCHEMA, _ros_joints),
    "sensor_msgs/Imu": (orientations.SCHEMA, _ros_imu),
} | {f"std_msgs/{kind}": (joint_states.SCHEMA, _number) for kind in _NUMBERS}
