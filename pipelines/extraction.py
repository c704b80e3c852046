"""Markers among ground, rocks, poles and people: which returns of a stop may be a sphere on a pole.

Works in the base frame with the levelled vertical. The sensor is taken as one point (the origin of
the base): a few centimetres of axis offset do not change which returns look like a sphere.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from pipelines.config import ExtractionConfig
from pipelines.geometry import levelling_rotation
from pipelines.values import (
    Array,
    Column,
    Index,
    MarkerCandidate,
    MarkerCandidates,
    Mask,
    Rejection,
    StitchedCloud,
)

_STUDY_FIELD = 10.0  # [m] from the station: where the study looks for its highest ground point
_GROUND_WINDOW = 4  # cells each way of the opening: rocks up to twice this are not ground
_GROUND_STEP = 0.10  # [m] that a cell's lowest point may lie above the opened surface
_GROUND_CELLS_MIN = 9  # a marker seen alone covers at most 6 cells: that is not yet ground
_GROUND_NOISE = 0.05  # [m] that a ground return may lie above its cell's lowest
_REJECTIONS_MAX = 200  # the most sphere-like groups that are kept with their reason
_TOUCHING = 0.10  # share of a ball's returns that may lie as far away beside it: mixed pixels
_STRANGE = 0.3  # share of the returns inside the outline that may be off the ball
_SIGMAS = 3.5  # standard deviations at which a shape is refused
_RADIUS_SLACK = 0.12  # of the radius: less is no reason to refuse, the fit judges it
_N_SHAPELY = 12  # returns that show the width of what they lie on
_N_LOOK = 4  # returns without which there is nothing to look at
_N_STEPS = 6  # of a fit that only has to tell what a group is
_NOISE_MIN = 0.006  # [m] of any VLP-16: what scatters less is not known better
_N_FACE = 256  # cells along a face of the cube of directions: 0.45 deg
_N_SURE = 20  # returns that show a shape well enough to judge by it alone
_SHAPE_SURE = 0.05  # of the radius: a radius known that well tells a ball from a stone by itself
_REACH = 4.5  # radii about a seed whose returns decide whether a ball stands free there


def extract(
    cloud: StitchedCloud, config: ExtractionConfig, marker_radius: float
) -> MarkerCandidates:
    """Find the groups of returns that may be spherical markers.

    Parameters
    ----------
    cloud : StitchedCloud
        One stop; rings and times are not needed.
    config : ExtractionConfig
        Ground grid, limits of the tests.
    marker_radius : float
        Radius of the spheres [m].

    Returns
    -------
    MarkerCandidates
        Candidates in the order of azimuth; of the groups that passed the first gate of size and
        were then refused, the (at most 200) largest, with the reason; and the height of the highest
        ground point within 10 m, where the study cuts its clouds.

    Notes
    -----
    A marker is a ball of known radius that stands free on a pole, so each place where something
    ends upward and to a side is tried: mean shift of a disc of the ball's size, then a robust fit
    along the beams, then the tests, which have their sentences in ``_verdict``. Ground is the
    opening of the lowest point per cell. Where no ground was seen it is unknown, and nothing is
    cut. Cost grows linearly with the returns.
    """
    up = levelling_rotation(cloud.levelling)[2].copy()
    ball = _Ball(marker_radius, up, float(cloud.rig.divergence.max()))
    grid = _grid(cloud, config)
    seeds = _seeds(cloud.p_base, grid.is_above, ball, config.n_points_min)
    looks = _distinct(_looks(cloud, grid, seeds, ball), config, marker_radius)
    verdicts = [_verdict(look, config, ball) for look in looks]
    verdicts = _grounded(cloud.p_base, looks, verdicts, ball)
    good = [look for look, reason in zip(looks, verdicts, strict=True) if not reason]
    bad = [(look, reason) for look, reason in zip(looks, verdicts, strict=True) if reason]
    return MarkerCandidates(
        candidates=_candidates(cloud, grid, good, ball, config),
        rejected=tuple(
            Rejection(p_base=look.p_base, n_points=look.n_points, reason=reason)
            for look, reason in bad[:_REJECTIONS_MAX]
        ),
        ground_height_max=grid.ground_height_max,
    )


class _Ball(NamedTuple):
    """What is looked for: radius [m], upward unit vector, full width of the beams [rad]."""

    radius: float
    up: Array
    divergence: float


class _Grid(NamedTuple):
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
    is_above : (n,) bool
        Returns that are not known to be ground.
    ground_height_max : float
        Highest ground return within 10 m, levelled [m].
    """

    cells: NDArray[np.int32]
    n_side: int
    edge: float
    R_station_base: Array
    is_above: Mask
    ground_height_max: float


def _grid(cloud: StitchedCloud, config: ExtractionConfig) -> _Grid:
    """Sort returns into cells and tell the ground."""
    n_side = 2 * int(np.ceil(config.range_max / config.ground_cell))
    R = levelling_rotation(cloud.levelling)
    cells, heights, lowest = _lowest_per_cell(
        cloud.p_base, R, config.ground_cell, n_side, config.range_max
    )
    ground = _ground(lowest, _opened(lowest, _GROUND_WINDOW), _GROUND_WINDOW)
    is_above, highest = _above(
        cloud.p_base, cells, heights, ground.ravel(), config.ground_clearance
    )
    return _Grid(cells, n_side, config.ground_cell, R, is_above, float(highest))


