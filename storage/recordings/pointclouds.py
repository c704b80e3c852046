"""sensor_msgs/msg/PointCloud2 in CDR: returns with any fields of the driver.

Messages with equal heads are unpacked together, at a tenth of the cost of one by one.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.model import RING_UNKNOWN, Array, Mask, Nanos
from spheremark.storage.recordings import cdr
from spheremark.storage.recordings.container import Batch, Channel
from spheremark.storage.recordings.families import (
    BrokenMessageError,
    Returns,
    far_note,
    plausible,
)
from spheremark.storage.recordings.options import TIME_UNITS
from spheremark.storage.recordings.points import (
    Layout,
    ReturnsDecoder,
    Tally,
    read_layout,
    unpack_any,
    unpack_clouds,
)
from spheremark.storage.recordings.pulse_times import (
    NO_FIELD,
    PULSES_MIN,
    PulseTimes,
    fault_of,
    plain_spans,
    plain_times,
    plain_unit,
    pulse_times,
)
from spheremark.storage.recordings.records import Octets

SCHEMA = "sensor_msgs/msg/PointCloud2"
FIELDS = (
    "Header header, uint32 height, uint32 width, PointField[] fields, bool is_bigendian, "
    "uint32 point_step, uint32 row_step, uint8[] data, bool is_dense"
)

_UNIT_NAMES = {10**9: "seconds", 10**6: "milliseconds", 10**3: "microseconds", 1: "nanoseconds"}
_FILLED = (0.8, 30.0)  # of the time between messages to their duration: they do not overlap, and a
# log that lacks more of them is no scan; units are a thousand apart
_OFFSET_MAX = 1e18  # [ns] of times since a stamp: their sum fits 64 bits
_BAD_MAX = 0.05  # share of messages whose times may be unusable before all are


class _Head(NamedTuple):
    """The head of a message: order of bytes, and places of its own numbers and of the points."""

    order: str  # of bytes in its numbers
    at_shape: int  # where height and width are
    at_sizes: int  # where the sizes of a row and of all points are
    at_points: int  # where these begin


class _Messages(NamedTuple):
    """Columns about messages, kept until all are read."""

    stamps_ns: Nanos
    log_times_ns: Nanos
    counts: Nanos  # of returns
    spans_ns: Nanos  # from the stamp to the latest instant
    has_times: Nanos  # 1 or 0; -1 where there are too few points
    is_ascending: Nanos  # 1 or 0: whether the instants within a message are
    extents_ns: Nanos  # from the earliest to the latest instant
    units_ns: Nanos  # that a recorded 1 was taken for; 0 where times are absolute, or are none
    plain_ns: Nanos  # that a recorded 1 is with most drivers that use this type


class PointClouds(ReturnsDecoder):
    """Decoder of a topic of point clouds."""

    def __init__(self, channel: Channel, size: int) -> None:
        """Start without messages."""
        super().__init__(channel, size)
        self._layout = Layout(description=b"", fields={}, order="<", step=0)
        self._parts = [_Messages(*(np.empty(0, np.int64),) * len(_Messages._fields))]
        self._has_bad_rings = False
        self._time_fault = ""

    def _add(self, batch: Batch, i: int) -> int:
        """Append message i, and those behind it with an equal head; return their number."""
        octets = batch.octets[batch.starts[i] : batch.starts[i] + batch.lengths[i]]
        head = self._read_head(octets)
        clouds = np.empty((0, 4), np.int64)
        if self._layout.compiled is not None:
            clouds = _alike(batch, i, head, self._layout.step)
        if not len(clouds):
            self._add_one(octets, head, int(batch.log_times_ns[i]))
            return 1
        self._add_clouds(batch.octets, clouds, batch.log_times_ns[i : i + len(clouds)])
        return len(clouds)

    def _read_head(self, octets: Octets) -> _Head:
        """Read the head of a message; the description of points only if it is a new one."""
        cursor = cdr.Cursor(octets)
        cursor.stamp()
        self._frame, at_shape = cursor.text().lstrip("/"), cursor.skip("I", 2)
        begin, description = cursor.at, self._layout.description
        if description and octets[begin : begin + len(description)].tobytes() == description:
            cursor.at = begin + len(description)
        else:
            self._layout = read_layout(cursor, octets)
        return _Head(cursor.order, at_shape, cursor.skip("I", 2), cursor.at)

    def _add_one(self, octets: Octets, head: _Head, log_time: int) -> None:
        """Append the returns of one message, whatever its layout."""
        points, n = _points(octets, head, self._layout.step)
        self._reserve(n, self._size / self._layout.step)
        stamp = int(cdr.stamps_ns(octets[None], 4, head.order)[0])
        tally = self._unpack_one(points, stamp, self._n, n)
        self._parts.append(_Messages(*np.array([[stamp, log_time, *tally]], np.int64).T))
        self._n += tally[0]

    def _unpack_one(self, points: Octets, stamp: int, row: int, n: int) -> tuple[int, ...]:
        """Write the returns of n points from a row on; return the columns about the message."""
        out = self._out.taken(slice(row, row + n))
        n, times, has_bad_ring = unpack_any(points, self._layout, out)
        self._has_bad_rings |= has_bad_ring
        stamps = out.stamps[:n]
        found = pulse_times(times, stamp, stamps)
        return self._about(n, found, is_ascending=bool((stamps[1:] >= stamps[:-1]).all()))

    def _about(self, n: int, times: PulseTimes, *, is_ascending: bool) -> tuple[int, ...]:
        """Return the columns about a message of n returns."""
        span, extent, unit, fault = times
        self._time_fault = self._time_fault or fault
        has_times = int(not fault) if n >= PULSES_MIN or span else -1
        time = self._layout.time
        plain = 0 if time is None else plain_unit(time.kind)
        return (n, span, has_times, is_ascending, extent, unit, plain)

    def _add_clouds(self, octets: Octets, clouds: Nanos, log_times_ns: Nanos) -> None:
        """Append the returns of messages of one layout that the compiled loop reads."""
        n_points = clouds[:, 1]
        self._reserve(int(n_points.sum()), self._size / self._layout.step)
        clouds[:, 3] = self._n + np.cumsum(n_points) - n_points
        tally = unpack_clouds(octets, clouds, self._layout, self._out)
        kept, is_plain = self._plain(tally)
        for k in np.flatnonzero(~is_plain).tolist():
            kept[k] = self._corrected(octets, clouds[k].tolist(), tally, k)
        self._has_bad_rings |= bool(tally.has_bad_ring.any())
        self._parts.append(_Messages(clouds[:, 2], log_times_ns, *kept.T))
        self._close_gaps(clouds[:, 3], kept[:, 0])

    def _plain(self, tally: Tally) -> tuple[Nanos, Mask]:
        """Return the columns about clouds, and which of them have times since the stamp."""
        n, low, high, n_zeros, is_ascending, _ = tally
        kept = np.ones((len(n), 7), np.int64)
        kept[:, 0], kept[:, 3] = n, is_ascending
        if self._layout.time is None:
            return kept, np.zeros(len(n), np.bool_)
        found = plain_spans(self._layout.time.kind, low, high, n_zeros, n)
        kept[:, 1], kept[:, 4], kept[:, 5], is_plain = found
        kept[:, 6] = plain_unit(self._layout.time.kind)
        return kept, is_plain

    def _corrected(self, octets: Octets, cloud: list[int], tally: Tally, k: int) -> tuple[int, ...]:
        """Correct the instants of cloud k if its times are unusable; return its columns."""
        begin, n_points, stamp, row = cloud
        n, low, high, n_zeros, is_ascending, _ = (column[k].item() for column in tally)
        time = self._layout.time
        found: PulseTimes | None = PulseTimes()
        if n and time is None:
            found = PulseTimes(fault=NO_FIELD)
        elif n and time is not None:
            fault = fault_of(low, high, n_zeros, n)
            found = PulseTimes(fault=fault) if fault else plain_times(time.kind, low, high)
        if found is None:
            points = octets[begin : begin + n_points * self._layout.step]
            return self._unpack_one(points, stamp, row, n_points)
        if found.fault:
            self._out.stamps[row : row + n] = stamp
        return self._about(n, found, is_ascending=bool(found.fault) or is_ascending)

    def _close_gaps(self, rows: Nanos, counts: Nanos) -> None:
        """Close the gaps behind clouds with points that are no returns."""
        for row, n in zip(rows.tolist(), counts.tolist(), strict=True):
            if row != self._n:
                self._out.put(self._n, self._out.taken(slice(row, row + n)))
            self._n += n

    def stamped_at_end(self, time_unit: str) -> Returns:
        """Return all returns, where the stamp of a message is the instant of its last point."""
        messages = self._near([])
        shifts = messages.spans_ns
        self._out.stamps[: self._n] -= np.repeat(shifts, messages.counts)
        self._parts = [messages._replace(stamps_ns=messages.stamps_ns - shifts)]
        return self.returns(time_unit)

    def returns(self, time_unit: str = "auto") -> Returns:
        """Return all returns, in the order of their instants; the unit is as of ``LogOptions``."""
        notes = [*self._broken()]
        messages = self._in_unit(self._near(notes), time_unit, notes)
        self._parts = [messages := self._stamped(messages, notes)]
        has_times = self._has_times(messages, notes)
        if self._layout.intensity is None:
            notes.append(f"The points of {self._topic} carry no intensity; it is taken as 0.")
        if self._has_bad_rings:
            self._out.rings[: self._n] = RING_UNKNOWN
            notes.append(f"{self._topic} has rings outside 0 to {RING_UNKNOWN - 1}; none is used.")
        elif self._layout.ring is None:
            notes.append(f"The points of {self._topic} have no field for their laser (ring).")
        is_known = not has_times or bool(messages.is_ascending.all())
        out = self._out.in_order(messages.counts if is_known else np.ones(self._n, np.int64))
        if out.are_double():
            n = len(out.rings)
            out = out.once()
            notes.append(
                f"{n - len(out.rings):,} of {n:,} returns of {self._topic} are both the strongest "
                "and the last of their pulse: they count once."
            )
        return Returns(
            topic=self._topic,
            frame=self._frame,
            p_lidar=out.p,
            intensities=out.intensities,
            rings=out.rings,
            stamps_ns=out.stamps,
            has_pulse_times=has_times,
            message_stamps_ns=np.sort(messages.stamps_ns),
            notes=tuple(notes),
            span_ns=int(np.median(messages.spans_ns)) if has_times else 0,
            lateness_ns=_lateness(messages),
        )

    def _in_unit(self, messages: _Messages, time_unit: str, notes: list[str]) -> _Messages:
        """Give the times of all messages one unit: the one that is named, or that fills them.

        A LiDAR that scans without a pause fills the time between its messages; as nanoseconds,
        microseconds would fill a thousandth of it. Where no unit does, the likeliest one counts.
        """
        factors = np.ones(len(messages.counts))
        known = (messages.units_ns > 0) & (messages.extents_ns > 0)
        for plain in np.unique(messages.plain_ns[known]).tolist():
            mine = known & (messages.plain_ns == plain)
            likely = int(np.sort(messages.units_ns[mine])[mine.sum() // 2])
            unit = TIME_UNITS.get(time_unit) or _unit_that_fills(messages, mine) or likely
            has_unit = (messages.units_ns > 0) & (messages.plain_ns == plain)
            factors[has_unit] = unit / messages.units_ns[has_unit]
            if unit != plain and time_unit not in TIME_UNITS:
                reason = ": they fill its messages so" if unit != likely else ""
                notes.append(
                    f"The times of {self._topic} are taken as {_UNIT_NAMES[unit]}{reason} "
                    "(--time-unit, or time_unit=... in a request, names another unit)."
                )
        if (factors == 1.0).all():
            return messages
        starts = np.repeat(messages.stamps_ns, messages.counts)
        offsets = self._out.stamps[: self._n] - starts
        scaled = _scaled(offsets, np.repeat(factors, messages.counts))
        self._out = self._out._replace(stamps=starts + scaled)
        return messages._replace(
            spans_ns=_scaled(messages.spans_ns, factors),
            extents_ns=_scaled(messages.extents_ns, factors),
            units_ns=_scaled(messages.units_ns, factors),
        )

    def _near(self, notes: list[str]) -> _Messages:
        """Leave out messages with implausible stamps; return the others."""
        messages = _Messages(*(np.concatenate(part) for part in zip(*self._parts, strict=True)))
        near = plausible(messages.stamps_ns, messages.log_times_ns)
        if near.all():
            return messages
        notes.append(far_note(self._topic, int((~near).sum()), "messages"))
        rows = np.flatnonzero(np.repeat(near, messages.counts))
        self._out, self._n = self._out.taken(rows), len(rows)
        return _Messages(*(column[near] for column in messages))

    def _stamped(self, messages: _Messages, notes: list[str]) -> _Messages:
        """Use the times of recording where there are no stamps."""
        shifts = messages.log_times_ns - messages.spans_ns
        if messages.stamps_ns.any() or not shifts.any():
            return messages
        self._out.stamps[: self._n] += np.repeat(shifts, messages.counts)
        notes.append(f"{self._topic} has no stamps; the times of recording are used.")
        return messages._replace(stamps_ns=shifts)

    def _has_times(self, messages: _Messages, notes: list[str]) -> bool:
        """Return whether the times are usable; if not, set each return to its message's stamp."""
        usable = messages.has_times[messages.has_times >= 0]
        if len(usable) and np.mean(usable == 0) <= _BAD_MAX:
            return True
        if self._layout.time is None:
            fault = f"it has the fields {', '.join(self._layout.fields) or 'none'}"
        else:
            fault = self._time_fault or "its messages have too few points to judge their times"
        notes.append(f"The points of {self._topic} carry no time of their own: {fault}.")
        self._out.stamps[: self._n] = np.repeat(messages.stamps_ns, messages.counts)
        return False


