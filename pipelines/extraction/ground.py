"""The ground of a stop: an opened grid of lowest points, unknown where none was seen.

Hides how ground is told from what stands on it.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

from pipelines.config import ExtractionConfig
from pipelines.geometry import levelling_rotation
from pipelines.threads import side_by_side
from pipelines.values import Array, Column, Mask, StitchedCloud

_Cell = TypeVar("_Cell", np.float32, np.uint8)

_STUDY_FIELD = 10.0  # [m] from the station: where the study looks for its highest ground point
_GROUND_WINDOW = 4  # cells each way of the opening: rocks up to twice this are not ground
_GROUND_STEP = 0.10  # [m] that a cell's lowest point may lie above the opened surface
_GROUND_CELLS_MIN = 9  # a marker seen alone covers at most 6 cells: that is not yet ground
_GROUND_RISE = 0.15  # [m] that ground may rise above its cell of the opened grid: tops of mounds
_BLOCK = 2048  # returns whose cells are found at once


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
    rows_above : (m,) int32
        Returns that are not known to be ground, ascending.
    ground_height_max : float
        Highest ground return within 10 m, levelled [m].
    """

    cells: NDArray[np.int32]
    n_side: int
    edge: float
    R_station_base: Array
    rows_above: NDArray[np.int32]
    ground_height_max: float


class _Layout(NamedTuple):
    """The grid: cells along one side, edge of a cell [m], how far it reaches [m]."""

    n_side: int
    edge: float
    reach: float


class _Seen(NamedTuple):
    """By cell: the ground [m], and whether its points must be looked at; and the clearance [m]."""

    ground: Column
    is_mixed: Mask
    clearance: float


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
    layout = _Layout(n_side, config.ground_cell, config.range_max)
    R = levelling_rotation(cloud.levelling)
    p, n = cloud.p_base, len(cloud.p_base)
    cells = np.empty(n, np.int32)
    extremes = side_by_side(
        lambda first, end: _extremes_per_cell(
            p[first:end], R.astype(np.float32), layout, cells[first:end]
        ),
        n,
    )
    lowest = np.minimum.reduce([low for low, _ in extremes])
    highest = np.maximum.reduce([high for _, high in extremes])
    ground = _ground(lowest, _opened(lowest, _GROUND_WINDOW), _GROUND_WINDOW)
    is_mixed, field_highest = _mixed(lowest, highest, ground, R, config)
    seen = _Seen(ground.ravel(), is_mixed.ravel(), config.ground_clearance)
    parts = side_by_side(lambda first, end: _above(p, R[2], cells, seen, first, end), n)
    rows = np.concatenate([rows for rows, _ in parts])
    high = max(field_highest, *(high for _, high in parts))
    return Grid(cells, n_side, config.ground_cell, R, rows, high)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _extremes_per_cell(
    p_base: Column, R: Column, layout: _Layout, cells: NDArray[np.int32]
) -> tuple[Column, Column]:
    """Write each point's cell (-1: too far); return the levelled lowest and highest per cell.

    In single precision, good to some micrometres, which halves the time.
    """
    extremes = np.empty((layout.n_side * layout.n_side, 2), np.float32)
    extremes[:, 0], extremes[:, 1] = np.inf, -np.inf
    xyz = np.empty((3, _BLOCK), np.float32)
    for low in range(0, len(p_base), _BLOCK):
        block = cells[low : low + _BLOCK]
        x, y, z = xyz[0, : len(block)], xyz[1, : len(block)], xyz[2, : len(block)]
        _level(p_base[low : low + _BLOCK], R, x, y, z)
        _cells_of_block(x, y, z, layout, block)
        for i in range(len(block)):
            cell = block[i]
            if cell >= 0:
                extremes[cell, 0] = min(extremes[cell, 0], z[i])
                extremes[cell, 1] = max(extremes[cell, 1], z[i])
    shape = (layout.n_side, layout.n_side)
    return extremes[:, 0].copy().reshape(shape), extremes[:, 1].copy().reshape(shape)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _level(p_base: Column, R: Column, x: Column, y: Column, z: Column) -> None:
    """Write the levelled coordinates of a few points."""
    a, b, c, d, e, f = R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2]
    g, h, k = R[2, 0], R[2, 1], R[2, 2]
    for i in range(len(x)):
        x[i], y[i], z[i] = p_base[i, 0], p_base[i, 1], p_base[i, 2]
    for i in range(len(x)):
        p, q, r = x[i], y[i], z[i]
        x[i], y[i] = a * p + b * q + c * r, d * p + e * q + f * r
        z[i] = g * p + h * q + k * r


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _cells_of_block(
    x: Column, y: Column, z: Column, layout: _Layout, cells: NDArray[np.int32]
) -> None:
    """Write the cells of a few levelled points; without a branch, for many at a time."""
    n_side, last = np.int32(layout.n_side), np.int32(layout.n_side - 1)
    half, per_edge = np.float32(0.5 * layout.n_side), np.float32(1.0 / layout.edge)
    reach = np.float32(layout.reach)
    for i in range(len(cells)):
        is_near = (x[i] * x[i] + y[i] * y[i] < reach * reach) & (abs(z[i]) < reach)
        row = min(np.int32(x[i] * per_edge + half), last)
        column = min(np.int32(y[i] * per_edge + half), last)
        cells[i] = row * n_side + column if is_near else np.int32(-1)


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


def _mixed(
    lowest: Column, highest: Column, ground: Column, R: Array, config: ExtractionConfig
) -> tuple[Mask, float]:
    """Tell the cells whose points must be looked at one by one; return the highest of the others.

    The others hold nothing but ground and lie on one side of the edge of the study's field, the
    highest counts where that is inside: an edge about the gimbal's axis, not about the plumb line,
    which leave at most the sine of the lean between them.
    """
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
    p_base: Column, v_up: Array, cells: NDArray[np.int32], seen: _Seen, first: int, end: int
) -> tuple[NDArray[np.int32], float]:
    """Return which points of mixed cells are not known to be ground, and the highest ground.

    Ground counts as such up to the edge of the study's field.
    """
    ground, is_mixed = seen.ground, seen.is_mixed
    rows = np.empty(end - first, np.int32)
    n_rows, highest = 0, -np.inf
    for i in range(first, end):
        cell = cells[i]
        if cell < 0 or not is_mixed[cell]:
            continue
        x, y, z = p_base[i, 0], p_base[i, 1], p_base[i, 2]
        height = np.float32(v_up[0] * x + v_up[1] * y + v_up[2] * z)
        over = height - ground[cell]
        rows[n_rows] = i  # kept only if the next one does not take its place
        n_rows += over > seen.clearance or ground[cell] == np.inf
        is_field = x * x + y * y < _STUDY_FIELD**2
        if is_field and -np.inf < over < _GROUND_RISE and height > highest:
            highest = float(height)
    return rows[:n_rows].copy(), highest
