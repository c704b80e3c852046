"""Input files of a survey: control marks (CSV), truth and rig (JSON).

An error names the row, the column and what was expected; nothing is repaired silently.
"""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from spheremark.pipelines.errors import (
    ControlError,
    InputError,
    NotFoundError,
    RigError,
    TruthError,
)
from spheremark.pipelines.geometry import rigid
from spheremark.pipelines.model import Array, ControlMarks, Rig, StopTruth, Truth
from spheremark.pipelines.scan.rigs import rig_from_mapping, rig_to_mapping
from spheremark.storage.imports.nesting import read_json

CONTROL_COLUMNS = ("mark", "x_m", "y_m", "z_m", "sigma_x_m", "sigma_y_m", "sigma_z_m")
TRUTH_FORMAT = "spheremark-truth/1"

_ALIASES = {
    "mark": ("mark", "name", "id", "point", "label", "marker", "p"),
    "x_m": ("x", "e", "east", "easting"),
    "y_m": ("y", "n", "north", "northing"),
    "z_m": ("z", "h", "height", "elevation", "up"),
    "sigma_x_m": ("sigma_x", "sigma_e", "sx"),
    "sigma_y_m": ("sigma_y", "sigma_n", "sy"),
    "sigma_z_m": ("sigma_z", "sigma_h", "sz"),
    "sigma_m": ("sigma",),
    "target_height_m": ("target_height", "th"),
    "down_m": ("down", "d"),
    "note": ("description", "desc", "code", "note"),
}
_NAMES = {
    spelling: column
    for column, aliases in _ALIASES.items()
    for alias in aliases
    for spelling in (alias, f"{alias}_m")
}
_AXES = {
    "enu": ("x_m", "y_m", "z_m"),
    "neu": ("y_m", "x_m", "z_m"),
    "ned": ("y_m", "x_m", "down_m"),
}
_UNITS = {"m": 1.0, "mm": 1e-3, "ft": 0.3048, "us-ft": 1200.0 / 3937.0}
_ROWS_MAX = 10_000
_SIZE_MAX = 4_000_000  # characters; far more than 10,000 rows need
_APART_MIN = 0.01  # [m] nearer marks are one mark entered twice
_COORDINATE_MAX = 1e8  # [m] larger than any national grid
_EXPECTED = (
    "expected mark,x_m,y_m,z_m and, if known, sigma_x_m,sigma_y_m,sigma_z_m [m], with "
    "decimal points"
)
_HEIGHT_MAX = 100.0  # [m] of a target above its mark
_NUMBER = re.compile(r"[-+.\d]|nan$|inf", re.IGNORECASE)  # how a cell that is no heading begins
_RIGID_TOLERANCE = 1e-6  # how far a rotation matrix may be from orthonormal

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlLayout:
    """Layout of a table of control marks, for what its header does not specify.

    Attributes
    ----------
    axes : str
        Axes of three coordinates without names, or named x, y and z: ``enu`` (east, north, up),
        ``neu`` or ``ned`` (down). Columns named easting, northing and the like specify them.
    unit : str
        Unit of coordinates and their sigmas: ``m``, ``mm``, ``ft`` or ``us-ft``.
    target_height : float
        Height of the centres above the given points, without a column for it [m].
    """

    axes: str = "enu"
    unit: str = "m"
    target_height: float = 0.0

    def __post_init__(self) -> None:
        for what, value, known in (("axes", self.axes, _AXES), ("unit", self.unit, _UNITS)):
            if value not in known:
                raise ControlError(
                    f"The {what} of the control table are given as {value!r}; known: "
                    f"{', '.join(known)}."
                )
        if not abs(self.target_height) < _HEIGHT_MAX:
            raise ControlError(
                f"The target height is {self.target_height:g} m; it must be below {_HEIGHT_MAX:g}."
            )


_PLAIN = ControlLayout()


