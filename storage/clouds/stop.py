"""Clouds of stops as Parquet files named by the SHA-256 of their bytes, for pages and downloads.

A file holds a uniform part of a stop's returns in the station frame and all that is near a marker,
with each marker's members and their residuals. It is a picture, not an input: results are computed
from recordings. Folders are fsspec URLs or paths, so that a cluster can share them.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import posixpath
import secrets
from collections.abc import Mapping
from dataclasses import dataclass

import fsspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from spheremark.pipelines.errors import InputError, NotFoundError
from spheremark.pipelines.geometry import levelling_rotation
from spheremark.pipelines.model import Array, Column, Index, MarkerFits, Mask, StopResult

NO_MARKER = -1  # the marker of a return that belongs to none
_FORMAT = "1"  # version of the file format; a reader knows every version that was ever written
_NEAR = 0.5  # [m] around a centre, within which every return is kept
_CELLS = 256  # cells of 1 m along an edge of the grid; the outermost ones reach to infinity
_GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class CloudView:
    """A part of a stop's cloud, to be looked at.

    Attributes
    ----------
    stop : str
        Name of the stop.
    fit_method : str
        Method that the markers and residuals belong to.
    n_returns : int
        Number of returns of the whole stop.
    p_station : (n, 3) float32
        Returns [m].
    intensities : (n,) float32
        Calibrated reflectivity, 0-255.
    is_near : (n,)
        Whether the return is within half a metre of a fitted centre.
    markers : (n,)
        Place of the return's marker in ``names``; ``NO_MARKER`` for those of none.
    residuals : (n,) float32
        Observed minus computed along the beam; NaN where the return carries no estimate [m].
    names : tuple of str
        Markers in the order of the fits.
    """

    stop: str
    fit_method: str
    n_returns: int
    p_station: Column
    intensities: Column
    is_near: Mask
    markers: Index
    residuals: Column
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        for name in ("p_station", "intensities", "is_near", "markers", "residuals"):
            column = getattr(self, name)
            if len(column) != len(self.p_station):
                raise InputError(f"CloudView.{name} has {len(column)} rows, not {len(self)}.")
            column.flags.writeable = False

    def __len__(self) -> int:
        """Return the number of returns in the view."""
        return len(self.p_station)


def view(stop: StopResult, n_max: int) -> CloudView:
    """Choose what of a stop is worth looking at.

    Parameters
    ----------
    stop : StopResult
        A stop; its first fitting method names the markers.
    n_max : int
        Number of returns away from markers that are kept.

    Returns
    -------
    CloudView
        All returns within half a metre of a fitted centre, and a uniform choice of the others.

    Notes
    -----
    Return ``i`` is kept where the fraction of ``i`` times the golden ratio is below the share to
    keep (Weyl's sequence): even in time, repeatable, and blind to the period of the lasers.
    """
    cloud = stop.cloud
    method, found = next(iter(stop.fits.items()))
    is_near = _near(cloud.p_base, np.array([fit.p_base for fit in found.fits]).reshape(-1, 3))
    markers, residuals = _members(found, len(cloud.p_base))
    is_kept = is_near | (markers != NO_MARKER)
    is_kept[_thinned(np.flatnonzero(~is_kept), n_max)] = True
    rows = np.flatnonzero(is_kept)
    R = levelling_rotation(cloud.levelling)
    return CloudView(
        stop=stop.name,
        fit_method=method,
        n_returns=len(cloud.p_base),
        p_station=(cloud.p_base[rows] @ R.T).astype(np.float32),
        intensities=cloud.intensities[rows],
        is_near=is_near[rows],
        markers=markers[rows],
        residuals=residuals[rows],
        names=tuple(fit.name for fit in found.fits),
    )


def write_cloud(stop: StopResult, folder: str, *, n_max: int = 200_000) -> str:
    """Write what of a stop is worth looking at.

    Parameters
    ----------
    stop : StopResult
        A stop.
    folder : str
        Path or fsspec URL of a folder; it is made when missing.
    n_max : int
        Number of returns away from markers that are kept.

    Returns
    -------
    str
        Path or URL of the file, ``<folder>/<SHA-256>.parquet``; the same stop gives the same.
    """
    buffer = io.BytesIO()
    table = _to_table(view(stop, n_max))
    split = dict.fromkeys(("x_m", "y_m", "z_m", "residual_m"), "BYTE_STREAM_SPLIT")
    pq.write_table(table, buffer, compression="zstd", use_dictionary=False, column_encoding=split)
    content = buffer.getvalue()
    url = posixpath.join(folder, f"{hashlib.sha256(content).hexdigest()}.parquet")
    files, path = fsspec.core.url_to_fs(url)
    if not files.exists(path):
        files.makedirs(posixpath.dirname(path), exist_ok=True)
        part = f"{path}.{secrets.token_hex(4)}.part"  # nobody sees half a file
        files.pipe_file(part, content)
        files.mv(part, path)
    return url


def read_cloud(url: str, *, n_max: int | None = None) -> CloudView:
    """Read a cloud.

    Parameters
    ----------
    url : str
        What ``write_cloud`` returned.
    n_max : int, optional
        Returns at most. Members of markers are kept first, then what is near a marker, then the
        rest, each chosen uniformly where not all have room.

    Returns
    -------
    CloudView
        In the order of the recording.

    Raises
    ------
    NotFoundError
        If there is no such file.
    InputError
        If it is not a cloud.
    """
    files, path = fsspec.core.url_to_fs(url)
    try:
        table = pq.read_table(io.BytesIO(files.cat_file(path)))
    except FileNotFoundError as error:
        raise NotFoundError(f"The cloud {url} is not there any more; run the job again.") from error
    except pa.ArrowInvalid as error:
        raise InputError(f"{url} is not a cloud: {error}") from error
    about = table.schema.metadata or {}
    if about.get(b"spheremark.cloud") != _FORMAT.encode():
        raise InputError(f"{url} is not a cloud that this version of spheremark knows.")
    return _from_table(table if n_max is None else table.take(_chosen(table, n_max)), about)


def to_ply(cloud: CloudView) -> bytes:
    """Return a cloud as a binary PLY file."""
    vertices = np.zeros(
        len(cloud),
        dtype=[(n, "<f4") for n in ("x", "y", "z", "intensity", "residual")] + [("marker", "<i4")],
    )
    for axis, name in enumerate(("x", "y", "z")):
        vertices[name] = cloud.p_station[:, axis]
    vertices["intensity"] = cloud.intensities
    vertices["residual"] = cloud.residuals
    vertices["marker"] = cloud.markers
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment spheremark, stop {cloud.stop}, station frame, metres",
        f"element vertex {len(cloud)}",
        *(f"property float {n}" for n in ("x", "y", "z", "intensity", "residual")),
        "property int marker",
        "end_header",
        "",
    ]
    return "\n".join(header).encode() + vertices.tobytes()


def _near(p: Column, centres: Array) -> Mask:
    """Return which points are near a centre, looking closely only at those in a cell near one."""
    cells = np.clip(np.floor(p[:, :2]) + _CELLS // 2, 0, _CELLS - 1).astype(np.intp)
    may_be_near = np.zeros((_CELLS, _CELLS), dtype=np.bool_)
    for corner in itertools.product((-_NEAR, _NEAR), repeat=2):
        at = np.clip(np.floor(centres[:, :2] + corner) + _CELLS // 2, 0, _CELLS - 1)
        may_be_near[tuple(at.astype(np.intp).T)] = True
    rows = np.flatnonzero(may_be_near[cells[:, 0], cells[:, 1]])
    is_near = np.zeros(len(p), dtype=np.bool_)
    for centre in centres:
        is_near[rows[np.linalg.norm(p[rows] - centre, axis=1) <= _NEAR]] = True
    return is_near


def _members(found: MarkerFits, n_returns: int) -> tuple[Index, Column]:
    """Return the marker of each return and its residual."""
    markers = np.full(n_returns, NO_MARKER, dtype=np.intp)
    residuals = np.full(n_returns, np.nan, dtype=np.float32)
    for i, fit in enumerate(found.fits):
        markers[fit.rejected] = i
        markers[fit.used] = i
        residuals[fit.used] = fit.residuals
    return markers, residuals


def _thinned(rows: Index, n_max: int) -> Index:
    """Return a uniform choice of at most so many rows, in their order."""
    if len(rows) <= n_max:
        return rows
    kept: Index = rows[(np.arange(len(rows)) * _GOLDEN) % 1.0 < n_max / len(rows)]
    return kept[:n_max]


def _chosen(table: pa.Table, n_max: int) -> Index:
    """Return the rows to show when there is room for so many."""
    is_member = table.column("marker").to_numpy() != NO_MARKER
    is_near = table.column("is_near").to_numpy()
    chosen: Index = np.zeros(0, dtype=np.intp)
    for tier in (is_member, is_near & ~is_member, ~is_near & ~is_member):
        room = n_max - len(chosen)
        chosen = np.concatenate([chosen, _thinned(np.flatnonzero(tier), room)])
    return np.sort(chosen)


def _to_table(cloud: CloudView) -> pa.Table:
    """Return a cloud as a table whose metadata say what it is."""
    about = {"stop": cloud.stop, "fit_method": cloud.fit_method, "names": cloud.names}
    columns: dict[str, Column | Mask | NDArray[np.int16]]
    columns = {name: cloud.p_station[:, axis] for axis, name in enumerate(("x_m", "y_m", "z_m"))}
    columns |= {
        "intensity": cloud.intensities,
        "is_near": cloud.is_near,
        "marker": cloud.markers.astype(np.int16),
        "residual_m": cloud.residuals,
    }
    metadata = {
        "spheremark.cloud": _FORMAT,
        "spheremark.about": json.dumps(about | {"n_returns": cloud.n_returns, "frame": "station"}),
    }
    return pa.table(columns).replace_schema_metadata(metadata)


def _from_table(table: pa.Table, metadata: Mapping[bytes, bytes]) -> CloudView:
    """Return the cloud that a table holds."""
    about = json.loads(metadata[b"spheremark.about"])
    columns = {name: table.column(name).to_numpy().copy() for name in table.column_names}
    return CloudView(
        stop=about["stop"],
        fit_method=about["fit_method"],
        n_returns=about["n_returns"],
        p_station=np.column_stack([columns["x_m"], columns["y_m"], columns["z_m"]]),
        intensities=columns["intensity"],
        is_near=columns["is_near"],
        markers=columns["marker"].astype(np.intp),
        residuals=columns["residual_m"],
        names=tuple(about["names"]),
    )