@numba.njit(cache=True, nogil=True)
def _lowest_per_cell(
    p_base: Column, R: Array, edge: float, n_side: int, range_max: float
) -> tuple[NDArray[np.int32], Column, Column]:
    """Return each point's cell (-1: too far) and levelled height, and the lowest point per cell."""
    n = len(p_base)
    cells = np.empty(n, np.int32)
    heights = np.empty(n, np.float32)
    lowest = np.full((n_side, n_side), np.inf, np.float32)
    half = n_side // 2
    for i in range(n):
        x, y, z = p_base[i, 0], p_base[i, 1], p_base[i, 2]
        x_level = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z
        y_level = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
        height = np.float32(R[2, 0] * x + R[2, 1] * y + R[2, 2] * z)
        heights[i] = height
        if not x_level * x_level + y_level * y_level < range_max * range_max:
            cells[i] = -1
            continue
        row = min(max(int(np.floor(x_level / edge)) + half, 0), n_side - 1)
        column = min(max(int(np.floor(y_level / edge)) + half, 0), n_side - 1)
        cells[i] = row * n_side + column
        lowest[row, column] = min(lowest[row, column], height)
    return cells, heights, lowest


@numba.njit(cache=True, nogil=True)
def _slide(values: Column, window: int, sign: float) -> Column:
    """Return the least of ``sign * values`` in a square window; infinite cells do not count."""
    n_rows, n_columns = values.shape
    along = np.full(values.shape, np.inf, np.float32)
    out = np.full(values.shape, np.inf, np.float32)
    for i in range(n_rows):
        for j in range(n_columns):
            for k in range(max(j - window, 0), min(j + window + 1, n_columns)):
                if np.isfinite(values[i, k]):
                    along[i, j] = min(along[i, j], sign * values[i, k])
    for i in range(n_rows):
        for k in range(max(i - window, 0), min(i + window + 1, n_rows)):
            for j in range(n_columns):
                out[i, j] = min(out[i, j], along[k, j])
    return out


def _opened(lowest: Column, window: int) -> Column:
    """Return the morphological opening of the lowest points; infinite where nothing is near."""
    eroded = _slide(lowest, window, 1.0)
    return np.asarray(-_slide(eroded, window, -1.0))


@numba.njit(cache=True, nogil=True)
def _ground(lowest: Column, opened: Column, window: int) -> Column:
    """Return the ground's height per cell; infinite where no ground was seen in or beside it.

    A cell has ground where its lowest point lies near the opened surface and enough others around
    do too: a marker behind a rock has no ground around it, and must not become ground itself.
    """
    n_rows, n_columns = lowest.shape
    is_low = lowest < opened + np.float32(_GROUND_STEP)
    out = np.full(lowest.shape, np.inf, np.float32)
    for i in range(n_rows):
        for j in range(n_columns):
            highest = -np.inf
            for k in range(max(i - 1, 0), min(i + 2, n_rows)):
                for m in range(max(j - 1, 0), min(j + 2, n_columns)):
                    if is_low[k, m]:
                        highest = max(highest, lowest[k, m])
            if highest == -np.inf:
                continue
            n_low = 0
            for k in range(max(i - window, 0), min(i + window + 1, n_rows)):
                for m in range(max(j - window, 0), min(j + window + 1, n_columns)):
                    n_low += is_low[k, m]
            if n_low >= _GROUND_CELLS_MIN:
                out[i, j] = highest
    return out


@numba.njit(cache=True, nogil=True)
def _above(
    p_base: Column,
    cells: NDArray[np.int32],
    heights: Column,
    ground: Column,
    clearance: float,
) -> tuple[Mask, float]:
    """Return which points are not known to be ground, and the highest ground point near by."""
    is_above = np.zeros(len(cells), np.bool_)
    highest = -np.inf
    for i in range(len(cells)):
        if cells[i] < 0:
            continue
        over = heights[i] - ground[cells[i]]
        is_above[i] = over > clearance or ground[cells[i]] == np.inf
        is_field = p_base[i, 0] ** 2 + p_base[i, 1] ** 2 < _STUDY_FIELD**2
        if is_field and -np.inf < over < _GROUND_NOISE and heights[i] > highest:
            highest = heights[i]
    return is_above, highest


@numba.njit(cache=True, nogil=True)
def _slot(keys: NDArray[np.int64], key: int) -> int:
    """Return the place of a key in an open hash table, or the free place where it belongs."""
    mask = len(keys) - 1
    place = ((key * 0x9E3779B97F4A7C1) >> 17) & mask
    while keys[place] != -1 and keys[place] != key:
        place = (place + 1) & mask
    return place


