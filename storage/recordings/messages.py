"""The messages that the decoders read, written in CDR: for logs of ours and for translations."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from typing import NamedTuple

_UNKNOWN = [0.0] * 9  # a covariance


class PointField(NamedTuple):
    """One field of a point: its name, its first byte, and the datatype of ``PointField``."""

    name: str
    offset: int
    datatype: int


class Transform(NamedTuple):
    """A transform between frames: instant [ns], names, translation [m] and quaternion x y z w."""

    stamp: int
    parent: str
    child: str
    translation: Iterable[float]
    quaternion: Iterable[float]


def cloud(stamp: int, frame: str, fields: Sequence[PointField], step: int, data: bytes) -> bytes:
    """Encode a PointCloud2 of one row."""
    n = len(data) // step
    message = _header(stamp, frame)
    message += struct.pack("<III", 1, n, len(fields))
    for field in fields:
        _text(message, field.name)
        _align(message, 4)
        message += struct.pack("<IB3xI", field.offset, field.datatype, 1)
    message += struct.pack("<B", 0)
    _align(message, 4)
    message += struct.pack("<III", step, n * step, n * step)
    return bytes(message) + data[: n * step] + b"\x01"


def joint_state(stamp: int, names: Sequence[str], positions: Sequence[float]) -> bytes:
    """Encode a JointState."""
    message = _header(stamp, "")
    message += struct.pack("<I", len(names))
    for name in names:
        _text(message, name)
    _align(message, 4)
    message += struct.pack("<I", len(positions))
    _align(message, 8 if positions else 4)
    message += struct.pack(f"<{len(positions)}dII", *positions, 0, 0)
    return bytes(message)


def imu(
    stamp: int,
    frame: str,
    quaternion: Iterable[float],
    rates: Iterable[float],
    accelerations: Iterable[float],
    *,
    has_orientation: bool = True,
) -> bytes:
    """Encode an Imu; a first variance of -1 marks an orientation that the device does not give."""
    message = _header(stamp, frame)
    _align(message, 8)
    variances = [0.0 if has_orientation else -1.0, *_UNKNOWN[1:]]
    numbers = (*quaternion, *variances, *rates, *_UNKNOWN, *accelerations, *_UNKNOWN)
    message += struct.pack("<37d", *numbers)
    return bytes(message)


def transforms(links: Sequence[Transform]) -> bytes:
    """Encode a TFMessage."""
    message = bytearray(b"\x00\x01\x00\x00") + struct.pack("<I", len(links))
    for one in links:
        _align(message, 4)
        message += struct.pack("<iI", *divmod(one.stamp, 1_000_000_000))
        _text(message, one.parent)
        _text(message, one.child)
        _align(message, 8)
        message += struct.pack("<7d", *one.translation, *one.quaternion)
    return bytes(message)


def scan_of_packets(stamp: int, frame: str, packets: Sequence[tuple[int, bytes]]) -> bytes:
    """Encode a VelodyneScan of packets with their instants [ns]."""
    message = _header(stamp, frame)
    message += struct.pack("<I", len(packets))
    for instant, data in packets:
        _align(message, 4)
        message += struct.pack("<iI", *divmod(instant, 1_000_000_000)) + data
    return bytes(message)


def _header(stamp: int, frame: str) -> bytearray:
    """Begin a message: encapsulation, stamp and frame, aligned for what follows."""
    message = bytearray(b"\x00\x01\x00\x00")
    message += struct.pack("<iI", *divmod(stamp, 1_000_000_000))
    _text(message, frame)
    _align(message, 4)
    return message


def _text(message: bytearray, text: str) -> None:
    """Append a string."""
    _align(message, 4)
    octets = text.encode() + b"\0"
    message += struct.pack("<I", len(octets)) + octets


def _align(message: bytearray, size: int) -> None:
    """Pad a message to a multiple of a size, counted from behind the encapsulation."""
    message += bytes((4 - len(message)) % size)
