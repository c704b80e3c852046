"""Site clouds: what other programs find in the files, and what an independent reading finds."""

from __future__ import annotations

import json
import struct
import xml.etree.ElementTree as ET
from contextlib import closing
from datetime import UTC, datetime

import laspy
import lazrs
import numpy as np
import pye57
import pytest

from spheremark.pipelines.errors import InputError
from spheremark.pipelines.geometry import rigid, rot_y, rot_z
from spheremark.pipelines.ground_model import StationPoints
from spheremark.storage.clouds.site import E57File, LazFile

MADE = datetime(2026, 5, 11, 12, 30, tzinfo=UTC)
START_NS = 1_778_500_000_123_456_789  # 2026-05-11T11:46:40 UTC


def written(file, some):
    """Write stops into a file and close it; return what it holds."""
    with closing(file):
        for stop in some:
            file.add(stop)
        return file.finish()


def write_laz(some, path, *, software):
    return written(LazFile(path, software=software, made=MADE), some)


def write_e57(some, path, *, software):
    return written(E57File(path, software=software, made=MADE), some)


def stops(n=3, n_points=2000):
    """Stations on a line, each turned and leaning, with returns all around."""
    rng = np.random.default_rng(5)
    for i in range(n):
        yield StationPoints(
            name=f"stop{i + 1}",
            T_site_station=rigid(rot_z(0.7 * i) @ rot_y(0.01 * i), [1000.0 + 4 * i, -200.0, 12.3]),
            p_station=rng.uniform(-20, 20, (n_points + i, 3)).astype(np.float32),
            intensities=rng.uniform(0, 255, n_points + i).astype(np.float32),
            rings=rng.integers(0, 16, n_points + i).astype(np.uint8),
            times=np.linspace(0, 13, n_points + i).astype(np.float32),
            start_ns=START_NS + i * 60_000_000_000,
        )


def in_site(stop):
    """The returns in the site frame, one by one from the definition of a pose."""
    T = stop.T_site_station
    return np.array([T[:3, :3] @ p + T[:3, 3] for p in stop.p_station.astype(np.float64)])


@pytest.fixture(scope="module")
def laz(tmp_path_factory):
    path = tmp_path_factory.mktemp("laz") / "site.laz"
    extent = write_laz(stops(), path, software="spheremark 1.2.3")
    return path, extent


@pytest.fixture(scope="module")
def e57(tmp_path_factory):
    path = tmp_path_factory.mktemp("e57") / "site.e57"
    return path, write_e57(stops(), path, software="spheremark 1.2.3")


def test_a_laz_file_has_all_returns_in_the_site_frame_to_the_millimetre(laz):
    found = laspy.read(laz[0])
    expected = np.vstack([in_site(stop) for stop in stops()])
    assert np.abs(found.xyz - expected).max() < 0.00051
    assert laz[1].n_points == len(expected) == found.header.point_count
    np.testing.assert_allclose(laz[1].bounds, [expected.min(axis=0), expected.max(axis=0)])
    np.testing.assert_allclose(found.header.maxs, expected.max(axis=0), atol=0.001)


def test_every_return_of_a_laz_file_names_its_station_laser_and_brightness(laz):
    found = laspy.read(laz[0])
    for number, stop in enumerate(stops(), start=1):
        own = found.point_source_id == number
        np.testing.assert_array_equal(found.ring[own], stop.rings)
        np.testing.assert_allclose(found.intensity[own] / 257.0, stop.intensities, atol=0.002)
        np.testing.assert_allclose(found.stop_time[own], stop.times)
        unix = found.gps_time[own] + 1e9 + datetime(1980, 1, 6, tzinfo=UTC).timestamp() - 18
        np.testing.assert_allclose(unix, stop.start_ns / 1e9 + stop.times, atol=1e-5)
    assert found.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD


def test_a_laz_file_names_its_stations_their_poses_and_a_local_system(laz):
    found = laspy.read(laz[0])
    assert (found.header.generating_software, found.header.creation_date) == (
        "spheremark 1.2.3",
        MADE.date(),
    )
    np.testing.assert_array_equal(found.header.scales, 0.001)
    (record,) = found.evlrs
    about = json.loads(record.record_data)["stations"]
    assert [station["name"] for station in about] == ["stop1", "stop2", "stop3"]
    poses = np.array([station["T_site_station"] for station in about])
    np.testing.assert_allclose(poses, [stop.T_site_station for stop in stops()])
    assert found.header.vlrs.get("WktCoordinateSystemVlr")[0].string.startswith("LOCAL_CS")


def test_a_laz_file_reads_the_same_by_its_specification(laz):
    """LAS 1.4 R15, tables 3, 13 and 16, decompressed without laspy."""
    data = laz[0].read_bytes()
    assert (data[:4], data[24:26]) == (b"LASF", b"\x01\x04")
    header_size, start, n_records = struct.unpack_from("<HII", data, 94)
    form, size = struct.unpack_from("<BH", data, 104)
    scale, offset = struct.unpack_from("<3d3d", data, 131)[:3], struct.unpack_from("<3d", data, 155)
    (n_points,) = struct.unpack_from("<Q", data, 247)
    assert (form & 0x7F, size) == (6, 35)
    assert struct.unpack_from("<H", data, 6)[0] & 17 == 17  # well-known text, standard time
    at, laszip = header_size, b""
    for _ in range(n_records):
        user, record, length = struct.unpack_from("<16sHH", data, at + 2)
        if (user.rstrip(b"\0"), record) == (b"laszip encoded", 22204):
            laszip = data[at + 54 : at + 54 + length]
        at += 54 + length
    raw = np.zeros(n_points * size, np.uint8)
    with laz[0].open("rb") as file:
        file.seek(start)
        lazrs.LasZipDecompressor(file, laszip).decompress_many(raw)
    rows = raw.reshape(-1, size)
    xyz = rows[:, :12].copy().view("<i4") * np.array(scale) + np.array(offset)
    expected = np.vstack([in_site(stop) for stop in stops()])
    assert np.abs(xyz - expected).max() < 0.00051
    np.testing.assert_array_equal(rows[:, 20:22].copy().view("<u2").ravel()[[0, -1]], [1, 3])
    np.testing.assert_array_equal(rows[:, 30], np.concatenate([stop.rings for stop in stops()]))


