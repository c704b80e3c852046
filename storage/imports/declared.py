"""What headers declare, held against what their files can hold and what a terrain may be."""

from __future__ import annotations

import os
from typing import IO

from spheremark.pipelines.errors import InputError

RATIO_MAX = 4000
"""Bytes that a byte of a compressed file stands for at most.

Equal values reach 1,032 by deflate and 2,800 in LAZ; what was measured reaches 20."""

POINTS_MAX = 200_000_000
"""Points of a cloud at most."""

_CELL_NARROWEST = 1e-3  # [m] below what any survey resolves; cells in degrees are narrower


def size_of(file: IO[bytes]) -> int:
    """Return the size of a file [bytes]."""
    return os.fstat(file.fileno()).st_size


def check_cells(n_columns: int, n_rows: int, name: str, cells_max: int) -> None:
    """Refuse more cells than a terrain may have."""
    if n_columns * n_rows > cells_max:
        raise InputError(
            f"{name} has {n_columns:,} x {n_rows:,} cells; {cells_max:,} are the most. Cut out the "
            "field (gdal_translate -projwin) or take wider cells."
        )


def check_bytes(what: str, n_bytes: int, n_bytes_max: int, name: str) -> None:
    """Refuse more bytes than a file can hold."""
    if n_bytes > n_bytes_max:
        raise InputError(
            f"{name} declares {what}, more than a file of its size can hold; it was cut short, or "
            "its header is damaged."
        )


def check_points(n_points: int, name: str, most: int = POINTS_MAX) -> None:
    """Refuse more points than a cloud may have."""
    if n_points > most:
        raise InputError(
            f"{name} has {n_points:,} points; {most:,} are the most. Cut out the part that is "
            "needed, or thin it out."
        )


def check_width(width: float, name: str) -> None:
    """Refuse cells that cannot be in metres."""
    if not _CELL_NARROWEST <= width < float("inf"):
        raise InputError(
            f"The cells of {name} are {width:g} m wide; an even grid of {_CELL_NARROWEST:g} m or "
            "more is needed. If its unit is the degree, reproject it (gdalwarp -t_srs)."
        )