@numba.njit(cache=True, nogil=True)
def _voxel(x: float, y: float, z: float, edge: float) -> int:
    """Return the key of the voxel that holds a point within some kilometres."""
    i, j, k = np.floor(x / edge), np.floor(y / edge), np.floor(z / edge)
    return ((int(i) + 500_000) * 1_000_000 + int(j) + 500_000) * 1_000_000 + int(k) + 500_000


@numba.njit(cache=True, nogil=True)
def _voxels(p_base: Column, is_above: Mask, edge: float) -> tuple[NDArray[np.int64], Column]:
    """Return the occupied voxels as an open hash table: keys, and sums of x, y, z with count."""
    size = 64
    while size < 2 * np.sum(is_above):
        size *= 2
    keys = np.full(size, -1, np.int64)
    sums = np.zeros((size, 4), np.float32)
    for i in range(len(p_base)):
        if is_above[i]:
            place = _slot(keys, _voxel(p_base[i, 0], p_base[i, 1], p_base[i, 2], edge))
            keys[place] = _voxel(p_base[i, 0], p_base[i, 1], p_base[i, 2], edge)
            sums[place, 0] += p_base[i, 0]
            sums[place, 1] += p_base[i, 1]
            sums[place, 2] += p_base[i, 2]
            sums[place, 3] += 1.0
    return keys, sums


@numba.njit(cache=True, nogil=True)
def _is_free(keys: NDArray[np.int64], p: Array, v_step: Array, v_beam: Array, edge: float) -> bool:
    """Tell whether nothing lies one step away, at the same depth give or take a voxel."""
    for depth in (-edge, 0.0, edge):
        q = p + v_step + depth * v_beam
        if keys[_slot(keys, _voxel(q[0], q[1], q[2], edge))] != -1:
            return False
    return True


@numba.njit(cache=True, nogil=True)
def _around(keys: NDArray[np.int64], sums: Column, p: Array, edge: float) -> Array:
    """Return sums of x, y, z and count over the 27 voxels about a point."""
    total = np.zeros(4)
    for i in range(-1, 2):
        for j in range(-1, 2):
            for k in range(-1, 2):
                key = _voxel(p[0] + i * edge, p[1] + j * edge, p[2] + k * edge, edge)
                place = _slot(keys, key)
                if keys[place] != -1:
                    for axis in range(4):
                        total[axis] += sums[place, axis]
    return total


@numba.njit(cache=True, nogil=True)
def _free_ends(
    keys: NDArray[np.int64], sums: Column, up: Array, radius: float, n_points_min: int
) -> Array:
    """Return centres and counts, (k, 4), of what ends upward and to at least one side."""
    out = np.empty((len(keys), 4))
    n_out = 0
    for place in range(len(keys)):
        if keys[place] == -1:
            continue
        p = sums[place, :3].astype(np.float64) / sums[place, 3]
        v_beam = p / np.linalg.norm(p)
        v_side = np.cross(up, v_beam)
        v_side /= np.linalg.norm(v_side) + 1e-12
        if not _is_free(keys, p, 3.0 * radius * up, v_beam, radius):
            continue
        if not (
            _is_free(keys, p, 3.0 * radius * v_side, v_beam, radius)
            or _is_free(keys, p, -3.0 * radius * v_side, v_beam, radius)
        ):
            continue
        total = _around(keys, sums, p, radius)
        if total[3] >= n_points_min:
            # the points of a cap lie 2/3 R before the centre on average
            out[n_out, :3] = total[:3] / total[3] + (2.0 / 3.0) * radius * v_beam
            out[n_out, 3] = total[3]
            n_out += 1
    return out[:n_out]


@numba.njit(cache=True, nogil=True)
def _thinned(seeds: Array, gap: float) -> Array:
    """Return the seeds, ordered by falling count, that have no stronger one within a gap."""
    kept = np.empty_like(seeds)
    n_kept = 0
    for i in range(len(seeds)):
        is_new = True
        for j in range(n_kept):
            dx, dy = seeds[i, 0] - kept[j, 0], seeds[i, 1] - kept[j, 1]
            dz = seeds[i, 2] - kept[j, 2]
            if dx * dx + dy * dy + dz * dz < gap * gap:
                is_new = False
                break
        if is_new:
            kept[n_kept] = seeds[i]
            n_kept += 1
    return kept[:n_kept]


def _seeds(p_base: Column, is_above: Mask, ball: _Ball, n_points_min: int) -> Array:
    """Return rough centres, (k, 3), at which a ball may be looked for."""
    keys, sums = _voxels(p_base, is_above, ball.radius)
    ends = _free_ends(keys, sums, ball.up, ball.radius, n_points_min)
    ends = ends[np.lexsort((ends[:, 2], ends[:, 1], ends[:, 0], -ends[:, 3]))]
    return np.ascontiguousarray(_thinned(ends, 0.5 * ball.radius)[:, :3])


