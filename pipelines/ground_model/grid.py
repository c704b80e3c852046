"""The grid in which the returns of one stop after another are gathered.

Each cell has four by four sub-cells. A stop leaves in each sub-cell the mean of its lowest returns;
stops are joined by weight, and where they differ by more than a step the lower one is kept: the
other one saw an object. Memory grows with the site, not with the returns.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.errors import ConfigError
from spheremark.pipelines.geometry import levelling_rotation, rigid, skew
from spheremark.pipelines.ground_model.values import ElevationConfig, StationPose
from spheremark.pipelines.model import Array, StitchedCloud

SUB = 4
"""Sub-cells along an edge of a cell."""

_CELLS_MAX = 1_000_000  # some 400 MB
_BAND = 0.03  # [m] above the lowest return of a sub-cell that is ground, beside noise
_BAND_SIGMAS = 6.0
_STEP = 0.05  # [m] by which two stops may differ in a sub-cell and mean the same ground
_SLOPE = 0.1  # a usual slope, where the true one is not yet known
_FLOOR = 0.002  # [m] that no stop's mean is better than when weights are given ...
_GRAZING = 0.1  # ... and as much again where beams graze at this sine: they see crests only


class Grid(NamedTuple):
    """Sums over stops; rows run north, columns east, sub-cells four times as fine."""

    corner: Array  # (2,) south-western corner [m]
    weights: Array  # (4r, 4c) float64 sum of the weights of stops
    moments: Array  # (4r, 4c, 3) float64 weighted sums of x and y from the corner and of height [m]
    # (4r, 4c) float64 sum of squared weight over returns: times the variance of one return, that of
    # the sum
    noises: Array
    counts: NDArray[np.int32]  # (4r, 4c) int32 returns
    # (r, c, 6) float64 weighted sums of the products of the beams' directions: xx, xy, xz, yy, yz,
    # zz
    beams: Array
    shares: Array  # (r, c) float64 sums of the weights
    # (r, c, 6) float64 sums of squared weight times the covariance that the pose of a station gives
    # to a point
    poses: Array
    # (r, c) float64 weighted sums of the squared distances from the stations [m^2]
    distances: Array


def empty_grid(p_site: Array, config: ElevationConfig) -> Grid:
    """Return an empty grid around stations."""
    low = np.floor((p_site[:, :2].min(axis=0) - config.range_max) / config.cell)
    high = np.ceil((p_site[:, :2].max(axis=0) + config.range_max) / config.cell)
    columns, rows = (int(n) for n in high - low)
    if rows * columns > _CELLS_MAX:
        raise ConfigError(
            f"Cells of {config.cell:g} m make {rows} x {columns} of them over this site, more than "
            f"{_CELLS_MAX:,}; take larger cells or a smaller range."
        )
    fine, coarse = (SUB * rows, SUB * columns), (rows, columns)
    return Grid(
        corner=low * config.cell,
        weights=np.zeros(fine),
        moments=np.zeros((*fine, 3)),
        noises=np.zeros(fine),
        counts=np.zeros(fine, np.int32),
        beams=np.zeros((*coarse, 6)),
        shares=np.zeros(coarse),
        poses=np.zeros((*coarse, 6)),
        distances=np.zeros(coarse),
    )


def add_stop(grid: Grid, cloud: StitchedCloud, pose: StationPose, config: ElevationConfig) -> None:
    """Gather the returns of one stop into a grid, in place."""
    T = pose.T_site_station @ rigid(levelling_rotation(cloud.levelling), np.zeros(3))
    place = (T[:2, 3] - grid.corner) / config.cell
    reach = config.range_max / config.cell
    first = np.maximum(np.floor(place - reach), 0.0).astype(np.intp)
    end = np.minimum(np.ceil(place + reach), grid.shares.shape[::-1]).astype(np.intp)
    T[:2, 3] -= grid.corner + first * config.cell  # from the corner of the window
    edge, (columns, rows) = config.cell / SUB, end - first
    sums = _lowest_returns(
        cloud.p_base,
        np.ascontiguousarray(T[:3]),
        (SUB * rows, SUB * columns),
        (edge, config.range_max**2, config.sigma_range**2),
    )
    window = np.array([first[1], first[0], rows, columns])
    covs = _cov_of_places(pose, grid.corner, window, config.cell)
    _join(grid, window, sums, covs, T[:3, 3], (edge, config.sigma_range**2))


def _cov_of_places(
    pose: StationPose, corner: Array, window: NDArray[np.intp], cell: float
) -> Array:
    """Return covariances by a pose, xx to zz, of a window's cells, a metre below the station."""
    row, column, n_rows, n_columns = window
    xs = corner[0] + (column + np.arange(n_columns) + 0.5) * cell
    ys = corner[1] + (row + np.arange(n_rows) + 0.5) * cell
    places = np.empty((n_rows, n_columns, 3))
    places[..., 0], places[..., 1] = np.meshgrid(xs, ys)
    places[..., 2] = pose.T_site_station[2, 3] - 1.0
    J = np.concatenate([-skew(places), np.broadcast_to(np.eye(3), (*places.shape, 3))], axis=-1)
    cov = J @ pose.cov_T_site_station @ np.swapaxes(J, -1, -2)
    return np.ascontiguousarray(cov[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]])


