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

from spheremark.pipelines.accuracy import centre_errors, station_error
from spheremark.pipelines.config import SurveyConfig, digest_of
from spheremark.pipelines.errors import InputError
from spheremark.pipelines.geometry import levelling_rotation, rigid
from spheremark.pipelines.model import (
    Array,
    ControlMarks,
    ErrorEllipse,
    Levelling,
    MarkerFit,
    MarkerFits,
    NoFix,
    StationFix,
    StationQuality,
    Status,
    StopResult,
    StopTruth,
    Truth,
)
from spheremark.pipelines.scan.rigs import rig_digest, rig_to_mapping
from spheremark.storage.catalogue.resections import resections_table, resections_with_errors
from spheremark.storage.catalogue.rows import Row, plain, table_of

_UPPER = np.triu_indices(3)
_TEXT, _REAL, _WHOLE, _LONG = pa.string(), pa.float64(), pa.int32(), pa.int64()
_INSTANT = pa.timestamp("us", "UTC")
_STOP = {"run_id": _TEXT, "stop": _TEXT}
_FIT = _STOP | {"fit_method": _TEXT}
_FIX = _FIT | {"resection_method": _TEXT}
_PLACE = {"x_m": _REAL, "y_m": _REAL, "z_m": _REAL}
_COV = dict.fromkeys([f"cov_{axes}_m2" for axes in ("xx", "xy", "xz", "yy", "yz", "zz")], _REAL)
_FIT_NUMBERS = (*_PLACE, *_COV, "sigma_3d_m", "azimuth_deg", "elevation_deg")
_ERROR = {"error_x_m": _REAL, "error_y_m": _REAL, "error_z_m": _REAL}

_COLUMNS = {
    "rigs": {"rig_digest": _TEXT, "name": _TEXT, "rig": _TEXT},
    "runs": {
        **dict.fromkeys(("run_id", "job_id", "survey_id", "recording_id"), _TEXT),
        **dict.fromkeys(("config", "config_digest", "code_version", "rig_digest"), _TEXT),
        "finished_at": _INSTANT,
        "duration_s": _REAL,
        "peak_memory_bytes": _LONG,
    },
    "stops": {
        **_STOP,
        "n_returns": _LONG,
        **dict.fromkeys(("coverage_deg", "duration_s", "roll_deg", "pitch_deg"), _REAL),
        "sigma_levelling_deg": _REAL,
        "sigma_heading_deg": _REAL,
        "cloud_url": _TEXT,
        "notes": pa.list_(_TEXT),
        "timings_s": _TEXT,
    },
    "marker_fits": {
        **_FIT,
        **dict.fromkeys(("marker", "mark", "status", "reason"), _TEXT),
        **_PLACE,
        **_COV,
        **dict.fromkeys(("sigma_3d_m", "range_m", "azimuth_deg", "elevation_deg"), _REAL),
        **dict.fromkeys(("n_points", "n_rejected", "n_rings"), _WHOLE),
        **dict.fromkeys(("coverage", "rms_m", "sigma0", "radius_m", "radius_free_m"), _REAL),
        **dict.fromkeys(("sigma_radius_free_m", "mean_intensity", "incidence_deg"), _REAL),
        "variant": _TEXT,
        **_ERROR,
        "error_radial_m": _REAL,
        "error_3d_m": _REAL,
        "sigma_range_shared_m": _REAL,
    },
    "rejections": {**_FIT, **_PLACE, "n_points": _WHOLE, "reason": _TEXT},
    "station_fixes": {
        **_FIX,
        "status": _TEXT,
        "reason": _TEXT,
        **_PLACE,
        "yaw_deg": _REAL,
        "rotation": pa.list_(_REAL),
        **_COV,
        "cov_motion": pa.list_(_REAL),
        **dict.fromkeys(("sigma_3d_m", "sigma_yaw_deg"), _REAL),
        **dict.fromkeys(("ellipse_major_m", "ellipse_minor_m", "ellipse_bearing_deg"), _REAL),
        **dict.fromkeys(("ellipse_major_95_m", "ellipse_minor_95_m"), _REAL),
        "n_markers": _WHOLE,
        "dof": _WHOLE,
        "sigma0": _REAL,
        "passes_global_test": pa.bool_(),
        **dict.fromkeys(("included_angle_min_deg", "included_angle_max_deg"), _REAL),
        **_ERROR,
        **dict.fromkeys(("error_yaw_deg", "error_horizontal_m", "error_3d_m"), _REAL),
        "dop": _REAL,
    },
    "observations": {
        **_FIX,
        "marker": _TEXT,
        "mark": _TEXT,
        "used": pa.bool_(),
        "reason": _TEXT,
        **dict.fromkeys(("residual_x_m", "residual_y_m", "residual_z_m"), _REAL),
        **dict.fromkeys(("redundancy", "w"), _REAL),
        **dict.fromkeys(("minimal_detectable_bias_m", "external_reliability_m"), _REAL),
        "shift_without_m": _REAL,
    },
    "resections": {
        **_FIX,
        "marks": pa.list_(_TEXT),
        "n_marks": _WHOLE,
        **dict.fromkeys(("included_angle_deg", "included_angle_horizontal_deg"), _REAL),
        "sigma_3d_m": _REAL,
        **_PLACE,
        "error_3d_m": _REAL,
        **dict.fromkeys(("included_angle_max_deg", "sigma_horizontal_m"), _REAL),
        "error_horizontal_m": _REAL,
    },
}
SCHEMAS = {name: pa.schema(list(columns.items())) for name, columns in _COLUMNS.items()}
"""Columns of the tables that a job writes, in the order of writing."""
TABLES = tuple(SCHEMAS)
"""Their names."""
_COMPARED = ("marker_fits", "station_fixes", "resections")  # have errors against truth


