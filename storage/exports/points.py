"""Named points for other programs: DXF and LandXML to stake out, GeoJSON for maps of the Earth."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Self
from xml.etree import ElementTree as ET

import numpy as np

from spheremark.pipelines.errors import InputError

_TEXT_HEIGHT = 0.15  # [m] of names in a drawing; a sphere is 0.2 m wide
_LAYERS = {"mark": 3, "control": 1, "station": 5, "stop": 5}  # colours of AutoCAD by kind
_LANDXML = "http://www.landxml.org/schema/LandXML-1.2"


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedPoint:
    """A point of the site: its kind, its name, x, y and z [m], and properties for maps."""

    kind: str
    name: str
    p_site: Sequence[float]
    properties: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class GeographicOrigin:
    """Where the origin of a site is on the Earth: WGS 84, and the bearing of its y axis [deg]."""

    longitude: float
    latitude: float
    bearing: float = 0.0

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read ``LON,LAT`` or ``LON,LAT,BEARING``.

        Parameters
        ----------
        text : str
            Numbers in degrees; the bearing of the y axis is clockwise from north, 0 by default.

        Returns
        -------
        GeographicOrigin
            The origin.

        Raises
        ------
        InputError
            If the text is not such numbers.
        """
        try:
            numbers = [float(part) for part in text.split(",")]
        except ValueError:
            numbers = []
        is_known = len(numbers) in (2, 3) and abs(numbers[0]) <= 180 and abs(numbers[1]) <= 90
        if not is_known or not all(abs(number) <= 360 for number in numbers):
            raise InputError(
                f"The origin is {text!r}; LON,LAT or LON,LAT,BEARING of the y axis is expected, in "
                "degrees (WGS 84), such as 16.37,48.21."
            )
        return cls(**dict(zip(("longitude", "latitude", "bearing"), numbers, strict=False)))

    def to_geographic(self, points: Sequence[NamedPoint]) -> list[tuple[float, float]]:
        """Return longitude and latitude of points [deg].

        Notes
        -----
        The plane of the site touches the ellipsoid at its origin (azimuthal equidistant); over
        1 km that differs from the distances of the site by less than a millimetre.
        """
        from rasterio.warp import transform

        bearing = math.radians(self.bearing)
        x, y = (np.array([float(one.p_site[axis]) for one in points]) for axis in (0, 1))
        east = x * math.cos(bearing) + y * math.sin(bearing)
        north = y * math.cos(bearing) - x * math.sin(bearing)
        place = f"+lat_0={self.latitude!r} +lon_0={self.longitude!r}"
        found = transform(f"+proj=aeqd {place} +ellps=WGS84 +units=m", "EPSG:4326", east, north)
        return list(zip(*found, strict=True))


def format_points(
    points: Sequence[NamedPoint], ending: str, origin: GeographicOrigin | None = None
) -> str:
    """Return points as the text of a file.

    Parameters
    ----------
    points : sequence of NamedPoint
        The points.
    ending : str
        ``.dxf`` (R12: a point and its name, a layer for each kind), ``.xml`` (LandXML 1.2) or
        ``.geojson`` (RFC 7946).
    origin : GeographicOrigin, optional
        Where the site is; GeoJSON needs it.

    Returns
    -------
    str
        The file.

    Raises
    ------
    InputError
        If the ending is another, or GeoJSON has no origin.
    """
    writers: Mapping[str, Callable[[], str]] = {
        ".dxf": lambda: _dxf(points),
        ".xml": lambda: _landxml(points),
        ".geojson": lambda: _geojson(points, origin),
    }
    if ending not in writers:
        raise InputError(f"{ending or 'No ending'} is no file of points; {', '.join(writers)} are.")
    return writers[ending]()


def _dxf(points: Sequence[NamedPoint]) -> str:
    """Return a drawing of release 12, the oldest that all programs read."""
    groups: list[tuple[int, object]] = [(0, "SECTION"), (2, "TABLES"), (0, "TABLE"), (2, "LAYER")]
    kinds = sorted({point.kind for point in points})
    groups.append((70, len(kinds)))
    for kind in kinds:
        colour = _LAYERS.get(kind, 7)
        groups += [(0, "LAYER"), (2, kind), (70, 0), (62, colour), (6, "CONTINUOUS")]
    groups += [(0, "ENDTAB"), (0, "ENDSEC"), (0, "SECTION"), (2, "ENTITIES")]
    for point in points:
        codes = zip((10, 20, 30), point.p_site, strict=True)
        place = [(code, f"{value:.5f}") for code, value in codes]
        name = point.name.encode("ascii", "backslashreplace").decode()  # the release knows no more
        groups += [(0, "POINT"), (8, point.kind), *place]
        groups += [(0, "TEXT"), (8, point.kind), *place, (40, _TEXT_HEIGHT), (1, name)]
    groups += [(0, "ENDSEC"), (0, "EOF")]
    return "".join(f"{code:3d}\n{value}\n" for code, value in groups)


def _landxml(points: Sequence[NamedPoint]) -> str:
    """Return the points as coordinate geometry; LandXML has northing before easting."""
    day = datetime.now(UTC).date().isoformat()
    root = ET.Element("LandXML", xmlns=_LANDXML, version="1.2", date=day, time="00:00:00")
    units = {"linearUnit": "meter", "areaUnit": "squareMeter", "volumeUnit": "cubicMeter"}
    units |= {"temperatureUnit": "celsius", "pressureUnit": "HPA", "angularUnit": "decimal degrees"}
    ET.SubElement(ET.SubElement(root, "Units"), "Metric", units)
    ET.SubElement(root, "Application", name="spheremark")
    group = ET.SubElement(root, "CgPoints", name="spheremark")
    for point in points:
        x, y, z = point.p_site
        one = ET.SubElement(group, "CgPoint", name=point.name, code=point.kind)
        one.text = f"{y:.5f} {x:.5f} {z:.5f}"
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _geojson(points: Sequence[NamedPoint], origin: GeographicOrigin | None) -> str:
    """Return the points in WGS 84; their heights are local and therefore properties."""
    if origin is None:
        raise InputError(
            "GeoJSON has longitudes and latitudes (RFC 7946), and where the site is on the Earth "
            "is not known: give its origin as LON,LAT[,BEARING], or take DXF, LandXML or CSV."
        )
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": [round(one, 9) for one in place]},
            "properties": {"kind": point.kind, "name": point.name, **point.properties}
            | dict(zip(("x_m", "y_m", "z_m"), point.p_site, strict=True)),
        }
        for point, place in zip(points, origin.to_geographic(points), strict=True)
    ]
    return json.dumps({"type": "FeatureCollection", "features": features}) + "\n"
