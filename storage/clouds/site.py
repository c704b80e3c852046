"""Clouds of a whole site as LAZ, and as E57 with a pose per scan.

Both are written stop by stop, so that memory holds one stop. LAZ has the returns in the site frame,
to the millimetre; E57 has them in the station frame, with the pose of the station in the site.
"""

from __future__ import annotations

import json
import math
import uuid
from dataclasses import dataclass
from datetime import date, datetime
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from pye57 import libe57
from scipy.spatial.transform import Rotation

from spheremark.pipelines.errors import InputError
from spheremark.pipelines.ground_model import StationPoints
from spheremark.pipelines.model import Array, Column, Rings
from spheremark.storage.exports.ground_model import SITE_WKT

_SCALE = 0.001  # [m] of a LAZ coordinate
_FULL = 65535 / 255  # LAS wants intensities to fill 16 bits
_CHUNK = 500_000  # returns at a time
_STATIONS = "stations: name, number (point_source_id), T_site_station, rows first [m]"
_RECORD = 1  # of our own records in a LAZ file
_GPS_EPOCH = 315_964_800  # [s] 1980-01-06 in seconds since 1970
_LEAP_SECONDS = 18  # [s] of GPS time before UTC, since 2017
_LAS_EPOCH = 1_000_000_000  # [s] that adjusted standard GPS time of LAS leaves out


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class CloudExtent:
    """Number of returns of a cloud, and their bounds in the site frame, (2, 3) [m]."""

    n_points: int
    bounds: Array


class LazFile:
    """The returns of stops in one LAZ file (LAS 1.4, point format 6), written stop by stop.

    A return has ``point_source_id``, the number of its station from 1, ``intensity`` with 0-255
    stretched to 16 bits, ``gps_time``, and the extra dimensions ``ring`` and ``stop_time``, seconds
    since the first return of its stop. Names and poses of the stations are in an extended record of
    user ``spheremark``. The coordinate system of the site is local, without a place on Earth.

    The GPS time is adjusted standard time, where the clocks of the logs hold the time of day. Of a
    log whose clock began later than 1980, it is counted from that beginning.

    Parameters
    ----------
    path : Path
        The file.
    software : str
        Name of the writing program.
    made : datetime
        Instant of writing; its day is in the header.
    """

    def __init__(self, path: Path, *, software: str, made: datetime) -> None:
        self._path, self._software, self._day = path, software, made.date()
        self._writer: laspy.LasWriter | None = None
        self._extents: list[CloudExtent] = []
        self._stations: list[dict[str, Any]] = []

    def add(self, stop: StationPoints) -> None:
        """Write the returns of one stop; InputError beyond the 65,535th stop."""
        number, p_site = len(self._stations) + 1, stop.p_site
        if number > np.iinfo(np.uint16).max:
            raise InputError(f"A LAZ file can number {number - 1} stations and no more.")
        if self._writer is None:
            header = _laz_header(stop.T_site_station[:3, 3], self._software, self._day)
            backend = laspy.LazBackend.Lazrs
            self._writer = laspy.open(self._path, mode="w", header=header, laz_backend=backend)
        for first in range(0, len(p_site), _CHUNK):
            rows = slice(first, first + _CHUNK)
            points = _laz_points(stop, p_site, rows, number, self._writer.header)
            self._writer.write_points(points)
        self._extents.append(_extent(p_site))
        self._stations.append(_station(number, stop))

    def finish(self) -> CloudExtent:
        """Write the end of the file and return its extent; InputError without any return."""
        extent = _joined(self._extents)
        if self._writer is not None:
            self._writer.write_evlrs(_stations_record(self._stations))
        return extent

    def close(self) -> None:
        """Close the file."""
        if self._writer is not None:
            self._writer.close()


class E57File:
    """The returns of stops in one E57 file (ASTM E2807-11), a scan with a pose for each stop.

    Coordinates are single precision in the station frame; ``pose`` is ``T_site_station``;
    ``rowIndex`` is the laser. Identifiers are computed from the contents, so that the same survey
    gives the same file.

    Parameters
    ----------
    path : Path
        The file.
    software : str
        Name of the writing program.
    made : datetime
        Instant of writing.
    """

    def __init__(self, path: Path, *, software: str, made: datetime) -> None:
        path.unlink(missing_ok=True)
        self._image = libe57.ImageFile(str(path), "w")
        self._scans = _e57_root(self._image, software, made)
        self._extents: list[CloudExtent] = []

    def add(self, stop: StationPoints) -> None:
        """Write the returns of one stop."""
        self._extents.append(_e57_scan(self._image, self._scans, stop))

    def finish(self) -> CloudExtent:
        """Return the extent of the file; InputError without any return."""
        return _joined(self._extents)

    def close(self) -> None:
        """Close the file."""
        self._image.close()


