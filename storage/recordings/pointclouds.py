"""sensor_msgs/msg/PointCloud2 in CDR: returns with whatever fields the driver wrote.

Fields are found by name, at any offset and of any type. The common layout (little endian, float32
coordinates) is unpacked by one compiled loop straight from the mapped file; all others by NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numba
import numpy as np
from numpy.typing import NDArray

from pipelines.values import RING_UNKNOWN, Nanos
from storage.recordings import cdr
from storage.recordings.container import Batch, Channel, Octets
from storage.recordings.families import (
    BrokenMessageError,
    Returns,
    broken_note,
    far_note,
    plausible,
)
from storage.recordings.shot_times import SHOTS_MIN, shot_times

SCHEMA = "sensor_msgs/msg/PointCloud2"
DEFINITION = f"""# A collection of N-dimensional points, possibly organised as an image.
{cdr.HEADER}
uint32 height
uint32 width
PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
{cdr.HEADER_PARTS}================================================================================
MSG: sensor_msgs/PointField
uint8 INT8    = 1
uint8 UINT8   = 2
uint8 INT16   = 3
uint8 UINT16  = 4
uint8 INT32   = 5
uint8 UINT32  = 6
uint8 FLOAT32 = 7
uint8 FLOAT64 = 8
string name
uint32 offset
uint8  datatype
uint32 count
"""

_KINDS = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")  # by PointField.datatype
_INTENSITIES = ("intensity", "i", "reflectivity", "signal")
_RINGS = ("ring", "channel", "line", "laser_id", "laserid")
_TIMES = ("time", "t", "timestamp", "time_stamp", "offset_time", "time_offset", "timeoffset")
_FIELD_MIN = 13  # [bytes] of a field with an empty name
_BAD_MAX = 0.05  # share of messages whose times may be unusable before all are
_FIRST_CAPACITY = 1 << 16  # points


@dataclass(frozen=True, slots=True, kw_only=True)
class _Field:
    """One field of a point."""

    offset: int
    kind: str

    @property
    def end(self) -> int:
        """First byte behind the field."""
        return self.offset + np.dtype(self.kind).itemsize


@dataclass(frozen=True, slots=True, kw_only=True)
class _Layout:
    """What a point looks like, and the bytes that said so."""

    said: bytes
    fields: dict[str, _Field]
    order: str
    step: int

    def named(self, names: tuple[str, ...]) -> _Field | None:
        """Return the first field that has one of the names, in any case."""
        lower = {name.lower(): one for name, one in self.fields.items()}
        return next((lower[name] for name in names if name in lower), None)

    def compiled(self) -> NDArray[np.int64] | None:
        """Return what the compiled loop must know, or nothing if it cannot do this layout."""
        x, y, z = (self.fields[axis] for axis in "xyz")
        intensity, ring, time = (self.named(n) for n in (_INTENSITIES, _RINGS, _TIMES))
        allowed = (
            *((axis, ("f4",)) for axis in (x, y, z, intensity)),
            (ring, ("u1", "u2")),
            (time, ("f4", "u4")),
        )
        if self.order == ">" or any(one and one.kind not in kinds for one, kinds in allowed):
            return None
        wide = 2 if ring and ring.kind == "u2" else 1
        optional = [one.offset if one else -1 for one in (intensity, ring, time)]
        return np.array([self.step, x.offset, y.offset, z.offset, *optional, wide], np.int64)

    def structured(self) -> np.dtype[np.void]:
        """Return the type of a point under our own names for its fields."""
        found = {
            **{axis: self.fields[axis] for axis in "xyz"},
            "intensity": self.named(_INTENSITIES),
            "ring": self.named(_RINGS),
            "time": self.named(_TIMES),
        }
        fields = {name: one for name, one in found.items() if one is not None}
        return np.dtype(
            {
                "names": list(fields),
                "formats": [self.order + one.kind for one in fields.values()],
                "offsets": [one.offset for one in fields.values()],
                "itemsize": self.step,
            }
        )


@dataclass(slots=True)
class _Messages:
    """What is kept of each message until all are read."""

    starts: list[int] = field(default_factory=list)
    stamps_ns: list[int] = field(default_factory=list)
    log_times_ns: list[int] = field(default_factory=list)
    spans_ns: list[int] = field(default_factory=list)
    has_times: list[bool | None] = field(default_factory=list)


class PointClouds:
    """Decoder of a topic of point clouds."""

    def __init__(self, channel: Channel, size: int) -> None:
        """Start without messages."""
        self._topic = channel.topic
        self._size = size
        self._frame = ""
        self._layout = _Layout(said=b"", fields={}, order="<", step=0)
        self._compiled: NDArray[np.int64] | None = None
        self._n = 0
        self._p = np.empty((0, 3), np.float32)
        self._intensities = np.empty(0, np.float32)
        self._rings = np.empty(0, np.uint8)
        self._stamps = np.empty(0, np.int64)
        self._messages = _Messages()
        self._has_bad_rings = False
        self._time_fault = ""
        self._n_broken = 0
        self._reason = ""

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
        height, width = cursor.number("I"), cursor.number("I")
        self._read_layout(cursor, octets)
        points = _points(cursor, octets, (height, width), self._layout.step)
        self._frame = frame
        start = self._n
        times = self._unpack(points, height * width)
        span, fault = shot_times(times, stamp, self._stamps[start : self._n])
        self._time_fault = self._time_fault or fault
        kept = self._messages
        kept.starts.append(start)
        kept.stamps_ns.append(stamp)
        kept.log_times_ns.append(log_time)
        kept.spans_ns.append(span)
        is_telling = self._n - start >= SHOTS_MIN or span != 0
        kept.has_times.append(not fault if is_telling else None)

    def _read_layout(self, cursor: cdr.Cursor, octets: Octets) -> None:
        """Read the description of a point, unless it is that of the message before."""
        begin, said = cursor.at, self._layout.said
        if said and octets[begin : begin + len(said)].tobytes() == said:
            cursor.at = begin + len(said)
            return
        fields = dict(_field(cursor) for _ in range(cursor.count(_FIELD_MIN)))
        order = ">" if cursor.number("B") else "<"
        step = cursor.number("I")
        said = octets[begin : cursor.at].tobytes()
        self._layout = _Layout(said=said, fields=_checked(fields, step), order=order, step=step)
        self._compiled = self._layout.compiled()

    def _reserve(self, n: int) -> None:
        """Make room; memory that is reserved but not written costs nothing."""
        if self._n + n <= len(self._p):
            return
        likely = self._size // self._layout.step if not self._n else 2 * len(self._p)
        capacity = max(likely, self._n + n)
        for name in ("_p", "_intensities", "_rings", "_stamps"):
            old = getattr(self, name)
            new = np.empty((capacity, *old.shape[1:]), old.dtype)
            new[: self._n] = old[: self._n]
            setattr(self, name, new)

    def _unpack(self, points: Octets, n: int) -> NDArray[np.generic] | None:
        """Write the returns of a cloud behind the others; return their times as recorded."""
        self._reserve(n)
        if self._compiled is None:
            return self._unpack_any(points, n)
        times = np.empty(n, np.uint32)
        rows = slice(self._n, self._n + n)
        kept, is_bad = _unpack_kernel(
            points,
            self._compiled,
            self._p[rows].view(np.uint32),
            self._intensities[rows].view(np.uint32),
            self._rings[rows],
            times,
        )
        self._n += kept
        self._has_bad_rings |= bool(is_bad)
        time = self._layout.named(_TIMES)
        return None if time is None else times[:kept].view(time.kind)

    def _unpack_any(self, octets: Octets, n: int) -> NDArray[np.generic] | None:
        """Do the same for any layout."""
        points = np.frombuffer(octets[: n * self._layout.step], self._layout.structured())
        with np.errstate(over="ignore", invalid="ignore"):
            p = np.stack([points[axis] for axis in "xyz"], axis=1).astype(np.float32)
        keep = np.isfinite(p).all(axis=1) & p.any(axis=1)
        rows = slice(self._n, self._n + int(keep.sum()))
        self._p[rows] = p[keep]
        names = points.dtype.names or ()
        intensities = points["intensity"][keep] if "intensity" in names else np.float32(0)
        self._intensities[rows] = np.nan_to_num(intensities, posinf=0.0, neginf=0.0)
        rings = points["ring"][keep] if "ring" in names else np.array(RING_UNKNOWN)
        is_ring = (rings >= 0) & (rings < RING_UNKNOWN)
        self._has_bad_rings |= bool("ring" in names and not is_ring.all())
        self._rings[rows] = np.where(is_ring, rings, RING_UNKNOWN).astype(np.uint8)
        self._n = rows.stop
        return points["time"][keep] if "time" in names else None

    def returns(self) -> Returns:
        """Give all returns, in the order of their instants."""
        notes = [*broken_note(self._topic, self._n_broken, self._reason)]
        self._drop_far(notes)
        n = self._n
        messages_ns = self._message_stamps(notes)
        has_times = self._has_times(notes, messages_ns)
        if self._layout.named(_INTENSITIES) is None:
            notes.append(f"The points of {self._topic} carry no intensity; it is taken as 0.")
        if self._has_bad_rings:
            self._rings[:n] = RING_UNKNOWN
            notes.append(f"{self._topic} has rings outside 0 to {RING_UNKNOWN - 1}; none is used.")
        elif self._layout.named(_RINGS) is None:
            notes.append(f"The points of {self._topic} do not tell their laser (ring).")
        stamps = self._stamps[:n]
        is_ascending = bool((stamps[1:] >= stamps[:-1]).all())
        rows = slice(n) if is_ascending else np.argsort(stamps, kind="stable")
        return Returns(
            topic=self._topic,
            frame=self._frame,
            p_lidar=self._p[rows],
            intensities=self._intensities[rows],
            rings=self._rings[rows],
            stamps_ns=self._stamps[rows],
            has_shot_times=has_times,
            message_stamps_ns=np.sort(messages_ns),
            notes=tuple(notes),
        )

    def _drop_far(self, notes: list[str]) -> None:
        """Leave out messages whose stamps cannot be."""
        kept = self._messages
        log_times = np.array(kept.log_times_ns, np.int64)
        near = plausible(np.array(kept.stamps_ns, np.int64), log_times)
        if near.all():
            return
        notes.append(far_note(self._topic, int((~near).sum()), "messages"))
        counts = self._counts()
        rows = np.repeat(near, counts)
        for name in ("_p", "_intensities", "_rings", "_stamps"):
            setattr(self, name, getattr(self, name)[: self._n][rows])
        self._n = int(rows.sum())
        kept.starts = [0, *np.cumsum(counts[near])[:-1].tolist()]
        for name in ("stamps_ns", "log_times_ns", "spans_ns", "has_times"):
            column = getattr(kept, name)
            setattr(kept, name, [one for one, is_near in zip(column, near, strict=True) if is_near])

    def _message_stamps(self, notes: list[str]) -> Nanos:
        """Return the stamp of each message; without any, put the times of recording instead."""
        kept = self._messages
        stamps = np.array(kept.stamps_ns, np.int64)
        if stamps.any() or not len(stamps):
            return stamps
        shifts = np.array(kept.log_times_ns, np.int64) - np.array(kept.spans_ns, np.int64)
        if shifts.any():
            self._stamps[: self._n] += np.repeat(shifts, self._counts())
            kept.stamps_ns = shifts.tolist()
            notes.append(f"{self._topic} has no stamps; the times of recording are used.")
        return shifts

    def _counts(self) -> Nanos:
        """Return the number of returns of each message."""
        edges = np.array([*self._messages.starts, self._n], np.int64)
        return edges[1:] - edges[:-1]

    def _has_times(self, notes: list[str], messages_ns: Nanos) -> bool:
        """Judge the points' times as a whole; without them, each return has its message's stamp."""
        verdicts = [verdict for verdict in self._messages.has_times if verdict is not None]
        verdicts = verdicts or [False]
        if verdicts.count(False) <= _BAD_MAX * len(verdicts):
            return True
        if self._layout.named(_TIMES) is None:
            fault = f"it has the fields {', '.join(self._layout.fields) or 'none'}"
        else:
            fault = self._time_fault or "its messages are too small to tell"
        notes.append(f"The points of {self._topic} carry no time of their own: {fault}.")
        self._stamps[: self._n] = np.repeat(messages_ns, self._counts())
        return False


def _field(cursor: cdr.Cursor) -> tuple[str, _Field]:
    """Read one field's name, place and type."""
    name, offset = cursor.text(), cursor.number("I")
    datatype = cursor.number("B")
    cursor.number("I")
    if not 0 < datatype < len(_KINDS):
        raise BrokenMessageError(f"its field {name!r} has the unknown datatype {datatype}")
    return name, _Field(offset=offset, kind=_KINDS[datatype])


