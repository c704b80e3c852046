"""Rows of results: names of columns that several tables share, and values as Arrow takes them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from spheremark.pipelines.model import Array

Row = dict[str, Any]

PLACE = ("x_m", "y_m", "z_m")
ERROR = tuple(f"error_{name}" for name in PLACE)
COV = tuple(f"cov_{axes}_m2" for axes in ("xx", "xy", "xz", "yy", "yz", "zz"))
"""The upper triangle of a covariance."""


def places(rows: Sequence[Row]) -> Array:
    """Return the coordinates of rows.

    Parameters
    ----------
    rows : sequence of mapping
        Rows with the columns of a place.

    Returns
    -------
    (n, 3)
        Their coordinates [m].
    """
    return np.array([[row[name] for name in PLACE] for row in rows]).reshape(-1, 3)


def natural(column: str) -> str:
    """Return the SQL that orders names by the numbers in them: stop2 before stop10.

    Parameters
    ----------
    column : str
        The column of the names.

    Returns
    -------
    str
        An expression of the names with numbers of eight digits or more.
    """
    wide = rf"regexp_replace({column}, '(\d+)', '0000000\1', 'g')"
    return rf"regexp_replace({wide}, '0*(\d{{8}})', '\1', 'g')"


def named(names: Sequence[str], values: Any) -> Row:
    """Return values as columns."""
    return dict(zip(names, values, strict=True))


def plain(value: object) -> object:
    """Return a value as Arrow takes it: None where it is not finite."""
    if isinstance(value, float):  # NumPy's doubles are
        return value if math.isfinite(value) else None
    return plain(value.item()) if isinstance(value, np.generic) else value
