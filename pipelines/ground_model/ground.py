"""Sub-cells -> mean height of the ground of each cell: hides how ground is separated from objects.

About each cell a curved surface is fitted to the sub-cells of a window, and those above it lose
their weight (robust interpolation: Kraus and Pfeifer, ISPRS J. 53, 1998). Sub-cells near that
surface are ground. The mean height of the cell is then estimated from its own sub-cells, with the
roughness of the sub-cells as the uncertainty of those that were not seen (block kriging with a
nugget). Sub-cells in the shadow of a crest are lower than those seen: the mean is corrected by
grazing angle and roughness, and the correction is added to the standard deviation.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.estimation.linear_algebra import solve
from spheremark.pipelines.ground_model.grid import SUB, Grid
from spheremark.pipelines.ground_model.values import ElevationConfig
from spheremark.pipelines.model import Array, Mask
from spheremark.pipelines.threads import side_by_side

_HALF_WEIGHTS = (0.10, 0.05, 0.03, 0.02, 0.02, 0.02)  # [m] above the surface, in each pass
_N_PLANE = 2  # passes with a plane; then curved
_BELOW = 3.0  # times as far below it: outliers below are rare
_NEAR = 0.05  # [m] from the surface that a sub-cell of the ground may be
_N_CURVED, _N_FLAT = 12, 5  # sub-cells that a curved surface and a plane need
_STEEPEST = 0.7  # slope that ground may have; 35 degrees
_RISE = 0.10  # [m] that it may rise beyond that
_RISE_WITHIN = 1.5  # [m] about a cell where lower ground is looked for
_ROUGHNESS_MIN = 0.0005  # [m]
_LASERS = 2.0  # different lasers that see a cell, at the least; near by, more cross it
_PITCH = np.radians(2.0)  # between lasers
_SHADOW = 1.2  # roughnesses that hidden sub-cells lie lower, where all that is hidden is in shadow
_SHADOW_RISE = 0.3  # how that begins, with slope over sine of the grazing angle: by simulation


class Ground(NamedTuple):
    """Heights of cells, (rows, columns) each; NaN where no ground was seen."""

    heights: Array
    sigmas: Array
    counts: NDArray[np.int32]


def ground_heights(grid: Grid, config: ElevationConfig) -> Ground:
    """Estimate the mean height of the ground in each cell.

    Notes
    -----
    The variance of a height is the sum of: the roughness of sub-cells that were not seen, or have
    too much weight; the noise of the ranges on the slope; the prior of the slope, where the
    sub-cells lie to one side; the common errors of a cell by poses, lasers and directions; and the
    correction for shadow.
    """
    rows, columns = grid.shares.shape
    surfaces = np.full((rows, columns, 8), np.nan)
    sizes = np.array([config.cell, config.object_max, config.sigma_range**2])
    side_by_side(
        lambda first, end: _fit_surfaces(grid, sizes, surfaces, first, end), rows, threaded_from=1
    )
    steep = _stands_out(surfaces[..., 0], config.cell)
    surfaces[steep] = np.nan
    heights, sigmas = np.full((rows, columns), np.nan), np.full((rows, columns), np.nan)
    counts = np.zeros((rows, columns), np.int32)
    common = np.array([config.sigma_laser_bias**2, config.sigma_direction**2])
    stands = _standing(grid, sizes, surfaces)
    _estimate(grid, sizes, common, surfaces, stands, heights, sigmas, counts)
    return Ground(heights, sigmas, counts)


@compiled
def _window(grid, row, column, cell, reach, points):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Collect x, y from a cell's centre in units of ``reach``, height and noise; count them."""
    middle_x, middle_y = (column + 0.5) * cell, (row + 0.5) * cell
    half = int(np.ceil(reach / cell * SUB)) + SUB // 2
    i0, j0 = row * SUB + SUB // 2, column * SUB + SUB // 2
    n = 0
    for i in range(max(i0 - half, 0), min(i0 + half, grid.weights.shape[0])):
        for j in range(max(j0 - half, 0), min(j0 + half, grid.weights.shape[1])):
            weight = grid.weights[i, j]
            if weight == 0.0:
                continue
            x = (grid.moments[i, j, 0] / weight - middle_x) / reach
            y = (grid.moments[i, j, 1] / weight - middle_y) / reach
            if x * x + y * y >= 1.0:
                continue
            points[n, 0], points[n, 1] = x, y
            points[n, 2] = grid.moments[i, j, 2] / weight
            points[n, 3] = grid.noises[i, j] / weight**2
            n += 1
    return n