@compiled
def _lowest_returns(p_base, T, shape, limits):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Return count and sums of x, y, z of each sub-cell's lowest returns, (4r, 4c, 4).

    ``limits``: edge of a sub-cell, square of the greatest distance, variance of a range.
    """
    edge, reach2, variance = limits
    lowest = np.full(shape, np.inf)
    for i in range(len(p_base)):
        u, v, w = np.float64(p_base[i, 0]), np.float64(p_base[i, 1]), np.float64(p_base[i, 2])
        x, y = T[0, 0] * u + T[0, 1] * v + T[0, 2] * w, T[1, 0] * u + T[1, 1] * v + T[1, 2] * w
        row, column = int((y + T[1, 3]) // edge), int((x + T[0, 3]) // edge)
        if x * x + y * y > reach2 or not (0 <= row < shape[0] and 0 <= column < shape[1]):
            continue
        z = T[2, 0] * u + T[2, 1] * v + T[2, 2] * w + T[2, 3]
        lowest[row, column] = min(lowest[row, column], z)
    sums = np.zeros((shape[0], shape[1], 4))
    for i in range(len(p_base)):
        u, v, w = np.float64(p_base[i, 0]), np.float64(p_base[i, 1]), np.float64(p_base[i, 2])
        x, y = T[0, 0] * u + T[0, 1] * v + T[0, 2] * w, T[1, 0] * u + T[1, 1] * v + T[1, 2] * w
        row, column = int((y + T[1, 3]) // edge), int((x + T[0, 3]) // edge)
        across2 = x * x + y * y
        if across2 > reach2 or not (0 <= row < shape[0] and 0 <= column < shape[1]):
            continue
        z = T[2, 0] * u + T[2, 1] * v + T[2, 2] * w
        slanted = (z * z + _SLOPE * _SLOPE * across2) / (z * z + across2)
        band = _BAND + _BAND_SIGMAS * np.sqrt(variance * slanted)
        if z + T[2, 3] <= lowest[row, column] + band:
            sums[row, column, 0] += 1.0
            sums[row, column, 1] += x + T[0, 3]
            sums[row, column, 2] += y + T[1, 3]
            sums[row, column, 3] += z + T[2, 3]
    return sums


@compiled
def _join(grid, window, sums, covs, station, noise):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Join the sums of one stop to the grid; ``noise``: edge of a sub-cell, variance of a range."""
    edge, variance = noise
    row0, column0 = window[0] * SUB, window[1] * SUB
    own = np.zeros((window[2], window[3]))
    for row in range(sums.shape[0]):
        for column in range(sums.shape[1]):
            n = sums[row, column, 0]
            if n == 0.0:
                continue
            x, y, z = sums[row, column, 1] / n, sums[row, column, 2] / n, sums[row, column, 3] / n
            dx, dy, dz = x - station[0], y - station[1], z - station[2]
            across2 = dx * dx + dy * dy
            far2 = across2 + dz * dz
            cov = covs[row // SUB, column // SUB]
            slanted = (dz * dz + _SLOPE * _SLOPE * across2) / far2
            level = cov[5] + _SLOPE * _SLOPE * 0.5 * (cov[0] + cov[3])
            floor = _FLOOR * (1.0 + _GRAZING * _GRAZING * far2 / max(dz * dz, 1e-6))
            weight = 1.0 / (variance * slanted / n + level + floor * floor)
            i, j = row0 + row, column0 + column
            if grid.weights[i, j] > 0.0:
                step = z - grid.moments[i, j, 2] / grid.weights[i, j]
                if step > _STEP:
                    continue
                if step < -_STEP:
                    grid.weights[i, j], grid.noises[i, j], grid.counts[i, j] = 0.0, 0.0, 0
                    grid.moments[i, j, :] = 0.0
            grid.weights[i, j] += weight
            grid.moments[i, j, 0] += weight * (x + column0 * edge)
            grid.moments[i, j, 1] += weight * (y + row0 * edge)
            grid.moments[i, j, 2] += weight * z
            grid.noises[i, j] += weight * weight / n
            grid.counts[i, j] += int(n)
            k, m = i // SUB, j // SUB
            grid.shares[k, m] += weight
            grid.distances[k, m] += weight * far2
            _add_products(grid.beams[k, m], weight / far2, dx, dy, dz)
            own[row // SUB, column // SUB] += weight
    for row in range(len(own)):  # all sub-cells of a cell share the error of the pose
        for column in range(own.shape[1]):
            square = own[row, column] ** 2
            for a in range(6):
                grid.poses[window[0] + row, window[1] + column, a] += square * covs[row, column, a]


@compiled
def _add_products(sums, weight, x, y, z):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Add weighted products of a vector's components."""
    sums[0] += weight * x * x
    sums[1] += weight * x * y
    sums[2] += weight * x * z
    sums[3] += weight * y * y
    sums[4] += weight * y * z
    sums[5] += weight * z * z