def parse_control(text: str, layout: ControlLayout = _PLAIN) -> ControlMarks:
    """Read a table of control marks.

    Parameters
    ----------
    text : str
        CSV with comma, semicolon or tab. Columns have their usual names in any order and case
        (also ``P,N,E,Z,D`` with a description as the last); without a header they are mark, three
        coordinates and, of seven, three sigmas, or, of five, a description. Empty lines and
        comments after ``#`` are skipped.
    layout : ControlLayout
        The layout where the header does not specify it.

    Returns
    -------
    ControlMarks
        The marks in the order of the table; exact without sigmas.

    Raises
    ------
    ControlError
        If a column is missing or unknown, a value is not a number, or two marks share a name or
        a place.
    """
    if len(text) > _SIZE_MAX:
        raise ControlError(
            f"The control table has {len(text):,} characters; at most {_SIZE_MAX:,} are read."
        )
    rows = list(table_rows(text, ControlError, "the control table"))
    if not rows:
        raise ControlError(f"The control table is empty; {_EXPECTED}.")
    columns, body = _columns(rows, layout.axes)
    if not body:
        raise ControlError(f"The control table has a header but no marks; {_EXPECTED}.")
    if len(body) > _ROWS_MAX:
        raise ControlError(f"The control table has more than {_ROWS_MAX:,} marks.")
    table = _table(columns, body)
    p, sigmas = table.positions(layout), table.sigmas(_UNITS[layout.unit])
    names = table.names()
    _require_apart(p, names, table.lines)
    return ControlMarks(names=names, p_site=p, cov_p_site=sigmas[:, :, None] ** 2 * np.eye(3))


def format_control(marks: ControlMarks) -> str:
    """Return control marks as CSV text with the columns of ``CONTROL_COLUMNS``.

    Parameters
    ----------
    marks : ControlMarks
        Marks; of their covariances only the diagonal is written.

    Returns
    -------
    str
        The table, with all digits of the numbers.
    """
    sigmas = np.sqrt(np.diagonal(marks.cov_p_site, axis1=1, axis2=2))
    lines = [",".join(CONTROL_COLUMNS)]
    for name, p, sigma in zip(marks.names, marks.p_site.tolist(), sigmas.tolist(), strict=True):
        lines.append(",".join([_quoted(name), *map(repr, (*p, *sigma))]))
    return "\n".join(lines) + "\n"


def parse_truth(text: str) -> Truth:
    """Read the truth of a survey.

    Parameters
    ----------
    text : str
        JSON of ``format_truth``.

    Returns
    -------
    Truth
        True marks, stops and rig.

    Raises
    ------
    TruthError
        If it is not such a JSON object.
    """
    values = _object(text, TruthError, "The truth file")
    if values.get("format") != TRUTH_FORMAT:
        raise TruthError(
            f"The truth file has the format {values.get('format')!r}; expected {TRUTH_FORMAT!r}."
        )
    try:
        return _truth(values)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise TruthError(
            f"The truth file is incomplete ({type(error).__name__}: {error}); "
            "expected marks with name and position_m, and stops with name, position_m and "
            "rotation_site_base."
        ) from error


def format_truth(truth: Truth) -> str:
    """Return a truth as JSON text.

    Parameters
    ----------
    truth : Truth
        The truth.

    Returns
    -------
    str
        What ``parse_truth`` reads.
    """
    values = {
        "format": TRUTH_FORMAT,
        "marks": [
            {"name": name, "position_m": p}
            for name, p in zip(truth.marks.names, truth.marks.p_site.tolist(), strict=True)
        ],
        "stops": [
            {
                "name": stop.name,
                "position_m": stop.T_site_base[:3, 3].tolist(),
                "rotation_site_base": stop.T_site_base[:3, :3].tolist(),
            }
            for stop in truth.stops
        ],
        "rig": None if truth.rig is None else rig_to_mapping(truth.rig),
        "about": dict(truth.about),
    }
    return json.dumps(values, indent=1, allow_nan=False) + "\n"


