"""Ground as in a lunar test field: fractal roughness, craters and mounds on one grid.

The grid is fine where the rover drives and coarser far away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spheremark.pipelines.model import Array, seal

_N = 1024  # nodes of the periodic map that the roughness is made on, per side
_CELL = 0.07  # [m] its spacing
_FINE_HALF = 15.0  # [m] half side of the part that keeps that spacing
_HALF = 35.0  # [m] half side of the patch; the periodic map is just wider
_GROWTH = 1.06  # from one coarse cell to the next
_HURST = 0.7  # lunar-like roughness: 0.6-0.8
_SLOPE_RMS = np.radians(2.5)  # at a base length of 1 m: a prepared field, at the gentle end
_OUTER_SCALE = 12.0  # [m] no longer undulations: the field has been levelled
_SATURATION = 1.54  # craters per m^2 larger than D, times D^2, when no more have room
_CRATER_SHARE = 0.03  # of saturation
_CRATER_SIZES = (0.5, 5.0)  # [m] smallest and largest diameter
_DEPTHS = (0.03, 0.10)  # depth over diameter, worn to fresh
_RIM = 0.25  # height of the rim over depth
_EJECTA = 2.0  # radii after which a rim has faded out


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Terrain:
    """Heights on a rectangular grid, finer near the middle.

    Attributes
    ----------
    xs, ys : (n,), (m,)
        Lines of the grid in the site frame, ascending [m].
    heights : (m, n)
        Height of the ground at each node, rows along y [m].
    """

    xs: Array
    ys: Array
    heights: Array

    def __post_init__(self) -> None:
        seal(self, xs=(None,), ys=(None,), heights=(len(self.ys), len(self.xs)))

    def height_at(self, p_site: Array) -> Array:
        """Return the height of the ground under points."""
        return interpolated(self.xs, self.ys, self.heights, p_site)

    def highest_near(self, p_site: Array, radius: float) -> float:
        """Return the height of the highest ground near a point."""
        away = np.hypot(self.xs[None, :] - p_site[0], self.ys[:, None] - p_site[1])
        return float(self.heights[away <= radius].max())


def rough_terrain(rng: np.random.Generator) -> Terrain:
    """Return a patch of cratered regolith, 70 m square, about level around height zero.

    Notes
    -----
    Fractal surface by spectral synthesis with a Hurst exponent of 0.7 and a root mean square slope
    of 2.5 degrees at 1 m; craters of cumulative slope -2 at 3 % of saturation, 0.5 to 5 m wide,
    each a paraboloid with a raised rim.
    """
    heights = _fractal(rng)
    lines = np.asarray((np.arange(_N) - _N // 2) * _CELL, dtype=np.float64)
    for x, y, diameter, ratio in _draw_craters(rng):
        _dig(heights, lines, (x, y), diameter, ratio * diameter)
    axis = _graded_axis()
    whole = Terrain(xs=lines, ys=lines.copy(), heights=heights - heights.mean())
    nodes = np.stack(np.meshgrid(axis, axis), axis=-1)
    return Terrain(xs=axis, ys=axis.copy(), heights=whole.height_at(nodes))


def with_mounds(terrain: Terrain, p_site: Array, radius: float) -> Terrain:
    """Return the ground with a mound at each point, whose tops have the points' heights."""
    heights = terrain.heights.copy()
    for top in p_site:
        away = np.hypot(terrain.xs[None, :] - top[0], terrain.ys[:, None] - top[1])
        rise = max(float(top[2] - terrain.height_at(top)), 0.0)
        heights += rise * np.cos(np.minimum(away / radius, 1.0) * np.pi / 2) ** 2
    return Terrain(xs=terrain.xs, ys=terrain.ys, heights=heights)


def interpolated(xs: Array, ys: Array, grid: Array, p_site: Array) -> Array:
    """Return the values of a grid at points, bilinear and clamped to its edge."""
    i, u = _cell(xs, p_site[..., 0])
    j, v = _cell(ys, p_site[..., 1])
    low = (1 - u) * grid[j, i] + u * grid[j, i + 1]
    high = (1 - u) * grid[j + 1, i] + u * grid[j + 1, i + 1]
    return np.asarray((1 - v) * low + v * high)


def _cell(lines: Array, x: Array) -> tuple[np.ndarray, Array]:
    """Return the cell of each coordinate and its place in it, 0 to 1; clamped to the grid."""
    i = np.clip(np.searchsorted(lines, x, side="right") - 1, 0, len(lines) - 2)
    return i, np.clip((x - lines[i]) / (lines[i + 1] - lines[i]), 0.0, 1.0)


def _graded_axis() -> Array:
    """Return the lines of a grid that is even near the middle and grows outwards [m]."""
    even = np.arange(0.0, _FINE_HALF, _CELL)
    steps = _CELL * _GROWTH ** np.arange(1, 200)
    coarse = even[-1] + np.cumsum(steps)
    side = np.concatenate([even, coarse[coarse < _HALF], [_HALF]])
    return np.concatenate([-side[:0:-1], side])


def _fractal(rng: np.random.Generator) -> Array:
    """Return a periodic rough surface with the wanted slope at 1 m, (n, n) [m]."""
    k = (
        2
        * np.pi
        * np.hypot(np.fft.fftfreq(_N, _CELL)[:, None], np.fft.rfftfreq(_N, _CELL)[None, :])
    )
    amplitudes = np.maximum(k, 2 * np.pi / _OUTER_SCALE) ** -(_HURST + 1.0)
    amplitudes[0, 0] = 0.0
    surface = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((_N, _N))) * amplitudes, s=(_N, _N))
    lag = round(1.0 / _CELL)
    slope = np.sqrt(np.mean((np.roll(surface, lag, axis=0) - surface) ** 2)) / (lag * _CELL)
    return np.asarray(surface * np.tan(_SLOPE_RMS) / slope)


def _draw_craters(rng: np.random.Generator) -> Array:
    """Return x, y, diameter and depth over diameter of craters, largest first, (n, 4)."""
    small, large = _CRATER_SIZES
    density = _CRATER_SHARE * _SATURATION * (small**-2 - large**-2)
    n = rng.poisson(density * (2 * _HALF) ** 2)
    diameters = (small**-2 - rng.random(n) * (small**-2 - large**-2)) ** -0.5
    places = rng.uniform(-_HALF, _HALF, (n, 2))
    craters = np.column_stack([places, diameters, rng.uniform(*_DEPTHS, n)])
    return np.asarray(craters[np.argsort(-diameters)])


def _dig(
    heights: Array, lines: Array, centre: tuple[float, float], diameter: float, depth: float
) -> None:
    """Dig one crater into a map of heights, in place."""
    radius = diameter / 2
    columns, rows = (
        slice(*np.searchsorted(lines, (c - _EJECTA * radius, c + _EJECTA * radius))) for c in centre
    )
    s = np.hypot(lines[columns][None, :] - centre[0], lines[rows][:, None] - centre[1]) / radius
    bowl = -depth + (1 + _RIM) * depth * s**2
    apron = _RIM * depth * np.clip((_EJECTA - s) / (_EJECTA - 1), 0.0, 1.0) ** 2
    heights[rows, columns] += np.where(s < 1, bowl, apron)
