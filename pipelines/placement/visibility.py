"""How much of a sphere is visible over the ground and what stands on it: hides ray marching.

A sphere's disc is cut into upright strips; for each the highest line of sight that something
between station and sphere touches is found. Where even the highest surface nearby lies below the
lowest line of sight, which is the rule, one coarse march decides. Where the surfaces themselves are
known, rays are cast at them for what the grid would hide.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.ndimage import maximum_filter

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import Array, Mask
from spheremark.pipelines.placement.plan import Arrangement, Site, Visibility
from spheremark.pipelines.simulation.scene import Caster, Mesh, caster
from spheremark.pipelines.threads import side_by_side

N_STRIPS = 8
"""Strips that a disc is cut into."""

TOUCHING = 0.05
"""Distance of a surface from a sphere below which it touches it: too near to be separated [m]."""

_COARSE = 5  # cells from one step of the coarse march to the next
_BEHIND = 0.05  # [m] something nearer to the sphere than this is its own foot
_MANY = 400  # pairs of station and mark that are worth a second thread
_HIDDEN, _SEEN = 1.0, -1.0
_N_HEIGHTS = 12  # rays to each strip of a disc
_REACH = 0.9  # [m] behind a centre that is searched for a surface
_N_PAIRS = 10_000  # of station and mark whose rays are cast at a time: some 50 MB
_TOUCH = 1e-3  # [m] from a sphere within which nothing hides it

Ray = tuple[float, float, float, float, float, float]
"""Origin, level direction and length [m]."""


def find_visibility(site: Site, stations_site: Array, marks: Arrangement) -> Visibility:
    """Find what is visible of marks, each as if it stood alone.

    Parameters
    ----------
    site : Site
        Ground and what stands on it.
    stations_site : (s, 3)
        Positions of the LiDAR [m].
    marks : Arrangement
        The marks.

    Returns
    -------
    Visibility
        For each station, mark and strip of the disc.

    Notes
    -----
    Cost grows linearly with stations, marks and distance over cell size. A mark that moves costs
    only its own column (``Visibility.joined``).
    """
    lowest = np.empty((len(stations_site), len(marks.names), N_STRIPS), np.float32)
    gaps = np.empty(lowest.shape[:2], np.float32)
    grids = (site.surface, _highest_near(site))
    frame = (site.xs[0], site.ys[0], site.cell)
    stations, p_site = np.ascontiguousarray(stations_site), np.ascontiguousarray(marks.p_site)

    def part(first: int, last: int) -> None:
        _march(grids, frame, (stations[first:last], p_site), site.marker_radius, lowest[first:last])

    side_by_side(part, len(stations), threaded_from=max(2, _MANY // max(len(p_site), 1)))
    if site.bodies is not None:
        _refine_by_rays(site.bodies, (stations, p_site), site.marker_radius, lowest)
    _find_gaps(site.surface, frame, (stations, p_site), gaps)
    above = p_site[:, 2] - site.ground_at(p_site)
    is_low = above < site.marker_radius + TOUCHING
    gaps[:, is_low] = np.minimum(gaps[:, is_low], above[is_low])
    return Visibility(lowest=lowest, gaps=gaps)


def _refine_by_rays(
    bodies: Mesh, places: tuple[Array, Array], radius: float, lowest: np.ndarray
) -> None:
    """Replace what the grid hides by what the surfaces themselves hide.

    A strip of which a share is visible counts as visible above the height that leaves as much of
    it; under a canopy it is the lower part, which is worth as much.
    """
    stations, marks = places
    lefts = (2.0 * np.arange(N_STRIPS) + 1.0) / N_STRIPS - 1.0
    chords = np.sqrt(1.0 - lefts**2)
    parts = (2.0 * np.arange(_N_HEIGHTS) + 1.0) / _N_HEIGHTS - 1.0
    disc = radius * np.stack(np.broadcast_arrays(lefts[:, None], chords[:, None] * parts), axis=-1)
    e, m = np.nonzero((lowest > _SEEN).any(axis=2))
    is_far = np.hypot(*(marks[m] - stations[e])[:, :2].T) >= 2.0 * radius
    for first in range(0, int(is_far.sum()), _N_PAIRS):
        some = slice(first, first + _N_PAIRS)
        i, k = e[is_far][some], m[is_far][some]
        seen = _open_rays(bodies, stations[i], marks[k], disc.reshape(-1, 2), radius)
        shares = seen.reshape(len(i), N_STRIPS, _N_HEIGHTS).mean(axis=2)
        part = np.where(shares == 1.0, _SEEN, chords * (1.0 - 2.0 * shares))
        lowest[i, k] = np.where(shares == 0.0, _HIDDEN, part)


def _open_rays(bodies: Mesh, stations: Array, marks: Array, disc: Array, radius: float) -> Mask:
    """Return which lines of sight to points of marks' discs meet nothing before them, (n, k)."""
    ahead = marks - stations
    distances = np.linalg.norm(ahead, axis=1)
    ahead = ahead / distances[:, None]
    left = np.column_stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(ahead))])
    left = left / np.linalg.norm(left, axis=1, keepdims=True)
    up = np.cross(ahead, left)
    lines = (marks - stations)[:, None] + disc[:, :1] * left[:, None] + disc[:, 1:] * up[:, None]
    rays = np.empty((*lines.shape[:2], 6), np.float32)
    rays[..., :3] = stations[:, None]
    rays[..., 3:] = lines / np.linalg.norm(lines, axis=2, keepdims=True)
    met, _ = _caster(bodies)(rays.reshape(-1, 6))
    return np.asarray(met.reshape(lines.shape[:2]) >= distances[:, None] - radius - _TOUCH)


