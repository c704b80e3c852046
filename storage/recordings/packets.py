"""velodyne_msgs/msg/VelodyneScan in CDR: raw packets of a VLP-16, read and written.

A packet holds 12 blocks of 32 pulses: distances in steps of 2 mm, reflectivities, and the azimuth
of each block's first pulse; the instant of its first pulse in microseconds past the hour, by the
sensor's clock; the return mode, and the model. Coordinates are those of the maker's manual
(63-9243, chapter 9) and of velodyne-decoder, heights of the lasers included.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.compilation import compiled, compiled_with
from spheremark.pipelines.model import Firings, Mask, Nanos, Rings
from spheremark.pipelines.scan.rigs import (
    FIRING_CYCLE,
    FIRING_ORDER,
    FIRINGS_PER_BLOCK,
    LASER_CYCLE,
    N_BLOCKS,
    N_LASERS,
    RANGE_STEP,
    tilted_vlp16,
)
from spheremark.pipelines.threads import side_by_side
from spheremark.storage.recordings import cdr
from spheremark.storage.recordings.container import Batch, Channel
from spheremark.storage.recordings.families import (
    BrokenMessageError,
    Returns,
    far_note,
    plausible,
)
from spheremark.storage.recordings.points import ReturnsDecoder
from spheremark.storage.recordings.records import Octets

SCHEMA = "velodyne_msgs/msg/VelodyneScan"
FIELDS = "Header header, VelodynePacket[] packets"

_PULSES = FIRINGS_PER_BLOCK * N_LASERS  # of a block
_STRIDE = 1216  # [bytes] of a packet in a message: its stamp, its data, and what aligns the next
_USED = 1214  # [bytes] of it that are not padding
_PADDING = _STRIDE - _USED
_AT_MODEL = 1213  # [bytes] from the beginning of a packet
_FULL_TURN = 36_000  # steps of an azimuth
_MORE = 1.1  # margin of the number of returns over that of the first packets
_WORTH = 64  # packets that two threads unpack sooner than one
_BLOCK_NS = round(FIRINGS_PER_BLOCK * FIRING_CYCLE * 1e9)
_PACKET_NS = N_BLOCKS * _BLOCK_NS
_VLP16, _STRONGEST, _DUAL = 0x22, 0x37, 0x39
_MODES = {_STRONGEST: "strongest return", 0x38: "last return", _DUAL: "dual return"}
_MODELS = {0x21: "an HDL-32E", 0x24: "a Puck Hi-Res", 0x28: "a VLP-32C", 0xA1: "a VLS-128"}
_HOUR_NS = 3_600_000_000_000
_CLOCK_STEP_NS = 1_000  # of the sensor's clock
_LATE_MAX_NS = 20e6  # delay of a packet against others when the computer is busy
_DRIFT_SPAN = 5.0  # [s] in less time two clocks drift apart by less than their stamps jitter
_LATE_SHARE = 0.95  # of the packets must be that punctual before the sensor's clock is used
_BLOCK = np.dtype(
    [
        ("flag", "<u2"),
        ("azimuth", "<u2"),
        ("pulses", [("distance", "<u2"), ("reflectivity", "u1")], _PULSES),
    ]
)
_PACKET = np.dtype(
    [("blocks", _BLOCK, N_BLOCKS), ("micros", "<u4"), ("mode", "u1"), ("model", "u1")]
)
_STAMPED = np.dtype([("sec", "<i4"), ("nanosec", "<u4"), ("data", _PACKET), ("padding", "<u2")])

Item = tuple[int, str, bytes]  # log time [ns], topic, message


class _Sensor(NamedTuple):
    """Tables of a VLP-16 for the kernel.

    Trigonometry of every azimuth, of the lasers in the order of firing with their heights [m] and
    rings, and the times of pulses since the first of their block [s] and of their packet [ns].
    """

    turns: NDArray[np.float32]
    lasers: NDArray[np.float32]
    rings: Rings
    since_block: NDArray[np.float32]
    since_packet_ns: Nanos
    lasting: NDArray[np.float32]


@cache
def _sensor() -> _Sensor:
    """Return the VLP-16; in single precision wherever velodyne-decoder has it."""
    rig = tilted_vlp16("", (0.0, 0.0))
    angles = np.radians(np.arange(_FULL_TURN) / 100.0)
    elevations = rig.laser_elevations[FIRING_ORDER]
    k = np.arange(_PULSES)
    pulses = k // N_LASERS * FIRING_CYCLE + k % N_LASERS * LASER_CYCLE
    blocks = np.arange(N_BLOCKS) * FIRINGS_PER_BLOCK * FIRING_CYCLE
    times = (blocks[:, None] + pulses).astype(np.float32)
    return _Sensor(
        turns=np.stack([np.cos(angles), np.sin(angles)], axis=1).astype(np.float32).ravel(),
        lasers=np.stack(
            [np.cos(elevations), np.sin(elevations), rig.laser_heights[FIRING_ORDER]], axis=1
        )
        .astype(np.float32)
        .ravel(),
        rings=FIRING_ORDER.astype(np.uint8),
        since_block=times - times[:, :1],
        since_packet_ns=np.rint((blocks[:, None] + pulses) * 1e9).astype(np.int64),
        lasting=times[:, 0].copy(),
    )


class Packets(ReturnsDecoder):
    """Decoder of a topic of raw packets."""

    def __init__(self, channel: Channel, size: int) -> None:
        """Start without messages."""
        super().__init__(channel, size)
        self._message_stamps = [np.empty(0, np.int64)]
        self._log_times = [np.empty(0, np.int64)]
        self._sizes = [np.empty(0, np.int64)]  # packets of each message
        self._heads = [np.empty((0, 4), np.int64)]  # packets: stamp, micros, mode and returns
        self._returns: Returns | None = None

    def _add(self, batch: Batch, i: int) -> int:
        """Append message i, and those behind it that begin alike; return how many these are."""
        octets = batch.octets[batch.starts[i] : batch.starts[i] + batch.lengths[i]]
        cursor = cdr.Cursor(octets)
        cursor.stamp()
        self._frame, at_count = cursor.text().lstrip("/"), cursor.skip("I")
        varying = (*range(4, 12), *range(at_count, cursor.at))
        rows = cdr.heads_alike(batch, i, cursor.at, varying)
        counts = cdr.numbers(rows, at_count, 1, cursor.order + "u4")[:, 0].astype(np.int64)
        room = batch.lengths[i : i + len(rows)] - cursor.at
        n = cdr.n_leading((counts == 0) | (counts * _STRIDE - _PADDING <= room))
        if not n:
            raise BrokenMessageError(
                f"it declares {counts[0]:,} packets, more than it has bytes for"
            )
        places = _places(batch.starts[i : i + n] + cursor.at, counts[:n])
        n = _n_of_ours(batch.octets, places, counts[:n])
        if not n:
            raise BrokenMessageError(_complaint(batch.octets[places[: counts[0]] + _AT_MODEL]))
        self._unpack(batch.octets, places[: counts[:n].sum()], is_little=cursor.order == "<")
        self._message_stamps.append(cdr.stamps_ns(rows[:n], 4, cursor.order))
        self._log_times.append(batch.log_times_ns[i : i + n])
        self._sizes.append(counts[:n])
        return n

    def _unpack(self, octets: Octets, places: Nanos, *, is_little: bool) -> None:
        """Append the returns of packets."""
        heads = np.empty((len(places), 4), np.int64)

        def count(begin: int, end: int) -> None:
            _heads_kernel(octets, places[begin:end], is_little, heads[begin:end])

        side_by_side(count, len(places), threaded_from=_WORTH)
        n = int(heads[:, 3].sum())
        self._reserve(n, _MORE * self._size / _STRIDE * n / max(len(heads), 1))
        rows = self._n + np.cumsum(heads[:, 3]) - heads[:, 3]
        sensor, out = _sensor(), (self._out.p.reshape(-1), *self._out[1:])

        def unpack(begin: int, end: int) -> None:
            part = slice(begin, end)
            _packets_kernel(octets, places[part], rows[part], heads[part], sensor, out)

        side_by_side(unpack, len(places), threaded_from=_WORTH)
        self._n += n
        self._heads.append(heads)

    def returns(self) -> Returns:
        """Return all returns, in the order of their instants; no message can follow."""
        if self._returns is None:
            self._returns = self._settled()
        return self._returns

    def _settled(self) -> Returns:
        """Set the instants of all returns, and sort them."""
        notes = [*self._broken()]
        messages_ns, counts = self._settle(np.concatenate(self._heads), notes)
        out = self._out.in_order(counts)  # pulses follow each other in a packet
        return Returns(
            topic=self._topic,
            frame=self._frame,
            p_lidar=out.p,
            intensities=out.intensities,
            rings=out.rings,
            stamps_ns=out.stamps,
            has_pulse_times=True,
            message_stamps_ns=np.sort(messages_ns),
            notes=tuple(notes),
            has_heights=True,
        )

    def _settle(self, heads: Nanos, notes: list[str]) -> tuple[Nanos, Nanos]:
        """Set the instants of the returns; return those of messages, and the counts of packets."""
        messages_ns, sizes = np.concatenate(self._message_stamps), np.concatenate(self._sizes)
        if not len(heads):
            return messages_ns, heads[:, 3]
        log_times = np.concatenate(self._log_times)
        if not heads[:, 0].any():
            messages_ns, stamps_ns = _stamps_of_messages(messages_ns, log_times, heads, sizes)
            notes.append(
                f"The packets of {self._topic} have no stamps; those of messages are used."
            )
        else:
            stamps_ns, note = punctual(heads[:, 0], heads[:, 1])
            notes += [f"{self._topic}: {note}"] if note else []
        shifts = stamps_ns - heads[:, 0]
        if np.abs(shifts).max() > _CLOCK_STEP_NS:
            self._out.stamps[: self._n] += np.repeat(shifts, heads[:, 3])
        near = plausible(stamps_ns, np.repeat(log_times, sizes))
        self._drop_far(near, heads[:, 3], notes)
        modes = sorted(
            {_MODES.get(int(mode), "unknown returns") for mode in np.unique(heads[:, 2])}
        )
        notes.append(f"{self._topic} holds raw packets of a VLP-16 ({', '.join(modes)}).")
        return messages_ns, heads[near, 3]

    def _drop_far(self, near: Mask, counts: Nanos, notes: list[str]) -> None:
        """Leave out the returns of packets whose stamps cannot be."""
        if near.all():
            return
        notes.append(far_note(self._topic, int(counts[~near].sum()), "returns"))
        rows = np.flatnonzero(np.repeat(near, counts))
        self._out, self._n = self._out.taken(rows), len(rows)


def _places(begins: Nanos, counts: Nanos) -> Nanos:
    """Return where the packets of messages begin that follow each other from given places on."""
    since = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.asarray(np.repeat(begins, counts) + _STRIDE * since)


def _n_of_ours(octets: Octets, places: Nanos, counts: Nanos) -> int:
    """Return how many messages there are before the first with a packet of another model."""
    is_other = octets[places + _AT_MODEL] != _VLP16
    if not is_other.any():
        return len(counts)
    return int(np.searchsorted(np.cumsum(counts), np.argmax(is_other), side="right"))


def _complaint(models: Octets) -> str:
    """Return the reason why packets of some models are not decoded."""
    others = sorted(set(models.tolist()) - {_VLP16})
    named = " and ".join(f"{_MODELS.get(one, 'another model')} (0x{one:02x})" for one in others)
    return (
        f"its packets are those of {named}, and only those of a VLP-16 (0x22) are decoded: record "
        "the driver's point clouds"
    )


def punctual(stamps_ns: Nanos, micros: Nanos) -> tuple[Nanos, str]:
    """Return the instants of packets by the sensor's clock, set to the recorder's.

    Notes
    -----
    The sensor's clock is even, the recorder's stamps jitter by milliseconds; a sensor without GPS
    counts its hour from power-on. Only the delay of the stamps, modulo an hour, is used, so that
    the turn of the hour does not matter.
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
    messages_ns: Nanos, log_times_ns: Nanos, heads: Nanos, sizes: Nanos
) -> tuple[Nanos, Nanos]:
    """Return instants of messages and packets where the packets have no stamps.

    A message is stamped with its first packet, or recorded when its last one is complete.
    """
    micros = np.split(heads[:, 1], np.cumsum(sizes)[:-1])
    since = [(one - one[:1]) * 1_000 % _HOUR_NS for one in micros]
    if not messages_ns.any():
        lasting = [int(one.max(initial=0)) + _PACKET_NS for one in since]
        messages_ns = log_times_ns - np.array(lasting, np.int64)
    pairs = zip(messages_ns, since, strict=True)
    return messages_ns, np.concatenate([start + one for start, one in pairs])


