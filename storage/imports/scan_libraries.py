"""Clouds that heavy libraries read (PCD, E57); runs in the confined process."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import IO

import numpy as np
import open3d
import pye57

from spheremark.pipelines.errors import InputError
from spheremark.pipelines.model import Array
from spheremark.storage.imports.declared import check_points
from spheremark.storage.imports.scans import POINTS_MAX, joined


def read_pcd(file: IO[bytes], *, name: str) -> dict[str, Array]:
    """Return the points of a PCD file."""
    for line in file.read(4096).split(b"\n"):
        if line.startswith(b"POINTS") and (n := line[6:].strip()).isdigit():
            check_points(int(n), name, POINTS_MAX)
    cloud = open3d.io.read_point_cloud(Path(_own_path(file)), format="pcd", remove_nan_points=True)
    return joined([np.asarray(cloud.points)])


def read_e57(file: IO[bytes], *, name: str, number: int) -> dict[str, Array]:
    """Return the points of one scan of an E57 file, in the scanner's frame."""
    with pye57.E57(_own_path(file)) as e57:
        if not 0 <= number < e57.scan_count:
            raise InputError(f"{name} has {e57.scan_count} scans; there is no number {number}.")
        header = e57.get_header(number)
        check_points(header.point_count, name, POINTS_MAX)
        data = e57.read_scan(number, transform=False, ignore_missing_fields=True)
    columns = [data.get(f"cartesian{axis}") for axis in "XYZ"]
    if any(one is None for one in columns):
        raise InputError(f"Scan {number} of {name} has no coordinates.")
    return joined([np.column_stack(columns)])


def _own_path(file: IO[bytes]) -> str:
    """Return a path of an open file, for libraries that take no other: in the jail, or outside."""
    jailed = Path(f"/{file.fileno()}")
    place = "/proc/self/fd" if sys.platform == "linux" else "/dev/fd"
    return str(jailed) if jailed.exists() else f"{place}/{file.fileno()}"
