"""From the bytes of points to columns: what a point looks like, and how it is unpacked.

Fields are found by name, at any offset and of any type. The common layout (little endian, float32
coordinates) is unpacked by one compiled loop, cloud by cloud on two threads; all others by NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from pipelines.threads import side_by_side
from pipelines.values import RING_UNKNOWN, Column, Index, Nanos, Rings
from storage.recordings import cdr
from storage.recordings.families import BrokenMessageError
from storage.recordings.records import Octets

_KINDS = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")  # by PointField.datatype
_INTENSITIES = ("intensity", "i", "reflectivity", "signal")
_RINGS = ("ring", "channel", "line", "laser_id", "laserid")
_TIMES = ("time", "t", "timestamp", "time_stamp", "offset_time", "time_offset", "timeoffset")
_FIELD_MIN = 13  # [bytes] of a field with an empty name
_RETURN = 25  # [bytes] in columns
_PAGE = 1 << 21  # [bytes] of a large page of memory: the fewer are touched, the fewer are faults
_WORTH = 4  # clouds that two threads unpack sooner than one


class Columns(NamedTuple):
    """Returns, as many as there is room for."""

    p: Column
    intensities: Column
    rings: Rings
    stamps: Nanos

    @classmethod
    def empty(cls, n: int) -> Columns:
        """Reserve room; memory that is not written costs nothing.

        Parameters
        ----------
        n : int
            Number of returns.

        Returns
        -------
        Columns
            Not filled.
        """
        block = np.empty(_RETURN * n + _PAGE, np.uint8)
        block = block[-block.ctypes.data % _PAGE :]
        stamps, p, intensities, rings = np.split(block[: _RETURN * n], [8 * n, 20 * n, 24 * n])
        return cls(
            p.view(np.float32).reshape(n, 3),
            intensities.view(np.float32),
            rings,
            stamps.view(np.int64),
        )

    def taken(self, rows: slice | Index) -> Columns:
        """Return some of the returns.

        Parameters
        ----------
        rows : slice or (n,)
            Which.

        Returns
        -------
        Columns
            Views, if the rows are a slice.
        """
        p, intensities, rings, stamps = self
        return Columns(p[rows], intensities[rows], rings[rows], stamps[rows])

    def put(self, row: int, other: Columns) -> None:
        """Write returns from a row on.

        Parameters
        ----------
        row : int
            The first row.
        other : Columns
            What is written; may be rows of these columns.
        """
        rows = slice(row, row + len(other.rings))
        self.p[rows], self.intensities[rows] = other.p, other.intensities
        self.rings[rows], self.stamps[rows] = other.rings, other.stamps

    def in_order(self, counts: Index) -> Columns:
        """Return the returns in the order of their instants; mostly they are in it.

        Parameters
        ----------
        counts : (k,)
            Lengths of stretches that are known to be in order, from the first row on.

        Returns
        -------
        Columns
            As many as the stretches have; views, if nothing had to be moved.
        """
        ends = np.cumsum(counts)
        stamps = self.stamps[: int(counts.sum())]
        begins = (ends - counts)[(counts > 0) & (ends > counts)]
        if (stamps[begins] >= stamps[begins - 1]).all():
            return self.taken(slice(len(stamps)))
        return self.taken(np.argsort(stamps, kind="stable"))


class Seen(NamedTuple):
    """What unpacking saw in a cloud; times as they were recorded."""

    n_returns: int
    earliest: float
    latest: float  # infinite if a time is not finite
    n_zeros: int
    is_ascending: bool
    has_bad_ring: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Field:
    """One field of a point.

    Attributes
    ----------
    offset : int
        Its first byte in the point.
    kind : str
        Its type, as NumPy calls it, without the order of bytes.
    """

    offset: int
    kind: str

    @property
    def end(self) -> int:
        """First byte behind the field."""
        return self.offset + np.dtype(self.kind).itemsize


@dataclass(frozen=True, kw_only=True)
class Layout:
    """What a point looks like, and the bytes that said so.

    Attributes
    ----------
    said : bytes
        The description as it stands in a message.
    fields : dict of str to Field
        By the names that the driver gave them.
    order : str
        Of bytes: ``<`` or ``>``.
    step : int
        From a point to the next [bytes].
    """

    said: bytes
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
        """What the compiled loop must know; none if it cannot do this layout."""
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
        """The type of a point under our own names for its fields."""
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
    """Read the description of a point.

    Parameters
    ----------
    cursor : Cursor
        Before the fields; behind the length of a point afterwards.
    octets : (size,) uint8
        The message.

    Returns
    -------
    Layout
        What a point looks like.

    Raises
    ------
    BrokenMessageError
        If there are no coordinates, or a field cannot be.
    """
    begin = cursor.at
    fields = dict(_field(cursor) for _ in range(cursor.count(_FIELD_MIN)))
    order = ">" if cursor.number("B") else "<"
    step = cursor.number("I")
    said = octets[begin : cursor.at].tobytes()
    return Layout(said=said, fields=_checked(fields, step), order=order, step=step)


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
    for name, one in fields.items():
        if one.end > step:
            raise BrokenMessageError(f"its field {name!r} lies outside the {step} bytes of a point")
    return fields


def unpack_any(
    points: Octets, layout: Layout, out: Columns
) -> tuple[int, NDArray[np.generic] | None, bool]:
    """Write the returns of one cloud of any layout, without their instants.

    Parameters
    ----------
    points : (size,) uint8
        Whole points.
    layout : Layout
        What they look like.
    out : Columns
        With room for all of them, from its first row on.

    Returns
    -------
    n : int
        Number of returns: points that are finite and not at the origin.
    times : (n,) or None
        As recorded; none when there is no such field.
    has_bad_ring : bool
        Whether one has a laser that cannot be.
    """
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


def unpack_clouds(octets: Octets, clouds: Nanos, layout: Layout, out: Columns) -> list[Seen]:
    """Write the returns of clouds and their instants, each from a row of its own on.

    Parameters
    ----------
    octets : (size,) uint8
        What holds the points.
    clouds : (n, 4)
        For each: first byte of its points, their number, its stamp [ns], its first row.
    layout : Layout
        What the points of all look like; one that can be compiled.
    out : Columns
        With room for all of their points.

    Returns
    -------
    list of Seen
        What was seen in each.
    """
    told, compiled = np.empty((len(clouds), 6)), layout.compiled
    p, intensities, rings, stamps = out
    columns = (p.view(np.uint32), intensities.view(np.uint32), rings, stamps)

    def unpack(begin: int, end: int) -> None:
        rows = slice(begin, end)
        _clouds_kernel(octets, clouds[rows], compiled, columns, told[rows])

    side_by_side(unpack, len(clouds), worth=_WORTH)
    return [
        Seen(int(n), low, high, int(n_zeros), not n_descents, n_bad > 0)
        for n, low, high, n_zeros, n_descents, n_bad in told.tolist()
    ]


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
def _clouds_kernel(octets, clouds, layout, columns, told):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Unpack clouds; tell their returns, extreme times, zero times, descents and bad rings."""
    for k in range(len(clouds)):
        told[k, 0], told[k, 1], told[k, 2], told[k, 3], told[k, 4], told[k, 5] = _cloud_kernel(
            octets, clouds[k], layout, columns
        )


