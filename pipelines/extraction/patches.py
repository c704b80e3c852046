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


class Patches(NamedTuple):
    """Returns sorted by cell, for the cells about the seeds.

    Attributes
    ----------
    starts : (n_side ** 2 + 1,)
        The rows of a cell are ``rows[starts[cell]:starts[cell + 1]]``.
    rows : (m,) int32
        Rows of the cloud.
    points : (m, 3) float32
        The returns themselves [m].
    n_side : int
        Cells along one side.
    margin : int
        Cells about a seed that may hold returns within reach.
    reach : float
        How far about a seed returns are looked at [m].
    """

    starts: NDArray[np.int64]
    rows: NDArray[np.int32]
    points: Column
    n_side: int
    margin: int
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
    is_wanted = _wanted(grid.n_side, cells_of(seeds, grid), margin)

    parts = side_by_side(
        lambda first, end: _rows_in(grid.cells, is_wanted, first, end), len(grid.cells)
    )
    rows = np.concatenate(parts)
    starts, rows = _by_cell(grid.cells, rows, len(is_wanted))
    return Patches(starts, rows, p_base[rows], grid.n_side, margin, reach)


def cells_of(p_base: Array, grid: Grid) -> NDArray[np.int64]:
    """Return the cells of some places.

    Parameters
    ----------
    p_base : (k, 3)
        The places [m].
    grid : Grid
        The grid.

    Returns
    -------
    (k,)
        Cells; of a place beyond the grid, the nearest one.
    """
    places = np.floor((p_base @ grid.R_station_base.T)[:, :2] / grid.edge).astype(np.int64)
    places = np.clip(places + grid.n_side // 2, 0, grid.n_side - 1)
    return np.asarray(places[:, 0] * grid.n_side + places[:, 1])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def near(patches: Patches, cell: int, c: Array) -> NDArray[np.int32]:
    """Return which of the returns are within reach of a place.

    Parameters
    ----------
    patches : Patches
        Returns by cell.
    cell : int
        A cell that holds the place, or is next to the one that does.
    c : (3,)
        The place [m].

    Returns
    -------
    (k,) int32
        Their places among ``patches.rows`` and ``patches.points``.
    """
    n_side, margin, points, starts = patches.n_side, patches.margin, patches.points, patches.starts
    row, column = cell // n_side, cell % n_side
    low, high = max(column - margin, 0), min(column + margin, n_side - 1)
    bottom, top = max(row - margin, 0), min(row + margin, n_side - 1)
    x, y, z, reach2 = c[0], c[1], c[2], patches.reach**2
    out = np.empty(starts[top * n_side + high + 1] - starts[bottom * n_side + low], np.int32)
    n_out = 0
    for k in range(bottom, top + 1):
        for i in range(starts[k * n_side + low], starts[k * n_side + high + 1]):
            dx, dy, dz = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
            out[n_out] = i  # kept only if the next one does not take its place
            n_out += dx * dx + dy * dy + dz * dz < reach2
    return out[:n_out]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def gathered(patches: Patches, places: NDArray[np.int32]) -> Array:
    """Return some of the returns in float64.

    Parameters
    ----------
    patches : Patches
        Returns by cell.
    places : (k,) int32
        Those that are wanted, as ``near`` gives them.

    Returns
    -------
    (k, 3)
        Points [m].
    """
    points = np.empty((len(places), 3))
    for i in range(len(places)):
        for axis in range(3):
            points[i, axis] = patches.points[places[i], axis]
    return points


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