@lru_cache(maxsize=4)
def _caster(bodies: Mesh) -> Caster:
    """Return the ray caster of surfaces; its search tree takes a second to build."""
    return caster.__wrapped__(bodies)


def with_occlusion(
    site: Site, stations_site: Array, marks: Arrangement, visibility: Visibility
) -> Visibility:
    """Return the visibility of marks that also hide each other, up to the top of a sphere."""
    lowest = visibility.lowest.copy()
    sizes = (site.marker_radius, site.pole_radius)
    _occlude(np.ascontiguousarray(stations_site), np.ascontiguousarray(marks.p_site), sizes, lowest)
    return Visibility(lowest=lowest, gaps=visibility.gaps.copy())


@lru_cache(maxsize=4)
def _highest_near(site: Site) -> Array:
    """Return the height of the highest surface within a coarse step of each node [m]."""
    surface = np.where(np.isfinite(site.surface), site.surface, -np.inf)
    reach = _COARSE + int(np.ceil(1.5 * site.marker_radius / site.cell)) + 1
    return np.asarray(maximum_filter(surface, size=2 * reach + 1, mode="nearest"))


@compiled
def _height(grid: Array, u: float, v: float) -> float:
    """Return a grid's bilinear value; far below the ground off the grid or where unknown."""
    i, j = int(np.floor(u)), int(np.floor(v))
    if u < 0.0 or v < 0.0 or j > grid.shape[0] - 2 or i > grid.shape[1] - 2:
        return -1e9
    u, v = u - i, v - j
    low = (1.0 - u) * grid[j, i] + u * grid[j, i + 1]
    high = (1.0 - u) * grid[j + 1, i] + u * grid[j + 1, i + 1]
    height = (1.0 - v) * low + v * high
    return height if height == height else -1e9


@compiled
def _clears(coarse: Array, frame: tuple[float, float, float], ray: Ray, slope: float) -> bool:
    """Return whether a ray of some slope stays above the highest surface nearby."""
    x, y, z, dx, dy, length = ray
    x0, y0, cell = frame
    n_y, n_x = coarse.shape
    n = int(length / (_COARSE * cell)) + 1
    for k in range(n + 1):
        s = min(k * _COARSE * cell, length)
        i = round((x + s * dx - x0) / cell)
        j = round((y + s * dy - y0) / cell)
        i, j = min(max(i, 0), n_x - 1), min(max(j, 0), n_y - 1)
        before = max(s - _COARSE * cell, 0.0)
        if coarse[j, i] > z + min(slope * s, slope * before):
            return False
    return True


@compiled
def _horizon(surface: Array, frame: tuple[float, float, float], ray: Ray) -> float:
    """Return the steepest slope at which something along a ray is met."""
    x, y, z, dx, dy, length = ray
    x0, y0, cell = frame
    n = max(int(2.0 * length / cell), 1)
    step = length / n
    steepest = -1e9
    for k in range(1, n + 1):
        s = k * step
        rise = _height(surface, (x + s * dx - x0) / cell, (y + s * dy - y0) / cell) - z
        steepest = max(steepest, rise / s)
    return steepest


