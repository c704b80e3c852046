"""Named points as files of other programs."""

import json
import xml.etree.ElementTree as ET

import ezdxf
import numpy as np
import pytest
from rasterio.warp import transform

from spheremark.pipelines.errors import InputError
from spheremark.storage.exports.points import GeographicOrigin, NamedPoint, format_points

POINTS = [
    NamedPoint(kind="mark", name="M1", p_site=(100.0, -40.25, 1.5), properties={"n": 3}),
    NamedPoint(kind="station", name="Überblick", p_site=(0.0, 500.0, 0.125)),
]


def test_a_drawing_opens_with_points_and_names_on_a_layer_for_each_kind(tmp_path):
    (tmp_path / "a.dxf").write_text(format_points(POINTS, ".dxf"))
    drawing = ezdxf.readfile(tmp_path / "a.dxf")
    assert not drawing.audit().errors
    points = drawing.modelspace().query("POINT")
    assert [one.dxf.layer for one in points] == ["mark", "station"]
    np.testing.assert_allclose([tuple(one.dxf.location) for one in points],
                               [point.p_site for point in POINTS])  # fmt: skip
    assert next(one.dxf.text for one in drawing.modelspace().query("TEXT")) == "M1"


def test_landxml_has_northing_before_easting():
    root = ET.fromstring(format_points(POINTS, ".xml"))
    space = {"x": "http://www.landxml.org/schema/LandXML-1.2"}
    points = root.findall("x:CgPoints/x:CgPoint", space)
    assert [one.get("name") for one in points] == ["M1", "Überblick"]
    assert [float(one) for one in points[0].text.split()] == [-40.25, 100.0, 1.5]
    assert root.find("x:Units/x:Metric", space).get("linearUnit") == "meter"


def test_geojson_is_in_wgs_84_where_the_origin_is_known():
    origin = GeographicOrigin.parse("16.37,48.21")
    features = json.loads(format_points(POINTS, ".geojson", origin))["features"]
    places = np.array([one["geometry"]["coordinates"] for one in features])
    assert places.shape == (2, 2)
    zone = transform("EPSG:4326", "EPSG:32633", [16.37, *places[:, 0]], [48.21, *places[:, 1]])
    found = np.linalg.norm(np.diff(np.array(zone)[:, [0, 2]], axis=1))
    assert found == pytest.approx(500.0, rel=5e-4)  # the grid's scale is 0.9996 to 1.0004
    assert places[1, 0] == pytest.approx(16.37, abs=1e-7)
    assert features[0]["properties"] == {
        "kind": "mark", "name": "M1", "n": 3, "x_m": 100.0, "y_m": -40.25, "z_m": 1.5,
    }  # fmt: skip


def test_the_y_axis_of_a_site_may_point_elsewhere_than_north():
    east = GeographicOrigin.parse("16.37,48.21,90").to_geographic(POINTS)[1]
    assert east[0] > 16.376
    assert east[1] == pytest.approx(48.21, abs=1e-5)


def test_geojson_without_an_origin_is_refused_with_what_to_take():
    with pytest.raises(InputError, match=r"origin as LON,LAT.*DXF, LandXML or CSV"):
        format_points(POINTS, ".geojson")


@pytest.mark.parametrize("text", ["", "16.37", "200,10", "1,91", "1,2,3,4", "nan,1", "a,b"])
def test_an_origin_that_is_none_is_refused(text):
    with pytest.raises(InputError, match="LON,LAT"):
        GeographicOrigin.parse(text)
