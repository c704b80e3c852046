"""From the bytes of points to columns.

Fields are found by name, at any offset and of any type. The common layout (little endian, float32
coordinates) is unpacked by one compiled loop, cloud by cloud on two threads; all others by NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import RING_UNKNOWN, Array, Column, Index, Mask, Nanos, Rings
from spheremark.pipelines.threads import by_turns
from spheremark.storage.recordings import cdr
from spheremark.storage.recordings.container import Batch, Channel
from spheremark.storage.recordings.families import BrokenMessageError, broken_note
from spheremark.storage.recordings.records import Octets

_KINDS = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")  # by PointField.datatype
_INTENSITIES = ("intensity", "i", "reflectivity", "signal")
_RINGS = ("ring", "channel", "line", "laser_id", "laserid")
_TIMES = ("time", "t", "timestamp", "time_stamp", "offset_time", "time_offset", "timeoffset")
_FIELD_MIN = 13  # [bytes] of a field with an empty name
_STEP_MAX = 1 << 16  # [bytes] of a point; drivers write 12 to 48
_PAGE = 1 << 21  # [bytes] of a large page of memory: fewer pages, fewer page faults
_WORTH = 4  # clouds that two threads unpack sooner than one
_PIECE = 8  # clouds that a thread takes at a time
_PULSE_NS = 1_000_000  # [ns] between the echoes of a pulse, and far less than a revolution
_DOUBLE_SAMPLE = 8_192  # returns: a third of a revolution of a VLP-16
_DOUBLE_MIN = 0.01  # of them; none is double where each pulse has one return
_MIXING = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
_BLOCK = 512  # points: few enough for the nearest cache
_EXPONENT = np.uint32(0x7F800000)  # bits of a float32; all are set where it is not finite
_MAGNITUDE = np.uint32(0x7FFFFFFF)


class Columns(NamedTuple):
    """Returns, as many as there is room for."""

    p: Column
    intensities: Column
    rings: Rings
    stamps: Nanos

    @classmethod
    def empty(cls, n: int) -> Columns:
        """Reserve room; memory that is not written costs nothing."""
        p, others = _reserved(12 * n), _reserved(13 * n)  # the others may outlive the points
        return cls(
            p.view(np.float32).reshape(n, 3),
            others[8 * n : 12 * n].view(np.float32),
            others[12 * n :],
            others[: 8 * n].view(np.int64),
        )

    def taken(self, rows: slice | Index) -> Columns:
        """Return some of the returns."""
        p, intensities, rings, stamps = self
        return Columns(p[rows], intensities[rows], rings[rows], stamps[rows])

    def put(self, row: int, other: Columns) -> None:
        """Write returns from a row on."""
        rows = slice(row, row + len(other.rings))
        self.p[rows], self.intensities[rows] = other.p, other.intensities
        self.rings[rows], self.stamps[rows] = other.rings, other.stamps

    def in_order(self, counts: Index) -> Columns:
        """Return the returns in the order of their instants; mostly they are in it already."""
        ends = np.cumsum(counts)
        stamps = self.stamps[: int(counts.sum())]
        begins = (ends - counts)[(counts > 0) & (ends > counts)]
        if (stamps[begins] >= stamps[begins - 1]).all():
            return self.taken(slice(len(stamps)))
        return self.taken(np.argsort(stamps, kind="stable"))

    def once(self) -> Columns:
        """Return each return once that both echoes of one pulse show, with its instant."""
        n = len(self.rings)
        low = np.uint64(n.bit_length())  # bits that hold the row, so that equal keys stay in order
        rows = np.arange(n, dtype=np.uint64)
        keys = np.sort((self._keys(slice(None)) >> low << low) | rows)
        mask = np.uint64((1 << n.bit_length()) - 1)
        twice = np.flatnonzero(keys[1:] >> low == keys[:-1] >> low)
        one, other = ((keys[at] & mask).astype(np.intp) for at in (twice, twice + 1))
        is_same = self.stamps[other] - self.stamps[one] < _PULSE_NS
        is_same &= (self.p[one] == self.p[other]).all(axis=1)
        keep = np.ones(n, np.bool_)
        keep[other[is_same]] = False
        return self.taken(np.flatnonzero(keep))

    def are_double(self) -> bool:
        """Return whether returns occur twice at the beginning, where no LiDAR comes back yet."""
        keys = self._keys(slice(_DOUBLE_SAMPLE))
        return len(np.unique(keys)) < (1.0 - _DOUBLE_MIN) * len(keys)

    def _keys(self, rows: slice) -> NDArray[np.uint64]:
        """Return numbers that are equal for equal coordinates, and hardly for others."""
        bits = np.ascontiguousarray(self.p[rows]).view(np.uint32).astype(np.uint64)
        return np.asarray(bits @ _MIXING)


def _reserved(size: int) -> Octets:
    """Return bytes that begin at a large page."""
    block = np.empty(size + _PAGE, np.uint8)
    begin = -block.ctypes.data % _PAGE
    return block[begin : begin + size]


class ReturnsDecoder:
    """Decoder of a LiDAR topic: counts broken messages; subclasses append the returns of others."""

    def __init__(self, channel: Channel, size: int) -> None:
        """Start without messages."""
        self._topic = channel.topic
        self._size = size
        self._frame = ""
        self._n = 0
        self._out = Columns.empty(0)
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
        """Append message i, and those behind it that begin alike; return how many these are."""
        raise NotImplementedError

    def _reserve(self, n: int, n_likely: float) -> None:
        """Make room for n more returns, the first time for as many as are likely."""
        old = self._out
        if self._n + n <= len(old.rings):
            return
        room = 2 * len(old.rings) if self._n else round(n_likely)
        self._out = Columns.empty(max(room, self._n + n))
        self._out.put(0, old.taken(slice(self._n)))

    def _broken(self) -> tuple[str, ...]:
        """Return the sentence about broken messages, if there were any."""
        return broken_note(self._topic, self._n_broken, self._reason)


class Tally(NamedTuple):
    """Counts and extreme times of clouds, a column each; times as they were recorded."""

    n_returns: Nanos
    earliest: Array
    latest: Array  # infinite if a time is not finite
    n_zeros: Nanos
    is_ascending: Mask
    has_bad_ring: Mask


@dataclass(frozen=True, slots=True, kw_only=True)
class Field:
    """One field of a point.

    Attributes
    ----------
    offset : int
        Its first byte in the point.
    kind : str
        Its NumPy type, without the order of bytes.
    """

    offset: int
    kind: str

    @property
    def end(self) -> int:
        """First byte behind the field."""
        return self.offset + np.dtype(self.kind).itemsize


@dataclass(frozen=True, kw_only=True)
class Layout:
    """The fields of a point, and their description in a message.

    Attributes
    ----------
    description : bytes
        The description as it stands in a message.
    fields : dict of str to Field
        By the names of the driver.
    order : str
        Of bytes: ``<`` or ``>``.
    step : int
        From a point to the next [bytes].
    """

    description: bytes
    fields: dict[str, Field]
    order: str
    step: int

    @cached_property
    def intensity(self) -> Field | None:
        """The field of the reflectivity, if there is one."""
        return self._named(_INTENSITIES)

    @cached_property
    def ring(self) -> Field | None:
        """The field of the laser, if there is one."""
        return self._named(_RINGS)

    @cached_property
    def time(self) -> Field | None:
        """The field of the time, if there is one."""
        return self._named(_TIMES)

    def _named(self, names: tuple[str, ...]) -> Field | None:
        """Return the first field that has one of the names, in any case."""
        lower = {name.lower(): one for name, one in self.fields.items()}
        return next((lower[name] for name in names if name in lower), None)

    @cached_property
    def compiled(self) -> Nanos | None:
        """Parameters of the compiled loop; None if it does not support this layout."""
        x, y, z = (self.fields[axis] for axis in "xyz")
        intensity, ring, time = self.intensity, self.ring, self.time
        allowed = (
            *((axis, ("f4",)) for axis in (x, y, z, intensity)),
            (ring, ("u1", "u2")),
            (time, ("f4", "u4")),
        )
        if self.order == ">" or any(one and one.kind not in kinds for one, kinds in allowed):
            return None
        is_wide = ring is not None and ring.kind == "u2"
        is_whole = time is not None and time.kind == "u4"
        places = [one.offset if one else -1 for one in (x, y, z, intensity, ring, time)]
        return np.array([self.step, *places, is_wide, is_whole], np.int64)

    @cached_property
    def structured(self) -> np.dtype[np.void]:
        """The NumPy type of a point, with fixed names of the fields."""
        found = {
            **{axis: self.fields[axis] for axis in "xyz"},
            "intensity": self.intensity,
            "ring": self.ring,
            "time": self.time,
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


def read_layout(cursor: cdr.Cursor, octets: Octets) -> Layout:
    """Read the description of a point."""
    begin = cursor.at
    fields = dict(_field(cursor) for _ in range(cursor.count(_FIELD_MIN)))
    order = ">" if cursor.number("B") else "<"
    step = cursor.number("I")
    description = octets[begin : cursor.at].tobytes()
    return Layout(description=description, fields=_checked(fields, step), order=order, step=step)


def _field(cursor: cdr.Cursor) -> tuple[str, Field]:
    """Read one field's name, place and type."""
    name, offset = cursor.text(), cursor.number("I")
    datatype = cursor.number("B")
    cursor.number("I")
    if not 0 < datatype < len(_KINDS):
        raise BrokenMessageError(f"its field {name!r} has the unknown datatype {datatype}")
    return name, Field(offset=offset, kind=_KINDS[datatype])