def _laz_header(p_site: Array, software: str, day: date) -> laspy.LasHeader:
    """Return a header whose origin is near a station, at whole metres."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, _SCALE)
    header.offsets = np.round(p_site)
    header.system_identifier = "spheremark"
    header.generating_software = software[:32]
    header.creation_date = day
    header.add_extra_dim(
        laspy.ExtraBytesParams(name="ring", type=np.uint8, description="laser, 0 the lowest")
    )
    header.add_extra_dim(
        laspy.ExtraBytesParams(
            name="stop_time", type=np.float32, description="s since its stop began"
        )
    )
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(SITE_WKT))
    header.global_encoding.wkt = True
    return header


def _laz_points(
    stop: StationPoints, p_site: Array, rows: slice, number: int, header: laspy.LasHeader
) -> laspy.ScaleAwarePointRecord:
    """Return some returns of a stop as LAZ points."""
    part = p_site[rows]
    record = laspy.ScaleAwarePointRecord.zeros(len(part), header=header)
    record.x, record.y, record.z = part.T
    record.intensity = np.round(np.clip(stop.intensities[rows], 0, 255) * _FULL).astype(np.uint16)
    record.return_number[:] = 1
    record.number_of_returns[:] = 1
    record.point_source_id[:] = number
    record.gps_time = _gps_time(stop.start_ns) - _LAS_EPOCH + stop.times[rows].astype(np.float64)
    record.stop_time = stop.times[rows]
    record.ring = stop.rings[rows]
    return record


def _gps_time(stamp_ns: int) -> float:
    """Return an instant of a log as GPS time [s]; where the clock is not set, as it stands."""
    seconds = stamp_ns / 1e9
    return seconds - _GPS_EPOCH + _LEAP_SECONDS if seconds > _GPS_EPOCH else seconds


def _station(number: int, stop: StationPoints) -> dict[str, Any]:
    """Return the entry of a station in the extended record."""
    return {"number": number, "name": stop.name, "T_site_station": stop.T_site_station.tolist()}


def _stations_record(stations: list[dict[str, Any]]) -> laspy.vlrs.vlrlist.VLRList:
    """Return the extended record of the stations."""
    text = json.dumps({"about": _STATIONS, "stations": stations})
    record = laspy.VLR(
        user_id="spheremark", record_id=_RECORD, description="stations", record_data=text.encode()
    )
    return laspy.vlrs.vlrlist.VLRList([record])


def _extent(p_site: Array) -> CloudExtent:
    """Return the extent of one stop."""
    bounds = (
        np.array([p_site.min(axis=0), p_site.max(axis=0)])
        if len(p_site)
        else np.array([[np.inf] * 3, [-np.inf] * 3])
    )
    return CloudExtent(n_points=len(p_site), bounds=bounds)


def _joined(extents: list[CloudExtent]) -> CloudExtent:
    """Return the extent of all stops; refuse a cloud without returns."""
    n_points = sum(extent.n_points for extent in extents)
    if not n_points:
        raise InputError("The stops have no return within the maximum distance: there is no cloud.")
    return CloudExtent(
        n_points=n_points,
        bounds=np.array(
            [
                np.min([extent.bounds[0] for extent in extents], axis=0),
                np.max([extent.bounds[1] for extent in extents], axis=0),
            ]
        ),
    )


def _e57_root(image: Any, software: str, made: datetime) -> Any:
    """Write the head of a file and return the node of its scans."""
    image.extensionsAdd("", libe57.E57_V1_0_URI)
    head = {
        "formatName": "ASTM E57 3D Imaging Data File",
        "guid": _guid(software),
        "versionMajor": libe57.E57_FORMAT_MAJOR,
        "versionMinor": libe57.E57_FORMAT_MINOR,
        "e57LibraryVersion": libe57.E57_LIBRARY_ID,
        "coordinateMetadata": "",
        "creationDateTime": _instant(int(made.timestamp() * 1e9)),
    }
    for name, value in head.items():
        image.root().set(name, _node(image, value))
    scans = libe57.VectorNode(image, True)
    image.root().set("data3D", scans)
    image.root().set("images2D", libe57.VectorNode(image, True))
    return scans


def _instant(stamp_ns: int) -> dict[str, Any]:
    """Return an instant as E57 has it: GPS time."""
    return {"dateTimeValue": _gps_time(stamp_ns), "isAtomicClockReferenced": 0}


def _guid(text: str) -> str:
    """Return an identifier computed from a text."""
    return "{" + str(uuid.uuid5(uuid.NAMESPACE_URL, f"spheremark/{text}")) + "}"


def _node(image: Any, value: Any) -> Any:
    """Return a value as a node of an E57 file; a mapping as a structure."""
    kinds = {str: libe57.StringNode, int: libe57.IntegerNode, float: libe57.FloatNode}
    if type(value) in kinds:
        return kinds[type(value)](image, value)
    node = libe57.StructureNode(image)
    for name, part in value.items():
        node.set(name, _node(image, part))
    return node


def _e57_scan(image: Any, scans: Any, stop: StationPoints) -> CloudExtent:
    """Write one stop."""
    about: dict[str, Any] = {
        "guid": _guid(f"{stop.name}/{len(scans)}/{stop.p_station.sum(dtype=np.float64)!r}"),
        "name": stop.name,
        "description": "returns in the levelled frame of the station",
        "pose": _pose(stop.T_site_station),
    }
    if len(stop.p_station):
        low, high = stop.p_station.min(axis=0), stop.p_station.max(axis=0)
        ends = (("Minimum", low), ("Maximum", high))
        about["cartesianBounds"] = {
            f"{axis}{end}": float(values[i]) for end, values in ends for i, axis in enumerate("xyz")
        }
        about["intensityLimits"] = {"intensityMinimum": 0.0, "intensityMaximum": 255.0}
    if stop.start_ns and len(stop.times):
        last_ns = stop.start_ns + int(float(stop.times.max()) * 1e9)
        about["acquisitionStart"] = _instant(stop.start_ns)
        about["acquisitionEnd"] = _instant(last_ns)
    scan = _node(image, about)
    scans.append(scan)
    _e57_points(image, scan, stop)
    return _extent(stop.p_site)


def _pose(T: Array) -> dict[str, Any]:
    """Return a pose as E57 has it: a unit quaternion and a translation."""
    x, y, z, w = (float(value) for value in Rotation.from_matrix(T[:3, :3]).as_quat())
    translation = {name: float(T[i, 3]) for i, name in enumerate("xyz")}
    return {"rotation": {"w": w, "x": x, "y": y, "z": z}, "translation": translation}


def _e57_points(image: Any, scan: Any, stop: StationPoints) -> None:
    """Write the returns of one stop, a part at a time."""
    reach = float(np.abs(stop.p_station).max(initial=1.0))
    limit = math.ceil(reach)
    prototype = libe57.StructureNode(image)
    for name in ("cartesianX", "cartesianY", "cartesianZ"):
        prototype.set(name, libe57.FloatNode(image, 0.0, libe57.E57_SINGLE, -limit, limit))
    prototype.set("intensity", libe57.FloatNode(image, 0.0, libe57.E57_SINGLE, 0.0, 255.0))
    prototype.set("rowIndex", libe57.IntegerNode(image, 0, 0, 255))
    points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    scan.set("points", points)
    x, y, z = stop.p_station.T
    columns: dict[str, Column | Rings] = {"cartesianX": x, "cartesianY": y, "cartesianZ": z}
    columns |= {"intensity": np.clip(stop.intensities, 0, 255), "rowIndex": stop.rings}
    parts = {name: np.empty(_CHUNK, column.dtype) for name, column in columns.items()}
    buffers = libe57.VectorSourceDestBuffer()
    for name, part in parts.items():
        buffers.append(libe57.SourceDestBuffer(image, name, part, _CHUNK, True, True))
    writer = points.writer(buffers)
    for first in range(0, len(stop.p_station), _CHUNK):
        n = min(_CHUNK, len(stop.p_station) - first)
        for name, column in columns.items():
            parts[name][:n] = column[first : first + n]
        writer.write(n)
    writer.close()
