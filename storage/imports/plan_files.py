"""Input files of a plan: marks, stops, and polygons where no mark may stand."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from spheremark.pipelines.errors import ControlError, InputError
from spheremark.pipelines.model import Array
from spheremark.pipelines.placement import Arrangement
from spheremark.storage.imports.nesting import read_json
from spheremark.storage.imports.survey_files import parse_control, table_rows

_SIZE_MAX = 20_000_000  # characters of a file
_POLYGONS = "Polygon or MultiPolygon in metres is expected"
_STOP_COLUMNS = "name,x_m,y_m and, if known, z_m of the LiDAR [m]"


def read_marks(path: str | Path) -> Arrangement:
    """Read marks.

    Parameters
    ----------
    path : str or Path
        JSON of ``spheremark plan`` with ``marks[]`` of ``name`` and ``position_m``; CSV of a plan,
        or of control marks.

    Returns
    -------
    Arrangement
        The marks in their order.

    Raises
    ------
    InputError
        If it has no marks.
    """
    text = _text(path)
    if text.lstrip()[:1] in "[{":
        return _marks_of_json(Path(path).name, text)
    marks = parse_control(_marks_of_plan(Path(path).name, text))
    return Arrangement(names=marks.names, p_site=np.array(marks.p_site))


def read_stops(path: str | Path) -> tuple[tuple[str, ...], Array]:
    """Read stops.

    Parameters
    ----------
    path : str or Path
        CSV with columns for name, x, y and, if known, z; CSV of a plan, whose rows of stops are
        read; or JSON with ``stops[]`` of ``name`` and ``position_m``.

    Returns
    -------
    names : tuple of str
        Names of the stops.
    p_site : (s, 3)
        Positions of the LiDAR; NaN for an unknown height [m].

    Raises
    ------
    InputError
        If it has no stops, or a value is not a number.
    """
    text, name = _text(path), Path(path).name
    if text.lstrip()[:1] in "[{":
        rows = _named_places(name, text, "stops")
        return tuple(row[0] for row in rows), np.array([row[1] for row in rows])
    rows = list(_stop_rows(name, text))
    if not rows:
        raise InputError(f"{name} holds no stops; {_STOP_COLUMNS} are expected.")
    return tuple(row[0] for row in rows), np.array([row[1] for row in rows])


def read_keep_out(path: str | Path) -> tuple[Array, ...]:
    """Read polygons.

    Parameters
    ----------
    path : str or Path
        GeoJSON with polygons in metres of the site frame; holes are ignored.

    Returns
    -------
    tuple of (k, 2)
        Their corners [m].

    Raises
    ------
    InputError
        If it is no GeoJSON, or has no polygon.
    """
    name = Path(path).name
    try:
        polygons = tuple(_rings(read_json(_text(path))))
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{name} is no GeoJSON with polygons: {str(error).rstrip('.')}; {_POLYGONS}."
        ) from error
    if not polygons:
        raise InputError(f"{name} holds no polygon; {_POLYGONS}.")
    return polygons


def _text(path: str | Path) -> str:
    """Return the text of a file; refuse one that is too large."""
    path = Path(path)
    if path.stat().st_size > _SIZE_MAX:
        raise InputError(f"{path.name} has more than {_SIZE_MAX // 10**6} MB; that is no plan.")
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path.name} is no text: {error}.") from error


def _named_places(file: str, text: str, key: str) -> list[tuple[str, list[float]]]:
    """Return names and positions of a JSON response."""
    try:
        values = read_json(text)
        rows = values[key] if isinstance(values, Mapping) else values
        found = [(str(row["name"]), [float(v) for v in row["position_m"]]) for row in rows]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{file} does not hold {key}[] with name and position_m "
            f"({type(error).__name__}: {error})."
        ) from error
    if not found:
        raise InputError(f"{file} holds no {key}.")
    for name, place in found:
        if len(place) != 3 or not np.isfinite(place).all():
            raise InputError(f"{file}: {name} is at {place}; three numbers in metres are expected.")
    return found


def _marks_of_json(file: str, text: str) -> Arrangement:
    """Return the marks of a JSON response."""
    rows = _named_places(file, text, "marks")
    return Arrangement(
        names=tuple(row[0] for row in rows), p_site=np.array([row[1] for row in rows])
    )


def _marks_of_plan(file: str, text: str) -> str:
    """Return the marks of a plan's CSV as a table of control marks; other tables unchanged."""
    (_, head), *body = list(table_rows(text, ControlError, file)) or [(0, [])]
    if "kind" not in head:
        return text
    columns = ("name", "x_m", "y_m", "z_m")
    if not set(columns) <= set(head):
        raise ControlError("The plan lacks a column of name, x_m, y_m, z_m.")
    table = io.StringIO()
    writer = csv.DictWriter(table, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    rows = (dict(zip(head, cells, strict=False)) for _, cells in body)
    writer.writerows(row for row in rows if row.get("kind") == "mark")
    return table.getvalue()


def _stop_rows(file: str, text: str) -> Iterator[tuple[str, list[float]]]:
    """Return the stops of a table."""
    (_, head), *body = list(table_rows(text, InputError, file)) or [(0, [])]
    heads = [cell.lower().removesuffix("_m") for cell in head]
    name = next((key for key in ("name", "stop", "id") if key in heads), None)
    if name is None or "x" not in heads or "y" not in heads:
        raise InputError(
            f"{file} has the columns {', '.join(heads) or 'none'}; {_STOP_COLUMNS} are expected."
        )
    for line, cells in body:
        row = dict(zip(heads, cells, strict=False))
        if row.get("kind", "stop") != "stop":
            continue
        place = []
        for axis in "xyz":
            value = row.get(axis, "")
            if not value and axis == "z":
                place.append(np.nan)
                continue
            try:
                place.append(float(value))
            except ValueError as error:
                raise InputError(
                    f"{file}, line {line}: {axis} is {value!r}, not a number in metres."
                ) from error
        if not np.isfinite(place[:2]).all():
            raise InputError(f"{file}, line {line}: a place must be finite.")
        yield row.get(name, ""), place


def _rings(value: Any) -> Iterator[Array]:
    """Return the outer rings of all polygons in a GeoJSON object."""
    kind = value["type"]
    if kind == "FeatureCollection":
        for feature in value["features"]:
            yield from _rings(feature)
    elif kind == "Feature":
        yield from _rings(value["geometry"])
    elif kind == "GeometryCollection":
        for geometry in value["geometries"]:
            yield from _rings(geometry)
    elif kind in ("Polygon", "MultiPolygon"):
        groups = [value["coordinates"]] if kind == "Polygon" else value["coordinates"]
        for rings in groups:
            ring = np.array(rings[0], dtype=np.float64)
            if (
                ring.ndim != 2
                or min(ring.shape) < 2
                or len(ring) < 4
                or not np.isfinite(ring).all()
            ):
                raise ValueError("a polygon needs four corners or more, the last the first again")
            yield np.ascontiguousarray(ring[:, :2])
