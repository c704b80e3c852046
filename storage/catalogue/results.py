"""Results of the pipeline as Arrow tables, named and shaped like the tables of the database.

Pure: workers build the tables, the owner of the database inserts them. NaN and infinite numbers
become NULL. Lengths in metres, angles in degrees, coordinates in the frame that the schema names.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
import pyarrow as pa

from spheremark.pipelines.accuracy.truth import centre_errors, station_error
from spheremark.pipelines.config import SurveyConfig, digest_of
from spheremark.pipelines.errors import InputError
from spheremark.pipelines.geometry import levelling_rotation, rigid
from spheremark.pipelines.model import (
    Array,
    ControlMarks,
    Levelling,
    MarkerFit,
    MarkerFits,
    NoFix,
    Optics,
    Rejection,
    StationFix,
    StationQuality,
    StopResult,
    StopTruth,
    Truth,
)
from spheremark.pipelines.scan.rigs import rig_digest, rig_to_mapping
from spheremark.storage.catalogue.centres import levelling_of
from spheremark.storage.catalogue.resections import resections_table, resections_with_errors
from spheremark.storage.catalogue.rows import COV, ERROR, PLACE, Row, named, places, plain
from spheremark.storage.catalogue.schema import row_of, table_of

_UPPER = np.triu_indices(3)
_FIT_NUMBERS = (*PLACE, *COV, "sigma_3d_m", "azimuth_deg", "elevation_deg")
_COMPARED = ("marker_fits", "station_fixes", "resections")  # have errors against truth
TABLES = (
    "rigs",
    "runs",
    "stops",
    "marker_fits",
    "rejections",
    "group_likelihoods",
    "possible_fits",
    "station_fixes",
    "observations",
    "resections",
)
"""Tables that a job writes, in the order of writing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunInfo:
    """A run: its origin and configuration.

    ``run_id`` names its rows in every table; ``duration`` is the time from the log to the numbers
    [s], ``peak_memory_bytes`` the largest resident size of the worker's process.
    """

    run_id: str
    job_id: str
    survey_id: str
    recording_id: str
    config: SurveyConfig
    code_version: str
    finished_at: datetime
    duration: float
    peak_memory_bytes: int | None = None


def tables(
    run: RunInfo,
    stops: tuple[StopResult, ...],
    *,
    marks: ControlMarks | None = None,
    truth: Truth | None = None,
    clouds: Mapping[str, str] | None = None,
) -> dict[str, pa.Table]:
    """Put the results of a run into tables.

    Parameters
    ----------
    run : RunInfo
        What the run was.
    stops : tuple of StopResult
        What it gave, at least one.
    marks : ControlMarks, optional
        The control marks that the fixes refer to.
    truth : Truth, optional
        For the ``error_*`` columns, which are NULL without.
    clouds : mapping of str to str, optional
        Where the cloud of each stop was written.

    Returns
    -------
    dict of str to Table
        One table for each of ``TABLES``.

    Raises
    ------
    InputError
        If there is no stop, or a fix refers to control marks that are not given.

    Notes
    -----
    Markers have the names of their candidates, whatever method fitted them.
    """
    if not stops:
        raise InputError(f"Run {run.run_id} has no stop; a run has at least one.")
    if marks is None and any(stop.fixes for stop in stops):
        raise InputError(f"Run {run.run_id} has fixes; give the control marks that they refer to.")
    rows, names = _run_rows(run, stops), () if marks is None else marks.names
    for stop in stops:
        for table, found in _stop_rows(stop, names, (clouds or {}).get(stop.name)).items():
            rows[table] += [{"run_id": run.run_id, "stop": stop.name, **row} for row in found]
    made = {name: table_of(name, rows[name]) for name in TABLES}
    made["resections"] = resections_table(run.run_id, stops, names)
    return made if truth is None else with_errors(made, truth)


def with_errors(known: Mapping[str, pa.Table], truth: Truth | None) -> dict[str, pa.Table]:
    """Compute the errors of results against a truth."""
    if truth is None:
        return {
            name: _without_errors(table) if name in _COMPARED else table
            for name, table in known.items()
        }
    truths = {stop.name: stop for stop in truth.stops}
    out = dict(known)
    if "marker_fits" in known:
        levellings = {
            (row["run_id"], row["stop"]): levelling_of(row) for row in known["stops"].to_pylist()
        }
        errors = _marker_errors(known["marker_fits"], levellings, truths, truth.marks)
        out["marker_fits"] = _with_columns(known["marker_fits"], errors)
    if "station_fixes" in known:
        fixes = known["station_fixes"].to_pylist()
        errors = [_station_errors(row, truths.get(row["stop"])) for row in fixes]
        out["station_fixes"] = _with_columns(known["station_fixes"], errors)
    if "resections" in known:
        out["resections"] = resections_with_errors(known["resections"], truths)
    return out