@compiled
def _march(
    grids: tuple[Array, Array],
    frame: tuple[float, float, float],
    places: tuple[Array, Array],
    radius: float,
    lowest: np.ndarray,
) -> None:
    """Fill in the lowest height, in radii, from which on each strip of each disc is seen."""
    surface, coarse = grids
    stations, marks = places
    n_strips = lowest.shape[2]
    for e in range(len(stations)):
        x, y, z = stations[e, 0], stations[e, 1], stations[e, 2]
        for m in range(len(marks)):
            dx, dy, dz = marks[m, 0] - x, marks[m, 1] - y, marks[m, 2] - z
            flat = np.hypot(dx, dy)
            if flat < 2.0 * radius:  # overhead or below: the fan does not reach
                lowest[e, m] = _HIDDEN
                continue
            dx, dy = dx / flat, dy / flat
            length = max(flat - radius - _BEHIND, 0.5 * flat)
            ray = (x, y, z, dx, dy, length)
            if _clears(coarse, frame, ray, (dz - 1.1 * radius) / flat):
                lowest[e, m] = _SEEN
                continue
            tilt = flat / np.sqrt(flat * flat + dz * dz)
            for c in range(n_strips):
                aside = radius * ((2.0 * c + 1.0) / n_strips - 1.0)
                far = np.hypot(flat, aside)
                bx, by = (flat * dx - aside * dy) / far, (flat * dy + aside * dx) / far
                slope = _horizon(surface, frame, (x, y, z, bx, by, length))
                height = tilt * (slope * flat - dz) / radius
                lowest[e, m, c] = min(max(height, _SEEN), _HIDDEN)


@compiled
def _find_gaps(
    surface: Array,
    frame: tuple[float, float, float],
    places: tuple[Array, Array],
    gaps: np.ndarray,
) -> None:
    """Fill in how far behind each centre the line of sight to it meets the surface."""
    stations, marks = places
    x0, y0, cell = frame
    step = min(0.5 * cell, 0.1)
    for e in range(len(stations)):
        for m in range(len(marks)):
            mx, my, mz = marks[m, 0], marks[m, 1], marks[m, 2]
            dx, dy, dz = mx - stations[e, 0], my - stations[e, 1], mz - stations[e, 2]
            flat = max(np.hypot(dx, dy), 1e-9)
            gaps[e, m] = np.inf
            for k in range(1, int(_REACH / step) + 1):
                s = k * step
                u, v = (mx + s * dx / flat - x0) / cell, (my + s * dy / flat - y0) / cell
                if _height(surface, u, v) >= mz + s * dz / flat:
                    gaps[e, m] = s
                    break


@compiled
def _occlude(stations: Array, marks: Array, sizes: tuple[float, float], lowest: np.ndarray) -> None:
    """Raise the lowest seen heights by the spheres and poles that stand before a mark."""
    radius, pole = sizes
    n_strips = lowest.shape[2]
    for e in range(len(stations)):
        x, y, z = stations[e, 0], stations[e, 1], stations[e, 2]
        for m in range(len(marks)):
            dx, dy, dz = marks[m, 0] - x, marks[m, 1] - y, marks[m, 2] - z
            flat = np.hypot(dx, dy)
            if flat < 2.0 * radius:
                continue
            dx, dy = dx / flat, dy / flat
            for other in range(len(marks)):
                ox, oy = marks[other, 0] - x, marks[other, 1] - y
                along = ox * dx + oy * dy
                if other == m or along < 2.0 * radius or along > flat - radius:
                    continue
                scale = flat / along
                aside = scale * (oy * dx - ox * dy)
                if abs(aside) > radius * (1.0 + scale):
                    continue
                rise = scale * (marks[other, 2] - z) - dz
                for c in range(n_strips):
                    off = abs(radius * ((2.0 * c + 1.0) / n_strips - 1.0) - aside)
                    top = -1e9
                    if off < scale * radius:
                        half = np.sqrt((scale * radius) ** 2 - off * off)
                        is_below = rise + half < -radius
                        top = rise + half if not is_below and rise - half < radius else -1e9
                    if off < scale * pole:
                        top = max(top, rise)
                    height = min(max(top / radius, _SEEN), _HIDDEN)
                    lowest[e, m, c] = max(lowest[e, m, c], height)
