"""Stop after stop into one elevation model; holes are filled only where that is wanted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from pipelines.elevation.grid import Grid, add_stop, empty_grid
from pipelines.elevation.ground import Ground, ground_heights
from pipelines.elevation.values import ElevationConfig, ElevationModel, StationPose
from pipelines.errors import NoGroundError
from pipelines.values import Array, StitchedCloud


class Terrain:
    """Gathers the ground of a site, one stop at a time.

    Parameters
    ----------
    poses : sequence of StationPose
        All stations whose clouds will come: they say how large the grid is.
    config : ElevationConfig
        Edge of a cell, limits, noise.
    """

    def __init__(self, poses: Sequence[StationPose], config: ElevationConfig) -> None:
        self._config = config
        places = np.array([pose.T_site_station[:3, 3] for pose in poses])
        self._grid: Grid = empty_grid(places, config)

    def add(self, cloud: StitchedCloud, pose: StationPose) -> None:
        """Add the returns of one stop.

        Parameters
        ----------
        cloud : StitchedCloud
            The stop.
        pose : StationPose
            Its pose.
        """
        add_stop(self._grid, cloud, pose, self._config)

    def model(self) -> ElevationModel:
        """Return the ground as the stops so far saw it, cut to where it was seen.

        Returns
        -------
        ElevationModel
            Heights, standard deviations and counts.

        Raises
        ------
        NoGroundError
            If no cell shows ground.
        """
        config = self._config
        ground = ground_heights(self._grid, config)
        is_filled = np.zeros(ground.heights.shape, dtype=np.bool_)
        if config.gap_max > 0.0:
            ground, is_filled = _filled(ground, config)
        known = np.isfinite(ground.heights)
        if not known.any():
            raise NoGroundError(
                f"No cell of {config.cell:g} m within {config.range_max:g} m of a station shows "
                "ground; take larger cells, or check that the poses belong to these logs."
            )
        rows, columns = (np.flatnonzero(known.any(axis=axis)) for axis in (1, 0))
        part = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        return ElevationModel(
            corner=self._grid.corner + np.array([columns[0], rows[0]]) * config.cell,
            cell=config.cell,
            heights=ground.heights[part].astype(np.float32),
            sigmas=ground.sigmas[part].astype(np.float32),
            counts=ground.counts[part].copy(),
            is_filled=is_filled[part].copy(),
        )


def _filled(ground: Ground, config: ElevationConfig) -> tuple[Ground, np.ndarray]:
    """Fill small holes from the cells around; return which ones were filled.

    The height is the mean of the nearest known cells in all directions, weighted by the inverse
    square of their distance. To their variance comes how much known heights differ at that
    distance.
    """
    known = np.isfinite(ground.heights)
    distances = np.asarray(ndimage.distance_transform_edt(~known)) * config.cell
    holes = ~known & (distances <= config.gap_max)
    reach = int(np.ceil(2.0 * config.gap_max / config.cell)) + 1
    heights, sigmas = ground.heights.copy(), ground.sigmas.copy()
    steps = _variogram(ground.heights, reach)
    for i, j in np.argwhere(holes):
        part = (slice(max(i - reach, 0), i + reach + 1), slice(max(j - reach, 0), j + reach + 1))
        rows, columns = np.nonzero(known[part])
        away = np.hypot(rows + part[0].start - i, columns + part[1].start - j)
        weights = away**-2.0 / np.sum(away**-2.0)
        heights[i, j] = weights @ ground.heights[part][rows, columns]
        own = weights @ ground.sigmas[part][rows, columns] ** 2
        nearest = min(int(np.ceil(away.min())), reach)
        sigmas[i, j] = np.sqrt(own + steps[nearest - 1])
    return Ground(heights, sigmas, ground.counts), holes


def _variogram(heights: Array, reach: int) -> Array:
    """Return half the mean square of the difference of heights 1 ... ``reach`` cells apart."""
    squares = np.zeros(reach)
    for lag in range(1, reach + 1):
        across = heights[:, lag:] - heights[:, :-lag]
        along = heights[lag:] - heights[:-lag]
        both = np.concatenate([across.ravel(), along.ravel()])
        both = both[np.isfinite(both)]
        squares[lag - 1] = np.mean(both**2) if len(both) else 0.0
    return squares
