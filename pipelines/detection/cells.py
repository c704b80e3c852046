"""Cells of the level ground and of directions: where each return of a stop lies.

Hides the one pass over all returns, and how those about a place are found without another pass.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.config import ExtractionConfig
from spheremark.pipelines.geometry import levelling_rotation
from spheremark.pipelines.model import Array, Column, Index, StitchedCloud
from spheremark.pipelines.threads import side_by_side

_N_AZIMUTHS, _N_SINES = 512, 128  # cells of directions: 0.7 to 0.9 deg at the horizon


class Cells(NamedTuple):
    """Each return's cell of the level ground, and all returns by direction.

    Attributes
    ----------
    edge : float
        Edge of a cell of the ground [m].
    R_station_base : (3, 3)
        Levelling.
    ground : (n,) int32
        Cell of each return on the level ground; ``n_side ** 2`` beyond the grid.
    heights : (n,) float32
        Levelled heights [m].
    lowest : (n_side, n_side) float32
        Height of the lowest return per cell; infinite without any [m].
    rows, starts : (n,), (512 * 128 + 1,)
        All returns by their direction from the origin of the base, in cells of azimuth and sine of
        elevation: those of a cell are ``rows[starts[cell]:starts[cell + 1]]``.
    """

    edge: float
    R_station_base: Array
    ground: NDArray[np.int32]
    heights: Column
    lowest: Column
    rows: Index
    starts: Index


def cells_of(cloud: StitchedCloud, config: ExtractionConfig) -> Cells:
    """Sort returns into cells."""
    n = len(cloud.p_base)
    n_side = 2 * int(np.ceil(config.range_max / config.ground_cell))
    R = levelling_rotation(cloud.levelling)
    ground, heights = np.empty(n, np.int32), np.empty(n, np.float32)
    directions = np.empty(n, np.uint16)  # of two bytes: sorted in one pass
    parts = side_by_side(
        lambda first, end: _sort(
            cloud.p_base[first:end],
            R.astype(np.float32),
            (n_side, config.ground_cell, config.range_max),
            (ground[first:end], heights[first:end], directions[first:end]),
        ),
        n,
    )
    lowest = np.minimum.reduce(parts)[:-1].reshape(n_side, n_side)
    counts = np.bincount(directions, minlength=_N_AZIMUTHS * _N_SINES)
    rows, starts = np.argsort(directions, kind="stable"), np.append(0, np.cumsum(counts))
    return Cells(config.ground_cell, R, ground, heights, lowest, rows, starts)


@compiled
def _sort(
    p_base: Column,
    R: Column,
    grid: tuple[int, float, float],
    sorted_into: tuple[NDArray[np.int32], Column, NDArray[np.uint16]],
) -> Column:
    """Write each return's cells and height; return the height of the lowest per cell."""
    (n_side, edge, reach), (ground, heights, directions) = grid, sorted_into
    lowest = np.full(n_side * n_side + 1, np.inf, np.float32)
    for i in range(len(p_base)):
        p, q, r = p_base[i, 0], p_base[i, 1], p_base[i, 2]
        x = R[0, 0] * p + R[0, 1] * q + R[0, 2] * r
        y = R[1, 0] * p + R[1, 1] * q + R[1, 2] * r
        z = R[2, 0] * p + R[2, 1] * q + R[2, 2] * r
        cell, direction = n_side * n_side, 0
        if x * x + y * y < reach * reach and abs(z) < reach:
            row, column = int(x / edge + 0.5 * n_side), int(y / edge + 0.5 * n_side)
            cell = min(row, n_side - 1) * n_side + min(column, n_side - 1)
        distance = np.sqrt(p * p + q * q + r * r)
        if 0.0 < distance < np.inf:
            direction = _azimuth_cell(np.arctan2(q, p)) * _N_SINES + _sine_cell(r / distance)
        ground[i], heights[i], directions[i] = cell, z, direction
        lowest[cell] = min(lowest[cell], z)
    return lowest


@compiled
def _azimuth_cell(azimuth: float) -> int:
    """Return the cell of an azimuth [rad]."""
    return int((azimuth / (2.0 * np.pi) + 1.0) * _N_AZIMUTHS) % _N_AZIMUTHS


@compiled
def _sine_cell(sine: float) -> int:
    """Return the cell of the sine of an elevation."""
    return min(max(int((0.5 + 0.5 * sine) * _N_SINES), 0), _N_SINES - 1)


@compiled
def rows_about(
    p_base: Column, all_cells: Cells, c: Array, reach: float, deep: float
) -> NDArray[np.int32]:
    """Return the rows of the returns about a place.

    Their beams from the origin pass it within reach and end within so much of its distance [m].
    """
    distance, level = np.sqrt(c @ c), np.sqrt(c[0] * c[0] + c[1] * c[1])
    half, elevation = np.arctan(reach / distance), np.arctan2(c[2], level)
    low = max(_sine_cell(np.sin(max(elevation - half, -0.5 * np.pi))) - 1, 0)
    high = min(_sine_cell(np.sin(min(elevation + half, 0.5 * np.pi))) + 1, _N_SINES - 1)
    first, n_azimuths = 0, _N_AZIMUTHS
    if np.sin(half) * distance < level:  # else the axis is within
        wide, azimuth = np.arcsin(np.sin(half) * distance / level), np.arctan2(c[1], c[0])
        first = _azimuth_cell(azimuth - wide) - 1  # and one more on each side for rounding
        n_azimuths = min(int(wide / np.pi * _N_AZIMUTHS) + 4, _N_AZIMUTHS)
    cells = np.arange(first, first + n_azimuths) % _N_AZIMUTHS * _N_SINES
    begins, ends = all_cells.starts[cells + low], all_cells.starts[cells + high + 1]
    edge2, n = (distance * np.cos(half)) ** 2, 0
    found = np.empty(np.sum(ends - begins) + 1, np.int32)
    for begin, end in zip(begins, ends):  # noqa: B905  numba knows no strict
        for row in all_cells.rows[begin:end]:
            x, y, z = p_base[row, 0], p_base[row, 1], p_base[row, 2]
            along, squares = c[0] * x + c[1] * y + c[2] * z, x * x + y * y + z * z
            found[n] = row  # overwritten by the next one unless counted
            is_in = (along > 0.0) & (along * along > edge2 * squares)
            n += is_in & (abs(np.sqrt(squares) - distance) < deep)
    return found[:n]