def test_an_e57_file_has_a_scan_with_a_pose_for_each_station(e57):
    with pye57.E57(str(e57[0])) as file:
        assert file.scan_count == 3
        for i, stop in enumerate(stops()):
            header = file.get_header(i)
            assert header["name"].value() == stop.name
            np.testing.assert_allclose(header.translation, stop.T_site_station[:3, 3])
            np.testing.assert_allclose(
                header.rotation_matrix, stop.T_site_station[:3, :3], atol=1e-12
            )
            raw = file.read_scan_raw(i)
            found = np.column_stack([raw[f"cartesian{axis}"] for axis in "XYZ"])
            np.testing.assert_array_equal(found.astype(np.float32), stop.p_station)
            np.testing.assert_array_equal(raw["rowIndex"], stop.rings)
            np.testing.assert_allclose(raw["intensity"], stop.intensities)
            moved = file.read_scan(i, ignore_missing_fields=True)
            np.testing.assert_allclose(moved["cartesianX"], in_site(stop)[:, 0], atol=1e-5)


def test_an_e57_file_says_when_it_was_made_and_when_each_scan_was(e57):
    with pye57.E57(str(e57[0])) as file:
        made = file.root["creationDateTime"]["dateTimeValue"].value()
        epoch = datetime(1980, 1, 6, tzinfo=UTC)
        assert made == pytest.approx((MADE - epoch).total_seconds() + 18, abs=1e-3)
        for i, stop in enumerate(stops()):
            begun = file.get_header(i)["acquisitionStart"]["dateTimeValue"].value()
            ended = file.get_header(i)["acquisitionEnd"]["dateTimeValue"].value()
            unix = begun + epoch.timestamp() - 18
            assert unix == pytest.approx(stop.start_ns / 1e9, abs=1e-5)
            assert ended - begun == pytest.approx(13.0, abs=1e-5)


def test_an_e57_file_reads_the_same_by_its_specification(e57):
    """ASTM E2807-11, 6.2 and 9: pages of 1020 bytes and a checksum; the rest is XML and packets."""
    data = e57[0].read_bytes()
    signature, major, _, _, xml_at, xml_size, page = struct.unpack_from("<8s2I4Q", data)
    assert (signature, major, page) == (b"ASTM-E57", 1, 1024)
    pages = [data[at : at + page - 4] for at in range(0, len(data), page)]
    logical = b"".join(pages)

    def place(physical):
        return physical // page * (page - 4) + physical % page

    xml = ET.fromstring(logical[place(xml_at) : place(xml_at) + xml_size])
    space = {"e": "http://www.astm.org/COMMIT/E57/2010-e57-v1.0"}
    scans = xml.findall("e:data3D/e:vectorChild", space)
    assert [scan.find("e:name", space).text for scan in scans] == ["stop1", "stop2", "stop3"]
    for scan, stop in zip(scans, stops(), strict=True):
        w, x, y, z = (float(scan.find(f"e:pose/e:rotation/e:{a}", space).text or 0) for a in "wxyz")
        first_row = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
        np.testing.assert_allclose(first_row, stop.T_site_station[0, :3], atol=1e-12)
        points = scan.find("e:points", space)
        assert int(points.get("recordCount")) == len(stop.p_station)
        at = place(int(points.get("fileOffset")))
        first_packet = place(struct.unpack_from("<Q", logical, at + 16)[0])
        kind, _, _, n_streams = struct.unpack_from("<BBHH", logical, first_packet)
        assert (kind, n_streams) == (1, 5)
        (n_bytes,) = struct.unpack_from("<H", logical, first_packet + 6)
        xs = np.frombuffer(logical, "<f4", n_bytes // 4, first_packet + 6 + 2 * n_streams)
        np.testing.assert_array_equal(xs, stop.p_station[: len(xs), 0])


def test_the_same_stops_give_the_same_bytes(tmp_path, laz, e57):
    write_laz(stops(), tmp_path / "again.laz", software="spheremark 1.2.3")
    write_e57(stops(), tmp_path / "again.e57", software="spheremark 1.2.3")
    assert (tmp_path / "again.laz").read_bytes() == laz[0].read_bytes()
    assert (tmp_path / "again.e57").read_bytes() == e57[0].read_bytes()


@pytest.mark.parametrize("n", [0, 1])
def test_a_cloud_without_returns_is_refused(tmp_path, n):
    with pytest.raises(InputError, match="no return"):
        write_laz(stops(n, n_points=0), tmp_path / "a.laz", software="s")
    with pytest.raises(InputError, match="no return"):
        write_e57(stops(n, n_points=0), tmp_path / "a.e57", software="s")
