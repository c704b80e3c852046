"""The ground of a stop: an opened grid of lowest points, unknown where none was seen.

Hides how ground is told from what stands on it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.config import ExtractionConfig
from spheremark.pipelines.detection.cells import Cells, rows_in
from spheremark.pipelines.model import Array, Column, Mask, StitchedCloud
from spheremark.pipelines.threads import side_by_side

_STUDY_FIELD = 10.0  # [m] from the station: where the study looks for its highest ground point
_GROUND_WINDOW = 4  # cells each way of the opening: rocks up to twice this are not ground
_GROUND_STEP = 0.10  # [m] that a cell's lowest point may lie above the opened surface
_GROUND_CELLS_MIN = 9  # a marker seen alone covers at most 6 cells: that is not yet ground
_N_WORTH = 100  # rows of the grid from which on a thread gains more than it takes to start
_GROUND_RISE = 0.15  # [m] that ground may rise above its cell of the opened grid: tops of mounds


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
    """Tell the ground."""
    v_up, clearance = cells.R_station_base[2], config.ground_clearance
    rise_max, n_side = min(clearance, _GROUND_RISE), cells.layout.n_side
    maps = side_by_side(
        lambda first, end: _mapped(cells, rise_max, first, end), n_side, worth=_N_WORTH
    )
    ground = np.concatenate([ground for ground, _, _ in maps], axis=None)
    is_mixed = np.concatenate([*(is_mixed for _, is_mixed, _ in maps), [False]], axis=None)
    parts = side_by_side(
        lambda first, end: _above(
            cloud.p_base,
            v_up,
            *rows_in(cells.ground, is_mixed, first, end),
            ground,
            clearance,
        ),
        len(cloud.p_base),
    )
    points = np.concatenate([points for points, _ in parts])
    highest = max(part[-1] for part in (*maps, *parts))
    return Ground(points, highest)


@compiled
def _lowest_about(values: Column, window: int) -> Column:
    """Return the lowest of the square window about each cell."""
    n, m = values.shape
    along = values.copy()
    for i in range(n):
        for k in range(max(i - window, 0), min(i + window + 1, n)):
            for j in range(m):
                along[i, j] = min(along[i, j], values[k, j])
    lowest = along.copy()
    for i in range(n):
        for k in range(1, window + 1):
            for j in range(m - k):
                lowest[i, j] = min(lowest[i, j], along[i, j + k])
            for j in range(m - k):
                lowest[i, j + k] = min(lowest[i, j + k], along[i, j])
    return lowest


@compiled
def _n_about(mask: Mask, window: int) -> NDArray[np.uint8]:
    """Return how many cells of a mask are set in the square window about each cell."""
    n, m = mask.shape
    along = np.zeros((n, m), np.uint8)
    for i in range(n):
        for k in range(max(i - window, 0), min(i + window + 1, n)):
            for j in range(m):
                along[i, j] += np.uint8(mask[k, j])
    counts = along.copy()
    for i in range(n):
        for k in range(1, window + 1):
            for j in range(m - k):
                counts[i, j] += along[i, j + k]
            for j in range(m - k):
                counts[i, j + k] += along[i, j]
    return counts


@compiled
def _where(mask: Mask, values: Column, other: float) -> Column:
    """Return values where a mask is set, another elsewhere: many times as quick as ``np.where``."""
    chosen = np.empty_like(values)
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            chosen[i, j] = values[i, j] if mask[i, j] else np.float32(other)
    return chosen


@compiled
def _highest_about(values: Column, window: int) -> Column:
    """Return the highest of the square window about each cell."""
    highest: Column = -_lowest_about(-values, window)
    return highest


@compiled
def _opened(lowest: Column, window: int) -> Column:
    """Return the morphological opening of the lowest points; -inf where too little is near.

    A window that sees nothing but a marker, behind a mound say, tells nothing about the ground.
    """
    eroded = _lowest_about(lowest, window)
    is_known = (_n_about(lowest < np.inf, window) >= _GROUND_CELLS_MIN) & (eroded < np.inf)
    opened: Column = _highest_about(_where(is_known, eroded, -np.inf), window)
    return opened


@compiled
def _ground(lowest: Column, window: int) -> Column:
    """Return the ground's height per cell; infinite where no ground was seen in or beside it.

    A cell has ground where its lowest point lies near the opened surface and enough others around
    do too: a marker behind a rock has no ground around it, and must not become ground itself.
    """
    is_low = lowest < _opened(lowest, window) + np.float32(_GROUND_STEP)
    highest = _highest_about(_where(is_low, lowest, -np.inf), 1)
    is_ground = (highest > -np.inf) & (_n_about(is_low, window) >= _GROUND_CELLS_MIN)
    ground: Column = _where(is_ground, highest, np.inf)
    return ground


@compiled
def _mapped(cells: Cells, rise_max: float, first: int, end: int) -> tuple[Column, Mask, float]:
    """Return ground and mixed cells of some rows of the grid, and the highest of the other cells.

    The ground of a cell hangs on what is seen up to three windows away, as it is asked three times
    what lies about a cell: about what is low, about the opened surface, and about the eroded one.
    """
    margin = 3 * _GROUND_WINDOW
    low = max(first - margin, 0)
    ground = _ground(cells.lowest[low : end + margin], _GROUND_WINDOW)[first - low : end - low]
    is_mixed, field_highest = _mixed(cells, ground, rise_max, first)
    return ground, is_mixed, field_highest


@compiled
def _mixed(cells: Cells, ground: Column, rise_max: float, first: int) -> tuple[Mask, float]:
    """Tell the cells whose points must be looked at one by one; return the highest of the others.

    The others hold nothing but ground and lie on one side of the edge of the study's field, the
    highest counts where that is inside: an edge about the gimbal's axis, not about the plumb line,
    which leave at most the sine of the lean between them. Asked of the rows that ground is given
    of, from the first one on.
    """
    n, edge, _ = cells.layout
    lean = np.hypot(cells.R_station_base[2, 0], cells.R_station_base[2, 1])
    is_mixed, field_highest = np.zeros(ground.shape, np.bool_), -np.inf
    for k in range(len(ground)):
        i = first + k
        for j in range(n):
            low, high, base = cells.lowest[i, j], cells.highest[i, j], ground[k, j]
            if low == np.inf:
                continue
            x, y = i + 0.5 - 0.5 * n, j + 0.5 - 0.5 * n
            away = edge * np.sqrt(x * x + y * y)
            slack = edge + lean * (max(abs(low), abs(high)) + away + 1.0)
            is_known = high - base <= rise_max - 1e-4 and base < np.inf
            if not is_known or abs(away - _STUDY_FIELD) <= slack:
                is_mixed[k, j] = True
            elif away + slack < _STUDY_FIELD:
                field_highest = max(field_highest, float(high))
    return is_mixed, field_highest


@compiled
def _above(
    p_base: Column,
    v_up: Array,
    rows: NDArray[np.int32],
    cells: NDArray[np.int32],
    ground: Column,
    clearance: float,
) -> tuple[Column, float]:
    """Return those of some returns that are not known to be ground, and the highest ground there.

    Ground counts as such up to the edge of the study's field.
    """
    above = np.empty((len(rows) + 1, 3), np.float32)
    n, highest = 0, -np.inf
    for i in range(len(rows)):
        x, y, z = p_base[rows[i], 0], p_base[rows[i], 1], p_base[rows[i], 2]
        height = np.float32(v_up[0] * x + v_up[1] * y + v_up[2] * z)
        below = ground[cells[i]]
        over = height - below
        above[n, 0], above[n, 1], above[n, 2] = x, y, z  # unless the next one takes its place
        n += (over > clearance) | (below == np.inf)
        is_field = x * x + y * y < _STUDY_FIELD**2
        if is_field and -np.inf < over < _GROUND_RISE and height > highest:
            highest = float(height)
    return above[:n], highest