class _Look(NamedTuple):
    """What a group looks like when it is taken for a ball of the known radius.

    Attributes
    ----------
    x, y, z : float
        Centre in the base frame [m].
    n_points : int
        Returns that the ball explains.
    n_strange : int
        Returns inside its outline, about as far away, that it does not explain.
    n_beside : int
        Returns beside and above its outline, about as far away.
    n_below : int
        Returns below and beside the pole, about as far away or somewhat nearer.
    scatter : float
        Robust standard deviation along the beams [m].
    width, height : float
        Extent of the explained returns across and along the vertical [m].
    radius_free, sigma_radius : float
        Radius when it is estimated too [m].
    flat_across, sigma_across : float
        How much of the ball's curvature across is missing: 0 a ball, 1 a plane.
    flat_along, sigma_along : float
        The same along the vertical: 0 a ball, 1 a post.
    """

    x: float
    y: float
    z: float
    n_points: int
    n_strange: int
    n_beside: int
    n_below: int
    scatter: float
    width: float
    height: float
    radius_free: float
    sigma_radius: float
    flat_across: float
    sigma_across: float
    flat_along: float
    sigma_along: float

    @property
    def p_base(self) -> Array:
        """Centre, (3,) [m]."""
        return np.array([self.x, self.y, self.z])


class _Patches(NamedTuple):
    """Returns sorted by cell, for the cells about the seeds.

    Attributes
    ----------
    starts : (n_side ** 2 + 1,)
        The rows of a cell are ``rows[starts[cell]:starts[cell + 1]]``.
    rows : (m,) int32
        Rows of the cloud.
    n_side : int
        Cells along one side.
    margin : int
        Cells about a seed that may hold returns within reach.
    reach : float
        How far about a seed returns are looked at [m].
    """

    starts: NDArray[np.int64]
    rows: NDArray[np.int32]
    n_side: int
    margin: int
    reach: float


