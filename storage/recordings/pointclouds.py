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
from storage.recordings.families import BrokenMessageError, Returns, broken_note

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
_REVOLUTION_LIMIT = 10.0  # [s] no message spans more; a larger time has another meaning
_EPOCH = 1e6  # [s] a larger time is absolute
_EPOCH_NS = 1e15  # the same in nanoseconds
_SHOTS_MIN = 32  # points that a message needs before its times can be judged
_ZEROS_MAX = 0.25  # share of zero times that a message with times may have
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


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _Cloud:
    """The head of one message, and where its points are."""

    stamp_ns: int
    frame: str
    fields: dict[str, _Field]
    order: str
    n: int
    step: int
    points: Octets


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

    def __init__(self, channel: Channel) -> None:
        """Start without messages."""
        self._topic = channel.topic
        self._frame = ""
        self._fields: dict[str, _Field] = {}
        self._n = 0
        self._p = np.empty((_FIRST_CAPACITY, 3), np.float32)
        self._intensities = np.empty(_FIRST_CAPACITY, np.float32)
        self._rings = np.empty(_FIRST_CAPACITY, np.uint8)
        self._stamps = np.empty(_FIRST_CAPACITY, np.int64)
        self._messages = _Messages()
        self._has_bad_rings = False
        self._time_fault = ""
        self._n_broken = 0
        self._reason = ""

    def add(self, batch: Batch) -> None:
        """Take some messages."""
        for octets, log_time in batch:
            try:
                self._add(_head(octets), log_time)
            except BrokenMessageError as error:
                self._n_broken += 1
                self._reason = self._reason or str(error)

    def _add(self, cloud: _Cloud, log_time: int) -> None:
        """Append the returns of one message."""
        self._reserve(cloud.n)
        self._frame, self._fields = cloud.frame, cloud.fields
        start = self._n
        times = self._unpack(cloud)
        stamps, fault = _shot_times(times, cloud.stamp_ns)
        self._stamps[start : self._n] = cloud.stamp_ns if stamps is None else stamps
        self._time_fault = self._time_fault or fault
        latest = 0 if stamps is None or not len(stamps) else int(stamps.max()) - cloud.stamp_ns
        kept = self._messages
        kept.starts.append(start)
        kept.stamps_ns.append(cloud.stamp_ns)
        kept.log_times_ns.append(log_time)
        kept.spans_ns.append(latest)
        is_telling = self._n - start >= _SHOTS_MIN or bool(latest)
        kept.has_times.append(stamps is not None if is_telling else None)

    def _reserve(self, n: int) -> None:
        """Make room; memory that is reserved but not written costs nothing."""
        if self._n + n <= len(self._p):
            return
        capacity = max(4 * len(self._p), self._n + n)
        for name in ("_p", "_intensities", "_rings", "_stamps"):
            old = getattr(self, name)
            new = np.empty((capacity, *old.shape[1:]), old.dtype)
            new[: self._n] = old[: self._n]
            setattr(self, name, new)

    def _unpack(self, cloud: _Cloud) -> NDArray[np.generic] | None:
        """Write the returns of a cloud behind the others; return their times as recorded."""
        x = _common_layout(cloud)
        if x is None:
            return self._unpack_any(cloud)
        times = np.empty(cloud.n, np.uint32)
        end = self._n + cloud.n
        kept, is_bad = _unpack_kernel(
            cloud.points,
            np.array([cloud.n, cloud.step, *x], np.int64),
            self._p[self._n : end].view(np.uint32),
            self._intensities[self._n : end].view(np.uint32),
            self._rings[self._n : end],
            times,
        )
        self._n += kept
        self._has_bad_rings |= bool(is_bad)
        time = _named(cloud.fields, _TIMES)
        return None if time is None else times[:kept].view(time.kind)

    def _unpack_any(self, cloud: _Cloud) -> NDArray[np.generic] | None:
        """Do the same for any layout."""
        points = _structured(cloud)
        with np.errstate(over="ignore", invalid="ignore"):
            p = np.stack([points[axis] for axis in "xyz"], axis=1).astype(np.float32)
        keep = np.isfinite(p).all(axis=1) & p.any(axis=1)
        rows = slice(self._n, self._n + int(keep.sum()))
        self._p[rows] = p[keep]
        names = points.dtype.names or ()
        intensities = points["intensity"][keep] if "intensity" in names else np.float32(0)
        self._intensities[rows] = np.nan_to_num(intensities, posinf=0.0, neginf=0.0)
        rings = points["ring"][keep] if "ring" in names else np.array(RING_UNKNOWN)
        outside = (rings < 0) | (rings >= RING_UNKNOWN)
        self._has_bad_rings |= bool("ring" in names and outside.any())
        self._rings[rows] = np.where(outside, RING_UNKNOWN, rings).astype(np.uint8)
        self._n = rows.stop
        return points["time"][keep] if "time" in names else None

    def returns(self) -> Returns:
        """Give all returns, in the order of their instants."""
        n = self._n
        notes = [*broken_note(self._topic, self._n_broken, self._reason)]
        messages_ns = self._message_stamps(notes)
        has_times = self._has_times(notes, messages_ns)
        if _named(self._fields, _INTENSITIES) is None:
            notes.append(f"The points of {self._topic} carry no intensity; it is taken as 0.")
        if self._has_bad_rings:
            self._rings[:n] = RING_UNKNOWN
            notes.append(f"{self._topic} has rings outside 0 to {RING_UNKNOWN - 1}; none is used.")
        elif _named(self._fields, _RINGS) is None:
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

    def _message_stamps(self, notes: list[str]) -> Nanos:
        """Return the stamp of each message; without any, put the times of recording instead."""
        kept = self._messages
        stamps = np.array(kept.stamps_ns, np.int64)
        if stamps.any() or not len(stamps):
            return stamps
        shifts = np.array(kept.log_times_ns, np.int64) - np.array(kept.spans_ns, np.int64)
        if shifts.any():
            self._stamps[: self._n] += np.repeat(shifts, self._counts())
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
        if _named(self._fields, _TIMES) is None:
            fault = f"it has the fields {', '.join(self._fields) or 'none'}"
        else:
            fault = self._time_fault or "its messages are too small to tell"
        notes.append(f"The points of {self._topic} carry no time of their own: {fault}.")
        self._stamps[: self._n] = np.repeat(messages_ns, self._counts())
        return False


