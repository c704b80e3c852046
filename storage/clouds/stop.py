"""Clouds of stops as Parquet files, for display; results are computed from recordings.

A file holds a uniform sample of a stop's returns in the station frame, and all returns near a
marker with the members of the marker and their residuals.
"""

from __future__ import annotations

import io
import itertools
import json
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
from spheremark.storage.files import keep_bytes

NO_MARKER = -1  # marker of a return without one
_FORMAT = "1"  # version of the file format; readers support all released versions
_NEAR = 0.5  # [m] around a centre, within which every return is kept
_CELLS = 256  # cells of 1 m along an edge of the grid; the outermost ones reach to infinity
_GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class CloudView:
    """A sample of a stop's cloud, for display.

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
        Index of the return's marker in ``names``; ``NO_MARKER`` without one.
    residuals : (n,) float32
        Observed minus computed along the beam; NaN for returns that no fit used [m].
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
    """Sample the cloud of a stop for display.

    Parameters
    ----------
    stop : StopResult
        A stop; its first fitting method names the markers.
    n_max : int
        Number of returns away from markers.

    Returns
    -------
    CloudView
        All returns within half a metre of a fitted centre, and a uniform sample of the others.

    Notes
    -----
    Return ``i`` is kept where the fraction of ``i`` times the golden ratio is below the sampling
    ratio (Weyl's sequence): even in time, repeatable, and independent of the period of the lasers.
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
    """Write a sample of the cloud of a stop.

    Parameters
    ----------
    stop : StopResult
        A stop.
    folder : str
        Path or fsspec URL of a folder; created when missing.
    n_max : int
        Number of returns away from markers.

    Returns
    -------
    str
        Path or URL of the file, ``<folder>/<SHA-256>.parquet``; the same stop gives the same.
    """
    buffer = io.BytesIO()
    table = _to_table(view(stop, n_max))
    split = dict.fromkeys(("x_m", "y_m", "z_m", "residual_m"), "BYTE_STREAM_SPLIT")
    pq.write_table(table, buffer, compression="zstd", use_dictionary=False, column_encoding=split)
    return keep_bytes(buffer.getvalue(), ".parquet", folder)


def read_cloud(url: str, *, n_max: int | None = None) -> CloudView:
    """Read a cloud.

    Parameters
    ----------
    url : str
        Result of ``write_cloud``.
    n_max : int, optional
        Largest number of returns. Members of markers come first, then returns near a marker, then
        the others; the group that exceeds the limit is sampled uniformly.

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


def read_sample(url: str | None) -> Column:
    """Read an even sample of the returns of a stop.

    Parameters
    ----------
    url : str, optional
        Result of ``write_cloud``.

    Returns
    -------
    (n, 3)
        Returns in the station frame; none where the cloud is not kept any more [m].
    """
    if url is None:
        return np.zeros((0, 3), np.float32)
    try:
        cloud = read_cloud(url)
    except NotFoundError:
        return np.zeros((0, 3), np.float32)
    step = max(1, cloud.n_returns // max(1, int(np.sum(~cloud.is_near))))
    near = np.flatnonzero(cloud.is_near)[::step]
    rows = np.sort(np.concatenate([np.flatnonzero(~cloud.is_near), near]))
    return np.asarray(cloud.p_station[rows])


def _near(p: Column, centres: Array) -> Mask:
    """Return which points are near a centre; distances are computed only in cells near one."""
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
    """Return a uniform sample of rows, in their order."""
    if len(rows) <= n_max:
        return rows
    kept: Index = rows[(np.arange(len(rows)) * _GOLDEN) % 1.0 < n_max / len(rows)]
    return kept[:n_max]


def _chosen(table: pa.Table, n_max: int) -> Index:
    """Return at most so many rows: members of markers first, then returns near one, then others."""
    is_member = table.column("marker").to_numpy() != NO_MARKER
    is_near = table.column("is_near").to_numpy()
    chosen: Index = np.zeros(0, dtype=np.intp)
    for tier in (is_member, is_near & ~is_member, ~is_near & ~is_member):
        room = n_max - len(chosen)
        chosen = np.concatenate([chosen, _thinned(np.flatnonzero(tier), room)])
    return np.sort(chosen)


def _to_table(cloud: CloudView) -> pa.Table:
    """Return a cloud as a table with its names and frame in the metadata."""
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
    """Return the cloud of a table."""
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