def _checked(fields: dict[str, Field], step: int) -> dict[str, Field]:
    """Return the fields if coordinates are among them and all lie inside a point."""
    missing = [axis for axis in "xyz" if axis not in fields]
    if missing:
        raise BrokenMessageError(f"it has no field {missing[0]!r}, only {', '.join(fields)}")
    if step > _STEP_MAX:
        raise BrokenMessageError(f"its points would have {step:,} bytes each")
    for name, one in fields.items():
        if one.end > step:
            raise BrokenMessageError(f"its field {name!r} lies outside the {step} bytes of a point")
    return fields


def unpack_any(
    points: Octets, layout: Layout, out: Columns
) -> tuple[int, NDArray[np.generic] | None, bool]:
    """Write the returns of one cloud of any layout, without their instants."""
    rows = np.frombuffer(points, layout.structured)
    with np.errstate(over="ignore", invalid="ignore"):
        p = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float32)
        keep = np.isfinite(p).all(axis=1) & p.any(axis=1)
    n = int(keep.sum())
    out.p[:n] = p[keep]
    intensities = rows["intensity"][keep] if layout.intensity else np.float32(0)
    out.intensities[:n] = np.nan_to_num(intensities, posinf=0.0, neginf=0.0)
    rings = rows["ring"][keep] if layout.ring else np.array(RING_UNKNOWN)
    is_ring = (rings >= 0) & (rings < RING_UNKNOWN)
    out.rings[:n] = np.where(is_ring, rings, RING_UNKNOWN).astype(np.uint8)
    times = rows["time"][keep] if layout.time else None
    return n, times, bool(layout.ring and not is_ring.all())


