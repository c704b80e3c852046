"""Terrains to plan on: elevation models (GeoTIFF, ESRI ASCII grid) and clouds of earlier scans.

A cloud becomes two grids: the ground is the lowest return of each cell where that is no bump, what
hides is the highest.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import laspy
import numpy as np
import rasterio
from rasterio.errors import RasterioError
from scipy.ndimage import distance_transform_edt, grey_opening

from spheremark.pipelines.errors import InputError, NotFoundError
from spheremark.pipelines.model import Array
from spheremark.pipelines.placement import Site, site_of_grid
from spheremark.pipelines.placement.sites import CELLS_MAX
from spheremark.storage.clouds.stop import read_cloud

RASTERS = (".tif", ".tiff", ".asc")
"""Endings of elevation models."""

CLOUDS = (".laz", ".las", ".ply", ".parquet")
"""Endings of clouds; Parquet is a cloud that this service has kept."""

_CELL = 0.10  # [m] of a grid that is made from a cloud
_CHUNK = 1_000_000  # points at a time
_BUMP = 0.25  # [m] a lowest return this far above its surroundings is no ground
_OPENING = 1.0  # [m] width of what is taken for a bump
_GAP = 1.5  # [m] from the nearest return beyond which the ground is not known


def read_terrain(path: str | Path, *, name: str = "") -> Site:
    """Read a terrain.

    Parameters
    ----------
    path : str or Path
        Elevation model (.tif, .asc) or cloud (.laz, .las, .ply, .parquet) in metres, z up.
    name : str
        What it is called; the name of the file by default.

    Returns
    -------
    Site
        Ground, and what hides.

    Raises
    ------
    NotFoundError
        If there is no such file.
    InputError
        If it cannot be read, is too large, is in degrees, or holds no ground.

    Notes
    -----
    Of an elevation model the first band is taken; cells without data stay unknown. A cloud is
    gridded at 0.1 m, unknown more than 1.5 m from its nearest return.
    """
    path = Path(path)
    if not path.is_file():
        raise NotFoundError(f"There is no terrain {path}.")
    suffix = path.suffix.lower()
    if suffix in RASTERS:
        return _raster(path, name or path.name)
    if suffix in CLOUDS:
        return _gridded(path, name or path.name)
    raise InputError(
        f"{path.name} is no terrain that can be read; an elevation model ({', '.join(RASTERS)}) or "
        f"a cloud ({', '.join(CLOUDS)}) is expected."
    )


def _raster(path: Path, name: str) -> Site:
    """Read an elevation model."""
    try:
        with rasterio.open(path) as file:
            if file.width * file.height > CELLS_MAX:
                raise InputError(
                    f"{name} has {file.width:,} x {file.height:,} cells; {CELLS_MAX:,} are the "
                    "most. Cut out the field (gdal_translate -projwin) or take wider cells."
                )
            if file.crs is not None and file.crs.is_geographic:
                raise InputError(
                    f"{name} is in degrees ({file.crs.to_string()}); metres are needed. Reproject "
                    "it (gdalwarp -t_srs)."
                )
            turn = file.transform
            heights = file.read(1, masked=True).astype(np.float64).filled(np.nan)
    except RasterioError as error:
        said = (
            str(error).replace(str(path), name).rstrip(".")
        )  # where it is kept is nobody's business
        raise InputError(f"{name} is no elevation model that can be read: {said}.") from error
    if turn.b or turn.d or turn.a <= 0 or turn.e == 0:
        raise InputError(
            f"The rows of {name} do not run from west to east; straighten it (gdalwarp)."
        )
    ys = turn.f + (np.arange(heights.shape[0]) + 0.5) * turn.e
    xs = turn.c + (np.arange(heights.shape[1]) + 0.5) * turn.a
    if turn.e < 0:
        ys, heights = ys[::-1], heights[::-1]
    heights[~(np.abs(heights) < 1e5)] = np.nan  # what is no height on Earth or Moon
    return site_of_grid(name, xs, ys, heights)


def _gridded(path: Path, name: str) -> Site:
    """Make grids of a cloud."""
    try:
        low, high = _extent(path)
    except (laspy.LaspyException, ValueError, EOFError, OSError) as error:
        raise InputError(
            f"{name} is no cloud that can be read: {str(error).rstrip('.')}."
        ) from error
    if not np.isfinite([low, high]).all():
        raise InputError(f"{name} holds no terrain: it has no points.")
    shape = np.floor((high - low) / _CELL).astype(np.int64) + 1
    if int(shape[0]) * int(shape[1]) > CELLS_MAX:
        raise InputError(
            f"{name} spreads over {high[0] - low[0]:,.0f} x {high[1] - low[1]:,.0f} m; at "
            f"{_CELL:g} m a cell that is more than {CELLS_MAX:,} cells. Cut out the field."
        )
    lowest = np.full((shape[1], shape[0]), np.inf)
    highest = np.full((shape[1], shape[0]), -np.inf)
    for points in _pieces(path):
        i, j = ((points[:, axis] - low[axis]) / _CELL for axis in range(2))
        cells = (j.astype(np.intp), i.astype(np.intp))
        np.minimum.at(lowest, cells, points[:, 2])
        np.maximum.at(highest, cells, points[:, 2])
    ground = _ground(np.where(np.isfinite(lowest), lowest, np.nan))
    lines = [low[axis] + (np.arange(shape[axis]) + 0.5) * _CELL for axis in range(2)]
    surface = np.where(np.isfinite(highest), highest, np.nan)
    return site_of_grid(name, lines[0], lines[1], ground, surface=surface)


def _ground(lowest: Array) -> Array:
    """Return the ground of lowest returns: bumps taken away, small gaps filled with the nearest."""
    is_hole = np.isnan(lowest)
    if is_hole.all():
        return lowest
    distance, nearest = distance_transform_edt(is_hole, return_indices=True)
    filled = lowest[tuple(nearest)]
    width = max(3, round(_OPENING / _CELL) | 1)
    opened = grey_opening(filled, size=(width, width))
    ground = np.where(filled - opened > _BUMP, opened, filled)
    return np.where(distance * _CELL <= _GAP, ground, np.nan)


def _extent(path: Path) -> tuple[Array, Array]:
    """Return the least and greatest x and y of a cloud [m]."""
    if path.suffix.lower() in (".laz", ".las"):
        with laspy.open(path) as file:
            header = file.header
            if not header.point_count:
                return np.full(2, np.nan), np.full(2, np.nan)
            return np.array(header.mins[:2]), np.array(header.maxs[:2])
    lows, highs = [np.full(2, np.inf)], [np.full(2, -np.inf)]
    for points in _pieces(path):
        lows.append(points[:, :2].min(axis=0))
        highs.append(points[:, :2].max(axis=0))
    return np.min(lows, axis=0), np.max(highs, axis=0)


def _pieces(path: Path) -> Iterator[Array]:
    """Return the points of a cloud piece by piece, (n, 3), if finite [m]."""
    suffix = path.suffix.lower()
    if suffix in (".laz", ".las"):
        with laspy.open(path) as file:
            for chunk in file.chunk_iterator(_CHUNK):
                yield np.column_stack([chunk.x, chunk.y, chunk.z]).astype(np.float64)
        return
    points = _ply(path) if suffix == ".ply" else read_cloud(str(path)).p_station
    points = np.asarray(points, dtype=np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points):
        yield points


def _ply(path: Path) -> Array:
    """Return the vertices of a PLY file [m]."""
    import open3d as o3d

    if not path.read_bytes()[:4].startswith(b"ply"):
        raise ValueError("its first line is not 'ply'")
    return np.asarray(o3d.io.read_point_cloud(path).points, dtype=np.float64)
