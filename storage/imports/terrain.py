"""Terrains to plan on: elevation models (GeoTIFF, ESRI ASCII grid) and clouds of earlier scans.

Hides which file is read how: a format is known by its first bytes, with which the ending of the
name must agree; its one reader runs in a confined process and returns a grid. What is kept of a
terrain is that grid, never the file.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.errors import InputError, NotFoundError
from spheremark.pipelines.placement import Site, site_of_grid
from spheremark.pipelines.placement.sites import CELLS_MAX
from spheremark.storage.confined import CLOUDS, Limits, UnreadableFileError, run_confined

LIMITS = Limits(seconds=120.0, memory_bytes=2 << 30, result_bytes=17 * CELLS_MAX)
"""Of one terrain: two grids of the most cells, and what it takes to make them."""

KEPT = ".npz"
"""Ending of a grid that this service has kept."""

_GRID_WORDS = (
    *(b"ncols", b"nrows", b"xllcorner", b"yllcorner", b"xllcenter", b"yllcenter"),
    *(b"cellsize", b"dx", b"dy", b"nodata"),
)
_HEIGHT_MAX = 1e5  # [m] beyond any height on Earth or Moon
_NOTHING = np.zeros(0)
_HEAD = 64  # [bytes] that show a format


class _Format(NamedTuple):
    """A format: its name for people, its endings, how a file begins, and its reader."""

    name: str
    kind: str
    endings: tuple[str, ...]
    beginnings: tuple[bytes, ...]
    reader: str


_MODEL, _CLOUD = "elevation model", "cloud"
_FORMATS = (
    _Format(
        "GeoTIFF",
        _MODEL,
        (".tif", ".tiff"),
        (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"),
        "spheremark.storage.imports.rasters:read_geotiff",
    ),
    _Format(
        "ESRI ASCII grid",
        _MODEL,
        (".asc",),
        _GRID_WORDS,
        "spheremark.storage.imports.ascii_grids:read_ascii_grid",
    ),
    _Format(
        "LAS",
        _CLOUD,
        (".laz", ".las"),
        (b"LASF",),
        f"{CLOUDS}:read_las",
    ),
    _Format(
        "PLY",
        _CLOUD,
        (".ply",),
        (b"ply\n", b"ply\r"),
        f"{CLOUDS}:read_ply",
    ),
    _Format(
        "Parquet",
        _CLOUD,
        (".parquet",),
        (b"PAR1",),
        f"{CLOUDS}:read_parquet",
    ),
)


def read_terrain(path: str | Path, *, name: str = "") -> Site:
    """Read a terrain from a foreign file, in a confined process.

    Parameters
    ----------
    path : str or Path
        Elevation model (.tif, .asc) or cloud (.laz, .las, .ply, .parquet) in metres, z up.
    name : str
        What it is called, with its ending; the name of the file by default.

    Returns
    -------
    Site
        Ground, and what hides.

    Raises
    ------
    NotFoundError
        If there is no such file.
    InputError
        If its ending and its first bytes are not of one known format, or it cannot be read, is too
        large, is in degrees, or holds no ground.

    Notes
    -----
    Of an elevation model the first band is taken; cells without data stay unknown. Files beside it
    (.tfw, .prj, .aux.xml) are not read. A cloud is gridded at 0.1 m, unknown more than 1.5 m from
    its nearest return. A file declares at most what its size can hold, in compressed formats 4,000
    times that, and at most 16 million cells or 200 million points.
    """
    path = Path(path)
    name = name or path.name
    if not path.is_file():
        raise NotFoundError(f"There is no terrain {path}.")
    reader = _format_of(path, name).reader
    return _site(name, run_confined(reader, path, LIMITS, name=name, cells_max=CELLS_MAX))


def check_ending(name: str) -> None:
    """Raise InputError if no terrain has a name of this ending.

    Parameters
    ----------
    name : str
        Name of a file.
    """
    _by_ending(name)


def write_grid(site: Site, path: Path) -> None:
    """Write the grid of a terrain over a file.

    Parameters
    ----------
    site : Site
        What ``read_terrain`` returned.
    path : Path
        The file; ``open_terrain`` reads it.
    """
    arrays = {"xs": site.xs, "ys": site.ys, "ground": site.ground}
    if not np.array_equal(site.surface, site.ground, equal_nan=True):
        arrays["surface"] = site.surface
    with path.open("r+b") as file:  # not made anew where an ended upload has removed it
        file.truncate()
        np.savez_compressed(file, allow_pickle=False, **arrays)
        file.flush()
        os.fsync(file.fileno())


def open_terrain(path: Path, name: str) -> Site:
    """Return a terrain that this service keeps.

    Parameters
    ----------
    path : Path
        A grid, as of ``write_grid``.
    name : str
        Name of the foreign file.

    Returns
    -------
    Site
        Ground, and what hides.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return _site(name, dict(arrays))
    except (EOFError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise UnreadableFileError(
            f"The grid of {name} is damaged on this disk; upload it again."
        ) from error
    except FileNotFoundError as error:
        raise NotFoundError(
            f"The grid of {name} is not there any more; upload it again."
        ) from error


def _format_of(path: Path, name: str) -> _Format:
    """Return the format of which both the ending and the first bytes are."""
    wanted = _by_ending(name)
    with path.open("rb") as file:
        head = file.read(_HEAD)
    if not _begins(head, wanted):
        others = [one.name for one in _FORMATS if _begins(head, one)]
        found = f"those of {others[0]}" if others else f"{head[:8]!r}"
        raise InputError(
            f"{name} is no {wanted.kind} that can be read: its ending is that of {wanted.name}, "
            f"its first bytes are {found}."
        )
    return wanted


def _begins(head: bytes, wanted: _Format) -> bool:
    """Whether a file begins as those of a format do; words of a text may be in any case."""
    return any(text.startswith(wanted.beginnings) for text in (head, head.lstrip().lower()))


def _by_ending(name: str) -> _Format:
    """Return the format that has the ending of a name."""
    found = [one for one in _FORMATS if name.lower().endswith(one.endings)]
    if not found:
        known = "; ".join(f"{one.name} ({', '.join(one.endings)})" for one in _FORMATS)
        raise InputError(
            f"{name} is no terrain that can be read; one of these is expected: {known}."
        )
    return found[0]


def _site(name: str, arrays: Mapping[str, NDArray[Any]]) -> Site:
    """Return the site of grids; a reader that a file has overcome may have forged them."""
    known = dict(arrays)
    xs, ys, ground = (known.pop(one, _NOTHING) for one in ("xs", "ys", "ground"))
    surface = known.pop("surface", ground)
    is_whole = all(one.dtype.kind == "f" for one in (xs, ys, ground, surface))
    is_whole = is_whole and not known and xs.ndim == ys.ndim == 1
    is_whole = is_whole and (len(ys), len(xs)) == ground.shape == surface.shape
    if not is_whole or not np.isfinite(np.concatenate([xs, ys])).all():
        raise UnreadableFileError(f"{name} cannot be read: its reader gave no grid.")
    ground, surface = (
        np.where(np.abs(one) < _HEIGHT_MAX, one, np.nan) for one in (ground, surface)
    )
    return site_of_grid(name, xs, ys, ground, surface=surface)
