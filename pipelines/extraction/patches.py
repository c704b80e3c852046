"""The returns about some places.

Hides how neighbours are found: returns sorted by the cells of the ground grid, only those that
matter.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from pipelines.extraction.ground import Grid
from pipelines.threads import side_by_side
from pipelines.values import Array, Column, Mask

_REACH = 4.5  # radii about a seed whose returns decide whether a ball stands free there

_ROUNDED = 1e-4  # [m]: more than a cell's edge may be off by rounding


class Patches(NamedTuple):
    """Returns sorted by cell, for the cells about the seeds.

    Attributes
    ----------
    starts : (n_side ** 2 + 1,)
        The returns of a cell are ``points[starts[cell]:starts[cell + 1]]``.
    points : (m, 3) float32
        The returns themselves [m].
    n_side : int
        Cells along one side.
    edge : float
        Edge of a cell [m].
    R_station_base : (3, 3)
        Levelling.
    reach : float
        How far about a seed returns are looked at [m].
    """

    starts: NDArray[np.int64]
    points: Column
    n_side: int
    edge: float
    R_station_base: Array
    reach: float


def patches_about(p_base: Column, grid: Grid, seeds: Array, radius: float) -> Patches:
    """Return the returns about some places, by cell.

    Parameters
    ----------
    p_base : (n, 3) float32
        All returns [m].
    grid : Grid
        Cells of all returns.
    seeds : (k, 3)
        The places [m].
    radius : float
        Radius of the ball that is looked for [m].

    Returns
    -------
    Patches
        The returns by cell.
    """
    reach = _REACH * radius
    margin = int(np.ceil(reach / grid.edge)) + 1
    is_wanted = _wanted(grid.n_side, _cells_of(seeds, grid), margin)

    parts = side_by_side(
        lambda first, end: _rows_in(grid.cells, is_wanted, first, end), len(grid.cells)
    )
    rows = np.concatenate(parts)
    starts, rows = _by_cell(grid.cells, rows, len(is_wanted))
    return Patches(starts, p_base[rows], grid.n_side, grid.edge, grid.R_station_base, reach)


def _cells_of(p_base: Array, grid: Grid) -> NDArray[np.int64]:
    """Return the cells of some places; of a place beyond the grid, the nearest one."""
    places = np.floor((p_base @ grid.R_station_base.T)[:, :2] / grid.edge).astype(np.int64)
    places = np.clip(places + grid.n_side // 2, 0, grid.n_side - 1)
    return np.asarray(places[:, 0] * grid.n_side + places[:, 1])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def points_near(patches: Patches, c: Array) -> Array:
    """Return the returns within reach of a place.

    Parameters
    ----------
    patches : Patches
        Returns by cell.
    c : (3,)
        A place at most a cell from one that the patches are about [m].

    Returns
    -------
    (k, 3)
        Points [m].
    """
    n_side, points, starts = patches.n_side, patches.points, patches.starts
    x, y, z, reach2 = c[0], c[1], c[2], patches.reach**2
    bottom, top = _span(patches, patches.R_station_base[0], c)
    low, high = _span(patches, patches.R_station_base[1], c)
    n = 0
    for k in range(bottom, top + 1):
        n += starts[k * n_side + high + 1] - starts[k * n_side + low]
    out = np.empty((n + 1, 3))
    n_out = 0
    for k in range(bottom, top + 1):
        for i in range(starts[k * n_side + low], starts[k * n_side + high + 1]):
            p, q, r = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
            # kept only if the next one does not take its place
            out[n_out, 0], out[n_out, 1], out[n_out, 2] = p, q, r
            n_out += (p - x) ** 2 + (q - y) ** 2 + (r - z) ** 2 < reach2
    return out[:n_out]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _span(patches: Patches, v_axis: Array, c: Array) -> tuple[int, int]:
    """Return the first and the last cell along an axis that may hold returns within reach."""
    place = v_axis[0] * c[0] + v_axis[1] * c[1] + v_axis[2] * c[2]
    reach, half = patches.reach + _ROUNDED, patches.n_side // 2
    first = int(np.floor((place - reach) / patches.edge)) + half
    last = int(np.floor((place + reach) / patches.edge)) + half
    return max(first, 0), min(last, patches.n_side - 1)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _wanted(n_side: int, seed_cells: NDArray[np.int64], margin: int) -> Mask:
    """Tell which cells are in and about the seeds' cells."""
    is_wanted = np.zeros(n_side * n_side, np.bool_)
    for cell in seed_cells:
        row, column = cell // n_side, cell % n_side
        for k in range(max(row - margin, 0), min(row + margin + 1, n_side)):
            for m in range(max(column - margin, 0), min(column + margin + 1, n_side)):
                is_wanted[k * n_side + m] = True
    return is_wanted


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _rows_in(cells: NDArray[np.int32], is_wanted: Mask, first: int, end: int) -> NDArray[np.int32]:
    """Return the rows, of those of a part, that lie in cells that are wanted."""
    rows = np.empty(end - first, np.int32)
    n_rows = 0
    for i in range(first, end):
        if cells[i] >= 0 and is_wanted[cells[i]]:
            rows[n_rows] = i
            n_rows += 1
    return rows[:n_rows].copy()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _by_cell(
    cells: NDArray[np.int32], rows: NDArray[np.int32], n_cells: int
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Return starts of cells, and rows sorted by their cells, by counting."""
    starts = np.zeros(n_cells + 1, np.int64)
    for row in rows:
        starts[cells[row] + 1] += 1
    starts = np.cumsum(starts)
    ends = starts[:-1].copy()
    ordered = np.empty_like(rows)
    for row in rows:
        cell = cells[row]
        ordered[ends[cell]] = row
        ends[cell] += 1
    return starts, ordered