@compiled
def _terms(x, y, terms):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Write the terms of a curved surface."""
    terms[0], terms[1], terms[2] = 1.0, x, y
    terms[3], terms[4], terms[5] = x * x, x * y, y * y


@compiled
def _robust(points, n, b):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Fit a surface to points of which some stand above it; return the number of its terms."""
    normal, terms = np.zeros((6, 6)), np.zeros(6)
    k = 0
    lowest = points[:n, 2].min()
    for step in range(len(_HALF_WEIGHTS)):
        is_first, half = step == 0, _HALF_WEIGHTS[step]
        wanted = 6 if step >= _N_PLANE and n >= _N_CURVED else 3
        normal[:], right = 0.0, np.zeros(6)
        for p in range(n):
            x, y, z = points[p, 0], points[p, 1], points[p, 2] - lowest
            _terms(x, y, terms)
            weight = 1.0 - x * x - y * y
            if not is_first:
                off = z
                for a in range(k):
                    off -= b[a] * terms[a]
                size = off / half if off > 0.0 else off / (_BELOW * half)
                weight /= 1.0 + size**4
            for a in range(wanted):
                right[a] += weight * z * terms[a]
                for c in range(a + 1):
                    normal[a, c] += weight * terms[a] * terms[c]
        for a in range(1, wanted):
            normal[a, a] += 1e-3
        if not solve(normal[:wanted, :wanted], right):
            return 0
        for a in range(wanted):
            b[a] = right[a]
        k = wanted
    b[0] += lowest
    return k


@compiled
def _fit_surfaces(grid, sizes, surfaces, first, end):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Write of each cell: height, slopes (2), curvatures (3), roughness variance, shape of beams.

    The shape of beams is the mean square of the cosine between beam and normal over that between
    vertical and normal.
    """
    cell, reach = sizes[0], max(sizes[1], 1.5 * sizes[0])
    side = 2 * (int(np.ceil(reach / cell * SUB)) + SUB)
    points, b = np.empty((side * side, 4)), np.zeros(6)
    for row in range(first, end):
        for column in range(grid.shares.shape[1]):
            if grid.shares[row, column] == 0.0:
                continue
            n = _window(grid, row, column, cell, reach, points)
            b[:] = 0.0
            k = _robust(points, n, b) if n >= _N_FLAT else 0
            if k == 0:
                continue
            share, beams = grid.shares[row, column], grid.beams[row, column]
            shape = _met(beams, share, b[1] / reach, b[2] / reach)
            roughness = _roughness(points, n, b, k, sizes[2] * shape)
            if roughness > 0.0:
                for a in range(6):
                    scale = 1.0 if a == 0 else reach if a < 3 else reach * reach
                    surfaces[row, column, a] = b[a] / scale
                surfaces[row, column, 6], surfaces[row, column, 7] = roughness, shape


@compiled
def _roughness(points, n, b, k, variance):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Return the variance of points about their surface beyond noise; 0 if too few are near it."""
    terms = np.zeros(6)
    squares = noise = 0.0
    n_near = 0
    for p in range(n):
        _terms(points[p, 0], points[p, 1], terms)
        off = points[p, 2]
        for a in range(6):
            off -= b[a] * terms[a]
        if abs(off) < _NEAR:
            squares, n_near = squares + off * off, n_near + 1
            noise += variance * points[p, 3]
    if n_near < _N_FLAT:
        return 0.0
    return max((squares - noise) / max(n_near - k, 1), _ROUGHNESS_MIN**2)