def _scaled(offsets_ns: Nanos, factors: Array) -> Nanos:
    """Return offsets in another unit, as far as 64 bits hold them."""
    return np.rint(np.clip(offsets_ns * factors, -_OFFSET_MAX, _OFFSET_MAX)).astype(np.int64)


def _unit_that_fills(messages: _Messages, known: Mask) -> int:
    """Return the unit in which messages last until the next one [ns]; 0 if none does."""
    has_stamps = messages.stamps_ns.any()
    stamps = np.unique(messages.stamps_ns if has_stamps else messages.log_times_ns)
    if len(stamps) < 3:
        return 0
    recorded = float(np.median(messages.extents_ns[known] / messages.units_ns[known]))
    ratio = float(np.median(np.diff(stamps))) / recorded
    fitting = (one for one in TIME_UNITS.values() if _FILLED[0] < ratio / one < _FILLED[1])
    return next(fitting, 0)


def _lateness(messages: _Messages) -> int:
    """Return how long after its last point a message was recorded [ns]; 0 if that is not known."""
    late = messages.log_times_ns - messages.stamps_ns
    return int(np.median(late - messages.spans_ns)) if late.any() else 0


def _alike(batch: Batch, i: int, head: _Head, step: int) -> Nanos:
    """Return message i and those behind it with an equal head and points without gaps, (n, 4).

    Columns: first byte of the points, their number, the stamp; the last is for the caller.
    """
    sizes_end, shape_end = head.at_sizes + 8, head.at_shape + 8
    varying = (*range(4, 12), *range(head.at_shape, shape_end), *range(head.at_sizes, sizes_end))
    rows = cdr.heads_alike(batch, i, head.at_points, varying)
    heights, widths = cdr.numbers(rows, head.at_shape, 2, head.order + "u4").astype(np.float64).T
    row_steps, sizes = cdr.numbers(rows, head.at_sizes, 2, head.order + "u4").astype(np.int64).T
    room = batch.lengths[i : i + len(rows)] - head.at_points
    is_plain = (heights <= 1) | (widths == 0) | (row_steps == widths * step)
    fits = (sizes <= room) & (heights * widths * step <= sizes)
    n = cdr.n_leading(is_plain & fits)
    clouds = np.zeros((n, 4), np.int64)
    clouds[:, 0] = batch.starts[i : i + n] + head.at_points
    clouds[:, 1] = (heights * widths)[:n]
    clouds[:, 2] = cdr.stamps_ns(rows[:n], 4, head.order)
    return clouds