def _head(octets: Octets) -> _Cloud:
    """Read the head of a cloud and check it against the bytes that are there."""
    cursor = cdr.Cursor(octets)
    stamp, frame = cursor.stamp_ns(), cursor.text().lstrip("/")
    height, width = cursor.number("I"), cursor.number("I")
    fields = dict(_field(cursor) for _ in range(cursor.count(13)))
    order = ">" if cursor.number("B") else "<"
    step, row_step = cursor.number("I"), cursor.number("I")
    size = cursor.count()
    points = octets[cursor.at : cursor.at + size]
    if width and height > 1 and row_step != width * step:
        points = _without_padding(points, height, width * step, row_step)
    n = width * height
    if n * step > len(points):
        raise BrokenMessageError(f"it declares {n:,} points of {step} bytes in {len(points):,}")
    return _Cloud(
        stamp_ns=stamp,
        frame=frame,
        fields=_checked(fields, step),
        order=order,
        n=n,
        step=step,
        points=points,
    )


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


def _without_padding(points: Octets, height: int, used: int, row_step: int) -> Octets:
    """Drop the padding behind each row of an organised cloud."""
    if row_step < used or row_step * (height - 1) + used > len(points):
        raise BrokenMessageError(f"its {height:,} rows of {row_step:,} bytes do not fit its data")
    rows = np.zeros((height, row_step), np.uint8)
    rows.ravel()[: len(points)] = points[: rows.size]
    return np.ascontiguousarray(rows[:, :used]).ravel()


def _named(fields: dict[str, _Field], names: tuple[str, ...]) -> _Field | None:
    """Return the first field that has one of the names, in any case."""
    lower = {name.lower(): one for name, one in fields.items()}
    return next((lower[name] for name in names if name in lower), None)


def _common_layout(cloud: _Cloud) -> list[int] | None:
    """Return what the compiled loop must know of the fields, or nothing if it cannot do them."""
    x, y, z = (cloud.fields[axis] for axis in "xyz")
    intensity, ring, time = (_named(cloud.fields, n) for n in (_INTENSITIES, _RINGS, _TIMES))
    allowed = ((x, "f4"), (y, "f4"), (z, "f4"), (intensity, "f4"), (ring, "u1u2"), (time, "f4u4"))
    if cloud.order == ">" or any(one and one.kind not in kinds for one, kinds in allowed):
        return None
    wide = 2 if ring and ring.kind == "u2" else 1
    optional = [one.offset if one else -1 for one in (intensity, ring, time)]
    return [x.offset, y.offset, z.offset, *optional, wide]


def _structured(cloud: _Cloud) -> NDArray[np.void]:
    """View the points of a cloud under our own names for their fields."""
    found = {
        **{axis: cloud.fields[axis] for axis in "xyz"},
        "intensity": _named(cloud.fields, _INTENSITIES),
        "ring": _named(cloud.fields, _RINGS),
        "time": _named(cloud.fields, _TIMES),
    }
    fields = {name: one for name, one in found.items() if one is not None}
    kind = np.dtype(
        {
            "names": list(fields),
            "formats": [cloud.order + one.kind for one in fields.values()],
            "offsets": [one.offset for one in fields.values()],
            "itemsize": cloud.step,
        }
    )
    return np.frombuffer(cloud.points[: cloud.n * cloud.step], kind)