@compiled
def _met(products, share, slope_x, slope_y):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Return the mean of ``(n . d)^2 / n_z^2`` over beams with directions d; n is the normal."""
    total = products[0] * slope_x**2 + products[3] * slope_y**2 + products[5]
    total += 2.0 * (products[1] * slope_x * slope_y - products[2] * slope_x - products[4] * slope_y)
    return max(total / share, 1e-6)


def _stands_out(heights: Array, cell: float) -> Mask:
    """Return the cells that lie above lower ground near by more steeply than ground can."""
    steps = cell * np.arange(-int(_RISE_WITHIN / cell), int(_RISE_WITHIN / cell) + 1)
    rises = _RISE + _STEEPEST * np.hypot(*np.meshgrid(steps, steps))
    known = np.where(np.isnan(heights), np.inf, heights)
    lowest = ndimage.grey_erosion(known, structure=-rises, mode="constant", cval=np.inf)
    return np.asarray(heights > lowest)


@compiled
def _off(grid, i, j, cell, surface):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Return x, y of a sub-cell from its cell's centre, and its height above the surface."""
    weight = grid.weights[i, j]
    x = grid.moments[i, j, 0] / weight - (j // SUB + 0.5) * cell
    y = grid.moments[i, j, 1] / weight - (i // SUB + 0.5) * cell
    off = grid.moments[i, j, 2] / weight - surface[0] - surface[1] * x - surface[2] * y
    return x, y, off - surface[3] * x * x - surface[4] * x * y - surface[5] * y * y


@compiled
def _standing(grid, sizes, surfaces):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Return the sub-cells of objects on the ground."""
    out = np.zeros(grid.weights.shape, dtype=np.bool_)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            surface = surfaces[i // SUB, j // SUB]
            if grid.weights[i, j] > 0.0 and not np.isnan(surface[0]):
                out[i, j] = _off(grid, i, j, sizes[0], surface)[2] > _NEAR
    return out


@compiled
def _estimate(grid, sizes, common, surfaces, stands, heights, sigmas, counts):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0913
    """Write height, standard deviation and number of returns of each cell."""
    cell = sizes[0]
    own = np.empty((SUB * SUB, 4))  # x, y from the centre; height above the surface; variance
    for row in range(heights.shape[0]):
        for column in range(heights.shape[1]):
            surface = surfaces[row, column]
            if np.isnan(surface[0]):
                continue
            n, n_returns = _own(grid, row, column, sizes, surface, stands, own)
            if n == 0:
                continue
            offset, variance = _mean(own, n, surface[6], cell)
            hidden = _hidden(n, surface[6], surface[7], cell)
            share = grid.shares[row, column]
            far2 = grid.distances[row, column] / share
            variance += _met(grid.poses[row, column], share**2, surface[1], surface[2])
            variance += common[0] * surface[7] / (_LASERS + cell / (_PITCH * np.sqrt(far2)))
            variance += common[1] * far2 + hidden**2
            bend = (surface[3] + surface[5]) * cell * cell / 12.0
            heights[row, column] = surface[0] + bend + offset - hidden
            sigmas[row, column] = np.sqrt(variance)
            counts[row, column] = n_returns


@compiled
def _hidden(n, roughness, shape, cell):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Return by how much the mean of a cell is lower for what of it is in shadow [m]."""
    rough = np.sqrt(roughness)
    steepness = np.sqrt(2.0 * roughness) * SUB / cell / np.sqrt(shape)
    depth = _SHADOW * rough * (1.0 - np.exp(-_SHADOW_RISE * steepness))
    return depth * (SUB * SUB - n) / (SUB * SUB)


@compiled
def _own(grid, row, column, sizes, surface, stands, own):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0913
    """Collect the sub-cells of a cell that are ground and not beside an object; count them."""
    n, n_returns = 0, 0
    for i in range(row * SUB, (row + 1) * SUB):
        for j in range(column * SUB, (column + 1) * SUB):
            weight = grid.weights[i, j]
            if weight == 0.0 or stands[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2].any():
                continue
            x, y, off = _off(grid, i, j, sizes[0], surface)
            if abs(off) < _NEAR:
                own[n, 0], own[n, 1], own[n, 2] = x, y, off
                own[n, 3] = sizes[2] * surface[7] * grid.noises[i, j] / weight**2
                n, n_returns = n + 1, n_returns + grid.counts[i, j]
    return n, n_returns


@compiled
def _mean(own, n, roughness, cell):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Return the mean of a cell by its sub-cells seen, and its variance: plane and roughness."""
    of_slope = 4.0 * roughness / cell**2
    normal, b = np.zeros((3, 3)), np.zeros(3)
    normal[1, 1] = normal[2, 2] = 1.0 / of_slope
    for p in range(n):
        weight = 1.0 / (roughness + own[p, 3])
        for a in range(3):
            value = 1.0 if a == 0 else own[p, a - 1]
            normal[a, 0] += weight * value
            if a > 0:
                normal[a, 1] += weight * value * own[p, 0]
            if a > 1:
                normal[a, 2] += weight * value * own[p, 1]
    b[0] = 1.0
    solve(normal, b)  # first row of the inverse: the estimate's weights follow from it
    offset = variance = lean_x = lean_y = 0.0
    for p in range(n):
        c = (b[0] + b[1] * own[p, 0] + b[2] * own[p, 1]) / (roughness + own[p, 3])
        offset += c * own[p, 2]
        lean_x, lean_y = lean_x + c * own[p, 0], lean_y + c * own[p, 1]
        variance += roughness * (c - 1.0 / (SUB * SUB)) ** 2 + own[p, 3] * c * c
    variance += roughness * (SUB * SUB - n) / (SUB * SUB) ** 2
    return offset, variance + of_slope * (lean_x**2 + lean_y**2)