def _checked(fields: dict[str, _Field], step: int) -> dict[str, _Field]:
    """Return the fields if coordinates are among them and all lie inside a point."""
    missing = [axis for axis in "xyz" if axis not in fields]
    if missing:
        raise BrokenMessageError(f"it has no field {missing[0]!r}, only {', '.join(fields)}")
    for name, one in fields.items():
        if one.end > step:
            raise BrokenMessageError(f"its field {name!r} lies outside the {step} bytes of a point")
    return fields


def _points(cursor: cdr.Cursor, octets: Octets, shape: tuple[int, int], step: int) -> Octets:
    """Return the bytes of the points of a cloud of so many rows and columns, without padding."""
    (height, width), row_step = shape, cursor.number("I")
    size = cursor.count()
    points = octets[cursor.at : cursor.at + size]
    if width and height > 1 and row_step != width * step:
        points = _without_padding(points, height, width * step, row_step)
    if height * width * step > len(points):
        raise BrokenMessageError(
            f"it declares {height * width:,} points of {step} bytes in {len(points):,} bytes"
        )
    return points


def _without_padding(points: Octets, height: int, used: int, row_step: int) -> Octets:
    """Drop the padding behind each row of an organised cloud."""
    if row_step < used or row_step * (height - 1) + used > len(points):
        raise BrokenMessageError(f"its {height:,} rows of {row_step:,} bytes do not fit its data")
    rows = np.zeros((height, row_step), np.uint8)
    rows.ravel()[: len(points)] = points[: rows.size]
    return np.ascontiguousarray(rows[:, :used]).ravel()


