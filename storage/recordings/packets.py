"""velodyne_msgs/msg/VelodyneScan in CDR: raw packets of a VLP-16, read and written.

A packet holds 12 blocks of 32 shots: distances in steps of 2 mm, reflectivities, and the azimuth of
each block's first shot; the instant of its first shot in microseconds past the hour, by the
sensor's clock; how many returns a shot can have, and the model. Coordinates are those that the
maker's manual (63-9243, chapter 9) and velodyne-decoder give, heights of the lasers included.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from pipelines.rigs import (
    FIRING_CYCLE,
    FIRING_ORDER,
    FIRINGS_PER_BLOCK,
    LASER_CYCLE,
    N_BLOCKS,
    N_LASERS,
    RANGE_STEP,
    tilted_vlp16,
)
from pipelines.values import Column, Firings, Nanos, Rings
from storage.recordings import cdr
from storage.recordings.container import Batch, Channel, Octets
from storage.recordings.families import (
    BrokenMessageError,
    Returns,
    broken_note,
    far_note,
    plausible,
)

SCHEMA = "velodyne_msgs/msg/VelodyneScan"
DEFINITION = f"""# Velodyne LIDAR scan packets.
{cdr.HEADER}VelodynePacket[] packets
{cdr.HEADER_PARTS}================================================================================
MSG: velodyne_msgs/VelodynePacket
builtin_interfaces/Time stamp
uint8[1206] data
"""

_SHOTS = FIRINGS_PER_BLOCK * N_LASERS  # of a block
_POINTS_MAX = N_BLOCKS * _SHOTS  # of a packet
_STRIDE = 1216  # [bytes] of a packet in a message: its stamp, its data, and what aligns the next
_USED = 1214  # [bytes] of it that are not padding
_FULL_TURN = 36_000  # steps of an azimuth
_BLOCK_NS = round(FIRINGS_PER_BLOCK * FIRING_CYCLE * 1e9)
_PACKET_NS = N_BLOCKS * _BLOCK_NS
_VLP16, _STRONGEST, _DUAL = 0x22, 0x37, 0x39
_MODES = {_STRONGEST: "strongest return", 0x38: "last return", _DUAL: "dual return"}
_MODELS = {0x21: "an HDL-32E", 0x24: "a Puck Hi-Res", 0x28: "a VLP-32C", 0xA1: "a VLS-128"}
_HOUR_NS = 3_600_000_000_000
_CLOCK_STEP_NS = 1_000  # of the sensor's clock
_LATE_MAX_NS = 20e6  # what a packet may be later than others when the computer is busy
_DRIFT_SPAN = 5.0  # [s] in less time two clocks drift apart by less than their stamps jitter
_LATE_SHARE = 0.95  # of the packets must be that punctual before the sensor's clock is believed
_BLOCK = np.dtype(
    [
        ("flag", "<u2"),
        ("azimuth", "<u2"),
        ("shots", [("distance", "<u2"), ("reflectivity", "u1")], _SHOTS),
    ]
)
_PACKET = np.dtype(
    [("blocks", _BLOCK, N_BLOCKS), ("micros", "<u4"), ("mode", "u1"), ("model", "u1")]
)
_STAMPED = np.dtype([("sec", "<i4"), ("nanosec", "<u4"), ("data", _PACKET), ("padding", "<u2")])

Item = tuple[int, str, bytes]  # log time [ns], topic, message


class _Out(NamedTuple):
    """Columns that the kernel fills from a row on."""

    p: Column
    intensities: Column
    rings: Rings
    stamps: Nanos


class _Sensor(NamedTuple):
    """What the kernel must know of a VLP-16.

    Trigonometry of every azimuth, of the lasers in the order of firing with their heights [m] and
    rings, and the times of shots since the first of their block [s] and of their packet [ns].
    """

    turns: NDArray[np.float32]
    lasers: NDArray[np.float32]
    rings: Rings
    since_block: NDArray[np.float32]
    since_packet_ns: Nanos
    lasting: NDArray[np.float32]


def _sensor() -> _Sensor:
    """Return the VLP-16; in single precision wherever velodyne-decoder has it."""
    rig = tilted_vlp16("", (0.0, 0.0))
    angles = np.radians(np.arange(_FULL_TURN) / 100.0)
    elevations = rig.laser_elevations[FIRING_ORDER]
    k = np.arange(_SHOTS)
    shots = k // N_LASERS * FIRING_CYCLE + k % N_LASERS * LASER_CYCLE
    blocks = np.arange(N_BLOCKS) * FIRINGS_PER_BLOCK * FIRING_CYCLE
    times = (blocks[:, None] + shots).astype(np.float32)
    return _Sensor(
        turns=np.column_stack([np.cos(angles), np.sin(angles)]).astype(np.float32),
        lasers=np.column_stack(
            [np.cos(elevations), np.sin(elevations), rig.laser_heights[FIRING_ORDER]]
        ).astype(np.float32),
        rings=FIRING_ORDER.astype(np.uint8),
        since_block=times - times[:, :1],
        since_packet_ns=np.rint((blocks[:, None] + shots) * 1e9).astype(np.int64),
        lasting=times[:, 0].copy(),
    )


class Packets:
    """Decoder of a topic of raw packets."""

    def __init__(self, channel: Channel, size: int) -> None:
        """Start without messages."""
        self._topic = channel.topic
        self._size = size
        self._frame = ""
        self._sensor = _sensor()
        self._n = 0
        self._out = _empty(0)
        self._message_stamps: list[int] = []
        self._log_times: list[int] = []
        self._heads: list[Nanos] = []  # per message: stamp, micros, mode and returns of each packet
        self._n_broken = 0
        self._reason = ""
        self._returns: Returns | None = None

    def add(self, batch: Batch) -> None:
        """Take some messages."""
        for octets, log_time in batch:
            try:
                self._add(octets, log_time)
            except BrokenMessageError as error:
                self._n_broken += 1
                self._reason = self._reason or str(error)

    def _add(self, octets: Octets, log_time: int) -> None:
        """Append the returns of one message."""
        cursor = cdr.Cursor(octets)
        stamp, frame = cursor.stamp_ns(), cursor.text().lstrip("/")
        n = cursor.number("I")
        at = cursor.at
        if n and at + n * _STRIDE - (_STRIDE - _USED) > len(octets):
            raise BrokenMessageError(f"it declares {n:,} packets, more than it has bytes for")
        for model in {int(byte) for byte in octets[at + 1213 :: _STRIDE][:n]} - {_VLP16}:
            raise BrokenMessageError(
                f"its packets are those of {_MODELS.get(model, 'another model')} (0x{model:02x}), "
                "and only those of a VLP-16 (0x22) are decoded: record the driver's point clouds"
            )
        self._reserve(n * _POINTS_MAX)
        heads = np.empty((n, 4), np.int64)
        is_little = cursor.order == "<"
        self._n = _unpack_kernel(octets, at, is_little, self._sensor, self._out, self._n, heads)
        self._frame = frame
        self._message_stamps.append(stamp)
        self._log_times.append(log_time)
        self._heads.append(heads)

    def _reserve(self, n: int) -> None:
        """Make room; memory that is reserved but not written costs nothing."""
        if self._n + n <= len(self._out.rings):
            return
        likely = self._size // _STRIDE * _POINTS_MAX if not self._n else 2 * len(self._out.rings)
        old, self._out = self._out, _empty(max(likely, self._n + n))
        rows = slice(self._n)
        self._out.p[rows], self._out.intensities[rows] = old.p[rows], old.intensities[rows]
        self._out.rings[rows], self._out.stamps[rows] = old.rings[rows], old.stamps[rows]

    def returns(self) -> Returns:
        """Give all returns, in the order of their instants; no message can follow."""
        if self._returns is None:
            self._returns = self._settled()
        return self._returns

    def _settled(self) -> Returns:
        """Bring all returns to their instants and into their order."""
        notes = [*broken_note(self._topic, self._n_broken, self._reason)]
        heads = np.concatenate([np.empty((0, 4), np.int64), *self._heads])
        messages_ns = self._settle(heads, notes)
        stamps = self._out.stamps[: self._n]
        is_ascending = bool((stamps[1:] >= stamps[:-1]).all())
        rows = slice(self._n) if is_ascending else np.argsort(stamps, kind="stable")
        return Returns(
            topic=self._topic,
            frame=self._frame,
            p_lidar=self._out.p[rows],
            intensities=self._out.intensities[rows],
            rings=self._out.rings[rows],
            stamps_ns=self._out.stamps[rows],
            has_shot_times=True,
            message_stamps_ns=np.sort(messages_ns),
            notes=tuple(notes),
            has_heights=True,
        )

    def _settle(self, heads: Nanos, notes: list[str]) -> Nanos:
        """Bring the returns to the instants of their shots; return those of the messages."""
        messages_ns = np.array(self._message_stamps, np.int64)
        if not len(heads):
            return messages_ns
        sizes = np.array([len(one) for one in self._heads])
        log_times = np.array(self._log_times, np.int64)
        if not heads[:, 0].any():
            messages_ns, stamps_ns = _stamps_of_messages(messages_ns, log_times, self._heads)
            notes.append(
                f"The packets of {self._topic} have no stamps; those of messages are used."
            )
        else:
            stamps_ns, note = punctual(heads[:, 0], heads[:, 1])
            notes += [f"{self._topic}: {note}"] if note else []
        shifts = stamps_ns - heads[:, 0]
        if np.abs(shifts).max() > _CLOCK_STEP_NS:
            self._out.stamps[: self._n] += np.repeat(shifts, heads[:, 3])
            heads[:, 0] = stamps_ns
            self._heads = np.split(heads, np.cumsum(sizes)[:-1])
        self._drop_far(
            np.repeat(plausible(stamps_ns, np.repeat(log_times, sizes)), heads[:, 3]), notes
        )
        modes = sorted(
            {_MODES.get(int(mode), "unknown returns") for mode in np.unique(heads[:, 2])}
        )
        notes.append(f"{self._topic} holds raw packets of a VLP-16 ({', '.join(modes)}).")
        return messages_ns

    def _drop_far(self, near: NDArray[np.bool_], notes: list[str]) -> None:
        """Leave out returns whose stamps cannot be."""
        if near.all():
            return
        notes.append(far_note(self._topic, int((~near).sum()), "returns"))
        rows = np.flatnonzero(near)
        p, intensities, rings, stamps = self._out
        self._out = _Out(p[rows], intensities[rows], rings[rows], stamps[rows])
        self._n = len(self._out.rings)


def _empty(n: int) -> _Out:
    """Return columns for so many returns."""
    return _Out(
        np.empty((n, 3), np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.uint8),
        np.empty(n, np.int64),
    )


def punctual(stamps_ns: Nanos, micros: Nanos) -> tuple[Nanos, str]:
    """Return the instants of packets by the sensor's clock, set to the recorder's.

    Parameters
    ----------
    stamps_ns : (n,)
        When the recorder says that each packet began.
    micros : (n,)
        When the sensor says so: microseconds past an hour of its own.

    Returns
    -------
    instants_ns : (n,)
        The sensor's even clock, which the stamps follow on average, drift included.
    note : str
        Why the stamps are taken as they are; empty otherwise.

    Notes
    -----
    The sensor's clock is even, the recorder's stamps jitter by milliseconds; a sensor without GPS
    counts its hour from when it was switched on. Only how late the stamps are, modulo an hour, is
    used, so that the turn of the hour does not matter.
    """
    late = (stamps_ns - micros * 1_000) % _HOUR_NS
    half = _HOUR_NS // 2
    late = ((late - late[0] + half) % _HOUR_NS - half).astype(np.float64)
    if np.ptp(late) <= _CLOCK_STEP_NS:
        return stamps_ns, ""
    seconds = (stamps_ns - stamps_ns[0]) * 1e-9
    usual = np.abs(late - np.median(late)) <= _LATE_MAX_NS
    if np.ptp(micros) == 0 or np.mean(usual) < _LATE_SHARE:
        return stamps_ns, "the sensor's own clock jumps; the stamps of its packets are used."
    if np.ptp(seconds) < _DRIFT_SPAN:
        line = np.median(late[usual], keepdims=True)
    else:
        line = np.polyfit(seconds[usual], late[usual], 1)
    return stamps_ns - np.rint(late - np.polyval(line, seconds)).astype(np.int64), ""


def _stamps_of_messages(
    messages_ns: Nanos, log_times_ns: Nanos, heads: list[Nanos]
) -> tuple[Nanos, Nanos]:
    """Return instants of messages and packets where the packets have no stamps.

    A message is stamped with its first packet, or recorded when its last one is complete.
    """
    since = [(one[:, 1] - one[:1, 1]) * 1_000 % _HOUR_NS for one in heads]
    if not messages_ns.any():
        lasting = [int(one.max(initial=0)) + _PACKET_NS for one in since]
        messages_ns = log_times_ns - np.array(lasting, np.int64)
    pairs = zip(messages_ns, since, strict=True)
    return messages_ns, np.concatenate([start + one for start, one in pairs])


@numba.njit(cache=True, nogil=True)
def _number(octets, at, size, is_little):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Read an unsigned number of so many bytes."""
    value = np.int64(0)
    for k in range(size):
        value |= np.int64(octets[at + k]) << (8 * k if is_little else 8 * (size - 1 - k))
    return value


