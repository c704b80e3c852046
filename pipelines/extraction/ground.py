"""The ground of a stop: an opened grid of lowest points, unknown where none was seen.

Hides how ground is told from what stands on it.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

from pipelines.config import ExtractionConfig
from pipelines.extraction.cells import Cells, rows_in
from pipelines.values import Array, Column, Mask, StitchedCloud

_Cell = TypeVar("_Cell", np.float32, np.uint8)

_STUDY_FIELD = 10.0  # [m] from the station: where the study looks for its highest ground point
_GROUND_WINDOW = 4  # cells each way of the opening: rocks up to twice this are not ground
_GROUND_STEP = 0.10  # [m] that a cell's lowest point may lie above the opened surface
_GROUND_CELLS_MIN = 9  # a marker seen alone covers at most 6 cells: that is not yet ground
_GROUND_RISE = 0.15  # [m] that ground may rise above its cell of the opened grid: tops of mounds


class Ground(NamedTuple):
    """Which returns rise above the ground.

    Attributes
    ----------
    rows_above : (m,) int32
        Returns that are not known to be ground, ascending.
    height_max : float
        Highest ground return within 10 m, levelled [m].
    """

    rows_above: NDArray[np.int32]
    height_max: float


def ground_of(cloud: StitchedCloud, cells: Cells, config: ExtractionConfig) -> Ground:
    """Tell the ground.

    Parameters
    ----------
    cloud : StitchedCloud
        One stop.
    cells : Cells
        Where its returns lie.
    config : ExtractionConfig
        Clearance above the ground.

    Returns
    -------
    Ground
        What rises above it.
    """
    lowest = cells.lowest
    ground = _ground(lowest, _opened(lowest, _GROUND_WINDOW), _GROUND_WINDOW)
    is_mixed, field_highest = _mixed(cells, ground, config)
    rows = rows_in(cells.ground, np.append(is_mixed, False))
    v_up, clearance = cells.R_station_base[2], config.ground_clearance
    rows, high = _above(cloud.p_base, v_up, cells.ground, rows, ground.ravel(), clearance)
    return Ground(rows, max(field_highest, high))


def _slid(values: NDArray[_Cell], window: int, combine: np.ufunc, outside: float) -> NDArray[_Cell]:
    """Return what combining makes of the square window about each cell."""
    for _ in range(2):  # rows, then columns
        padded = np.pad(values, ((window, window), (0, 0)), constant_values=outside)
        out = padded[: len(values)].copy()
        for shift in range(1, 2 * window + 1):
            combine(out, padded[shift : shift + len(values)], out=out)
        values = np.ascontiguousarray(out.T)
    return values


def _opened(lowest: Column, window: int) -> Column:
    """Return the morphological opening of the lowest points; -inf where too little is near.

    A window that sees nothing but a marker, behind a mound say, tells nothing about the ground.
    """
    eroded = _slid(lowest, window, np.minimum, np.inf)
    n_known = _slid(np.isfinite(lowest).astype(np.uint8), window, np.add, 0)
    eroded[(n_known < _GROUND_CELLS_MIN) | ~np.isfinite(eroded)] = -np.inf
    return _slid(eroded, window, np.maximum, -np.inf)


def _ground(lowest: Column, opened: Column, window: int) -> Column:
    """Return the ground's height per cell; infinite where no ground was seen in or beside it.

    A cell has ground where its lowest point lies near the opened surface and enough others around
    do too: a marker behind a rock has no ground around it, and must not become ground itself.
    """
    is_low = lowest < opened + np.float32(_GROUND_STEP)
    highest = _slid(np.where(is_low, lowest, np.float32(-np.inf)), 1, np.maximum, -np.inf)
    n_low = _slid(is_low.astype(np.uint8), window, np.add, 0)
    is_ground = (highest > -np.inf) & (n_low >= _GROUND_CELLS_MIN)
    return np.where(is_ground, highest, np.float32(np.inf))


def _mixed(cells: Cells, ground: Column, config: ExtractionConfig) -> tuple[Mask, float]:
    """Tell the cells whose points must be looked at one by one; return the highest of the others.

    The others hold nothing but ground and lie on one side of the edge of the study's field, the
    highest counts where that is inside: an edge about the gimbal's axis, not about the plumb line,
    which leave at most the sine of the lean between them.
    """
    lowest, highest, R = cells.lowest, cells.highest, cells.R_station_base
    places = (np.arange(len(ground)) + 0.5) * config.ground_cell
    places -= 0.5 * config.ground_cell * len(ground)
    away = np.hypot(places[:, None], places[None, :])
    is_seen = np.isfinite(lowest)
    farthest = np.where(is_seen, np.maximum(np.abs(lowest), np.abs(highest)), 0.0) + away + 1.0
    slack = config.ground_cell + np.hypot(R[2, 0], R[2, 1]) * farthest
    with np.errstate(invalid="ignore"):  # where nothing was seen
        rises = ~(highest - ground <= min(config.ground_clearance, _GROUND_RISE) - 1e-4)
    is_inside = away + slack < _STUDY_FIELD
    is_mixed = is_seen & (rises | np.isinf(ground) | (np.abs(away - _STUDY_FIELD) <= slack))
    return is_mixed, float(highest[is_inside & ~is_mixed].max(initial=-np.inf))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _above(
    p_base: Column,
    v_up: Array,
    cells: NDArray[np.int32],
    rows: NDArray[np.int32],
    ground: Column,
    clearance: float,
) -> tuple[NDArray[np.int32], float]:
    """Return which of some rows are not known to be ground, and the highest ground among them.

    Ground counts as such up to the edge of the study's field.
    """
    above = np.empty(len(rows), np.int32)
    n, highest = 0, -np.inf
    for i in rows:
        x, y, z = p_base[i, 0], p_base[i, 1], p_base[i, 2]
        height = np.float32(v_up[0] * x + v_up[1] * y + v_up[2] * z)
        below = ground[cells[i]]
        over = height - below
        above[n] = i  # kept only if the next one does not take its place
        n += (over > clearance) | (below == np.inf)
        is_field = x * x + y * y < _STUDY_FIELD**2
        if is_field and -np.inf < over < _GROUND_RISE and height > highest:
            highest = float(height)
    return above[:n].copy(), highest