@compiled
def _number(octets, at, size, is_little):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Read an unsigned number of so many bytes."""
    value = np.int64(0)
    for k in range(size):
        value |= np.int64(octets[at + k]) << (8 * k if is_little else 8 * (size - 1 - k))
    return value


@compiled
def _short(octets, at):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Read two bytes, little endian; unsigned places spare the test for negative ones."""
    return np.uint32(octets[at]) | np.uint32(octets[at + np.uint64(1)]) << np.uint32(8)


@compiled
def _heads_kernel(octets, places, is_little, heads):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Fill stamp, micros, mode and number of returns of packets that begin at places.

    The data of a packet are little endian whatever the message is. A block that does not begin as
    one ends its packet.
    """
    for k in range(len(places)):
        at = places[k]
        heads[k, 0] = _number(octets, at, 4, is_little) * np.int64(1_000_000_000)
        heads[k, 0] += _number(octets, at + 4, 4, is_little)
        heads[k, 1], heads[k, 2] = _number(octets, at + 1208, 4, True), octets[at + 1212]
        step = 2 if octets[at + 1212] == 0x39 else 1
        n = 0
        for i in range(0, 12, step):
            block = np.uint64(at + 8 + 100 * i)
            other = block + np.uint64(100 * (step - 1))
            if _short(octets, block) != 0xEEFF or _short(octets, other) != 0xEEFF:
                break
            for j in range(np.uint64(4), np.uint64(100), np.uint64(3)):
                steps = _short(octets, block + j)
                n += steps != 0
                if step == 2:
                    last = _short(octets, other + j)
                    n += last != 0 and last != steps
        heads[k, 3] = n


@compiled
def _packets_kernel(octets, places, rows, heads, sensor, out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Write the returns of packets that begin at places, of each from its row on."""
    for k in range(len(places)):
        data = np.uint64(places[k] + 8)
        step = 2 if heads[k, 2] == 0x39 else 1
        first = np.int32(_short(octets, data + np.uint64(2)))
        last = np.int32(_short(octets, data + np.uint64(1102)))
        speed = np.float32((last - first + 36000) % 36000) / sensor.lasting[11 // step]
        n, end = np.uint64(rows[k]), np.uint64(rows[k] + heads[k, 3])
        for i in range(0, 12, step):
            if n == end:
                break
            block = data + np.uint64(100 * i)
            strongest = block + np.uint64(100 * (step - 1))
            place = (np.uint64(i // step), speed, heads[k, 0])
            n = _unpack_block(octets, (block, strongest), place, sensor, out, n)


@compiled
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


@compiled_with(inline="always")
def _put(out, n, aim, steps, reflectivity, sensor):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Write one return to a row."""
    turn, laser, instant = aim
    p, intensities, rings, stamps = out
    at, place, direction = np.uint64(3) * n, np.uint64(3) * laser, np.uint64(2) * turn
    r = np.float32(steps) * np.float32(RANGE_STEP)
    reach = r * sensor.lasers[place]
    p[at] = reach * sensor.turns[direction]
    p[at + np.uint64(1)] = -reach * sensor.turns[direction + np.uint64(1)]
    p[at + np.uint64(2)] = (
        r * sensor.lasers[place + np.uint64(1)] + sensor.lasers[place + np.uint64(2)]
    )
    intensities[n] = reflectivity
    rings[n] = sensor.rings[laser]
    stamps[n] = instant


def scans(topic: str, frame: str, firings: Firings, revolution_ns: int) -> Iterator[Item]:
    """Yield one message per revolution, as the driver of a VLP-16 publishes them."""
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
    """Return packets with their stamps, as they follow each other in a message."""
    n = len(firings.azimuths) // N_BLOCKS
    rows = slice(n * N_BLOCKS)
    packets = np.zeros(n, _STAMPED)
    stamps = firings.start_ns + np.arange(n, dtype=np.int64) * _PACKET_NS
    packets["sec"], packets["nanosec"] = stamps // 1_000_000_000, stamps % 1_000_000_000
    blocks = packets["data"]["blocks"]
    blocks["flag"] = 0xEEFF
    blocks["azimuth"] = firings.azimuths[rows].reshape(n, N_BLOCKS)
    blocks["pulses"]["distance"] = firings.distances[rows].reshape(n, N_BLOCKS, _PULSES)
    blocks["pulses"]["reflectivity"] = firings.reflectivities[rows].reshape(n, N_BLOCKS, _PULSES)
    packets["data"]["micros"] = stamps % _HOUR_NS // 1_000
    packets["data"]["mode"], packets["data"]["model"] = _STRONGEST, _VLP16
    return packets