def unpack_clouds(octets: Octets, clouds: Nanos, layout: Layout, out: Columns) -> Tally:
    """Write the returns of clouds and their instants, each from a row of its own on."""
    tallies, parameters = np.empty((len(clouds), 6)), layout.compiled
    p, intensities, rings, stamps = out
    columns = (p.view(np.uint32).ravel(), intensities.view(np.uint32), rings, stamps)

    def unpack(begin: int, end: int) -> None:
        rows = slice(begin, end)
        _clouds_kernel(octets, clouds[rows], parameters, columns, tallies[rows])

    by_turns(unpack, len(clouds), size=_PIECE, threaded_from=_WORTH)
    n, low, high, zeros, n_descents, n_bad = tallies.T
    n_returns, n_zeros = n.astype(np.int64), zeros.astype(np.int64)
    return Tally(n_returns, low, high, n_zeros, n_descents == 0, n_bad > 0)


@compiled
def _word(octets, at):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Read four bytes, little endian, at any address; unsigned places let it be one load."""
    return (
        np.uint32(octets[at])
        | np.uint32(octets[at + np.uint64(1)]) << np.uint32(8)
        | np.uint32(octets[at + np.uint64(2)]) << np.uint32(16)
        | np.uint32(octets[at + np.uint64(3)]) << np.uint32(24)
    )


@compiled
def _clouds_kernel(octets, clouds, layout, columns, tallies):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Unpack clouds; count their returns, zero times, descents and bad rings; extreme times."""
    times = np.empty(_BLOCK, np.uint32)
    for k in range(len(clouds)):
        n, low, high, n_zeros, n_descents, n_bad = _cloud_kernel(
            octets, clouds[k], layout, columns, times
        )
        tallies[k, 0], tallies[k, 1], tallies[k, 2] = n, low, high
        tallies[k, 3], tallies[k, 4], tallies[k, 5] = n_zeros, n_descents, n_bad