def _run_rows(run: RunInfo, stops: tuple[StopResult, ...]) -> dict[str, list[Row]]:
    """Return the rows of a run as a whole, and empty lists for those of its stops."""
    rig, config = stops[0].cloud.rig, run.config.text
    digest = rig_digest(rig)
    rows: dict[str, list[Row]] = {name: [] for name in TABLES}
    rows["rigs"].append(
        {"rig_digest": digest, "name": rig.name, "rig": json.dumps(rig_to_mapping(rig))}
    )
    rows["runs"].append(
        {
            **row_of("runs", run),
            "config": config,
            "config_digest": digest_of(config),
            "rig_digest": digest,
        }
    )
    return rows


def _stop_rows(
    stop: StopResult, names: tuple[str, ...], cloud_url: str | None
) -> dict[str, list[Row]]:
    """Return the rows of one stop by table, without the columns of run and stop."""
    rows: dict[str, list[Row]] = {name: [] for name in TABLES[2:]}
    rows["stops"].append(_stop_row(stop, cloud_url))
    R, sigma_heading = levelling_rotation(stop.cloud.levelling), stop.sigma_heading
    for method, found in stop.fits.items():
        label = {"fit_method": method}
        matched = _matched(stop, method, names)
        for i, row in enumerate(_fit_rows(found.fits, R, sigma_heading)):
            rows["marker_fits"].append(label | {"mark": matched.get(i)} | row)
        rows["rejections"] += [
            label
            | row_of("rejections", one)
            | named(PLACE, R @ one.p_base)
            | {"is_possible": may_be}
            for groups, may_be in ((found.possible, True), (found.rejected, False))
            for one in groups
        ]
        possible = _fit_rows(found.possible_fits, R, sigma_heading, "possible_fits")
        rows["possible_fits"] += [label | row for row in possible]
    rows["group_likelihoods"] += _likelihood_rows(next(iter(stop.fits.values())), R)
    for (fit_method, method), fix in stop.fixes.items():
        label = {"fit_method": fit_method, "resection_method": method}
        station: Row = label | _fix_row(fix)
        if isinstance(fix, StationFix):
            quality = stop.quality[fit_method, method]
            station["dop"] = quality.dilution_of_precision
            observed = _observation_rows(fix, quality, stop.fits[fit_method], names)
            rows["observations"] += [label | one for one in observed]
        rows["station_fixes"].append(station)
    return rows


def _stop_row(stop: StopResult, cloud_url: str | None) -> Row:
    """Return the row of ``stops``."""
    cloud = stop.cloud
    return {
        **row_of("stops", cloud),
        **row_of("stops", cloud.levelling),
        "n_returns": len(cloud.p_base),
        "sigma_levelling_deg": np.degrees(cloud.levelling.sigma),
        "sigma_heading_deg": np.degrees(stop.sigma_heading),
        "sigma_clock_deg": np.degrees(cloud.levelling.sigma_clock),
        "cloud_url": cloud_url,
        "timings_s": json.dumps(dict(stop.timings)),
    }


def _likelihood_rows(found: MarkerFits, R: Array) -> list[Row]:
    """Return the rows of the compared groups of a stop; R levels the base."""
    groups: list[tuple[Row, MarkerFit | Rejection]] = [
        ({"marker": one.name, "reason": one.hypothesis}, one)
        for one in (*found.fits, *found.possible_fits)
    ]
    groups += [({"reason": one.reason}, one) for one in found.rejected]
    return [
        named(PLACE, R @ one.p_base)
        | {"n_points": one.n_points, "log_likelihoods": one.log_likelihoods.tolist()}
        | words
        for words, one in groups
        if len(one.log_likelihoods)
    ]


def _fit_rows(
    fits: Sequence[MarkerFit], R: Array, sigma_heading: float, table: str = "marker_fits"
) -> list[Row]:
    """Return rows of a table of fits without errors, method and mark; R levels the base."""
    p = np.array([fit.p_base for fit in fits]).reshape(-1, 3) @ R.T
    covs = np.array([fit.cov_with_heading(sigma_heading) for fit in fits]).reshape(-1, 3, 3)
    cov = (R @ covs @ R.T)[:, *_UPPER]
    sigmas = np.sqrt(np.trace(covs, axis1=1, axis2=2))
    azimuths = np.degrees(np.arctan2(p[:, 1], p[:, 0]))
    elevations = np.degrees(np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])))
    numbers = np.column_stack([p, cov, sigmas, azimuths, elevations]).tolist()
    return [
        row_of(table, fit)
        | named(_FIT_NUMBERS, row)
        | {"marker": fit.name, "range_m": fit.mean_range, "n_rejected": len(fit.rejected)}
        | {"range_by_optics_m": fit.range_by_optics.tolist(), "optics": _optics(fit.optics)}
        for fit, row in zip(fits, numbers, strict=True)
    ]


