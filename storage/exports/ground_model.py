"""Elevation models as GeoTIFF: heights, standard deviations, counts and interpolated cells."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from rasterio.crs import CRS
from rasterio.errors import RasterioIOError
from rasterio.transform import Affine

from spheremark.pipelines.errors import InputError, NotFoundError
from spheremark.pipelines.ground_model import ElevationModel

BANDS = (
    ("height_m", "m", "mean height of the ground in the cell, in the site frame"),
    ("sigma_m", "m", "standard deviation of that height"),
    ("count", "", "returns that carry it"),
    ("filled", "", "1 where the height is interpolated from cells around"),
)
"""Name, unit and meaning of each band."""
SITE_WKT = 'LOCAL_CS["site",LOCAL_DATUM["site",0],UNIT["metre",1],AXIS["x",EAST],AXIS["y",NORTH]]'
"""Coordinate system of a site: local, without a place on Earth."""


def write_geotiff(model: ElevationModel, path: Path, *, software: str) -> None:
    """Write an elevation model.

    Parameters
    ----------
    model : ElevationModel
        The model.
    path : Path
        The file.
    software : str
        Name of the writing program.

    Notes
    -----
    Four bands of 32-bit floats, the first row the northernmost, as rasters have it; a value stands
    for the area of its cell. Cells without ground are NaN in the first two bands, which is also the
    value for no data.
    """
    rows, columns = model.heights.shape
    north = float(model.corner[1] + rows * model.cell)
    layers = (model.heights, model.sigmas, model.counts, model.is_filled)
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=columns,
        height=rows,
        count=len(BANDS),
        dtype="float32",
        crs=CRS.from_wkt(SITE_WKT),
        transform=Affine(model.cell, 0.0, float(model.corner[0]), 0.0, -model.cell, north),
        nodata=np.nan,
        compress="deflate",
        predictor=3,
    ) as file:
        for i, ((name, unit, meaning), layer) in enumerate(zip(BANDS, layers, strict=True), 1):
            file.write(np.asarray(layer[::-1], dtype=np.float32), i)
            file.set_band_description(i, name)
            file.set_band_unit(i, unit)
            file.update_tags(i, meaning=meaning)
        file.update_tags(TIFFTAG_SOFTWARE=software, AREA_OR_POINT="Area", frame="site, z up")


def read_geotiff(path: str | Path) -> ElevationModel:
    """Read an elevation model.

    Parameters
    ----------
    path : str or Path
        A file of ``write_geotiff``.

    Returns
    -------
    ElevationModel
        The model.

    Raises
    ------
    NotFoundError
        If there is no such file.
    InputError
        If it is not such a file.
    """
    if not Path(path).exists():
        raise NotFoundError(f"The elevation model {path} is not there any more; make it again.")
    try:
        with rasterio.open(path, driver="GTiff") as file:
            names = file.descriptions
            transform, bands = file.transform, file.read()
    except RasterioIOError as error:
        raise InputError(f"{path} is not a GeoTIFF: {error}") from error
    if names != tuple(name for name, _, _ in BANDS):
        raise InputError(f"{path} has the bands {names}, not those of an elevation model.")
    heights, sigmas, counts, filled = (np.ascontiguousarray(band[::-1]) for band in bands)
    south = transform.f + transform.e * len(heights)
    return ElevationModel(
        corner=np.array([transform.c, south]),
        cell=float(transform.a),
        heights=heights,
        sigmas=sigmas,
        counts=counts.astype(np.int32),
        is_filled=filled > 0.5,
    )
