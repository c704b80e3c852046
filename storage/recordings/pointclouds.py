"""sensor_msgs/msg/PointCloud2 in CDR: returns with any fields of the driver.

Messages with equal heads are unpacked together, at a tenth of the cost of one by one.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.model import RING_UNKNOWN, Mask, Nanos
from spheremark.storage.recordings import cdr
from spheremark.storage.recordings.container import Batch, Channel
from spheremark.storage.recordings.families import (
    BrokenMessageError,
    Returns,
    broken_note,
    far_note,
    plausible,
)
from spheremark.storage.recordings.points import (
    Columns,
    Layout,
    Tally,
    read_layout,
    unpack_any,
    unpack_clouds,
)
from spheremark.storage.recordings.pulse_times import (
    NO_FIELD,
    PULSES_MIN,
    fault_of,
    plain_span,
    plain_spans,
    pulse_times,
)
from spheremark.storage.recordings.records import Octets

SCHEMA = "sensor_msgs/msg/PointCloud2"
FIELDS = (
    "Header header, uint32 height, uint32 width, PointField[] fields, bool is_bigendian, "
    "uint32 point_step, uint32 row_step, uint8[] data, bool is_dense"
)

_UNITS = (1_000, 1_000_000)  # [ns] of times that are no nanoseconds
_FILLED = (0.8, 3.0)  # of the time between messages to their duration, in the right unit
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


class PointClouds:
    """Decoder of a topic of point clouds."""

    def __init__(self, channel: Channel, size: int) -> None:
        """Start without messages."""
        self._topic = channel.topic
        self._size = size
        self._frame = ""
        self._layout = Layout(description=b"", fields={}, order="<", step=0)
        self._n = 0
        self._out = Columns.empty(0)
        self._parts = [_Messages(*(np.empty(0, np.int64),) * 6)]
        self._has_bad_rings = False
        self._time_fault = ""
        self._n_broken = 0
        self._reason = ""

    def add(self, batch: Batch) -> None:
        """Take some messages."""
        i, n = 0, len(batch.starts)
        while i < n:
            try:
                i += self._add(batch, i)
            except BrokenMessageError as error:
                i += 1
                self._n_broken += 1
                self._reason = self._reason or str(error)

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

    def _reserve(self, n: int) -> None:
        """Make room for n more returns."""
        old = self._out
        if self._n + n <= len(old.rings):
            return
        likely = self._size // self._layout.step if not self._n else 2 * len(old.rings)
        self._out = Columns.empty(max(likely, self._n + n))
        self._out.put(0, old.taken(slice(self._n)))

    def _add_one(self, octets: Octets, head: _Head, log_time: int) -> None:
        """Append the returns of one message, whatever its layout."""
        points, n = _points(octets, head, self._layout.step)
        self._reserve(n)
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
        span, fault = pulse_times(times, stamp, stamps)
        is_ascending = bool((stamps[1:] >= stamps[:-1]).all())
        return (n, span, self._has_times_of(n, span, fault), is_ascending)

    def _has_times_of(self, n: int, span: int, fault: str) -> int:
        """Return 1 if the times of a message are usable, 0 if not, -1 if they are too few."""
        self._time_fault = self._time_fault or fault
        return int(not fault) if n >= PULSES_MIN or span else -1

    def _add_clouds(self, octets: Octets, clouds: Nanos, log_times_ns: Nanos) -> None:
        """Append the returns of messages of one layout that the compiled loop reads."""
        n_points = clouds[:, 1]
        self._reserve(int(n_points.sum()))
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
        kept = np.ones((len(n), 4), np.int64)
        kept[:, 0], kept[:, 3] = n, is_ascending
        if self._layout.time is None:
            return kept, np.zeros(len(n), np.bool_)
        kept[:, 1], is_plain = plain_spans(self._layout.time.kind, low, high, n_zeros, n)
        return kept, is_plain

    def _corrected(self, octets: Octets, cloud: list[int], tally: Tally, k: int) -> tuple[int, ...]:
        """Correct the instants of cloud k if its times are unusable; return its columns."""
        begin, n_points, stamp, row = cloud
        n, low, high, n_zeros, is_ascending, _ = (column[k].item() for column in tally)
        time, fault = self._layout.time, ""
        span: int | None = 0
        if n and time is None:
            fault = NO_FIELD
        elif n and time is not None:
            fault = fault_of(low, high, n_zeros, n)
            span = 0 if fault else plain_span(time.kind, low, high)
        if span is None:
            points = octets[begin : begin + n_points * self._layout.step]
            return self._unpack_one(points, stamp, row, n_points)
        if fault:
            self._out.stamps[row : row + n] = stamp
        has_times = self._has_times_of(n, span, fault)
        return (n, span, has_times, bool(fault) or is_ascending)

    def _close_gaps(self, rows: Nanos, counts: Nanos) -> None:
        """Close the gaps behind clouds with points that are no returns."""
        for row, n in zip(rows.tolist(), counts.tolist(), strict=True):
            if row != self._n:
                self._out.put(self._n, self._out.taken(slice(row, row + n)))
            self._n += n

    def stamped_at_end(self) -> Returns:
        """Return all returns, where the stamp of a message is the instant of its last point."""
        messages = self._near([])
        shifts = messages.spans_ns
        self._out.stamps[: self._n] -= np.repeat(shifts, messages.counts)
        self._parts = [messages._replace(stamps_ns=messages.stamps_ns - shifts)]
        return self.returns()

    def returns(self) -> Returns:
        """Return all returns, in the order of their instants."""
        notes = [*broken_note(self._topic, self._n_broken, self._reason)]
        messages = self._in_unit(self._near(notes), notes)
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

    def _in_unit(self, messages: _Messages, notes: list[str]) -> _Messages:
        """Take whole times as micro- or milliseconds where that makes clouds last until the next.

        A LiDAR that scans without a pause fills the time between its messages; as nanoseconds its
        times would fill a thousandth of it, or a millionth.
        """
        time, stamps = self._layout.time, np.unique(messages.stamps_ns)
        span = float(np.median(messages.spans_ns)) if len(stamps) > 2 else 0.0
        if time is None or time.kind[0] not in "iu" or span <= 0.0:
            return messages
        ratio = float(np.median(np.diff(stamps))) / span
        unit = next((one for one in _UNITS if _FILLED[0] < ratio / one < _FILLED[1]), None)
        if unit is None:
            return messages
        out, starts = self._out.stamps[: self._n], np.repeat(messages.stamps_ns, messages.counts)
        out[:] = starts + (out - starts) * unit
        name = "microseconds" if unit == _UNITS[0] else "milliseconds"
        notes.append(f"The times of {self._topic} are taken as {name}: they fill its messages so.")
        return messages._replace(spans_ns=messages.spans_ns * unit)

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