def _optics(optics: Optics | None) -> list[float] | None:
    """Return what a scan shows of its beams, as the column of that name."""
    if optics is None:
        return None
    parts = (optics.estimates, optics.weights, optics.sigmas_prior, optics.sigmas_profile)
    return list(np.concatenate([part.ravel() for part in parts]).tolist())


def _fix_row(fix: StationFix | NoFix) -> Row:
    """Return the row of ``station_fixes`` without errors."""
    if isinstance(fix, NoFix):
        return {"status": "failed", "reason": fix.reason, "n_markers": 0}
    return {
        **row_of("station_fixes", fix),
        **named(PLACE, fix.p_site),
        "rotation": fix.T_site_station[:3, :3].ravel().tolist(),
        **named(COV, fix.cov_p_site[_UPPER]),
        "cov_motion": fix.cov_T_site_station.ravel().tolist(),
        **row_of("station_fixes", fix.ellipse, "ellipse_"),
        "n_markers": len(fix.matches),
        "included_angle_min_deg": np.degrees(fix.included_angles[0]),
        "included_angle_max_deg": np.degrees(fix.included_angles[1]),
    }


def _observation_rows(
    fix: StationFix, quality: StationQuality, fits: MarkerFits, names: tuple[str, ...]
) -> list[Row]:
    """Return one row of ``observations`` for each marker of the stop."""
    shifts = np.linalg.norm(quality.without_each.shifts_site, axis=1)
    excluded = {exclusion.fit: exclusion.reason for exclusion in fix.excluded}
    rows: list[Row] = [
        {"marker": fit.name, "used": False, "reason": excluded.get(i, "Not matched.")}
        for i, fit in enumerate(fits.fits)
    ]
    for k, (i, mark) in enumerate(fix.matches):
        rows[i] |= {
            "mark": names[mark],
            "used": True,
            "reason": "",
            **named([f"residual_{name}" for name in PLACE], fix.residuals_site[k]),
            "redundancy": fix.redundancies[k],
            "w": fix.w_statistics[k],
            "minimal_detectable_bias_m": fix.detectable_biases[k],
            "external_reliability_m": fix.external_reliabilities[k],
            "shift_without_m": shifts[k] if len(shifts) else None,
        }
    return rows


def _matched(stop: StopResult, fit_method: str, names: tuple[str, ...]) -> dict[int, str]:
    """Return the control mark of each fit that the method's first station used."""
    for (method, _), fix in stop.fixes.items():
        if method == fit_method and isinstance(fix, StationFix):
            return {int(i): names[mark] for i, mark in fix.matches}
    return {}


def _with_columns(table: pa.Table, errors: Sequence[Mapping[str, object]]) -> pa.Table:
    """Return a table with its error columns replaced; missing values are NULL."""
    for i, name in enumerate(table.column_names):
        if name.startswith("error_"):
            values = pa.array([plain(row.get(name)) for row in errors], pa.float64())
            table = table.set_column(i, name, values)
    return table


def _without_errors(table: pa.Table) -> pa.Table:
    """Return a table with nothing in its error columns."""
    for i, name in enumerate(table.schema.names):
        if name.startswith("error_") and table.column(i).null_count < len(table):
            table = table.set_column(i, name, pa.nulls(len(table), pa.float64()))
    return table


def _marker_errors(
    fits: pa.Table,
    levellings: Mapping[tuple[str, str], Levelling],
    truths: Mapping[str, StopTruth],
    marks: ControlMarks,
) -> list[Row]:
    """Return the errors of each row of ``marker_fits``, along the axes of the station."""
    rows = fits.to_pylist()
    errors: list[Row] = [{} for _ in rows]
    groups: dict[tuple[str, str, str], list[int]] = {}
    for i, row in enumerate(rows):
        groups.setdefault((row["run_id"], row["stop"], row["fit_method"]), []).append(i)
    for (run_id, stop, _), members in groups.items():
        if stop in truths:
            p_station = places([rows[i] for i in members])
            R = levelling_rotation(levellings[run_id, stop])
            found = centre_errors(p_station @ R, truths[stop], marks)
            for k, i in enumerate(members):
                errors[i] = {
                    **named(ERROR, R @ found.error_base[k]),
                    "error_radial_m": found.error_radial[k],
                    "error_3d_m": found.error_3d[k],
                }
    return errors


def _station_errors(row: Row, truth: StopTruth | None) -> Row:
    """Return the errors of a row of ``station_fixes``."""
    if truth is None or row["x_m"] is None:
        return {}
    error = station_error(rigid(np.reshape(row["rotation"], (3, 3)), places([row])[0]), truth)
    return {
        **named(ERROR, error.error_site),
        "error_yaw_deg": np.degrees(error.error_yaw),
        "error_horizontal_m": np.hypot(*error.error_site[:2]),
        "error_3d_m": error.error_3d,
    }