def _points(octets: Octets, head: _Head, step: int) -> tuple[Octets, int]:
    """Return the bytes of the points of a message, without padding, and their number."""
    height, width = struct.unpack_from(head.order + "II", octets.data, head.at_shape)
    row_step, size = struct.unpack_from(head.order + "II", octets.data, head.at_sizes)
    points = octets[head.at_points : head.at_points + size]
    if size > len(points):
        raise BrokenMessageError(f"it declares {size:,} bytes of points and has {len(points):,}")
    if width and height > 1 and row_step != width * step:
        points = _without_padding(points, height, width * step, row_step)
    n = height * width
    if n * step > len(points):
        raise BrokenMessageError(
            f"it declares {n:,} points of {step} bytes in {len(points):,} bytes"
        )
    return points[: n * step], n


def _without_padding(points: Octets, height: int, used: int, row_step: int) -> Octets:
    """Drop the padding behind each row of an organised cloud."""
    if row_step < used or row_step * (height - 1) + used > len(points):
        raise BrokenMessageError(f"its {height:,} rows of {row_step:,} bytes do not fit its data")
    rows = np.zeros((height, row_step), np.uint8)
    rows.ravel()[: len(points)] = points[: rows.size]
    return np.ascontiguousarray(rows[:, :used]).ravel()
