"""ESRI ASCII grids, read strictly; runs in the confined process.

GDAL's reader takes letters for zero; here they are refused.
"""

from __future__ import annotations

import re
from typing import IO

import numpy as np

from spheremark.pipelines.errors import InputError
from spheremark.pipelines.model import Array
from spheremark.storage.imports.declared import check_bytes, check_cells, check_width, size_of

_HEAD_MAX = 4096  # [bytes]
_WORD = re.compile(rb"\s*([a-zA-Z_]+)[ \t]+([^\s]{1,40})[ \t]*\r?\n")
_WORDS = (
    *("ncols", "nrows", "xllcorner", "yllcorner", "xllcenter", "yllcenter"),
    *("cellsize", "dx", "dy", "nodata_value"),
)
_NO_DATA = -9999.0  # where a header names nothing else


def read_ascii_grid(file: IO[bytes], *, name: str, cells_max: int) -> dict[str, Array]:
    """Return the grid of an ESRI ASCII grid: ``xs``, ``ys`` and ``ground``."""
    words, begin = _header(file.read(_HEAD_MAX), name)
    n_columns, n_rows = (_count(words, word, name) for word in ("ncols", "nrows"))
    check_cells(n_columns, n_rows, name, cells_max)
    smallest = 2 * n_columns * n_rows - 1  # a digit and what divides it from the next
    check_bytes(f"{n_columns:,} x {n_rows:,} cells", smallest, size_of(file) - begin, name)
    xs = _line(words, "x", n_columns, name)
    ys = _line(words, "y", n_rows, name)
    file.seek(begin)
    n = n_columns * n_rows
    try:
        heights = np.fromfile(file, count=n, sep=" ")
    except ValueError as error:
        raise InputError(
            f"{name} holds what is no number among its heights; {n:,} numbers are expected."
        ) from error
    rest = file.read(64).strip(b" \t\r\n\0")
    if heights.size < n or rest:
        raise InputError(
            f"{name} has {heights.size:,} heights and then {rest[:20]!r}; {n:,} numbers are "
            "expected, and nothing else."
        )
    heights[heights == words.get("nodata_value", _NO_DATA)] = np.nan
    return {"xs": xs, "ys": ys, "ground": heights.reshape(n_rows, n_columns)[::-1]}


def _header(head: bytes, name: str) -> tuple[dict[str, float], int]:
    """Return the words of a header, and where it ends."""
    words: dict[str, float] = {}
    begin = 0
    while found := _WORD.match(head, begin):
        word, begin = found[1].decode().lower(), found.end()
        try:
            value = float(found[2])
        except ValueError:
            value = np.nan
        if word not in _WORDS or word in words:
            raise InputError(f"{name} is no elevation model that can be read: {word!r} is unknown.")
        words[word] = value
    return words, begin


def _count(words: dict[str, float], word: str, name: str) -> int:
    """Return a count of the header."""
    value = words.get(word, np.nan)
    if not (1 <= value < 2**53 and value == int(value)):
        raise InputError(
            f"{name} is no elevation model that can be read: {word} is {value:g} in its header; a "
            "whole number from 1 is expected."
        )
    return int(value)


def _line(words: dict[str, float], axis: str, n: int, name: str) -> Array:
    """Return the places of the cells' middles along an axis, ascending [m]."""
    width = words.get(f"d{axis}", words.get("cellsize", np.nan))
    centre = words.get(f"{axis}llcenter", words.get(f"{axis}llcorner", np.nan) + width / 2)
    line = np.asarray(centre + np.arange(n) * width, dtype=np.float64)
    check_width(width, name)
    if not np.isfinite(line).all():
        raise InputError(f"{name} does not say where it lies: {axis} begins at {centre:g} m.")
    return line