@dataclass(frozen=True, slots=True, kw_only=True)
class RunInfo:
    """A run: its origin and configuration.

    Attributes
    ----------
    run_id : str
        Names its rows in every table.
    job_id, survey_id, recording_id : str
        Where it belongs.
    config : SurveyConfig
        The effective configuration.
    code_version : str
        Version of spheremark.
    finished_at : datetime
        When the numbers were there, with a time zone.
    duration : float
        Time from the log to the numbers [s].
    peak_memory_bytes : int or None
        Largest resident size of the worker's process.
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
    made = {name: _table(name, rows[name]) for name in TABLES}
    made["resections"] = resections_table(run.run_id, stops, names, made["resections"].schema)
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
        errors = _marker_errors(known["marker_fits"], _levellings(known), truths, truth.marks)
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
            "run_id": run.run_id,
            "job_id": run.job_id,
            "survey_id": run.survey_id,
            "recording_id": run.recording_id,
            "config": config,
            "config_digest": digest_of(config),
            "code_version": run.code_version,
            "rig_digest": digest,
            "finished_at": run.finished_at,
            "duration_s": run.duration,
            "peak_memory_bytes": run.peak_memory_bytes,
        }
    )
    return rows


def _stop_rows(
    stop: StopResult, names: tuple[str, ...], cloud_url: str | None
) -> dict[str, list[Row]]:
    """Return the rows of one stop by table, without the columns of run and stop."""
    rows: dict[str, list[Row]] = {name: [] for name in TABLES[2:]}
    rows["stops"].append(_stop_row(stop, cloud_url))
    R, sigma_heading = levelling_rotation(stop.cloud.levelling), stop.cloud.rig.sigma_heading
    for method, found in stop.fits.items():
        label = {"fit_method": method}
        matched = _matched(stop, method, names)
        for i, row in enumerate(_fit_rows(found.fits, R, sigma_heading)):
            rows["marker_fits"].append(label | {"mark": matched.get(i)} | row)
        rows["rejections"] += [
            label | _place(R @ r.p_base) | {"n_points": r.n_points, "reason": r.reason}
            for r in found.rejected
        ]
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
        "n_returns": len(cloud.p_base),
        "coverage_deg": np.degrees(cloud.coverage),
        "duration_s": cloud.duration,
        "roll_deg": np.degrees(cloud.levelling.roll),
        "pitch_deg": np.degrees(cloud.levelling.pitch),
        "sigma_levelling_deg": np.degrees(cloud.levelling.sigma),
        "sigma_heading_deg": np.degrees(cloud.rig.sigma_heading),
        "cloud_url": cloud_url,
        "notes": list(cloud.notes),
        "timings_s": json.dumps(dict(stop.timings)),
    }


def _fit_rows(fits: Sequence[MarkerFit], R: Array, sigma_heading: float) -> list[Row]:
    """Return rows of ``marker_fits`` without errors, method and mark; R levels the base."""
    p = np.array([fit.p_base for fit in fits]).reshape(-1, 3) @ R.T
    covs = np.array([fit.cov_with_heading(sigma_heading) for fit in fits]).reshape(-1, 3, 3)
    cov = (R @ covs @ R.T)[:, *_UPPER]
    sigmas = np.sqrt(np.trace(covs, axis1=1, axis2=2))
    azimuths = np.degrees(np.arctan2(p[:, 1], p[:, 0]))
    elevations = np.degrees(np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])))
    numbers = np.column_stack([p, cov, sigmas, azimuths, elevations]).tolist()
    return [
        dict(zip(_FIT_NUMBERS, row, strict=True)) | _fit_row(fit)
        for fit, row in zip(fits, numbers, strict=True)
    ]


def _fit_row(fit: MarkerFit) -> Row:
    """Return the columns of a fit beside its centre."""
    return {
        "marker": fit.name,
        "status": str(fit.status),
        "reason": fit.reason,
        "range_m": fit.mean_range,
        "n_points": fit.n_points,
        "n_rejected": len(fit.rejected),
        "n_rings": fit.n_rings,
        "coverage": fit.coverage,
        "rms_m": fit.rms,
        "sigma0": fit.sigma0,
        "radius_m": fit.radius,
        "radius_free_m": fit.radius_free,
        "sigma_radius_free_m": fit.sigma_radius_free,
        "mean_intensity": fit.mean_intensity,
        "incidence_deg": np.degrees(fit.incidence),
        "variant": fit.variant,
        "sigma_range_shared_m": fit.sigma_range_shared,
    }


def _fix_row(fix: StationFix | NoFix) -> Row:
    """Return the row of ``station_fixes`` without errors."""
    if isinstance(fix, NoFix):
        return {"status": "failed", "reason": fix.reason, "n_markers": 0}
    return {
        "status": str(fix.status),
        "reason": fix.reason,
        **_place(fix.p_site),
        "yaw_deg": np.degrees(fix.yaw),
        "rotation": fix.T_site_station[:3, :3].ravel().tolist(),
        **_cov(fix.cov_p_site),
        "cov_motion": fix.cov_T_site_station.ravel().tolist(),
        "sigma_3d_m": fix.sigma_3d,
        "sigma_yaw_deg": np.degrees(fix.sigma_yaw),
        **_ellipse(fix.ellipse),
        "n_markers": len(fix.matches),
        "dof": fix.dof,
        "sigma0": fix.sigma0,
        "passes_global_test": fix.passes_global_test,
        "included_angle_min_deg": np.degrees(fix.included_angles[0]),
        "included_angle_max_deg": np.degrees(fix.included_angles[1]),
    }


def _ellipse(ellipse: ErrorEllipse) -> Row:
    """Return an error ellipse as columns, standard and 95 %."""
    return {
        "ellipse_major_m": ellipse.major,
        "ellipse_minor_m": ellipse.minor,
        "ellipse_bearing_deg": np.degrees(ellipse.bearing),
        "ellipse_major_95_m": ellipse.major_95,
        "ellipse_minor_95_m": ellipse.minor_95,
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
        residual = dict(
            zip(
                ("residual_x_m", "residual_y_m", "residual_z_m"), fix.residuals_site[k], strict=True
            )
        )
        rows[i] |= {
            "mark": names[mark],
            "used": True,
            "reason": "",
            **residual,
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


def _place(p: Array) -> Row:
    """Return coordinates as columns."""
    return dict(zip(("x_m", "y_m", "z_m"), p, strict=True))


def _cov(cov: Array) -> Row:
    """Return the upper triangle of a covariance as columns."""
    return dict(zip(_COV, cov[_UPPER], strict=True))


def _table(name: str, rows: Sequence[Row]) -> pa.Table:
    """Return rows as an Arrow table in the shape of a table of the database."""
    return table_of(_COLUMNS[name], rows)


def _with_columns(table: pa.Table, errors: Sequence[Mapping[str, object]]) -> pa.Table:
    """Return a table with its error columns replaced; missing values are NULL."""
    for i, name in enumerate(table.column_names):
        if name.startswith("error_"):
            values = pa.array([plain(row.get(name)) for row in errors], _REAL)
            table = table.set_column(i, name, values)
    return table


def _without_errors(table: pa.Table) -> pa.Table:
    """Return a table with nothing in its error columns."""
    for i, name in enumerate(table.schema.names):
        if name.startswith("error_") and table.column(i).null_count < len(table):
            table = table.set_column(i, name, pa.nulls(len(table), _REAL))
    return table


def _levellings(known: Mapping[str, pa.Table]) -> dict[tuple[str, str], Levelling]:
    """Return the levelling of each stop of each run."""
    return {
        (row["run_id"], row["stop"]): Levelling(
            roll=np.radians(row["roll_deg"]),
            pitch=np.radians(row["pitch_deg"]),
            sigma=np.radians(row["sigma_levelling_deg"]),
            is_measured=True,
        )
        for row in known["stops"].to_pylist()
    }


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
            p_station = np.array(
                [[rows[i][axis] for axis in ("x_m", "y_m", "z_m")] for i in members]
            )
            R = levelling_rotation(levellings[run_id, stop])
            found = centre_errors(p_station @ R, truths[stop], marks)
            for k, i in enumerate(members):
                errors[i] = {
                    **_errors(R @ found.error_base[k]),
                    "error_radial_m": found.error_radial[k],
                    "error_3d_m": found.error_3d[k],
                }
    return errors


def _station_errors(row: Row, truth: StopTruth | None) -> Row:
    """Return the errors of a row of ``station_fixes``."""
    if truth is None or row["x_m"] is None:
        return {}
    error = station_error(_fix_of(row), truth)
    return {
        **_errors(error.error_site),
        "error_yaw_deg": np.degrees(error.error_yaw),
        "error_horizontal_m": np.hypot(*error.error_site[:2]),
        "error_3d_m": error.error_3d,
    }


def _errors(error: Array) -> Row:
    """Return an error as columns."""
    return dict(zip(_ERROR, error, strict=True))


def _fix_of(row: Row) -> StationFix:
    """Return the pose of a row of ``station_fixes``, without what made it."""
    R = np.array(row["rotation"]).reshape(3, 3)
    none = np.zeros(0)
    return StationFix(
        method=row["resection_method"],
        T_site_station=rigid(R, [row["x_m"], row["y_m"], row["z_m"]]),
        cov_T_site_station=np.full((6, 6), np.nan),
        cov_p_site=np.full((3, 3), np.nan),
        matches=np.zeros((0, 2), dtype=np.intp),
        residuals_site=np.zeros((0, 3)),
        redundancies=none,
        w_statistics=none,
        detectable_biases=none,
        external_reliabilities=none,
        dof=0,
        sigma0=np.nan,
        passes_global_test=True,
        included_angles=np.full(2, np.nan),
        status=Status(row["status"]),
        reason=row["reason"],
    )