@numba.njit(cache=True, nogil=True)
def _word(octets, at):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Read four bytes, little endian, at any address; unsigned places let it be one load."""
    return (
        np.uint32(octets[at])
        | np.uint32(octets[at + np.uint64(1)]) << np.uint32(8)
        | np.uint32(octets[at + np.uint64(2)]) << np.uint32(16)
        | np.uint32(octets[at + np.uint64(3)]) << np.uint32(24)
    )


@numba.njit(cache=True, nogil=True)
def _unpack_kernel(octets, layout, p, intensities, rings, times):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Copy the bits of finite returns away from the origin; return their number.

    Works on bits, so that one compiled version serves float32 and uint32 and any alignment.
    """
    step, x, y, z, intensity, ring, time, wide = layout
    exponent, magnitude = np.uint32(0x7F800000), np.uint32(0x7FFFFFFF)
    to_x, to_y, to_z = np.uint64(x), np.uint64(y), np.uint64(z)
    to_intensity, to_ring, to_time = np.uint64(intensity), np.uint64(ring), np.uint64(time)
    at, kept, is_bad = np.uint64(0), np.uint64(0), False
    for _ in range(len(times)):
        a, b, c = _word(octets, at + to_x), _word(octets, at + to_y), _word(octets, at + to_z)
        p[kept, 0], p[kept, 1], p[kept, 2] = a, b, c
        bits = np.uint32(0) if intensity < 0 else _word(octets, at + to_intensity)
        intensities[kept] = np.uint32(0) if (bits & exponent) == exponent else bits
        laser = np.uint32(255) if ring < 0 else np.uint32(octets[at + to_ring])
        if wide == 2:
            laser |= np.uint32(octets[at + to_ring + np.uint64(1)]) << np.uint32(8)
        if ring >= 0 and laser > 254:
            is_bad = True
        rings[kept] = np.uint8(laser)
        times[kept] = np.uint32(0) if time < 0 else _word(octets, at + to_time)
        is_finite = (a & exponent) != exponent and (b & exponent) != exponent
        is_finite = is_finite and (c & exponent) != exponent
        kept += np.uint64(is_finite and ((a | b | c) & magnitude) != 0)
        at += np.uint64(step)
    return kept, is_bad
