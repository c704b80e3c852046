"""Stop after stop into one elevation model; small holes are filled on request."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from spheremark.pipelines.errors import NoGroundError
from spheremark.pipelines.ground_model.grid import Grid, add_stop, empty_grid
from spheremark.pipelines.ground_model.ground import Ground, ground_heights
from spheremark.pipelines.ground_model.values import ElevationConfig, ElevationModel, StationPose
from spheremark.pipelines.model import Array, StitchedCloud


class Terrain:
    """Ground of a site, gathered stop by stop.

    Parameters
    ----------
    poses : sequence of StationPose
        All stations whose clouds will be added: they determine the grid.
    config : ElevationConfig
        Edge of a cell, limits, noise.
    """

    def __init__(self, poses: Sequence[StationPose], config: ElevationConfig) -> None:
        self._config = config
        places = np.array([pose.T_site_station[:3, 3] for pose in poses])
        self._grid: Grid = empty_grid(places, config)

    def add(self, cloud: StitchedCloud, pose: StationPose) -> None:
        """Add the returns of one stop at its pose."""
        add_stop(self._grid, cloud, pose, self._config)

    def model(self) -> ElevationModel:
        """Return the ground that the stops saw so far, cut to its extent.

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

    The height is the mean of the known cells around, weighted by the inverse square of their
    distance. To the variance of that mean its variance as a prediction of the cell is added:
    ``2 sum w_i g_i - sum w_i w_j g_ij`` with the variogram ``g`` (Matheron, 1963). Without two
    known heights nothing is filled.
    """
    known = np.isfinite(ground.heights)
    distances = np.asarray(ndimage.distance_transform_edt(~known)) * config.cell
    holes = ~known & (distances <= config.gap_max)
    reach = int(np.ceil(2.0 * config.gap_max / config.cell)) + 1
    steps = _variogram(ground.heights, 2 * reach)
    if not np.isfinite(steps).any():
        return ground, np.zeros_like(holes)
    to_hole, spectrum = _differences(steps, reach)
    padded = np.stack([np.where(known, a, 0.0) for a in (ground.heights, ground.sigmas**2)])
    padded = np.pad(padded, ((0, 0), (reach, reach), (reach, reach)))
    nearness = np.pad(known.astype(np.float64), reach)
    heights, sigmas = ground.heights.copy(), ground.sigmas.copy()
    inverse_squares = _inverse_squares(reach)
    for i, j in np.argwhere(holes):
        part = (slice(i, i + 2 * reach + 1), slice(j, j + 2 * reach + 1))
        weights = nearness[part] * inverse_squares
        weights /= weights.sum()
        height, own = np.sum(weights * padded[:, *part], axis=(1, 2))
        own += max(2.0 * np.sum(weights * to_hole) - _among(weights, spectrum), 0.0)
        heights[i, j], sigmas[i, j] = height, np.sqrt(own)
    return Ground(heights, sigmas, ground.counts), holes


def _inverse_squares(reach: int) -> Array:
    """Return the inverse squares of the distances from the middle of a window, in cells."""
    squares = np.add.outer(*(np.arange(-reach, reach + 1.0) ** 2,) * 2)
    squares[reach, reach] = np.inf
    return np.asarray(1.0 / squares)


def _differences(steps: Array, reach: int) -> tuple[Array, Array]:
    """Return the variogram from the middle of a window, and its spectrum over twice the window."""
    lags = np.arange(1.0, len(steps) + 1.0)
    is_known = np.isfinite(steps)
    lags, steps = np.r_[0.0, lags[is_known]], np.r_[0.0, steps[is_known]]
    n = 2 * (2 * reach + 1)
    apart = np.minimum(np.arange(n), n - np.arange(n)).astype(np.float64)
    table = np.interp(np.hypot(*np.meshgrid(apart, apart)), lags, steps)
    shift = np.abs(np.arange(-reach, reach + 1))
    return np.asarray(table[np.ix_(shift, shift)]), np.asarray(np.fft.fft2(table).real)


def _among(weights: Array, spectrum: Array) -> float:
    """Return the variogram's mean over all pairs of weighted cells, by Parseval's theorem."""
    power = np.abs(np.fft.fft2(weights, spectrum.shape)) ** 2
    return float(np.sum(power * spectrum) / spectrum.size)


def _variogram(heights: Array, reach: int) -> Array:
    """Return half the mean square difference of heights 1 ... ``reach`` cells apart, or NaN."""
    squares = np.full(reach, np.nan)
    for lag in range(1, reach + 1):
        across = heights[:, lag:] - heights[:, :-lag]
        along = heights[lag:] - heights[:-lag]
        both = np.concatenate([across.ravel(), along.ravel()])
        both = both[np.isfinite(both)]
        if len(both):
            squares[lag - 1] = 0.5 * np.mean(both**2)
    return squares
