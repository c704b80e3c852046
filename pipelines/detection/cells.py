"""Cells of the level ground and of directions: where each return of a stop lies.

Hides the one pass over all returns. Later steps select returns by their cells, which takes a small
part of the time that computing with coordinates takes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.config import ExtractionConfig
from spheremark.pipelines.geometry import levelling_rotation
from spheremark.pipelines.model import Array, Column, Mask, StitchedCloud
from spheremark.pipelines.threads import side_by_side

N_DIRECTIONS_SIDE = 128
"""Cells along a side of the octahedron of directions: 0.5 to 1 deg."""

N_DIRECTIONS = 2 * N_DIRECTIONS_SIDE**2
"""Cells of directions."""

_GROUP = 64  # returns that are tested at once: mostly none of them is wanted
_BLOCK = 512  # returns at a time: they stay in the nearest cache


class Layout(NamedTuple):
    """The grid: cells along one side, edge of a cell [m], how far it reaches [m]."""

    n_side: int
    edge: float
    reach: float


class Cells(NamedTuple):
    """Each return's cells, and how high and low returns lie in those of the ground.

    Attributes
    ----------
    layout : Layout
        The grid of the ground.
    R_station_base : (3, 3)
        Levelling.
    ground : (n,) int32
        Cell of each return on the level ground; ``n_side ** 2`` beyond the grid.
    directions : (n,) uint16
        Cell of each return's direction; any cell for a return that is not finite.
    lowest, highest : (n_side, n_side) float32
        Levelled heights of the lowest and highest return per cell; infinite without any [m].
    """

    layout: Layout
    R_station_base: Array
    ground: NDArray[np.int32]
    directions: NDArray[np.uint16]
    lowest: Column
    highest: Column


def cells_of(cloud: StitchedCloud, config: ExtractionConfig) -> Cells:
    """Sort returns into cells."""
    n, flat = len(cloud.p_base), cloud.p_base.reshape(-1)
    n_side = 2 * int(np.ceil(config.range_max / config.ground_cell))
    layout = Layout(n_side, config.ground_cell, config.range_max)
    R = levelling_rotation(cloud.levelling)
    ground, directions = np.empty(n, np.int32), np.empty(n, np.uint16)
    extremes = side_by_side(
        lambda first, end: _sort(
            flat[3 * first : 3 * end],
            R.astype(np.float32),
            layout,
            ground[first:end],
            directions[first:end],
        ),
        n,
    )
    (lows, highs), (other_lows, other_highs) = extremes[0][:-1].T, extremes[-1][:-1].T
    lowest = np.minimum(lows, other_lows).reshape(n_side, n_side)
    highest = np.maximum(highs, other_highs).reshape(n_side, n_side)
    return Cells(layout, R, ground, directions, lowest, highest)


@compiled
def rows_in(
    cells: NDArray[np.integer], is_wanted: Mask, first: int, end: int
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the returns, of those of a part, that lie in some cells."""
    rows, own = np.empty(end - first + 1, np.int32), np.empty(end - first + 1, np.int32)
    n_rows = 0
    for low in range(first, end, _GROUP):
        group = cells[low : min(low + _GROUP, end)]
        is_any = False
        for cell in group:
            is_any |= is_wanted[np.uint32(cell)]
        if is_any:
            for i in range(len(group)):
                cell = np.uint32(group[i])
                rows[n_rows], own[n_rows] = low + i, cell  # overwritten by the next unless counted
                n_rows += is_wanted[cell]
    return rows[:n_rows], own[:n_rows]


@compiled
def direction_cells(x: Column, y: Column, z: Column, cells: NDArray[np.uint16]) -> None:
    """Write the cells of some directions: the octahedron seen from above and from below."""
    half, side = np.float32(0.4999 * N_DIRECTIONS_SIDE), np.int32(N_DIRECTIONS_SIDE)
    for i in range(len(x)):
        total = abs(x[i]) + abs(y[i]) + abs(z[i])
        scale = half / total if (total > 0.0) & (total < np.inf) else np.float32(0.0)
        row, column = np.int32(x[i] * scale + half), np.int32(y[i] * scale + half)
        cell = (row + (side if z[i] > 0.0 else np.int32(0))) * side + column
        cells[i] = cell if scale > 0.0 else np.int32(0)


@compiled
def _sort(
    flat: Column,
    R: Column,
    layout: Layout,
    ground: NDArray[np.int32],
    directions: NDArray[np.uint16],
) -> Column:
    """Write each return's cells; return the levelled lowest and highest per cell of the ground.

    In single precision, good to some micrometres, which halves the time.
    """
    extremes = np.empty((layout.n_side * layout.n_side + 1, 2), np.float32)
    extremes[:, 0], extremes[:, 1] = np.inf, -np.inf
    xyz = np.empty((3, _BLOCK), np.float32)
    for low in range(0, len(ground), _BLOCK):
        cells = ground[low : low + _BLOCK]
        x, y, z = xyz[0, : len(cells)], xyz[1, : len(cells)], xyz[2, : len(cells)]
        _unpack(flat[3 * low : 3 * (low + len(cells))], x, y, z)
        direction_cells(x, y, z, directions[low : low + _BLOCK])
        _level(R, x, y, z)
        _ground_cells(x, y, z, layout, cells)
        for i in range(len(cells)):
            cell = np.uint32(cells[i])
            extremes[cell, 0] = min(extremes[cell, 0], z[i])
            extremes[cell, 1] = max(extremes[cell, 1], z[i])
    return extremes


@compiled
def _unpack(flat: Column, x: Column, y: Column, z: Column) -> None:
    """Write the coordinates of a few returns side by side."""
    for i in range(len(x)):
        x[i], y[i], z[i] = flat[3 * i], flat[3 * i + 1], flat[3 * i + 2]


@compiled
def _level(R: Column, x: Column, y: Column, z: Column) -> None:
    """Level a few returns."""
    a, b, c, d, e, f = R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2]
    g, h, k = R[2, 0], R[2, 1], R[2, 2]
    for i in range(len(x)):
        p, q, r = x[i], y[i], z[i]
        x[i], y[i] = a * p + b * q + c * r, d * p + e * q + f * r
        z[i] = g * p + h * q + k * r


@compiled
def _ground_cells(
    x: Column, y: Column, z: Column, layout: Layout, cells: NDArray[np.int32]
) -> None:
    """Write the cells of a few levelled returns; without a branch, for many at a time."""
    n_side, last = np.int32(layout.n_side), np.int32(layout.n_side - 1)
    half, per_edge = np.float32(0.5 * layout.n_side), np.float32(1.0 / layout.edge)
    reach, beyond = np.float32(layout.reach), np.int32(layout.n_side * layout.n_side)
    for i in range(len(cells)):
        is_near = (x[i] * x[i] + y[i] * y[i] < reach * reach) & (abs(z[i]) < reach)
        row = min(np.int32(x[i] * per_edge + half), last)
        column = min(np.int32(y[i] * per_edge + half), last)
        cells[i] = row * n_side + column if is_near else beyond