@numba.njit(cache=True, nogil=True)
def _cloud_kernel(octets, cloud, layout, columns):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Copy the bits of finite returns away from the origin, and add their times to the stamp.

    Works on bits, so that one compiled version serves any alignment. A point that is no return is
    overwritten by the next one.
    """
    step, x, y, z, intensity, ring, time, is_wide, is_whole = layout
    p, intensities, rings, stamps = columns
    exponent, magnitude = np.uint32(0x7F800000), np.uint32(0x7FFFFFFF)
    to_x, to_y, to_z = np.uint64(x), np.uint64(y), np.uint64(z)
    to_intensity, to_ring, to_time = np.uint64(intensity), np.uint64(ring), np.uint64(time)
    bits = np.empty(1, np.uint32)
    seconds = bits.view(np.float32)
    at, row, stamp = np.uint64(cloud[0]), np.uint64(cloud[3]), cloud[2]
    first, previous = row, stamp - np.int64(1 << 62)
    low, high, n_zeros, n_descents, n_bad = np.inf, -np.inf, 0, 0, 0
    for _ in range(cloud[1]):
        a, b, c = _word(octets, at + to_x), _word(octets, at + to_y), _word(octets, at + to_z)
        p[row, 0], p[row, 1], p[row, 2] = a, b, c
        value = np.uint32(0) if intensity < 0 else _word(octets, at + to_intensity)
        intensities[row] = np.uint32(0) if (value & exponent) == exponent else value
        laser = np.uint32(255) if ring < 0 else np.uint32(octets[at + to_ring])
        if is_wide:
            laser |= np.uint32(octets[at + to_ring + np.uint64(1)]) << np.uint32(8)
        rings[row] = np.uint8(laser)
        bits[0] = np.uint32(0) if time < 0 else _word(octets, at + to_time)
        t = np.float64(bits[0]) if is_whole else np.float64(seconds[0])
        instant = stamp + np.int64(np.rint(t if is_whole else t * 1e9))
        stamps[row] = instant
        is_finite = (a & exponent) != exponent and (b & exponent) != exponent
        if is_finite and (c & exponent) != exponent and ((a | b | c) & magnitude) != 0:
            n_bad += int(ring >= 0 and laser > 254)
            low = min(low, t)
            high = np.inf if t - t != 0 else max(high, t)
            n_zeros += t == 0
            n_descents += instant < previous
            previous = instant
            row += np.uint64(1)
        at += np.uint64(step)
    return row - first, low, high, n_zeros, n_descents, n_bad