def parse_rig(text: str) -> Rig:
    """Read a rig.

    Parameters
    ----------
    text : str
        JSON of a rig, or any JSON object that has one under the key ``rig``.

    Returns
    -------
    Rig
        The rig.

    Raises
    ------
    RigError
        If it is not such a JSON object.
    """
    values = _object(text, RigError, "The rig file")
    inner = values.get("rig", values)
    if not isinstance(inner, Mapping):
        raise RigError(f"The rig file's rig is {inner!r}; it must be an object with T_head_lidar.")
    return rig_from_mapping(inner)


def format_rig(rig: Rig) -> str:
    """Return a rig as JSON text.

    Parameters
    ----------
    rig : Rig
        The rig.

    Returns
    -------
    str
        The mapping of ``rig_to_mapping``.
    """
    return json.dumps(rig_to_mapping(rig), indent=1, allow_nan=False) + "\n"


def read_control(path: str | Path, layout: ControlLayout = _PLAIN) -> ControlMarks:
    """Read control marks from a file, as ``parse_control`` does.

    Parameters
    ----------
    path : str or Path
        The file.
    layout : ControlLayout
        The layout where the header does not specify it.

    Returns
    -------
    ControlMarks
        The marks.
    """
    return _read(path, lambda text: parse_control(text, layout), ControlError)


def read_truth(path: str | Path) -> Truth:
    """Read the truth of a survey from a file, as ``parse_truth`` does.

    Parameters
    ----------
    path : str or Path
        The file.

    Returns
    -------
    Truth
        True marks, stops and rig.
    """
    return _read(path, parse_truth, TruthError)


def read_rig(path: str | Path) -> Rig:
    """Read a rig from a file, as ``parse_rig`` does."""
    return _read(path, parse_rig, RigError)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Table:
    """The cells of a control table by column, and the line of each row."""

    lines: tuple[int, ...]
    cells: Mapping[str, Sequence[str]]

    def lengths(self, column: str, unit: float) -> Array:
        """Return the lengths in a column, whose cells are multiples of a unit [m]."""
        cells = self.cells[column]
        lengths = unit * np.array([_number(cell) for cell in cells])
        if (wrong := np.flatnonzero(~(np.abs(lengths) < _COORDINATE_MAX))).size:
            cell, length = cells[wrong[0]], lengths[wrong[0]]
            found = repr(cell) if np.isnan(length) else f"{cell!r}, that is {length:g} m"
            raise ControlError(
                f"Line {self.lines[wrong[0]]}, column {column} of the control table is {found}; it "
                f"must be a number below {_COORDINATE_MAX:g} m, with a decimal point."
            )
        return lengths

    def names(self) -> tuple[str, ...]:
        """Return the names of the marks, all different."""
        lines: dict[str, int] = {}
        for line, name in zip(self.lines, self.cells["mark"], strict=True):
            if not name:
                raise ControlError(f"Line {line} of the control table has a mark without a name.")
            if name in lines:
                raise ControlError(
                    f"Lines {lines[name]} and {line} of the control table both name the mark "
                    f"{name!r}; names must differ."
                )
            lines[name] = line
        return tuple(lines)

    def positions(self, layout: ControlLayout) -> Array:
        """Return the positions of the centres, (n, 3) [m]."""
        unit = _UNITS[layout.unit]
        is_down = "down_m" in self.cells
        up = -self.lengths("down_m", unit) if is_down else self.lengths("z_m", unit)
        p = np.column_stack([self.lengths("x_m", unit), self.lengths("y_m", unit), up])
        has_heights = "target_height_m" in self.cells
        height = self.lengths("target_height_m", unit) if has_heights else layout.target_height
        p[:, 2] += height
        return p

    def sigmas(self, unit: float) -> Array:
        """Return the standard deviations of the coordinates, (n, 3) [m]."""
        columns = [name for name in CONTROL_COLUMNS[4:] if name in self.cells] or ["sigma_m"] * 3
        if columns[0] not in self.cells:
            return np.zeros((len(self.lines), 3))
        sigmas = np.column_stack([self.lengths(column, unit) for column in columns])
        if (sigmas < 0.0).any():
            row, axis = np.argwhere(sigmas < 0.0)[0]
            raise ControlError(
                f"Line {self.lines[row]}, column {columns[axis]} of the control table is "
                f"{sigmas[row, axis]:g} m; a standard deviation cannot be negative."
            )
        return sigmas


