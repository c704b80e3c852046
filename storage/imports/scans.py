"""Clouds of single scans (LAS, LAZ, PLY, PCD, E57, text, NPY), read in a confined process.

A format is known by its first bytes; text is what none of them is. ``read_scan`` is for callers,
all others run in the child.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import laspy
import numpy as np

from spheremark.pipelines.errors import InputError, NotFoundError
from spheremark.pipelines.model import Array
from spheremark.storage.confined import Limits, run_confined
from spheremark.storage.imports import ply
from spheremark.storage.imports.cloud_files import check_las
from spheremark.storage.imports.declared import check_bytes, check_points, size_of

POINTS_MAX = 60_000_000
LIMITS = Limits(seconds=300.0, memory_bytes=6 << 30, result_bytes=24 * POINTS_MAX)
"""Of one scan: its points in double precision, and what it takes to read them."""

_READERS = (  # first bytes, and the function that reads the rest
    (b"LASF", "scans:read_las"),
    (b"ply", "scans:read_ply"),
    (b"\x93NUMPY", "scans:read_npy"),
    (b"ASTM-E57", "scan_libraries:read_e57"),
    (b"# .PCD", "scan_libraries:read_pcd"),
    (b"VERSION", "scan_libraries:read_pcd"),
)
_NO_TEXT = (
    "is no cloud of a known kind (LAS, LAZ, PLY, PCD, E57, NPY), and no text with x y z in lines"
)
_CHUNK = 1_000_000  # points at a time


def read_scan(path: str | Path, *, number: int = 0) -> Array:
    """Read the points of a scan from a foreign file, in a confined process.

    Parameters
    ----------
    path : str or Path
        LAS, LAZ, PLY, PCD, E57, NPY (rows of x y z), or text with x y z in each row, in metres.
    number : int
        Which scan of an E57 file; its points are those of the scanner's frame.

    Returns
    -------
    (n, 3)
        Finite points, in the order of the file [m].

    Raises
    ------
    NotFoundError
        If there is no such file.
    InputError
        If it cannot be read, is too large, or holds no point.
    """
    path = Path(path)
    if not path.is_file():
        raise NotFoundError(f"There is no cloud {path}.")
    with path.open("rb") as file:
        head = file.read(16).lstrip()
    function = next((name for start, name in _READERS if head.startswith(start)), "scans:read_text")
    reader = f"spheremark.storage.imports.{function}"
    options: dict[str, Any] = {"number": number} if function.endswith("e57") else {}
    points = run_confined(reader, path, LIMITS, name=path.name, **options)["points"]
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise InputError(f"{path.name} holds no finite point.")
    return np.asarray(points, np.float64)


def read_las(file: IO[bytes], *, name: str) -> dict[str, Array]:
    """Return the points of a LAS or LAZ file."""
    check_las(file, name)
    with laspy.open(file, closefd=False, laz_backend=laspy.LazBackend.Lazrs) as las:
        check_points(las.header.point_count, name, POINTS_MAX)
        pieces = [np.column_stack([c.x, c.y, c.z]) for c in las.chunk_iterator(_CHUNK)]
    return joined(pieces)


def read_ply(file: IO[bytes], *, name: str) -> dict[str, Array]:
    """Return the vertices of a PLY file."""
    vertices = ply.vertices_of(file, name)
    check_points(vertices.n, name, POINTS_MAX)
    n_bytes, room = vertices.n * vertices.smallest, size_of(file) - vertices.begin + 1
    check_bytes(f"{vertices.n:,} vertices", n_bytes, room, name)
    return joined(list(vertices.pieces(file, _CHUNK)))


def read_npy(file: IO[bytes], *, name: str) -> dict[str, Array]:
    """Return the rows of a NumPy array."""
    try:
        points = np.load(file, allow_pickle=False)
    except ValueError as error:
        raise InputError(f"{name} is no array that can be read: {error}.") from error
    if points.ndim != 2 or points.shape[1] < 3 or points.dtype.kind not in "fiu":
        raise InputError(
            f"{name} holds an array of shape {points.shape} and type {points.dtype}; numbers of "
            "the shape (n, 3) are expected: x, y and z in metres."
        )
    return joined([points[:, :3]])


def read_text(file: IO[bytes], *, name: str) -> dict[str, Array]:
    """Return the first three numbers of each line; a heading may be the first line."""
    first = file.readline(4096)
    file.seek(0)
    is_heading = not _is_numbers(first)
    delimiter = next((one for one in (",", ";") if one.encode() in first), None)
    try:
        points = np.loadtxt(
            file,
            delimiter=delimiter,
            usecols=(0, 1, 2),
            ndmin=2,
            skiprows=int(is_heading),
            max_rows=POINTS_MAX,
            encoding="utf-8",
        )
    except (ValueError, UnicodeDecodeError, IndexError) as error:
        raise InputError(f"{name} {_NO_TEXT}: {error}.") from error
    if not len(points):
        raise InputError(f"{name} {_NO_TEXT}: it has no line of numbers.")
    return joined([points])


def _is_numbers(line: bytes) -> bool:
    """Return whether a line holds numbers, or is a comment."""
    parts = line.replace(b",", b" ").replace(b";", b" ").split()
    if line.startswith(b"#"):
        return True
    try:
        return len([float(one) for one in parts[:3]]) == 3
    except ValueError:
        return False


def joined(pieces: Sequence[Array]) -> dict[str, Array]:
    """Return points as the answer of a reader."""
    points = np.concatenate(pieces) if pieces else np.empty((0, 3))
    return {"points": np.ascontiguousarray(points, np.float64)}
