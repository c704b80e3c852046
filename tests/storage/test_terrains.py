"""Terrains are read right, and each layer that stops a hostile one holds without the others."""

import socket

import numpy as np
import pytest

from spheremark.pipelines.errors import InputError, NotFoundError
from spheremark.pipelines.placement.sites import CELLS_MAX
from spheremark.storage.confined import run_confined
from spheremark.storage.imports.terrain import LIMITS, open_terrain, read_terrain, write_grid
from tests.storage import hostile_terrains as made


@pytest.fixture
def write(tmp_path):
    def written(ending, body):
        path = tmp_path / f"terrain{ending}"
        path.write_bytes(body)
        return path

    return written


@pytest.mark.parametrize("kind", made.valid())
def test_each_format_is_read_right_and_survives_being_kept(write, tmp_path, kind):
    ending, body = made.valid()[kind]
    site = read_terrain(write(ending, body))
    middle = np.array([site.xs.mean(), site.ys.mean()])
    assert abs(float(site.ground_at(middle))) < 0.05
    width = 0.5 if ending.lower().startswith(".tif") else 1.0 if ending.lower() == ".asc" else 0.1
    for line in (site.xs, site.ys):
        np.testing.assert_allclose(np.diff(line), width, rtol=0, atol=1e-9)
    kept = tmp_path / "digest.npz"
    kept.touch()  # the upload, over which the grid is written
    write_grid(site, kept)
    again = open_terrain(tmp_path / "digest.npz", site.name)
    for name in ("xs", "ys", "ground", "surface"):
        np.testing.assert_array_equal(getattr(again, name), getattr(site, name))


def test_all_forms_of_one_cloud_give_one_grid(write):
    forms = ("ply", "ply of doubles", "ply of text", "ply with faces and colours", "parquet")
    sites = [read_terrain(write(*made.valid()[one])) for one in forms]
    for site in sites[1:]:
        np.testing.assert_allclose(site.ground, sites[0].ground, rtol=0, atol=0.05)
        np.testing.assert_allclose(site.xs, sites[0].xs, rtol=0, atol=1e-3)


def test_the_first_row_of_an_ascii_grid_is_the_northern_one(write):
    text = made.asc("", "1 2 3\n4 5 -9999\n7 8 9\n", xllcorner=None, xllcenter=10)
    site = read_terrain(write(".asc", text))
    assert site.xs.tolist() == [10.0, 11.0, 12.0]
    assert site.ys.tolist() == [0.5, 1.5, 2.5]
    assert site.ground[2].tolist() == [1.0, 2.0, 3.0]
    assert np.isnan(site.ground[1, 2])


def test_files_beside_a_terrain_are_not_read(write, tmp_path):
    path = write(".tif", made.tif())
    for name in ("terrain.tif.aux.xml", "terrain.tif.ovr", "terrain.tif.msk", "terrain.tfw"):
        (tmp_path / name).write_bytes(made.vrt(made.raw_band("/etc/passwd")))
    site = read_terrain(path)
    assert np.diff(site.xs).mean() == pytest.approx(0.5)
    assert len(list(tmp_path.iterdir())) == 5


@pytest.mark.parametrize(
    "name", [n for n, ending, _ in made.references("", "", "") if ending == ".tif"]
)
def test_the_one_driver_refuses_what_the_first_bytes_would_have(write, tmp_path, name):
    secret = tmp_path / "secret"
    secret.write_text(made.SECRET)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.setblocking(False)
        address = f"http://127.0.0.1:{listener.getsockname()[1]}"
        bodies = {one: body for one, _, body in made.references(secret, address, tmp_path)}
        path = write(".tif", bodies[name])
        with pytest.raises(InputError):
            run_confined(
                "spheremark.storage.imports.rasters:read_geotiff",
                path, LIMITS, name="terrain.tif", cells_max=CELLS_MAX,
            )  # fmt: skip
        with pytest.raises(BlockingIOError):
            listener.accept()
    assert sorted(tmp_path.iterdir()) == [secret, path]


@pytest.mark.parametrize(
    ("ending", "body", "reason"),
    [
        (".tif", made.las(), "ending is that of GeoTIFF, its first bytes are those of LAS"),
        (".tif", b"<VRTDataset", "its first bytes are b'<VRTData'"),
        (".gpkg", made.tif(), r"one of these is expected: GeoTIFF \(.tif, .tiff\)"),
        (".ply", made.ply(b"", 300_000_000, "ascii 1.0"), "300,000,000 points; 200,000,000"),
        (".ply", made.ply(b"", 3), "declares 3 vertices, more than a file of its size"),
        (".ply", made.ply(b"", 1, properties=["float " + 5000 * "x"]), "5,000 characters; 64"),
        (".tif", made.tif(50_000, 20_000, dtype="uint8", tiled=True, sparse_ok=True),
         "50,000 x 20,000 cells; 16,000,000 are the most"),
        (".asc", made.asc(rows="a b c\n" * 3), "no number among its heights; 9 numbers"),
        (".asc", made.asc(rows="1 2 3\n" * 4), "9 heights and then b'1 2 3'"),
        (".asc", made.asc(cellsize=1e-4), "0.0001 m wide"),
        (".las", made.patched(made.las(), (100, "<I", 2**32 - 1)), "4,294,967,295 records"),
        (".las", made.patched(made.las(), (179, "<2d", 0.1, 0.0)), "outside the extent"),
    ],
    ids=lambda v: str(v)[:30],
)  # fmt: skip
def test_a_refusal_says_what_was_found_and_expected(write, ending, body, reason):
    with pytest.raises(InputError, match=reason):
        read_terrain(write(ending, body))


def test_a_terrain_that_is_not_there_is_said_so(tmp_path):
    with pytest.raises(NotFoundError):
        read_terrain(tmp_path / "x.tif")
    with pytest.raises(NotFoundError):
        read_terrain(tmp_path)
    with pytest.raises(NotFoundError, match="upload it again"):
        open_terrain(tmp_path / "x.npz", "x.tif")
