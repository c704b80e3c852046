"""Elevation models as GeoTIFF: what comes back, and what an independent reading finds."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
import rasterio

from spheremark.pipelines.errors import InputError, NotFoundError
from spheremark.pipelines.ground_model import ElevationModel
from spheremark.storage.exports.ground_model import read_geotiff, write_geotiff


@pytest.fixture
def model():
    rng = np.random.default_rng(8)
    heights = rng.normal(0, 0.1, (7, 11)).astype(np.float32)
    heights[2, 3] = np.nan
    sigmas = np.where(np.isnan(heights), np.nan, 0.004).astype(np.float32)
    counts = rng.integers(1, 900, heights.shape).astype(np.int32)
    counts[2, 3] = counts[5, 1] = 0
    filled = np.zeros(heights.shape, dtype=bool)
    filled[5, 1] = True
    return ElevationModel(
        corner=np.array([-2.5, 10.25]),
        cell=0.25,
        heights=heights,
        sigmas=sigmas,
        counts=counts,
        is_filled=filled,
    )


def test_a_model_comes_back_as_it_was_written(model, tmp_path):
    write_geotiff(model, tmp_path / "dem.tif", software="spheremark 1.2.3")
    found = read_geotiff(tmp_path / "dem.tif")
    for name in ("corner", "heights", "sigmas", "counts", "is_filled"):
        np.testing.assert_array_equal(getattr(found, name), getattr(model, name))
    assert found.cell == model.cell


def test_gdal_finds_each_height_at_its_place_in_a_local_system(model, tmp_path):
    write_geotiff(model, tmp_path / "dem.tif", software="spheremark 1.2.3")
    with rasterio.open(tmp_path / "dem.tif") as file:
        assert np.isnan(file.nodata)
        assert file.crs.to_wkt().startswith("LOCAL_CS")
        assert "metre" in file.crs.to_wkt()
        assert file.descriptions == ("height_m", "sigma_m", "count", "filled")
        places = [(x, y) for y in model.ys for x in model.xs]
        found = np.array(list(file.sample(places)))
    np.testing.assert_array_equal(found[:, 0], model.heights.ravel())
    np.testing.assert_array_equal(found[:, 2], model.counts.ravel())


def test_the_file_reads_the_same_by_the_specifications_of_tiff_and_geotiff(model, tmp_path):
    """TIFF 6.0, sections 2 and 14, and OGC GeoTIFF 1.1, without GDAL."""
    write_geotiff(model, tmp_path / "dem.tif", software="spheremark 1.2.3")
    data = (tmp_path / "dem.tif").read_bytes()
    order, magic, at = struct.unpack_from("<2sHI", data)
    assert (order, magic) == (b"II", 42)
    tags = {}
    for i in range(struct.unpack_from("<H", data, at)[0]):
        tag, kind, n = struct.unpack_from("<HHI", data, at + 2 + 12 * i)
        form = {2: "s", 3: "H", 4: "I", 12: "d"}[kind]
        size = n * struct.calcsize(form)
        where = at + 10 + 12 * i
        if size > 4:
            (where,) = struct.unpack_from("<I", data, where)
        tags[tag] = struct.unpack_from(f"<{n}{form}", data, where)
    scale, tie = tags[33550], tags[33922]
    assert (scale[0], scale[1]) == (0.25, 0.25)
    assert (tie[3], tie[4]) == (model.corner[0], model.corner[1] + 7 * 0.25)
    assert (tags[256], tags[257], tags[277]) == ((11,), (7,), (4,))
    keys = np.reshape(tags[34735], (-1, 4))
    stated = {int(key): int(value) for key, _, _, value in keys[1:]}
    assert (stated[1025], stated[3076]) == (1, 9001)  # pixels are areas, the unit is the metre
    strip = zlib.decompress(data[tags[273][0] :][: tags[279][0]])
    rows = np.frombuffer(strip, np.uint8)[: 11 * 4 * 4].astype(int)
    undone = np.empty_like(rows)  # floating-point predictor: bytes apart, differences of neighbours
    for k in range(len(rows)):
        undone[k] = (rows[k] + (undone[k - 4] if k >= 4 else 0)) % 256
    values = undone.astype(np.uint8).reshape(4, 44)[::-1].T.copy().view("<f4").reshape(11, 4)
    np.testing.assert_array_equal(values[:, 0], model.heights[-1])


def test_what_is_no_elevation_model_is_refused(tmp_path):
    with pytest.raises(NotFoundError, match="not there"):
        read_geotiff(tmp_path / "none.tif")
    (tmp_path / "text.tif").write_text("no raster")
    with pytest.raises(InputError, match="not a GeoTIFF"):
        read_geotiff(tmp_path / "text.tif")