def table_rows(
    text: str, error_class: type[InputError], what: str
) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows of a table in CSV with comma, semicolon or tab, without comments.

    Parameters
    ----------
    text : str
        The table.
    error_class : type of InputError
        Class of the error at a cell that is too long.
    what : str
        What the table is, for that error.

    Yields
    ------
    int, list of str
        Number of the line, from 1, and its cells.
    """
    lines = [_without_comment(line).strip() for line in text.lstrip("\ufeff").splitlines()]
    first = next((line for line in lines if line), "")
    separator = max("\t;,", key=first.count)
    for number, line in enumerate(lines, start=1):
        if line:
            try:
                (cells,) = csv.reader([line], delimiter=separator)
            except csv.Error as error:
                raise error_class(
                    f"Line {number} of {what} has a cell of more than {csv.field_size_limit():,} "
                    "characters; a name or a number is expected. Shorten it, or end its quotes."
                ) from error
            yield number, [cell.strip() for cell in cells]


def _without_comment(line: str) -> str:
    """Return a line up to the first ``#`` that is not in quotes."""
    found = re.match(r'(?:[^"#]|"[^"]*"?)*', line)
    return found[0] if found else ""


def _columns(
    rows: list[tuple[int, list[str]]], axes: str
) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the names of the columns, and the rows below the header if there is one."""
    first = rows[0][1]
    if len(first) in (4, 5, 7) and all(map(_NUMBER.match, first[1:4])):
        sigmas = [f"sigma_{axis}" for axis in _AXES["neu" if axes == "ned" else axes]]
        rest = {4: [], 5: ["note"], 7: sigmas}[len(first)]
        return ["mark", *_AXES[axes], *rest], rows
    columns = _named(first, axes)
    _require_columns(columns, first)
    return columns, rows[1:]


def _named(header: list[str], axes: str) -> list[str]:
    """Return the column of each name in a header."""
    words = [cell.lower() for cell in header]
    columns = [_NAMES.get(word, "") for word in words]
    unknown = [cell for cell, column in zip(header, columns, strict=True) if not column]
    if unknown:
        raise ControlError(
            f"The control table has the unknown column {unknown[0]!r} ({', '.join(header)}); "
            f"{_EXPECTED}."
        )
    if "z_m" in columns:  # the D of P,N,E,Z,D is a description
        columns = ["note" if column == "down_m" else column for column in columns]
    turned = dict(zip(("x", "y", "z"), _AXES[axes], strict=True))
    if axes != "enu":
        turned |= {"sigma_x": "sigma_y_m", "sx": "sigma_y_m"}
        turned |= {"sigma_y": "sigma_x_m", "sy": "sigma_x_m"}
    return [
        turned.get(word.removesuffix("_m"), column)
        for word, column in zip(words, columns, strict=True)
    ]


def _require_columns(columns: list[str], header: list[str]) -> None:
    """Refuse a header with a missing or a repeated column."""
    doubled = [column for column in columns if columns.count(column) > 1 and column != "note"]
    third = "down_m" if "down_m" in columns else "z_m"
    missing = [column for column in ("mark", "x_m", "y_m", third) if column not in columns]
    sigmas = [column for column in columns if column.startswith("sigma")]
    if sigmas not in ([], ["sigma_m"]) and sorted(sigmas) != list(CONTROL_COLUMNS[4:]):
        missing += ["all three of sigma_x_m, sigma_y_m, sigma_z_m, or sigma_m alone"]
    if doubled or missing:
        fault = f"has {doubled[0]} twice" if doubled else f"lacks {missing[0]}"
        raise ControlError(f"The control table {fault} ({', '.join(header)}); {_EXPECTED}.")


def _number(cell: str) -> float:
    """Return the number in a cell; NaN where it holds none."""
    try:
        return float(cell)
    except ValueError:
        return math.nan


def _table(columns: Sequence[str], rows: Sequence[tuple[int, list[str]]]) -> _Table:
    """Return the cells below a header by column."""
    for line, cells in rows:
        if len(cells) != len(columns):
            raise ControlError(
                f"Line {line} of the control table has {len(cells)} values and must have "
                f"{len(columns)} ({', '.join(columns)}); {_EXPECTED}."
            )
    by_column = zip(*(cells for _, cells in rows), strict=True)
    lines = tuple(line for line, _ in rows)
    return _Table(lines=lines, cells=dict(zip(columns, by_column, strict=True)))


def _require_apart(p: Array, names: Sequence[str], lines: Sequence[int]) -> None:
    """Refuse two marks at one position; only neighbours in x are compared."""
    order = np.argsort(p[:, 0], kind="stable")
    for step in range(1, len(p)):
        near = p[order[step:], 0] - p[order[:-step], 0] < _APART_MIN
        if not near.any():
            return
        apart = np.linalg.norm(p[order[step:]] - p[order[:-step]], axis=1)
        if (apart < _APART_MIN).any():
            place = int(np.argmin(apart))
            first, second = sorted((int(order[place]), int(order[place + step])))
            raise ControlError(
                f"Lines {lines[first]} and {lines[second]} of the control table place "
                f"{names[first]!r} and {names[second]!r} {apart[place] * 1e3:.1f} mm "
                f"apart; marks must be at least {_APART_MIN * 1e3:.0f} mm apart."
            )


def _quoted(name: str) -> str:
    """Return a name as a CSV cell."""
    escaped = name.replace('"', '""')
    return f'"{escaped}"' if any(mark in name for mark in ',;\t"#') else name


def _truth(values: Mapping[str, Any]) -> Truth:
    """Return the truth of a JSON object."""
    names = tuple(str(mark["name"]) for mark in values["marks"])
    p = np.array([_vector(mark["position_m"]) for mark in values["marks"]]).reshape(-1, 3)
    stops = tuple(
        StopTruth(
            name=str(stop["name"]),
            T_site_base=rigid(_rotation(stop["rotation_site_base"]), _vector(stop["position_m"])),
        )
        for stop in values["stops"]
    )
    for what, found in (("marks", names), ("stops", tuple(stop.name for stop in stops))):
        if len(set(found)) < len(found):
            raise ValueError(f"two {what} have one name")
    rig = values.get("rig")
    return Truth(
        marks=ControlMarks(names=names, p_site=p, cov_p_site=np.zeros((len(names), 3, 3))),
        stops=stops,
        rig=None if rig is None else rig_from_mapping(rig),
        about=dict(values.get("about") or {}),
    )


def _vector(values: ArrayLike) -> Array:
    """Return a position."""
    vector = np.array(values, np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{values!r} is not a position of three numbers")
    return vector


def _rotation(values: ArrayLike) -> Array:
    """Return a rotation matrix."""
    R = np.array(values, np.float64)
    if R.shape != (3, 3) or not np.abs(R @ R.T - np.eye(3)).max() < _RIGID_TOLERANCE:
        raise ValueError("a rotation_site_base is not a rotation of three rows")
    if np.linalg.det(R) < 0:
        raise ValueError("a rotation_site_base is a reflection")
    return R


def _object(text: str, error_class: type[InputError], what: str) -> dict[str, Any]:
    """Read a JSON object."""
    try:
        values = read_json(text)
    except ValueError as error:
        raise error_class(f"{what} is not JSON that can be read: {error}.") from error
    if not isinstance(values, dict):
        raise error_class(f"{what} holds a {type(values).__name__}; it must be a JSON object.")
    return values


def _read(path: str | Path, parse: Callable[[str], _T], error_class: type[InputError]) -> _T:
    """Read a text file and parse it."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise NotFoundError(f"There is no file {path}.") from error
    except UnicodeDecodeError as error:
        raise error_class(f"{path} is not a text file in UTF-8: {error}.") from error
    return parse(text)