@numba.njit(cache=True, nogil=True)
def _short(octets, at):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Read two bytes, little endian; unsigned places spare the test for negative ones."""
    return np.uint32(octets[at]) | np.uint32(octets[at + np.uint64(1)]) << np.uint32(8)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _unpack_kernel(octets, at, is_little, sensor, out, n, heads):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0913
    """Append the returns of packets from a byte on to row ``n`` on; return the new number of rows.

    Fills stamp, micros, mode and returns of each packet. The data of a packet are little endian
    whatever the message is. A block that does not begin as one ends its packet.
    """
    for k in range(len(heads)):
        stamp = _number(octets, at, 4, is_little) * np.int64(1_000_000_000)
        stamp += _number(octets, at + 4, 4, is_little)
        data = np.uint64(at + 8)
        heads[k, 0], heads[k, 1] = stamp, _number(octets, at + 1208, 4, True)
        heads[k, 2], heads[k, 3] = octets[at + 1212], n
        step = 2 if octets[at + 1212] == 0x39 else 1
        first = np.int32(_short(octets, data + np.uint64(2)))
        last = np.int32(_short(octets, data + np.uint64(1102)))
        speed = np.float32((last - first + 36000) % 36000) / sensor.lasting[11 // step]
        for i in range(0, 12, step):
            block = data + np.uint64(100 * i)
            strongest = block + np.uint64(100 * (step - 1))
            if _short(octets, block) != 0xEEFF or _short(octets, strongest) != 0xEEFF:
                break
            place = (np.uint64(i // step), speed, stamp)
            n = _unpack_block(octets, (block, strongest), place, sensor, out, np.uint64(n))
        heads[k, 3] = np.int64(n) - heads[k, 3]
        at += 1216
    return np.int64(n)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _unpack_block(octets, blocks, place, sensor, out, n):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Append the returns of one block, or of a pair of them with dual returns; return the rows.

    Of a dual return the last comes first, and the strongest is left out where it is the same.
    """
    row, speed, stamp = place
    azimuth = np.float32(_short(octets, blocks[0] + np.uint64(2)))
    for j in range(np.uint64(32)):
        behind = np.uint64(4) + np.uint64(3) * j
        steps = _short(octets, blocks[0] + behind)
        other = np.uint32(0)
        if blocks[1] != blocks[0]:
            other = _short(octets, blocks[1] + behind)
        if steps | other == 0:
            continue
        # In single precision and rounded as velodyne-decoder does.
        turned = azimuth + speed * sensor.since_block[row, j] + np.float32(36000)
        turn = np.uint32(turned + np.float32(0.5)) - np.uint32(36000)
        if turn >= 36000:
            turn -= np.uint32(36000)
        instant = stamp + sensor.since_packet_ns[row, j]
        aim = (np.uint64(turn), j & np.uint64(15), instant)
        if steps != 0:
            _put(out, n, aim, steps, octets[blocks[0] + behind + np.uint64(2)], sensor)
            n += np.uint64(1)
        if other != 0 and other != steps:
            _put(out, n, aim, other, octets[blocks[1] + behind + np.uint64(2)], sensor)
            n += np.uint64(1)
    return n