@numba.njit(cache=True, nogil=True)
def _by_cell(
    cells: NDArray[np.int32], n_side: int, seed_cells: NDArray[np.int64], margin: int
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Return starts and rows of the returns in and about the seeds' cells, by counting sort."""
    is_wanted = np.zeros(n_side * n_side, np.bool_)
    for cell in seed_cells:
        row, column = cell // n_side, cell % n_side
        for k in range(max(row - margin, 0), min(row + margin + 1, n_side)):
            for m in range(max(column - margin, 0), min(column + margin + 1, n_side)):
                is_wanted[k * n_side + m] = True
    starts = np.zeros(n_side * n_side + 1, np.int64)
    for cell in cells:
        if cell >= 0 and is_wanted[cell]:
            starts[cell + 1] += 1
    starts = np.cumsum(starts)
    ends = starts[:-1].copy()
    rows = np.empty(starts[-1], np.int32)
    for i in range(len(cells)):
        cell = cells[i]
        if cell >= 0 and is_wanted[cell]:
            rows[ends[cell]] = i
            ends[cell] += 1
    return starts, rows


@numba.njit(cache=True, nogil=True)
def _near(p_base: Column, patches: _Patches, cell: int, c: Array) -> NDArray[np.int32]:
    """Return the rows of the returns within reach of a point that lies in or by a cell."""
    n_side, margin = patches.n_side, patches.margin
    row, column = cell // n_side, cell % n_side
    low, high = max(column - margin, 0), min(column + margin, n_side - 1)
    out = np.empty(64, np.int32)
    n_out = 0
    for k in range(max(row - margin, 0), min(row + margin + 1, n_side)):
        first, last = patches.starts[k * n_side + low], patches.starts[k * n_side + high + 1]
        for i in patches.rows[first:last]:
            dx, dy, dz = p_base[i, 0] - c[0], p_base[i, 1] - c[1], p_base[i, 2] - c[2]
            if dx * dx + dy * dy + dz * dz < patches.reach * patches.reach:
                if n_out == len(out):
                    out = np.concatenate((out, np.empty(n_out, np.int32)))
                out[n_out] = i
                n_out += 1
    return out[:n_out]


@numba.njit(cache=True, nogil=True)
def _view(points: Array, c: Array, up: Array) -> tuple[Array, Array, Array]:
    """Return the points as seen toward a centre, and two unit vectors across the view.

    The first array, (n, 3), holds for each beam where it passes the centre, across and up, and how
    much farther than that the return lies [m].
    """
    v_beam = c / np.linalg.norm(c)
    v_up = up - np.dot(up, v_beam) * v_beam
    v_up /= np.linalg.norm(v_up) + 1e-12
    v_across = np.cross(v_up, v_beam)
    seen = np.empty((len(points), 3))
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        observed2 = x * x + y * y + z * z
        share = (c[0] * x + c[1] * y + c[2] * z) / observed2
        dx, dy, dz = share * x - c[0], share * y - c[1], share * z - c[2]
        seen[i, 0] = dx * v_across[0] + dy * v_across[1] + dz * v_across[2]
        seen[i, 1] = dx * v_up[0] + dy * v_up[1] + dz * v_up[2]
        seen[i, 2] = np.sqrt(observed2) * (1.0 - share)
    return seen, v_across, v_up


@numba.njit(cache=True, nogil=True)
def _shifted(points: Array, c: Array, up: Array, radius: float) -> tuple[Array, int]:
    """Return where a disc of the ball's size comes to rest, and how many returns it holds."""
    n = 0
    for _ in range(4):
        seen, v_across, v_up = _view(points, c, up)
        across, along, depth, n = 0.0, 0.0, 0.0, 0
        for i in range(len(seen)):
            is_inside = seen[i, 0] ** 2 + seen[i, 1] ** 2 < (1.15 * radius) ** 2
            if is_inside and -2.0 * radius < seen[i, 2] < 0.8 * radius:
                across, along, depth = across + seen[i, 0], along + seen[i, 1], depth + seen[i, 2]
                n += 1
        if n == 0:
            break
        v_beam = c / np.linalg.norm(c)
        depth = depth / n + 2.0 / 3.0 * radius
        c = c + (across / n) * v_across + (along / n) * v_up + depth * v_beam
    return c, n


@numba.njit(cache=True, nogil=True)
def _surroundings(seen: Array, radius: float, blur: float) -> tuple[int, int]:
    """Count the returns beside and below the outline that a free ball on a pole would not have."""
    n_beside, n_below = 0, 0
    inner = 1.2 * radius + blur
    for i in range(len(seen)):
        across, along, depth = seen[i, 0], seen[i, 1], seen[i, 2]
        gap = np.sqrt(across * across + along * along)
        is_pole = along < 0.0 and abs(across) < 0.6 * radius + blur
        if gap < inner or is_pole:
            continue
        if along > -0.5 * radius:
            n_beside += gap < 2.2 * radius + blur and abs(depth) < 1.5 * radius
        else:
            n_below += gap < 2.8 * radius + blur and -3.0 * radius < depth < 1.5 * radius
    return n_beside, n_below


@numba.njit(cache=True, nogil=True)
def _shape(seen: Array, radius: float) -> tuple[Array, Array]:
    """Return along-beam residuals and their derivatives by ball and shape.

    Derivatives, (n, 6): centre across, up and along the beam, radius, and the missing shares of the
    curvature across and along the vertical. A beam that misses is expected at the outline.
    """
    residuals: Array = np.empty(len(seen))
    J: Array = np.zeros((len(seen), 6))
    for i in range(len(seen)):
        x, y, depth = seen[i, 0], seen[i, 1], seen[i, 2]
        h2 = radius * radius - x * x - y * y
        half = np.sqrt(max(h2, 0.0))
        residuals[i] = depth + half
        J[i, 2] = 1.0
        if h2 <= 0.0:
            continue
        steep = max(half, 0.25 * radius)  # a beam's footprint keeps the outline from being a cliff
        J[i, 0], J[i, 1], J[i, 3] = -x / steep, -y / steep, -radius / steep
        J[i, 4] = half - np.sqrt(radius * radius - y * y)
        J[i, 5] = half - np.sqrt(radius * radius - x * x)
    return residuals, J


@numba.njit(cache=True, nogil=True)
def _approached(
    p_base: Column, patches: _Patches, seeds: Array, seed_cells: NDArray[np.int64], ball: _Ball
) -> Array:
    """Return where seeds' discs came to rest, the returns in, beside and below them, (k, 6)."""
    out = np.zeros((len(seeds), 6))
    for k in range(len(seeds)):
        rows = _near(p_base, patches, seed_cells[k], seeds[k])
        points = _gathered(p_base, rows)
        c, n = _shifted(points, seeds[k], ball.up, ball.radius)
        seen, _, _ = _view(points, c, ball.up)
        blur = 0.5 * ball.divergence * np.sqrt(c[0] ** 2 + c[1] ** 2 + c[2] ** 2)
        n_beside, n_below = _surroundings(seen, ball.radius, blur)
        out[k, 0], out[k, 1], out[k, 2] = c[0], c[1], c[2]
        out[k, 3], out[k, 4], out[k, 5] = n, n_beside, n_below
    return out


@numba.njit(cache=True, nogil=True)
def _gathered(p_base: Column, rows: NDArray[np.int32]) -> Array:
    """Return some points in float64."""
    points = np.empty((len(rows), 3))
    for i in range(len(rows)):
        points[i, 0], points[i, 1] = p_base[rows[i], 0], p_base[rows[i], 1]
        points[i, 2] = p_base[rows[i], 2]
    return points


def _solve(J: Array, residuals: Array, weights: Array, prior: float) -> tuple[Array, Array]:
    """Return the weighted least-squares step and the inverse of its normal matrix."""
    weighted = J * weights[:, None]
    inverse = np.asarray(
        np.linalg.inv(weighted.T @ J + prior * np.eye(J.shape[1])), dtype=np.float64
    )
    return inverse @ (weighted.T @ residuals), inverse


def _weights(seen: Array, residuals: Array, radius: float, blur: float, scatter: float) -> Array:
    """Return Tukey's weights of the returns that may belong to the ball."""
    limit = 4.7 * scatter
    is_on = np.hypot(seen[:, 0], seen[:, 1]) < radius + blur
    is_on &= (seen[:, 1] > -0.9 * radius) & (np.abs(residuals) < limit)
    return np.where(is_on, (1.0 - (residuals / limit) ** 2) ** 2, 0.0)


def _scatter(seen: Array, residuals: Array, radius: float) -> float:
    """Return the robust standard deviation of the residuals inside the outline [m]."""
    is_inside = np.hypot(seen[:, 0], seen[:, 1]) < 0.9 * radius
    inside = np.abs(residuals[is_inside & (np.abs(residuals) < 1.5 * radius)])
    return float(np.clip(1.4826 * np.median(inside), 0.004, 0.03)) if len(inside) > 2 else 0.03


def _settled(points: Array, c: Array, ball: _Ball, n_unknowns: int) -> tuple[Array, float, Array]:
    """Return the centre of the ball near a place, its radius, and the covariance for unit noise.

    With three unknowns the radius stays as it is, with four it is estimated too. The prior, 3 cm on
    a start good to that, keeps a handful of returns from running away.
    """
    radius, inverse = ball.radius, np.eye(n_unknowns)
    for _ in range(_N_STEPS):
        seen, v_across, v_up = _view(points, c, ball.up)
        residuals, J = _shape(seen, radius)
        scatter = _scatter(seen, residuals, radius)
        distance = float(np.linalg.norm(c))
        weights = _weights(seen, residuals, radius, 0.5 * ball.divergence * distance, scatter)
        step, inverse = _solve(J[:, :n_unknowns], residuals, weights, (scatter / 0.03) ** 2)
        step *= min(1.0, 0.5 * ball.radius / (float(np.linalg.norm(step)) + 1e-12))
        c = c + step[0] * v_across + step[1] * v_up + step[2] * c / distance
        if n_unknowns > 3:
            radius = float(np.clip(radius + step[3], 0.3 * ball.radius, 3.0 * ball.radius))
    return c, radius, inverse


def _look(points: Array, start: Array, ball: _Ball) -> _Look | None:
    """Return what is seen near a place; nothing if hardly a return lies on a ball there."""
    radius = ball.radius
    c, _, _ = _settled(points, start, ball, 3)
    blur = 0.5 * ball.divergence * float(np.linalg.norm(c))
    seen, _, _ = _view(points, c, ball.up)
    residuals, J = _shape(seen, radius)
    scatter = _scatter(seen, residuals, radius)
    weights = _weights(seen, residuals, radius, blur, max(scatter, _NOISE_MIN))
    is_in = weights > 0.0
    if is_in.sum() < _N_LOOK:
        return None
    is_strange = ~is_in & (np.hypot(seen[:, 0], seen[:, 1]) < 0.9 * radius)
    is_strange &= (np.abs(seen[:, 2]) < 2.0 * radius) & (seen[:, 1] > -0.8 * radius)
    rms = float(np.sqrt(np.sum(weights * residuals**2) / np.sum(weights)))
    noise = max(rms, _NOISE_MIN)
    n_beside, n_below = _surroundings(seen, radius, blur)
    flat, cov_flat = _solve(J[:, [0, 1, 2, 4, 5]], residuals, weights, 1e-6)
    _, radius_free, cov_free = _settled(points, c, ball, 4)
    return _Look(
        x=float(c[0]),
        y=float(c[1]),
        z=float(c[2]),
        n_points=int(is_in.sum()),
        n_strange=int(is_strange.sum()),
        n_beside=n_beside,
        n_below=n_below,
        scatter=rms,
        width=float(np.ptp(seen[is_in, 0])),
        height=float(np.ptp(seen[is_in, 1])),
        radius_free=radius_free,
        sigma_radius=noise * float(np.sqrt(cov_free[3, 3])),
        flat_across=float(flat[3]),
        sigma_across=noise * float(np.sqrt(cov_flat[3, 3])),
        flat_along=float(flat[4]),
        sigma_along=noise * float(np.sqrt(cov_flat[4, 4])),
    )


def _looks(cloud: StitchedCloud, grid: _Grid, seeds: Array, ball: _Ball) -> list[_Look]:
    """Return what is seen where the seeds' discs came to rest with little around them."""
    patches = _patches(grid, seeds, ball.radius)
    found = _approached(cloud.p_base, patches, seeds, _cells_of(seeds, grid), ball)
    is_free = found[:, 4] + found[:, 5] <= 2.0 + 0.6 * found[:, 3]
    found = found[(found[:, 3] >= _N_LOOK) & is_free]
    found = found[np.lexsort((found[:, 2], found[:, 1], found[:, 0], -found[:, 3]))]
    places = _thinned(found[:, :4].copy(), 0.5 * ball.radius)[:, :3]
    looks = []
    for place, cell in zip(places, _cells_of(places, grid), strict=True):
        points = _gathered(cloud.p_base, _near(cloud.p_base, patches, cell, place))
        looks.append(_look(points, place, ball))
    return [look for look in looks if look is not None]


def _cells_of(p_base: Array, grid: _Grid) -> NDArray[np.int64]:
    """Return the cells of some places, (k, 3)."""
    places = np.floor((p_base @ grid.R_station_base.T)[:, :2] / grid.edge).astype(np.int64)
    places = np.clip(places + grid.n_side // 2, 0, grid.n_side - 1)
    return np.asarray(places[:, 0] * grid.n_side + places[:, 1])


def _patches(grid: _Grid, seeds: Array, radius: float) -> _Patches:
    """Return the returns about the seeds, by cell."""
    reach = _REACH * radius
    margin = int(np.ceil(reach / grid.edge)) + 1
    starts, rows = _by_cell(grid.cells, grid.n_side, _cells_of(seeds, grid), margin)
    return _Patches(starts, rows, grid.n_side, margin, reach)


def _distinct(looks: list[_Look], config: ExtractionConfig, radius: float) -> list[_Look]:
    """Return the groups that pass the first gate, each once, those with most returns first."""
    kept: list[_Look] = []
    worthy = [look for look in looks if _passes_first_gate(look, config, radius)]
    for look in sorted(worthy, key=lambda look: (-look.n_points, look.x, look.y)):
        gaps = (np.hypot(np.hypot(look.x - o.x, look.y - o.y), look.z - o.z) for o in kept)
        if all(gap > 1.5 * radius for gap in gaps):
            kept.append(look)
    return kept


def _passes_first_gate(look: _Look, config: ExtractionConfig, radius: float) -> bool:
    """Tell whether a group is worth a verdict: enough returns, about as large as a ball."""
    return (
        look.n_points >= config.n_points_min
        and look.scatter > 0.0
        and max(look.width, look.height) > 0.8 * radius
        and look.n_strange <= look.n_points
    )


def _radius_slack(look: _Look, ball: _Ball) -> float:
    """Return by how much the free radius may be off: rays instead of wide beams make it larger."""
    blur = 0.5 * ball.divergence * float(np.linalg.norm(look.p_base))
    return max(_SIGMAS * look.sigma_radius, _RADIUS_SLACK * ball.radius + 0.6 * blur)


def _verdict(look: _Look, config: ExtractionConfig, ball: _Ball) -> str:
    """Return why a group is not a free ball of the known radius; empty if it may be one."""
    radius = ball.radius
    few = 1.0 + _TOUCHING * look.n_points
    width_min = (0.9 if look.n_points >= _N_SHAPELY else 0.5) * radius
    off = look.radius_free - radius
    tests = (
        (
            look.n_beside > few,
            f"It does not stand free: {look.n_beside} returns beside or above its outline lie "
            f"as far away, where {look.n_points} lie on it.",
        ),
        (
            look.n_below > few,
            f"It does not stand on a pole: {look.n_below} returns below its outline and beside "
            "a pole's place lie as far away, as under a rock or a head.",
        ),
        (
            look.n_strange > _STRANGE * (look.n_points + look.n_strange),
            f"It is not one surface: {look.n_strange} returns inside its outline are off the "
            f"sphere that {look.n_points} lie on.",
        ),
        (
            look.scatter > config.scatter_max,
            f"Its returns scatter by {1e3 * look.scatter:.0f} mm about a sphere of the known "
            f"radius; at most {1e3 * config.scatter_max:.0f} mm are taken for noise.",
        ),
        (
            look.width < width_min,
            f"It is {1e3 * look.width:.0f} mm wide, too slim for a sphere of diameter "
            f"{2e3 * radius:.0f} mm: a pole.",
        ),
        (
            abs(off) > _radius_slack(look, ball),
            f"Its own radius is {1e3 * look.radius_free:.0f} mm (standard deviation "
            f"{1e3 * look.sigma_radius:.0f} mm), not {1e3 * radius:.0f} mm.",
        ),
        (
            look.flat_along > max(_SIGMAS * look.sigma_along, 0.5),
            "It is not curved from top to bottom: a post or a panel.",
        ),
        (
            look.flat_across > max(_SIGMAS * look.sigma_across, 0.5),
            "It is not curved from side to side: a panel or a rail.",
        ),
    )
    return next((reason for is_so, reason in tests if is_so), "")


@numba.njit(cache=True, nogil=True)
def _direction_cell(x: float, y: float, z: float) -> int:
    """Return the cell of a direction on a cube of ``_N_FACE`` squared cells a face."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face, first, second, largest = int(x > 0.0), y, z, ax
    elif ay >= az:
        face, first, second, largest = 2 + int(y > 0.0), x, z, ay
    else:
        face, first, second, largest = 4 + int(z > 0.0), x, y, az
    scale = 0.4999 * _N_FACE / max(largest, 1e-9)
    row, column = int(first * scale + 0.5 * _N_FACE), int(second * scale + 0.5 * _N_FACE)
    return (face * _N_FACE + row) * _N_FACE + column


@numba.njit(cache=True, nogil=True)
def _in_directions(p_base: Column, centres: Array, up: Array, reach: float) -> Column:
    """Return the points, at whatever depth, whose beams may pass some centres within a reach."""
    is_wanted = np.zeros(6 * _N_FACE * _N_FACE, np.bool_)
    n_steps = 2 + int(1.5 * reach * _N_FACE / np.sqrt(np.min(np.sum(centres**2, axis=1)) + 1e-9))
    for k in range(len(centres)):
        c = centres[k]
        v_across = np.cross(up, c)
        v_across *= reach / (np.sqrt(np.sum(v_across**2)) + 1e-12)
        for i in range(-n_steps, n_steps + 1):
            for j in range(-n_steps, n_steps + 1):
                q = c + (i / n_steps) * v_across + (j / n_steps) * reach * up
                is_wanted[_direction_cell(q[0], q[1], q[2])] = True
    rows = np.empty(len(p_base), np.int32)
    n_rows = 0
    for i in range(len(p_base)):
        if is_wanted[_direction_cell(p_base[i, 0], p_base[i, 1], p_base[i, 2])]:
            rows[n_rows] = i
            n_rows += 1
    return p_base[rows[:n_rows]]


def _beneath(points: Array, look: _Look, ball: _Ball) -> tuple[int, int]:
    """Count the returns below a group beside a pole's place: those past it, and the others."""
    c, radius = look.p_base, ball.radius
    distance = float(np.linalg.norm(c))
    blur = 0.5 * ball.divergence * distance
    reach = 2.8 * radius + blur
    cosines = points @ c / (distance * np.linalg.norm(points, axis=1))
    near = points[cosines > np.cos(np.arctan(reach / distance))]
    seen, _, _ = _view(near, c, ball.up)
    across, along, depth = np.abs(seen[:, 0]), seen[:, 1], seen[:, 2]
    is_below = (along < -0.3 * radius) & (across > 0.6 * radius + blur)
    is_below &= np.hypot(across, along) > 1.2 * radius + blur
    n_past = int(np.sum(is_below & (depth > 1.5 * radius)))
    return n_past, int(is_below.sum()) - n_past


def _grounded(p_base: Column, looks: list[_Look], verdicts: list[str], ball: _Ball) -> list[str]:
    """Refuse what rests on the ground: beams below a ball on a pole go on past it.

    A group that shows its shape well may have its lower half hidden by something nearer.
    """
    open_cases = [look for look, reason in zip(looks, verdicts, strict=True) if not reason]
    if not open_cases:
        return verdicts
    centres = np.array([look.p_base for look in open_cases])
    points = _in_directions(p_base, centres, ball.up, 3.0 * ball.radius + 0.1).astype(np.float64)
    return [
        reason or _resting(points, look, ball) for look, reason in zip(looks, verdicts, strict=True)
    ]


def _resting(points: Array, look: _Look, ball: _Ball) -> str:
    """Return why a group seems to rest on the ground; empty if it does not."""
    n_past, n_short = _beneath(points, look, ball)
    is_sure = look.n_points >= _N_SURE and look.sigma_radius < _SHAPE_SURE * ball.radius
    if is_sure or n_short <= 1 + n_past:
        return ""
    return (
        f"It rests on the ground: of {n_past + n_short} beams that pass below it beside a pole's "
        f"place, {n_short} end at its distance or nearer."
    )


def _score(look: _Look, config: ExtractionConfig, ball: _Ball) -> float:
    """Return how easily the tests were passed: 1 with ease, 0 just so."""
    used = (
        look.n_beside / (1.0 + _TOUCHING * look.n_points),
        look.n_below / (1.0 + _TOUCHING * look.n_points),
        look.n_strange / (_STRANGE * (look.n_points + look.n_strange)),
        look.scatter / config.scatter_max,
        abs(look.radius_free - ball.radius) / _radius_slack(look, ball),
    )
    return float(np.clip(1.0 - np.mean(np.square(used)), 0.0, 1.0))


def _candidates(
    cloud: StitchedCloud, grid: _Grid, looks: list[_Look], ball: _Ball, config: ExtractionConfig
) -> tuple[MarkerCandidate, ...]:
    """Return candidates in the order of azimuth."""
    ordered = sorted(looks, key=lambda look: np.arctan2(look.y, look.x))
    centres = np.array([look.p_base for look in ordered]).reshape(-1, 3)
    patches = _patches(grid, centres, ball.radius)
    cells = _cells_of(centres, grid)
    return tuple(
        MarkerCandidate(
            members=_members(cloud, _near(cloud.p_base, patches, cell, p), p, ball),
            p_base_rough=p.copy(),
            score=_score(look, config, ball),
        )
        for look, p, cell in zip(ordered, centres, cells, strict=True)
    )


def _members(cloud: StitchedCloud, near: NDArray[np.int32], p: Array, ball: _Ball) -> Index:
    """Return the rows on and about a ball, ascending: its outline, and what of its pole touches."""
    rows = np.sort(near).astype(np.intp)
    seen, _, _ = _view(cloud.p_base[rows].astype(np.float64), p, ball.up)
    blur = 0.5 * ball.divergence * float(np.linalg.norm(p))
    is_about = np.hypot(seen[:, 0], seen[:, 1]) < 1.5 * ball.radius + blur
    is_level = (seen[:, 2] > -2.2 * ball.radius) & (seen[:, 2] < 1.6 * ball.radius)
    return np.asarray(rows[is_about & is_level])