def _shot_times(times: NDArray[np.generic] | None, stamp_ns: int) -> tuple[Nanos | None, str]:
    """Return the instant of each return, or why its times are of no use.

    Drivers write float32 seconds since the stamp (Velodyne), whole nanoseconds since it (Ouster,
    Livox), or absolute float64 seconds (Hesai, RoboSense) or nanoseconds: told by type and size.
    """
    if times is None:
        return None, ""
    if not len(times):
        return np.empty(0, np.int64), ""
    low, high = float(times.min()), float(times.max())
    if not np.isfinite((low, high)).all():
        return None, "some of its times are not finite"
    if low == high and len(times) >= _SHOTS_MIN:
        return None, f"its times are all {low:g}"
    if len(times) >= _SHOTS_MIN and np.count_nonzero(times) < (1 - _ZEROS_MAX) * len(times):
        return None, f"{len(times) - np.count_nonzero(times):,} of {len(times):,} times are 0"
    offsets = _offsets_ns(times, low, high, stamp_ns)
    if offsets is None:
        return None, f"its times run from {low:g} to {high:g}, which is neither s nor ns"
    return offsets + stamp_ns, ""


def _offsets_ns(times: NDArray[np.generic], low: float, high: float, stamp_ns: int) -> Nanos | None:
    """Return nanoseconds since the stamp, or nothing if the times make no sense."""
    is_whole = times.dtype.kind in "iu"
    if low > (_EPOCH_NS if is_whole or low > _EPOCH_NS else _EPOCH):
        absolute = _absolute_ns(times)
        # A driver may stamp points by the sensor's clock and messages by the computer's.
        far = stamp_ns and abs(int(absolute[0]) - stamp_ns) > _REVOLUTION_LIMIT * 1e9
        return absolute - (int(absolute.min()) if far else stamp_ns)
    scale = 1.0 if is_whole else 1e9
    if max(abs(low), abs(high)) * scale > _REVOLUTION_LIMIT * 1e9:
        return None
    return np.rint(times.astype(np.float64) * scale).astype(np.int64)


def _absolute_ns(times: NDArray[np.generic]) -> Nanos:
    """Return absolute times, in seconds or nanoseconds, as nanoseconds."""
    if times.dtype.kind in "iu" or float(times.min()) > _EPOCH_NS:
        return times.astype(np.int64)
    seconds = np.floor(times.astype(np.float64))
    fractions = np.rint((times.astype(np.float64) - seconds) * 1e9)
    return np.asarray(seconds.astype(np.int64) * 1_000_000_000 + fractions.astype(np.int64))


@numba.njit(cache=True, nogil=True)
def _word(octets, at):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Read four bytes, little endian, at any address."""
    return (
        np.uint32(octets[at])
        | np.uint32(octets[at + 1]) << np.uint32(8)
        | np.uint32(octets[at + 2]) << np.uint32(16)
        | np.uint32(octets[at + 3]) << np.uint32(24)
    )


@numba.njit(cache=True, nogil=True)
def _unpack_kernel(octets, layout, p, intensities, rings, times):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Copy the bits of finite returns away from the origin; return their number.

    Works on bits, so that one compiled version serves float32 and uint32 and any alignment.
    """
    n, step, x, y, z, intensity, ring, time, wide = layout
    exponent, magnitude = np.uint32(0x7F800000), np.uint32(0x7FFFFFFF)
    kept = 0
    is_bad = False
    for i in range(n):
        at = i * step
        a, b, c = _word(octets, at + x), _word(octets, at + y), _word(octets, at + z)
        if ((a | b | c) & magnitude) == 0:
            continue
        if (a & exponent) == exponent or (b & exponent) == exponent or (c & exponent) == exponent:
            continue
        p[kept, 0], p[kept, 1], p[kept, 2] = a, b, c
        bits = np.uint32(0) if intensity < 0 else _word(octets, at + intensity)
        intensities[kept] = np.uint32(0) if (bits & exponent) == exponent else bits
        laser = 255 if ring < 0 else np.int64(octets[at + ring])
        if ring >= 0 and wide == 2:
            laser |= np.int64(octets[at + ring + 1]) << 8
        if ring >= 0 and laser > 254:
            is_bad = True
        rings[kept] = laser & 255
        times[kept] = np.uint32(0) if time < 0 else _word(octets, at + time)
        kept += 1
    return kept, is_bad