@compiled
def _cloud_kernel(octets, cloud, layout, columns, times):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Copy the bits of finite returns away from the origin, and add their times to the stamp.

    Works on bits, so that one compiled version serves any alignment, and block by block, in loops
    that the compiler can vectorise.
    """
    p, intensities, rings, stamps = columns
    is_whole = layout[8] != 0
    at, stamp, row, end = cloud[0], cloud[2], cloud[3], cloud[3]
    low, high, n_zeros, n_descents, n_bad = np.int32(0x7FFFFFFF), np.int32(-0x7FFFFFFF), 0, 0, 0
    for done in range(0, cloud[1], _BLOCK):
        n = min(_BLOCK, cloud[1] - done)
        _copy_block(octets, at + done * layout[0], layout, (p, intensities, rings, times), end, n)
        if _may_be_none(p, end, n):
            n = _close_up(p, intensities, rings, times, end, n)
        _void(intensities, end, n)
        _date(times, n, is_whole, stamp, stamps, end)
        low, high, n_zero = _extremes(times, n, is_whole, low, high)
        n_zeros += n_zero
        n_descents += _n_descents(stamps, max(end, row + 1), end + n)
        n_bad += _n_unknown(rings, end, n) if layout[5] >= 0 else 0
        end += n
    return end - row, _time(low, is_whole), _time(high, is_whole), n_zeros, n_descents, n_bad


@compiled
def _copy_block(octets, at, layout, columns, row, n):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Copy n points to columns, whether or not they are returns."""
    step, x, y, z, intensity, ring, time, is_wide, _ = layout
    p, intensities, rings, times = columns
    _copy_coordinates(octets, (at + x, at + y, at + z), step, p, 3 * row, n)
    places = (at + max(intensity, 0), at + max(ring, 0), at + max(time, 0))
    _copy_others(octets, places, step, is_wide, (intensities, rings, times), row, n)
    if intensity < 0:
        intensities[row : row + n] = 0
    if ring < 0:
        rings[row : row + n] = RING_UNKNOWN
    if time < 0:
        times[:n] = 0


@compiled
def _copy_coordinates(octets, places, step, p, first, n):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Copy coordinates from strided bytes."""
    x, y, z = np.uint64(places[0]), np.uint64(places[1]), np.uint64(places[2])
    for i in range(np.uint64(first), np.uint64(first + 3 * n), np.uint64(3)):
        p[i] = _word(octets, x)
        p[i + np.uint64(1)] = _word(octets, y)
        p[i + np.uint64(2)] = _word(octets, z)
        x += np.uint64(step)
        y += np.uint64(step)
        z += np.uint64(step)


@compiled
def _copy_others(octets, places, step, is_wide, columns, row, n):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0913
    """Copy intensities, rings and times; rings beyond the last become unknown."""
    intensities, rings, times = columns
    intensity, ring, time = np.uint64(places[0]), np.uint64(places[1]), np.uint64(places[2])
    second, shift = ring + np.uint64(is_wide), np.uint32(8 * is_wide)
    k = np.uint64(0)
    for i in range(np.uint64(row), np.uint64(row + n)):
        intensities[i] = _word(octets, intensity)
        times[k] = _word(octets, time)
        laser = np.uint32(octets[ring]) | np.uint32(octets[second]) << shift
        rings[i] = np.uint8(min(laser, np.uint32(RING_UNKNOWN)))
        k += np.uint64(1)
        intensity += np.uint64(step)
        time += np.uint64(step)
        ring += np.uint64(step)
        second += np.uint64(step)


@compiled
def _may_be_none(p, row, n):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Return whether a coordinate is zero or not finite: then some points may be no returns."""
    n_odd = 0
    for i in range(np.uint64(3 * row), np.uint64(3 * (row + n))):
        n_odd += (p[i] & _MAGNITUDE) - np.uint32(1) >= _EXPONENT - np.uint32(1)
    return n_odd > 0


