"""GeoTIFFs as grids; runs in the confined process.

GDAL reads them by its one driver, from the open file, without files beside it.
"""

from __future__ import annotations

import os
from typing import IO

import numpy as np
import numpy.ma  # what a module loads late cannot be loaded once confined
import rasterio
from rasterio.crs import CRS
from rasterio.errors import RasterioError
from rasterio.io import DatasetReader

from spheremark.pipelines.errors import InputError
from spheremark.pipelines.model import Array
from spheremark.storage.imports.declared import (
    RATIO_MAX,
    check_bytes,
    check_cells,
    check_width,
    size_of,
)

_BLOCK_MAX = 256 << 20  # [bytes] of a block, which is unpacked whole
_THIS_FILE = ("/0", "/dev/fd/0")  # once other files are out of reach, and before
_OPTIONS = {
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_GEOREF_SOURCES": "INTERNAL",
    "GDAL_PAM_ENABLED": "NO",
    "GDAL_CACHEMAX": 64,
    "GDAL_NUM_THREADS": "1",
}

CRS.from_epsg(4326).to_wkt()  # opens PROJ's database, which cannot be opened once confined


def read_geotiff(file: IO[bytes], *, name: str, cells_max: int) -> dict[str, Array]:
    """Return the grid of a GeoTIFF: ``xs``, ``ys`` and ``ground``."""
    this_file = next(path for path in _THIS_FILE if os.path.exists(path))  # noqa: PTH110  no Path
    try:
        with rasterio.Env(**_OPTIONS), rasterio.open(this_file, driver="GTiff") as raster:
            check_cells(raster.width, raster.height, name, cells_max)
            _check_size(raster, size_of(file), name)
            _check_place(raster, name)
            turn = raster.transform
            heights = raster.read(1, masked=True).astype(np.float64).filled(np.nan)
    except RasterioError as error:
        reason = str(error).replace(this_file, name).rstrip(".")
        raise InputError(f"{name} is no elevation model that can be read: {reason}.") from error
    ys = turn.f + (np.arange(heights.shape[0]) + 0.5) * turn.e
    xs = turn.c + (np.arange(heights.shape[1]) + 0.5) * turn.a
    if turn.e < 0:
        ys, heights = ys[::-1], heights[::-1]
    return {"xs": xs, "ys": ys, "ground": heights}


def _check_size(file: DatasetReader, size: int, name: str) -> None:
    """Refuse what unpacks to more than a file of this size can mean."""
    dtype = np.dtype(file.dtypes[0])
    if dtype.kind not in "iuf":
        raise InputError(f"The heights of {name} are of type {dtype}; real numbers are expected.")
    what = f"{file.width:,} x {file.height:,} cells"
    check_bytes(what, file.width * file.height * dtype.itemsize, RATIO_MAX * size, name)
    rows, columns = file.block_shapes[0]
    bands = file.count if file.interleaving is None or file.interleaving.name == "pixel" else 1
    if rows * columns * bands * dtype.itemsize > _BLOCK_MAX:
        raise InputError(
            f"The blocks of {name} have {columns:,} x {rows:,} cells of {bands:,} bands; "
            f"{_BLOCK_MAX >> 20} MiB are the most. Write it in tiles (gdal_translate"
            " -co TILED=YES)."
        )


def _check_place(file: DatasetReader, name: str) -> None:
    """Refuse a raster that is not in metres, or whose rows do not run from west to east."""
    if file.crs is not None and file.crs.is_geographic:
        raise InputError(
            f"{name} is in degrees ({file.crs.to_string()}); metres are needed. Reproject it "
            "(gdalwarp -t_srs)."
        )
    turn = file.transform
    if turn.is_identity:
        raise InputError(
            f"{name} does not say where it lies; files beside it are not read. Write the place "
            "into it (gdal_translate -a_ullr)."
        )
    if turn.b or turn.d or turn.a <= 0 or turn.e == 0:
        raise InputError(
            f"The rows of {name} do not run from west to east; straighten it (gdalwarp)."
        )
    check_width(turn.a, name)
