"""Clouds (LAS, LAZ, PLY, Parquet) as grids; runs in the confined process.

A header is believed as far as the size of the file goes. A cloud becomes two grids: the ground is
the lowest return of each cell where that is no bump, the surface that hides is the highest.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import IO

import laspy
import numpy as np
import pyarrow.parquet as pq
from scipy.ndimage import distance_transform_edt, grey_opening

from spheremark.pipelines.errors import InputError
from spheremark.pipelines.model import Array, Mask
from spheremark.storage.imports import ply
from spheremark.storage.imports.declared import RATIO_MAX, check_bytes, check_points, size_of

_CHUNK = 1_000_000  # points at a time
_CELL = 0.10  # [m] of the grid
_BUMP = 0.25  # [m] a lowest return this far above its surroundings is no ground
_OPENING = 1.0  # [m] width of what is taken for a bump
_GAP = 1.5  # [m] from the nearest return beyond which the ground is not known

_HEIGHT_MAX = 1e5  # [m] beyond any height on Earth or Moon

Pieces = Iterator[Array]


def prepare() -> None:
    """Do nothing: what the readers need is imported above."""


def read_las(file: IO[bytes], *, name: str, cells_max: int) -> dict[str, Array]:
    """Return the grid of a LAS or LAZ file: ``xs``, ``ys``, ``ground`` and ``surface``."""
    check_las(file, name)
    with laspy.open(file, closefd=False, laz_backend=laspy.LazBackend.Lazrs) as las:
        header = las.header
        low, high = np.array(header.mins[:2]), np.array(header.maxs[:2])
        pieces = (np.column_stack([c.x, c.y, c.z]) for c in las.chunk_iterator(_CHUNK))
        return _gridded(pieces, low, high, name, cells_max)


def read_ply(file: IO[bytes], *, name: str, cells_max: int) -> dict[str, Array]:
    """Return the grid of a PLY file: ``xs``, ``ys``, ``ground`` and ``surface``."""
    vertices = ply.vertices_of(file, name)
    check_points(vertices.n, name)
    n_bytes, room = vertices.n * vertices.smallest, size_of(file) - vertices.begin + 1
    check_bytes(f"{vertices.n:,} vertices", n_bytes, room, name)

    def pieces() -> Pieces:
        return vertices.pieces(file, _CHUNK)

    return _gridded(pieces(), *_extent(pieces()), name, cells_max)


def read_parquet(file: IO[bytes], *, name: str, cells_max: int) -> dict[str, Array]:
    """Return the grid of a cloud that spheremark has written, as the other readers do."""
    table = pq.ParquetFile(file, pre_buffer=False)  # which would need threads
    if b"spheremark.cloud" not in (table.schema_arrow.metadata or {}):
        raise InputError(f"{name} is no cloud of spheremark; other Parquet files are not read.")
    n_points = table.metadata.num_rows
    check_points(n_points, name)
    check_bytes(f"{n_points:,} points", 12 * n_points, RATIO_MAX * size_of(file), name)

    def pieces() -> Pieces:
        columns = ["x_m", "y_m", "z_m"]
        for number in range(table.num_row_groups):
            group = table.read_row_group(number, columns=columns, use_threads=False)
            yield np.column_stack([group.column(one).to_numpy() for one in columns])

    return _gridded(pieces(), *_extent(pieces()), name, cells_max)


def check_las(file: IO[bytes], name: str) -> None:
    """Refuse a header (ASPRS LAS 1.4, table 3) whose counts or scales cannot be."""
    size, head = size_of(file), file.read(375)
    file.seek(0)
    if len(head) < 227:
        raise InputError(f"{name} has {len(head)} bytes; the header of a LAS file has 227.")
    minor, header_size = head[25], *struct.unpack_from("<H", head, 94)
    begin, n_vlrs, form, length = struct.unpack_from("<IIBH", head, 96)
    (n_points,) = struct.unpack_from("<I", head, 107)
    end_of_points = size
    if minor >= 4 and len(head) >= 375 <= header_size:
        begin_evlrs, n_evlrs, n_points = struct.unpack_from("<QIQ", head, 235)
        if n_evlrs:
            end_of_points = begin_evlrs
            if not begin <= begin_evlrs <= size or 60 * n_evlrs > size - begin_evlrs:
                raise InputError(f"{name} declares {n_evlrs:,} extended records beyond its end.")
    if not 227 <= header_size <= begin <= size or 54 * n_vlrs > begin - header_size:
        raise InputError(
            f"{name} declares {n_vlrs:,} records of 54 bytes or more between byte {header_size:,} "
            f"and byte {begin:,}; it is damaged."
        )
    n_bytes, ratio = n_points * length, RATIO_MAX if form & 0xC0 else 1
    check_points(n_points, name)
    check_bytes(f"{n_points:,} points", n_bytes, ratio * (end_of_points - begin), name)
    numbers = np.frombuffer(head, "<f8", 12, 131)
    scales, extent = numbers[:3], numbers[6:].reshape(3, 2)
    if not (np.isfinite(numbers).all() and scales.all() and (extent[:, 0] >= extent[:, 1]).all()):
        raise InputError(
            f"The scales, offsets or extents in the header of {name} are infinite, zero or swapped."
        )


def _extent(pieces: Pieces) -> tuple[Array, Array]:
    """Return the least and greatest x and y of all points [m]; infinite where there is none."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for points in pieces:
        known = points[_is_known(points)][:, :2]
        low = np.minimum(low, known.min(axis=0, initial=np.inf))
        high = np.maximum(high, known.max(axis=0, initial=-np.inf))
    return low, high


