"""Tables as columns, named as in the database: the input of figures and pages."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Columns = Mapping[str, NDArray[Any]]

MM = 1e3  # [mm/m]
_STOP_NUMBER = re.compile(r"^(.*?)[\s._-]*(?:[A-Za-z]*)(\d+)$")


def floats(columns: Columns, name: str) -> NDArray[np.float64]:
    """Return a column as floats; NULL is NaN."""
    return np.asarray(columns[name], dtype=np.float64)


def texts(columns: Columns, name: str) -> list[str]:
    """Return a column as texts; NULL is empty."""
    return ["" if value is None else str(value) for value in columns[name]]


def select(columns: Columns, keep: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
    """Return the rows of a table where ``keep`` is true."""
    return {name: column[keep] for name, column in columns.items()}


def known_values(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the finite values of a column."""
    return values[np.isfinite(values)]


def largest(values: NDArray[np.float64]) -> float:
    """Return the largest known magnitude, or zero."""
    known = known_values(values)
    return float(np.abs(known).max()) if len(known) else 0.0


def rms(values: NDArray[np.float64]) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def has_errors(columns: Columns) -> bool:
    """Whether the error of any row is known."""
    return bool(np.isfinite(floats(columns, "error_3d_m")).any())


def on_marks(columns: Columns) -> NDArray[np.bool_]:
    """Return which fits belong to a mark; all where no mark is known."""
    known = np.isfinite(floats(columns, "error_3d_m"))
    if known.any():
        return known
    matched = np.array([mark != "" for mark in texts(columns, "mark")], dtype=np.bool_)
    return matched if matched.any() else np.ones(len(matched), dtype=np.bool_)


def by_method(columns: Columns) -> Iterator[tuple[str, dict[str, NDArray[Any]]]]:
    """Yield the rows of each fitting method, ``along_beam`` first."""
    methods = np.array(texts(columns, "fit_method"), dtype=object)
    for method in sorted(set(methods.tolist()), key=lambda name: (name != "along_beam", name)):
        yield method, select(columns, methods == method)


def lane_and_number(stop: str) -> tuple[str, int | None]:
    """Split the name of a stop into its lane and its number along it: ``lane-2-stop-5``."""
    found = _STOP_NUMBER.match(stop)
    return (found[1] or "lane", int(found[2])) if found else (stop, None)


def lane_order(stop: str) -> tuple[str, int, str]:
    """Return the key that sorts stops by lane and number; a stop without a number comes first."""
    lane, number = lane_and_number(stop)
    return (lane, -1 if number is None else number, stop)


def plain_rows(columns: Columns) -> list[dict[str, Any]]:
    """Return columns as rows of plain values; unknown numbers are None."""
    lists: list[list[Any]] = [_plain(column) for column in columns.values()]
    return [dict(zip(columns, row, strict=True)) for row in zip(*lists, strict=True)]


def _plain(column: NDArray[Any]) -> list[Any]:
    """Return a column as plain values, with None for what is not known."""
    values: list[Any] = column.tolist()
    return [None if isinstance(value, float) and math.isnan(value) else value for value in values]
