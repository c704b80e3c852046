"""Positions from pairs and triples of marks as Arrow columns: hundreds of rows for each stop."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from spheremark.pipelines.model import Array, StopResult, StopTruth, SubsetFixes
from spheremark.storage.catalogue.rows import PLACE, named
from spheremark.storage.catalogue.schema import SCHEMAS

_LABELS = ("run_id", "stop", "fit_method", "resection_method")
_ERRORS = ("error_horizontal_m", "error_3d_m")


def resections_table(run_id: str, stops: Iterable[StopResult], names: tuple[str, ...]) -> pa.Table:
    """Put the subsets of stops into the table ``resections``, without errors."""
    schema = SCHEMAS["resections"]
    groups = [
        ((run_id, stop.name, *methods), subsets)
        for stop in stops
        for methods, sizes in stop.subsets.items()
        for subsets in sizes
    ]
    if not groups:
        return schema.empty_table()
    found = [subsets for _, subsets in groups]
    columns = _labels([labels for labels, _ in groups], found) | _marks(found, names)
    columns |= {name: _numbers(values) for name, values in _measures(found).items()}
    columns |= {name: pa.nulls(len(columns["marks"]), pa.float64()) for name in _ERRORS}
    return pa.table([columns[name] for name in schema.names], schema=schema)


def _labels(labels: Sequence[tuple[str, ...]], found: Sequence[SubsetFixes]) -> dict[str, pa.Array]:
    """Return the columns that name run, stop and methods."""
    rows = pa.array(np.repeat(np.arange(len(found)), [len(one.marks) for one in found]))
    return {
        name: pa.array(values, pa.string()).take(rows)
        for name, values in zip(_LABELS, zip(*labels, strict=True), strict=True)
    }


def _marks(found: Sequence[SubsetFixes], names: tuple[str, ...]) -> dict[str, pa.Array]:
    """Return the columns that name the marks of each subset and count them."""
    counts = np.repeat(
        np.array([one.marks.shape[1] for one in found], dtype=np.int32),
        [len(one.marks) for one in found],
    )
    ends = np.cumsum(counts, dtype=np.int32)
    places = np.concatenate([one.marks.ravel() for one in found])
    marks = pa.array(names, pa.string()).take(pa.array(places))
    return {
        "marks": pa.ListArray.from_arrays(np.concatenate([np.zeros(1, np.int32), ends]), marks),
        "n_marks": pa.array(counts),
    }


def _measures(found: Sequence[SubsetFixes]) -> dict[str, Array]:
    """Return the columns of numbers."""
    angles = np.degrees(np.concatenate([one.included_angles for one in found]))
    horizontal = np.concatenate([one.included_angles_horizontal[:, 0] for one in found])
    return {
        "included_angle_deg": angles[:, 0],
        "included_angle_max_deg": angles[:, 1],
        "included_angle_horizontal_deg": np.degrees(horizontal),
        "sigma_horizontal_m": np.concatenate([one.sigma_horizontal for one in found]),
        "sigma_3d_m": np.concatenate([one.sigma_3d for one in found]),
        **named(PLACE, np.concatenate([one.p_site for one in found]).T),
    }


def resections_with_errors(known: pa.Table, truths: Mapping[str, StopTruth]) -> pa.Table:
    """Compute the errors of rows of ``resections`` against the true stops."""
    p_true = np.full((len(known), 3), np.nan)
    for stop in pc.unique(known["stop"]).to_pylist():
        if stop in truths:
            p_true[pc.equal(known["stop"], stop).to_numpy()] = truths[stop].T_site_base[:3, 3]
    places = [known[name].cast(pa.float64()).to_numpy() for name in PLACE]
    errors = np.stack(places, axis=1) - p_true
    for name, values in zip(
        _ERRORS, (np.hypot(*errors[:, :2].T), np.linalg.norm(errors, axis=1)), strict=True
    ):
        known = known.set_column(known.schema.get_field_index(name), name, _numbers(values))
    return known


def _numbers(values: Array) -> pa.Array:
    """Return numbers as a column in which what is not finite is NULL."""
    return pa.array(values, pa.float64(), mask=~np.isfinite(values))