def _is_known(points: Array) -> Mask:
    """Return which points have coordinates that can be."""
    is_known = np.isfinite(points).all(axis=1) & (np.abs(points[:, 2]) < _HEIGHT_MAX)
    return np.asarray(is_known)


def _gridded(
    pieces: Pieces, low: Array, high: Array, name: str, cells_max: int
) -> dict[str, Array]:
    """Make grids of a cloud that lies between two corners [m]."""
    if not (np.isfinite([low, high]).all() and (low <= high).all()):
        raise InputError(f"{name} holds no terrain: it has no points.")
    n_cells = np.floor((high - low) / _CELL) + 1.0
    if not n_cells.prod() <= cells_max:
        raise InputError(
            f"{name} spreads over {high[0] - low[0]:,.0f} x {high[1] - low[1]:,.0f} m; at "
            f"{_CELL:g} m a cell that is more than {cells_max:,} cells. Cut out the field."
        )
    shape = n_cells.astype(np.intp)
    lowest = np.full((shape[1], shape[0]), np.inf)
    highest = np.full((shape[1], shape[0]), -np.inf)
    for piece in pieces:
        points = piece[_is_known(piece)].astype(np.float64)
        places = (points[:, :2] - low) / _CELL
        if not ((places > -1.0) & (places < shape + 1)).all():
            raise InputError(
                f"Points of {name} lie outside the extent in its header; write the file again with "
                "the right one (las2las, pdal translate)."
            )
        i, j = np.clip(places.astype(np.intp), 0, shape - 1).T
        np.minimum.at(lowest, (j, i), points[:, 2])
        np.maximum.at(highest, (j, i), points[:, 2])
    xs, ys = (low[axis] + (np.arange(shape[axis]) + 0.5) * _CELL for axis in range(2))
    surface = np.where(np.isfinite(highest), highest, np.nan)
    ground = _ground(np.where(np.isfinite(lowest), lowest, np.nan))
    return {"xs": xs, "ys": ys, "ground": ground, "surface": surface}


def _ground(lowest: Array) -> Array:
    """Return the ground of lowest returns: bumps taken away, small gaps filled with the nearest."""
    is_hole = np.isnan(lowest)
    if is_hole.all():
        return lowest
    distance, nearest = distance_transform_edt(is_hole, return_indices=True)
    filled = lowest[tuple(nearest)]
    width = max(3, round(_OPENING / _CELL) | 1)
    opened = grey_opening(filled, size=(width, width))
    ground = np.where(filled - opened > _BUMP, opened, filled)
    return np.where(distance * _CELL <= _GAP, ground, np.nan)
