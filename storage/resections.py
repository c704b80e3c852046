"""Positions from pairs and triples of marks as Arrow columns: hundreds of rows for each stop."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipelines.values import Array, StopResult, StopTruth, SubsetFixes

_PLACE = ("x_m", "y_m", "z_m")
_ERRORS = ("error_horizontal_m", "error_3d_m")


def resections_table(
    run_id: str, stops: Iterable[StopResult], names: tuple[str, ...], schema: pa.Schema
) -> pa.Table:
    """Put the subsets of stops into the table ``resections``, without errors.

    Parameters
    ----------
    run_id : str
        The run that they belong to.
    stops : iterable of StopResult
        What it gave.
    names : tuple of str
        Names of the control marks.
    schema : Schema
        Columns of the table.

    Returns
    -------
    Table
        One row for each subset.
    """
    tables = [
        _table((run_id, stop.name, *methods), subsets, names, schema)
        for stop in stops
        for methods, sizes in stop.subsets.items()
        for subsets in sizes
    ]
    return pa.concat_tables([schema.empty_table(), *tables])


def _table(
    labels: tuple[str, ...], found: SubsetFixes, names: tuple[str, ...], schema: pa.Schema
) -> pa.Table:
    """Return the subsets of one size at one stop."""
    n, k = found.marks.shape
    known = dict(zip(("run_id", "stop", "fit_method", "resection_method"), labels, strict=True))
    text = pa.string()  # said, because to guess a scalar's type costs more than all else here
    columns = {name: pa.repeat(pa.scalar(value, text), n) for name, value in known.items()}
    marks = pa.array(names, pa.string()).take(pa.array(found.marks.ravel()))
    columns["marks"] = pa.ListArray.from_arrays(np.arange(0, n * k + 1, k, dtype=np.int32), marks)
    columns["n_marks"] = pa.repeat(pa.scalar(k, pa.int32()), n)
    angles = np.degrees(found.included_angles)
    numbers = {
        "included_angle_deg": angles[:, 0],
        "included_angle_max_deg": angles[:, 1],
        "included_angle_horizontal_deg": np.degrees(found.included_angles_horizontal[:, 0]),
        "sigma_horizontal_m": found.sigma_horizontal,
        "sigma_3d_m": found.sigma_3d,
        **dict(zip(_PLACE, found.p_site.T, strict=True)),
    }
    columns |= {name: _numbers(values) for name, values in numbers.items()}
    columns |= {name: pa.nulls(n, pa.float64()) for name in _ERRORS}
    return pa.table([columns[name] for name in schema.names], schema=schema)


def resections_with_errors(known: pa.Table, truths: Mapping[str, StopTruth]) -> pa.Table:
    """Take the errors of rows of ``resections`` anew.

    Parameters
    ----------
    known : Table
        Any rows of it.
    truths : mapping of str to StopTruth
        True poses by stop; rows of other stops have no errors.

    Returns
    -------
    Table
        The same rows with their ``error_*`` columns replaced.
    """
    p_true = np.full((len(known), 3), np.nan)
    for stop in pc.unique(known["stop"]).to_pylist():
        if stop in truths:
            p_true[pc.equal(known["stop"], stop).to_numpy()] = truths[stop].T_site_base[:3, 3]
    places = [known[name].cast(pa.float64()).to_numpy() for name in _PLACE]
    errors = np.stack(places, axis=1) - p_true
    for name, values in zip(
        _ERRORS, (np.hypot(*errors[:, :2].T), np.linalg.norm(errors, axis=1)), strict=True
    ):
        known = known.set_column(known.schema.get_field_index(name), name, _numbers(values))
    return known


def _numbers(values: Array) -> pa.Array:
    """Return numbers as a column in which what is not finite is NULL."""
    return pa.array(values, pa.float64(), mask=~np.isfinite(values))
