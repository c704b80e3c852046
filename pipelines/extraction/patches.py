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
from pipelines.values import Array, Column

_REACH = 4.5  # radii about a seed whose returns decide whether a ball stands free there


class Patches(NamedTuple):
    """Returns sorted by cell, for the cells about the seeds.

    Attributes
    ----------
    starts : (n_side ** 2 + 1,)
        The rows of a cell are ``rows[starts[cell]:starts[cell + 1]]``.
    rows : (m,) int32
        Rows of the cloud.
    n_side : int
        Cells along one side.
    margin : int
        Cells about a seed that may hold returns within reach.
    reach : float
        How far about a seed returns are looked at [m].
    """

    starts: NDArray[np.int64]
    rows: NDArray[np.int32]
    n_side: int
    margin: int
    reach: float


def patches_about(grid: Grid, seeds: Array, radius: float) -> Patches:
    """Return the returns about some places, by cell.

    Parameters
    ----------
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
    starts, rows = _by_cell(grid.cells, grid.n_side, cells_of(seeds, grid), margin)
    return Patches(starts, rows, grid.n_side, margin, reach)


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


@numba.njit(cache=True, nogil=True)
def near(p_base: Column, patches: Patches, cell: int, c: Array) -> NDArray[np.int32]:
    """Return the rows of the returns within reach of a place.

    Parameters
    ----------
    p_base : (n, 3) float32
        Returns [m].
    patches : Patches
        Their rows by cell.
    cell : int
        A cell that holds the place, or is next to the one that does.
    c : (3,)
        The place [m].

    Returns
    -------
    (k,) int32
        Rows of the cloud.
    """
    n_side, margin = patches.n_side, patches.margin
    row, column = cell // n_side, cell % n_side
    low, high = max(column - margin, 0), min(column + margin, n_side - 1)
    out = np.empty(64, np.int32)
    n_out = 0
    for k in range(max(row - margin, 0), min(row + margin + 1, n_side)):
        first, last = patches.starts[k * n_side + low], patches.starts[k * n_side + high + 1]
        for i in patches.rows[first:last]:
            dx, dy, dz = p_base[i, 0] - c[0], p_base[i, 1] - c[1], p_base[i, 2] - c[2]
            if dx * dx + dy * dy + dz * dz < patches.reach * patches.reach:
                if n_out == len(out):
                    out = np.concatenate((out, np.empty(n_out, np.int32)))
                out[n_out] = i
                n_out += 1
    return out[:n_out]


@numba.njit(cache=True, nogil=True)
def gathered(p_base: Column, rows: NDArray[np.int32]) -> Array:
    """Return some points in float64.

    Parameters
    ----------
    p_base : (n, 3) float32
        Returns [m].
    rows : (k,) int32
        Those that are wanted.

    Returns
    -------
    (k, 3)
        Points [m].
    """
    points = np.empty((len(rows), 3))
    for i in range(len(rows)):
        points[i, 0], points[i, 1] = p_base[rows[i], 0], p_base[rows[i], 1]
        points[i, 2] = p_base[rows[i], 2]
    return points


@numba.njit(cache=True, nogil=True)
def _by_cell(
    cells: NDArray[np.int32], n_side: int, seed_cells: NDArray[np.int64], margin: int
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Return starts and rows of the returns in and about the seeds' cells, by counting sort."""
    is_wanted = np.zeros(n_side * n_side, np.bool_)
    for cell in seed_cells:
        row, column = cell // n_side, cell % n_side
        for k in range(max(row - margin, 0), min(row + margin + 1, n_side)):
            for m in range(max(column - margin, 0), min(column + margin + 1, n_side)):
                is_wanted[k * n_side + m] = True
    starts = np.zeros(n_side * n_side + 1, np.int64)
    for cell in cells:
        if cell >= 0 and is_wanted[cell]:
            starts[cell + 1] += 1
    starts = np.cumsum(starts)
    ends = starts[:-1].copy()
    rows = np.empty(starts[-1], np.int32)
    for i in range(len(cells)):
        cell = cells[i]
        if cell >= 0 and is_wanted[cell]:
            rows[ends[cell]] = i
            ends[cell] += 1
    return starts, rows
