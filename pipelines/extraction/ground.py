"""The ground of a stop: an opened grid of lowest points, unknown where none was seen.

Hides how ground is told from what stands on it.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from pipelines.config import ExtractionConfig
from pipelines.geometry import levelling_rotation
from pipelines.threads import side_by_side
from pipelines.values import Array, Column, Mask, StitchedCloud

_STUDY_FIELD = 10.0  # [m] from the station: where the study looks for its highest ground point
_GROUND_WINDOW = 4  # cells each way of the opening: rocks up to twice this are not ground
_GROUND_STEP = 0.10  # [m] that a cell's lowest point may lie above the opened surface
_GROUND_CELLS_MIN = 9  # a marker seen alone covers at most 6 cells: that is not yet ground
_GROUND_RISE = 0.15  # [m] that ground may rise above its cell of the opened grid: tops of mounds


class Grid(NamedTuple):
    """Each return's cell and height, and which returns rise above the ground.

    Attributes
    ----------
    cells : (n,) int32
        Cell of each return, -1 beyond the range looked at.
    n_side : int
        Cells along one side.
    edge : float
        Edge of a cell [m].
    R_station_base : (3, 3)
        Levelling.
    is_above : (n,) bool
        Returns that are not known to be ground.
    ground_height_max : float
        Highest ground return within 10 m, levelled [m].
    """

    cells: NDArray[np.int32]
    n_side: int
    edge: float
    R_station_base: Array
    is_above: Mask
    ground_height_max: float


def ground_grid(cloud: StitchedCloud, config: ExtractionConfig) -> Grid:
    """Sort returns into cells and tell the ground.

    Parameters
    ----------
    cloud : StitchedCloud
        One stop.
    config : ExtractionConfig
        Edge of a cell, clearance, and how far to look.

    Returns
    -------
    Grid
        Cells, and what rises above the ground.
    """
    n_side = 2 * int(np.ceil(config.range_max / config.ground_cell))
    R = levelling_rotation(cloud.levelling)
    n = len(cloud.p_base)
    cells, is_above = np.empty(n, np.int32), np.empty(n, np.bool_)

    p, edge, clearance = cloud.p_base, config.ground_cell, config.ground_clearance
    parts = side_by_side(
        lambda first, end: _lowest_per_cell(
            p[first:end], R, edge, n_side, config.range_max, cells[first:end]
        ),
        n,
    )
    lowest = np.minimum.reduce(parts)
    ground = _ground(lowest, _opened(lowest, _GROUND_WINDOW), _GROUND_WINDOW).ravel()
    highest = side_by_side(
        lambda first, end: _above(
            p[first:end], R, cells[first:end], ground, clearance, is_above[first:end]
        ),
        n,
    )
    return Grid(cells, n_side, edge, R, is_above, float(max(highest)))


@numba.njit(cache=True, nogil=True)
def _lowest_per_cell(
    p_base: Column,
    R: Array,
    edge: float,
    n_side: int,
    range_max: float,
    cells: NDArray[np.int32],
) -> Column:
    """Write each point's cell (-1: too far), and return the levelled lowest point per cell."""
    lowest = np.full((n_side, n_side), np.inf, np.float32)
    half = n_side // 2
    (a, b, c), (d, e, f), (g, h, k) = R[0], R[1], R[2]
    for i in range(len(p_base)):
        x, y, z = p_base[i, 0], p_base[i, 1], p_base[i, 2]
        x_level, y_level = a * x + b * y + c * z, d * x + e * y + f * z
        height = np.float32(g * x + h * y + k * z)
        is_near = x_level * x_level + y_level * y_level < range_max * range_max
        if not (is_near and abs(height) < range_max):
            cells[i] = -1
            continue
        row = min(max(int(np.floor(x_level / edge)) + half, 0), n_side - 1)
        column = min(max(int(np.floor(y_level / edge)) + half, 0), n_side - 1)
        cells[i] = row * n_side + column
        lowest[row, column] = min(lowest[row, column], height)
    return lowest


@numba.njit(cache=True, nogil=True)
def _slide(values: Column, window: int, sign: float) -> Column:
    """Return the least of ``sign * values`` in a square window; infinite cells do not count."""
    n_rows, n_columns = values.shape
    along = np.full(values.shape, np.inf, np.float32)
    out = np.full(values.shape, np.inf, np.float32)
    for i in range(n_rows):
        for j in range(n_columns):
            for k in range(max(j - window, 0), min(j + window + 1, n_columns)):
                if np.isfinite(values[i, k]):
                    along[i, j] = min(along[i, j], sign * values[i, k])
    for i in range(n_rows):
        for k in range(max(i - window, 0), min(i + window + 1, n_rows)):
            for j in range(n_columns):
                out[i, j] = min(out[i, j], along[k, j])
    return out


def _opened(lowest: Column, window: int) -> Column:
    """Return the morphological opening of the lowest points; infinite where too little is near.

    A window that sees nothing but a marker, behind a mound say, tells nothing about the ground.
    """
    eroded = _slide(lowest, window, 1.0)
    eroded[_n_known(lowest, window) < _GROUND_CELLS_MIN] = np.inf
    return np.asarray(-_slide(eroded, window, -1.0))


def _n_known(lowest: Column, window: int) -> NDArray[np.int64]:
    """Return how many cells of the square window about each cell have returns."""
    padded = np.pad(np.isfinite(lowest), ((window + 1, window), (window + 1, window)))
    sums = padded.cumsum(axis=0).cumsum(axis=1)
    side = 2 * window + 1
    return np.asarray(
        sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    )


@numba.njit(cache=True, nogil=True)
def _ground(lowest: Column, opened: Column, window: int) -> Column:
    """Return the ground's height per cell; infinite where no ground was seen in or beside it.

    A cell has ground where its lowest point lies near the opened surface and enough others around
    do too: a marker behind a rock has no ground around it, and must not become ground itself.
    """
    n_rows, n_columns = lowest.shape
    is_low = lowest < opened + np.float32(_GROUND_STEP)
    out = np.full(lowest.shape, np.inf, np.float32)
    for i in range(n_rows):
        for j in range(n_columns):
            highest = -np.inf
            for k in range(max(i - 1, 0), min(i + 2, n_rows)):
                for m in range(max(j - 1, 0), min(j + 2, n_columns)):
                    if is_low[k, m]:
                        highest = max(highest, lowest[k, m])
            if highest == -np.inf:
                continue
            n_low = 0
            for k in range(max(i - window, 0), min(i + window + 1, n_rows)):
                for m in range(max(j - window, 0), min(j + window + 1, n_columns)):
                    n_low += is_low[k, m]
            if n_low >= _GROUND_CELLS_MIN:
                out[i, j] = highest
    return out


@numba.njit(cache=True, nogil=True)
def _above(
    p_base: Column,
    R: Array,
    cells: NDArray[np.int32],
    ground: Column,
    clearance: float,
    is_above: Mask,
) -> float:
    """Tell which points are not known to be ground; return the highest ground point near by."""
    highest = -np.inf
    g, h, k = R[2]
    for i in range(len(cells)):
        is_above[i] = False
        if cells[i] < 0:
            continue
        x, y, z = p_base[i, 0], p_base[i, 1], p_base[i, 2]
        height = np.float32(g * x + h * y + k * z)
        over = height - ground[cells[i]]
        is_above[i] = over > clearance or ground[cells[i]] == np.inf
        is_field = x * x + y * y < _STUDY_FIELD**2
        if is_field and -np.inf < over < _GROUND_RISE and height > highest:
            highest = float(height)
    return highest