@compiled
def _close_up(p, intensities, rings, times, row, n):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Move the returns of a block to its first rows; return their number."""
    kept = 0
    for i in range(n):
        a, b, c = p[3 * (row + i)], p[3 * (row + i) + 1], p[3 * (row + i) + 2]
        to = row + kept
        p[3 * to], p[3 * to + 1], p[3 * to + 2] = a, b, c
        intensities[to], rings[to], times[kept] = intensities[row + i], rings[row + i], times[i]
        is_finite = (a & _EXPONENT) != _EXPONENT and (b & _EXPONENT) != _EXPONENT
        is_finite = is_finite and (c & _EXPONENT) != _EXPONENT
        kept += is_finite and ((a | b | c) & _MAGNITUDE) != 0
    return kept


@compiled
def _void(intensities, row, n):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Replace intensities that are not finite by zero."""
    for i in range(np.uint64(row), np.uint64(row + n)):
        value = intensities[i]
        intensities[i] = np.uint32(0) if (value & _EXPONENT) == _EXPONENT else value


@compiled
def _date(times, n, is_whole, stamp, stamps, row):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Write instants from times since a stamp: whole nanoseconds, or the bits of seconds."""
    first = np.uint64(row)
    if is_whole:
        for i in range(np.uint64(n)):
            stamps[first + i] = stamp + np.int64(times[i])
        return
    seconds = times.view(np.float32)
    for i in range(np.uint64(n)):
        stamps[first + i] = stamp + np.int64(np.rint(np.float64(seconds[i]) * 1e9))


@compiled
def _extremes(times, n, is_whole, low, high):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Return the extreme times as integers of the same order, not finite ones outermost, and zeros.

    Comparisons of integers vectorise better than those of floating numbers.
    """
    n_zeros, sign = 0, np.uint32(0) if is_whole else ~_MAGNITUDE
    for i in range(np.uint64(n)):
        order = _ordered(np.int32(times[i]), is_whole)
        low, high = min(low, order), max(high, order)
        n_zeros += (times[i] & ~sign) == 0
    return low, high, n_zeros


@compiled
def _ordered(bits, is_whole):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Turn the bits of an unsigned or floating number to one of the same order, and back."""
    if is_whole:
        return bits ^ np.int32(-0x80000000)
    return bits ^ ((bits >> np.int32(31)) & np.int32(0x7FFFFFFF))


@compiled
def _time(order, is_whole):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Return the recorded time of an integer from ``_ordered``."""
    bits = np.empty(1, np.uint32)
    bits[0] = np.uint32(_ordered(order, is_whole))
    return np.float64(bits[0]) if is_whole else np.float64(bits.view(np.float32)[0])


@compiled
def _n_descents(stamps, begin, end):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Count the instants that are earlier than their predecessor."""
    n = 0
    for i in range(np.uint64(begin), np.uint64(end)):
        n += stamps[i] < stamps[i - np.uint64(1)]
    return n


@compiled
def _n_unknown(rings, row, n):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Count the unknown rings."""
    n_unknown = 0
    for i in range(np.uint64(row), np.uint64(row + n)):
        n_unknown += rings[i] == RING_UNKNOWN
    return n_unknown
