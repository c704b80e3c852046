"""Spheres in clouds of single scans, in the formats that other programs write."""

import json

import laspy
import numpy as np
import open3d
import pye57
import pytest

from spheremark.storage.imports.scans import read_scan
from tests.real_scans import REAL, needs
from tests.service.test_commands import run

RADIUS = 0.1
CENTRES = np.array([[4.0, 1.0, 0.9], [-2.0, 5.0, 0.8], [3.0, -4.0, 1.1]])


@pytest.fixture(scope="module")
def points():
    """A scan with three spheres on poles above flat ground, from 1.5 m above the origin."""
    rng = np.random.default_rng(2)
    azimuths = np.radians(np.arange(0, 360, 0.12))
    elevations = np.radians(np.arange(-30, 5, 0.12))
    a, e = (one.ravel() for one in np.meshgrid(azimuths, elevations))
    v = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    station = np.array([0.0, 0.0, 1.5])
    with np.errstate(divide="ignore"):
        ranges = np.where(v[:, 2] < 0, -station[2] / v[:, 2], np.inf)
    for centre in CENTRES:
        away = centre - station
        along = v @ away
        inside = RADIUS**2 - (away @ away - along**2)
        hits = (inside > 0) & (along > 0)
        ranges[hits] = np.minimum(ranges[hits], along[hits] - np.sqrt(inside[hits]))
    seen = ranges < 20
    noisy = ranges[seen] + rng.normal(0, 0.002, seen.sum())
    return station + noisy[:, None] * v[seen]


def write_las(path, p):
    las = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    las.header.scales = [1e-4] * 3
    las.x, las.y, las.z = p.T
    las.write(path)


def write_open3d(path, p, **options):
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(p))
    assert open3d.io.write_point_cloud(str(path), cloud, **options)


def write_e57(path, p):
    with pye57.E57(str(path), mode="w") as file:
        file.write_scan_raw({f"cartesian{axis}": p[:, i] for i, axis in enumerate("XYZ")})


WRITERS = {
    "a.las": write_las,
    "a.laz": write_las,
    "a.ply": write_open3d,
    "ascii.ply": lambda path, p: write_open3d(path, p, write_ascii=True),
    "a.pcd": write_open3d,
    "packed.pcd": lambda path, p: write_open3d(path, p, compressed=True),
    "a.e57": write_e57,
    "a.npy": np.save,
    "a.xyz": np.savetxt,
    "a.csv": lambda path, p: np.savetxt(path, p, delimiter=",", header="x,y,z", comments=""),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_cloud_of_any_format_is_read(tmp_path, points, name):
    WRITERS[name](tmp_path / name, points)
    np.testing.assert_allclose(read_scan(tmp_path / name), points, rtol=0, atol=1e-4)


def test_spheres_of_a_cloud_are_found_from_where_the_scanner_stood(tmp_path, points):
    np.save(tmp_path / "a.npy", points)
    options = ("--radius", RADIUS, "--station", "0,0,1.5", "--divergence-mrad", "0.2", "--json")
    found = json.loads(run("spheres", tmp_path / "a.npy", *options).stdout)
    assert found["n_points"] == len(points)
    centres = np.array([one["centre_m"] for one in found["spheres"]])
    distances = np.linalg.norm(centres[:, None] - CENTRES, axis=2)
    assert distances.min(axis=0).max() < 0.002


def test_a_cloud_without_spheres_ends_with_a_reason(tmp_path, points):
    np.save(tmp_path / "a.npy", points[points[:, 2] < 0.3])
    done = run("spheres", tmp_path / "a.npy", "--radius-m", "0.1", code=1)
    assert "No sphere of 0.1 m" in done.stdout


@pytest.mark.parametrize(
    ("octets", "said"),
    [
        (b"no cloud\n", "no cloud of a known kind"),
        (b"ply\nformat ascii 1.0\nelement vertex 9000000\nproperty float x\n", "no end"),
        (b"\x93NUMPY\1\0v\0{'descr': '|O', 'fortran_order': False, 'shape': (1,)}", "array"),
        (b"ASTM-E57" + bytes(40), "cannot be read"),
        (b"VERSION .7\nFIELDS x y z\nPOINTS 99999999999\nDATA binary\n", "points"),
    ],
)
def test_files_that_are_no_cloud_are_refused_in_a_sentence(tmp_path, octets, said):
    (tmp_path / "a.bin").write_bytes(octets)
    failed = run("spheres", tmp_path / "a.bin", "--radius", "0.1", code=1)
    assert said in failed.stderr
    assert "Traceback" not in failed.stderr


@needs("tls_spheres")
@pytest.mark.parametrize("number", range(101, 106))
def test_real_targets_of_a_laser_scanner_are_where_their_segmented_points_are(number):
    path = REAL / "tls_spheres" / f"SPH{number}.xyz"
    options = ("--radius", "0.05", "--divergence-mrad", "0.1", "--json")
    found = json.loads(run("spheres", path, *options).stdout)
    segmented = np.loadtxt(path.with_name(f"t{path.name}"), delimiter=",")
    normal = np.column_stack([2 * segmented, np.ones(len(segmented))])
    centre = np.linalg.lstsq(normal, (segmented**2).sum(axis=1), rcond=None)[0][:3]
    (sphere,) = found["spheres"]
    assert np.linalg.norm(np.array(sphere["centre_m"]) - centre) < 0.001  # [m]