@numba.njit(cache=True, nogil=True, inline="always")
def _put(out, n, aim, steps, reflectivity, sensor):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Write one return to a row."""
    turn, laser, instant = aim
    r = np.float32(steps) * np.float32(RANGE_STEP)
    reach = r * sensor.lasers[laser, 0]
    out.p[n, 0] = reach * sensor.turns[turn, 0]
    out.p[n, 1] = -reach * sensor.turns[turn, 1]
    out.p[n, 2] = r * sensor.lasers[laser, 1] + sensor.lasers[laser, 2]
    out.intensities[n] = reflectivity
    out.rings[n] = sensor.rings[laser]
    out.stamps[n] = instant


def scans(topic: str, frame: str, firings: Firings, revolution_ns: int) -> Iterator[Item]:
    """Give one message per revolution, as the driver of a VLP-16 would publish them.

    Parameters
    ----------
    topic, frame : str
        Names of the topic and of the LiDAR's frame.
    firings : Firings
        All shots; what does not fill a packet at the end is left out.
    revolution_ns : int
        Time that one message spans.

    Yields
    ------
    tuple of (int, str, bytes)
        When it is complete [ns], the topic and the message, stamped with its first packet.
    """
    packets = encoded(firings)
    stamps = packets["sec"].astype(np.int64) * 1_000_000_000 + packets["nanosec"]
    turns = (stamps - stamps[0]) // revolution_ns if len(stamps) else stamps
    edges = [*np.flatnonzero(np.diff(turns, prepend=-1)).tolist(), len(packets)]
    for begin, end in pairwise(edges):
        octets = frame.encode() + b"\0"
        message = b"\x00\x01\x00\x00" + packets[begin : begin + 1].tobytes()[:8]
        message += struct.pack("<I", len(octets)) + octets + bytes(-len(octets) % 4)
        message += struct.pack("<I", end - begin)
        message += packets[begin:end].tobytes()[: _USED - _STRIDE]
        yield int(stamps[end - 1]) + _PACKET_NS, topic, message


def encoded(firings: Firings) -> NDArray[np.void]:
    """Return packets with their stamps, as they follow each other in a message.

    Parameters
    ----------
    firings : Firings
        All shots; what does not fill a packet at the end is left out.

    Returns
    -------
    (n,) structured
        ``sec``, ``nanosec``, the 1206 bytes ``data``, and two bytes of padding.
    """
    n = len(firings.azimuths) // N_BLOCKS
    rows = slice(n * N_BLOCKS)
    packets = np.zeros(n, _STAMPED)
    stamps = firings.start_ns + np.arange(n, dtype=np.int64) * _PACKET_NS
    packets["sec"], packets["nanosec"] = stamps // 1_000_000_000, stamps % 1_000_000_000
    blocks = packets["data"]["blocks"]
    blocks["flag"] = 0xEEFF
    blocks["azimuth"] = firings.azimuths[rows].reshape(n, N_BLOCKS)
    blocks["shots"]["distance"] = firings.distances[rows].reshape(n, N_BLOCKS, _SHOTS)
    blocks["shots"]["reflectivity"] = firings.reflectivities[rows].reshape(n, N_BLOCKS, _SHOTS)
    packets["data"]["micros"] = stamps % _HOUR_NS // 1_000
    packets["data"]["mode"], packets["data"]["model"] = _STRONGEST, _VLP16
    return packets
