"""The ground of a stop: an opened grid of lowest points, unknown where none was seen."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.config import ExtractionConfig
from spheremark.pipelines.detection.cells import Cells, rows_in
from spheremark.pipelines.model import Array, Column, Mask, StitchedCloud
from spheremark.pipelines.threads import side_by_side

_FIELD = 10.0  # [m] from the station: where the published method takes the highest ground point
_WINDOW = 4  # cells each way of the opening: rocks up to twice this are not ground
_STEP = 0.10  # [m] that a cell's lowest point may lie above the opened surface
_CELLS_MIN = 9  # a marker seen alone covers at most 6 cells: that is not yet ground
_RISE = 0.15  # [m] that ground may rise above its cell of the opened grid: tops of mounds
_AROUND = 24  # cells each way about a place whose ground may show its height
_ROUGH, _SLOPE, _TILT = 0.05, 0.05, 0.2  # [m] of the ground, how it bends away, tangent of tilts
_LOW, _REACHES = 0.2, (0.8, 0.4, 0.2, 0.2)  # share of cells, and heights [m], that may be ground


class Ground(NamedTuple):
    """Which returns rise above the ground.

    Attributes
    ----------
    points_above : (m, 3) float32
        Returns that are not known to be ground [m].
    height_max : float
        Highest ground return within 10 m, levelled [m].
    """

    points_above: Column
    height_max: float


def ground_of(cloud: StitchedCloud, cells: Cells, config: ExtractionConfig) -> Ground:
    """Return which returns rise above the ground, and how high the ground is."""
    v_up, clearance = cells.R_station_base[2], config.ground_clearance
    ground = _ground(cells.lowest)
    is_mixed, highest = _mixed(cells, ground, min(clearance, _RISE))
    heights, is_wanted = ground.ravel(), np.append(is_mixed, False)
    parts = side_by_side(
        lambda first, end: _above(
            cloud.p_base, v_up, *rows_in(cells.ground, is_wanted, first, end), heights, clearance
        ),
        len(cloud.p_base),
    )
    points = np.concatenate([points for points, _ in parts])
    return Ground(points, max(highest, *(part[1] for part in parts)))


def heights_above(cells: Cells, places: Array) -> Array:
    """Return heights of places above the ground about each, and their sigmas, (n, 2) [m].

    Sigmas are infinite where too little ground is seen within some metres.
    """
    n_side, edge, _ = cells.layout
    found = np.full((len(places), 2), (np.nan, np.inf))
    for i, (x, y, z) in enumerate(places @ cells.R_station_base.T):
        row, column = (int(np.floor(a / edge)) + n_side // 2 for a in (x, y))
        rows = slice(max(row - _AROUND, 0), row + _AROUND + 1)
        columns = slice(max(column - _AROUND, 0), column + _AROUND + 1)
        near = cells.lowest[rows, columns]
        at = np.argwhere(near < np.inf)
        if len(at) >= _CELLS_MIN:
            off = (at + [rows.start, columns.start] + 0.5 - n_side // 2) * edge - (x, y)
            height, sigma = _plane_below(off, near[tuple(at.T)].astype(np.float64))
            found[i] = z - height, sigma
    return found


def _plane_below(off: Array, lowest: Array) -> tuple[float, float]:
    """Return the height of the ground at the origin, by a plane through lowest points, and sigma.

    What stands on the ground is left out step by step, from a low level plane on.
    """
    J = np.column_stack([np.ones(len(off)), off])
    precisions = 1.0 / (_ROUGH + _SLOPE * np.hypot(*off.T)) ** 2
    plane, cov = np.array([np.quantile(lowest, _LOW), 0.0, 0.0]), np.eye(3)
    for reach in _REACHES:
        residuals = lowest - J @ plane
        weights = precisions * (abs(residuals) < reach)
        cov = np.linalg.inv((J * weights[:, None]).T @ J + np.diag([1e-6, *2 * [_TILT**-2.0]]))
        plane = cov @ (J.T @ (weights * lowest))
    return float(plane[0]), float(np.sqrt(_ROUGH**2 + _CELLS_MIN * cov[0, 0]))


def _lowest_about(values: Column, window: int) -> Column:
    """Return the lowest of the square window about each cell."""
    lowest = np.pad(values, window, constant_values=np.inf)
    for _ in range(2 * window):
        lowest = np.minimum(lowest[1:], lowest[:-1])
    for _ in range(2 * window):
        lowest = np.minimum(lowest[:, 1:], lowest[:, :-1])
    return lowest


def _highest_about(values: Column, window: int) -> Column:
    """Return the highest of the square window about each cell."""
    return -_lowest_about(-values, window)


def _n_about(mask: Mask, window: int) -> NDArray[np.int64]:
    """Return how many cells of a mask are set in the square window about each cell."""
    sums = np.pad(mask, ((window + 1, window), (window + 1, window))).cumsum(axis=0).cumsum(axis=1)
    size = 2 * window + 1
    counts: NDArray[np.int64]
    counts = sums[size:, size:] - sums[size:, :-size] - sums[:-size, size:] + sums[:-size, :-size]
    return counts


def _opened(lowest: Column) -> Column:
    """Return the morphological opening of the lowest points; -inf where too few cells are known.

    A window that sees nothing but a marker, behind a mound say, shows no ground.
    """
    eroded = _lowest_about(lowest, _WINDOW)
    is_known = (_n_about(lowest < np.inf, _WINDOW) >= _CELLS_MIN) & (eroded < np.inf)
    return _highest_about(np.where(is_known, eroded, np.float32(-np.inf)), _WINDOW)


def _ground(lowest: Column) -> Column:
    """Return the ground's height per cell; infinite where no ground was seen in or beside it.

    A cell has ground where its lowest point lies near the opened surface and enough others around
    do too: a marker behind a rock has no ground around it, and must not become ground itself.
    """
    is_low = lowest < _opened(lowest) + np.float32(_STEP)
    highest = _highest_about(np.where(is_low, lowest, np.float32(-np.inf)), 1)
    is_ground = (highest > -np.inf) & (_n_about(is_low, _WINDOW) >= _CELLS_MIN)
    return np.where(is_ground, highest, np.float32(np.inf))


def _mixed(cells: Cells, ground: Column, rise_max: float) -> tuple[Mask, float]:
    """Return the cells whose returns must be tested one by one, and the highest of the others.

    The others hold nothing but ground and lie on one side of the edge of the field, whose highest
    point counts inside: an edge about the gimbal's axis, not about the plumb line, which leave at
    most the sine of the lean between them.
    """
    n, edge, _ = cells.layout
    lean = np.hypot(cells.R_station_base[2, 0], cells.R_station_base[2, 1])
    middles = np.arange(n) + 0.5 - 0.5 * n
    away = edge * np.hypot(middles[:, None], middles)
    is_seen = cells.lowest < np.inf
    extreme = np.maximum(np.abs(cells.lowest), np.abs(cells.highest))
    slack = edge + lean * (np.where(is_seen, extreme, 0.0) + away + 1.0)
    # in double precision, like the limit
    is_known = (cells.highest - ground <= np.float64(rise_max - 1e-4)) & (ground < np.inf)
    is_mixed = is_seen & ~(is_known & (np.abs(away - _FIELD) > slack))
    is_inside = is_seen & ~is_mixed & (away + slack < _FIELD)
    return is_mixed, float(cells.highest[is_inside].max(initial=-np.inf))


@compiled
def _above(
    p_base: Column,
    v_up: Array,
    rows: NDArray[np.int32],
    cells: NDArray[np.int32],
    ground: Column,
    clearance: float,
) -> tuple[Column, float]:
    """Return the returns that are not known to be ground, and the highest ground in the field."""
    above = np.empty((len(rows) + 1, 3), np.float32)
    n, highest = 0, -np.inf
    for i in range(len(rows)):
        x, y, z = p_base[rows[i], 0], p_base[rows[i], 1], p_base[rows[i], 2]
        height = np.float32(v_up[0] * x + v_up[1] * y + v_up[2] * z)
        below = ground[cells[i]]
        over = height - below
        above[n, 0], above[n, 1], above[n, 2] = x, y, z  # overwritten by the next unless counted
        n += (over > clearance) | (below == np.inf)
        is_field = x * x + y * y < _FIELD**2
        if is_field and -np.inf < over < _RISE and height > highest:
            highest = float(height)
    return above[:n], highest
