"""The result of a survey: its chosen solution, the checks of its uncertainty, and the decision."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.accuracy import acceptance
from spheremark.pipelines.accuracy.acceptance import Check, Compared, Decision, SolutionQuality
from spheremark.pipelines.model import Array
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.catalogue.solutions import Solution, chosen_solution

Columns = Mapping[str, NDArray[Any]]

_STATIONS = "SELECT * FROM chosen_stations WHERE survey_id = $id ORDER BY station"
_ADJUSTMENT = "SELECT * FROM adjustments WHERE adjustment_id = $id"
_NOT_IN = """
SELECT DISTINCT x.stop FROM stops AS x JOIN latest_runs AS r USING (run_id)
WHERE r.survey_id = $id AND NOT EXISTS (
    SELECT 1 FROM chosen_stations AS c
    WHERE c.survey_id = $id AND c.recording_id = r.recording_id AND c.stop = x.stop
) ORDER BY x.stop
"""
_CENTRES = """
SELECT m.stop || ' ' || m.marker AS name, m.run_id || m.stop AS scan, m.x_m, m.y_m,
    m.cov_xx_m2, m.cov_xy_m2, m.cov_xz_m2, m.cov_yy_m2, m.cov_yz_m2, m.cov_zz_m2,
    m.x_m / m.range_m AS unit_x, m.y_m / m.range_m AS unit_y, m.z_m / m.range_m AS unit_z,
    radians(x.sigma_heading_deg) AS sigma_heading,
    coalesce(m.sigma_range_shared_m, 0) AS sigma_range,
    m.error_x_m, m.error_y_m, m.error_z_m
FROM latest_marker_fits AS m JOIN stops AS x USING (run_id, stop)
WHERE m.survey_id = $id AND m.fit_method = $method AND m.error_3d_m IS NOT NULL
    AND m.cov_xx_m2 IS NOT NULL
ORDER BY m.stop, m.marker
"""
_NETWORK_RESIDUALS = """
SELECT concat_ws(' ', station, marker) AS name, residual_x_m, residual_y_m, residual_z_m,
    redundancy
FROM adjusted_observations
WHERE adjustment_id = $id AND kind = 'centre' AND used AND residual_x_m IS NOT NULL
"""
_STATION_RESIDUALS = """
SELECT o.stop || ' ' || o.marker AS name, o.residual_x_m, o.residual_y_m, o.residual_z_m,
    o.redundancy, o.stop
FROM observations AS o
JOIN chosen_stations AS c
    ON c.run_id = o.run_id AND c.stop = o.stop AND c.fit_method = o.fit_method
    AND c.resection_method = o.resection_method
WHERE c.survey_id = $id AND c.adjustment_id IS NULL AND o.used AND o.residual_x_m IS NOT NULL
"""
_CHECKS = "SELECT * FROM control_checks WHERE adjustment_id = $id ORDER BY mark"
_RESIDUAL = "residual"
_PARTS = ("xx", "xy", "xz", "xy", "yy", "yz", "xz", "yz", "zz")


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyResult:
    """The result of a survey.

    ``stations`` are rows of ``chosen_stations``; ``missing`` are stops that are not among them.
    """

    solution: Solution | None
    decision: Decision
    checks: tuple[Check, ...]
    stations: Columns
    missing: tuple[str, ...]


def survey_result(catalogue: Catalogue, survey: str) -> SurveyResult:
    """Return the chosen solution of a survey (id or name), its checks and the decision."""
    record = catalogue.get_survey(survey)
    key = {"id": record.survey_id}
    solution = chosen_solution(catalogue, record.survey_id)
    stations = catalogue.columns(_STATIONS, key)
    missing = tuple(catalogue.columns(_NOT_IN, key)["stop"].tolist())
    network = None
    if solution is not None and solution.adjustment_id is not None:
        network = catalogue.rows(_ADJUSTMENT, {"id": solution.adjustment_id})[0]
    checks = () if solution is None else _checks(catalogue, solution, stations, network)
    passes = stations["passes_global_test"]
    quality = SolutionQuality(
        stations=stations["station"].tolist(),
        sigmas_3d=stations["sigma_3d_m"].astype(np.float64),
        failed=[
            name
            for name, good in zip(stations["station"], passes, strict=True)
            if good is not None and not good
        ],
        missing=missing,
        control=next((one for one in checks if one.what == "control"), None),
        warnings=_warnings(stations, network),
        is_free=solution is not None and solution.is_free,
    )
    return SurveyResult(
        solution=solution,
        decision=acceptance.decide(quality, record.tolerance),
        checks=checks,
        stations=stations,
        missing=missing,
    )


def plain_result(result: SurveyResult) -> dict[str, Any]:
    """Return decision and checks as plain values, with the unit in each name."""
    solution = result.solution
    return {
        "solution": solution and solution.solution,
        "adjustment_id": solution and solution.adjustment_id,
        "fit_method": solution and solution.fit_method,
        "resection_method": solution and solution.resection_method,
        "status": result.decision.status,
        "sentence": result.decision.sentence,
        "reasons": list(result.decision.reasons),
        "missing_stops": list(result.missing),
        "checks": [
            {
                "what": one.what,
                "measure": one.measure,
                "n": one.n,
                "ratio_rms": one.ratio,
                "ratio_low": one.low,
                "ratio_high": one.high,
                "rms_m": one.rms,
                "largest_m": one.largest,
                "largest_at": one.where,
            }
            for one in result.checks
        ],
    }


def _warnings(stations: Columns, network: Mapping[str, Any] | None) -> tuple[str, ...]:
    """Return the weaknesses that a solution states itself."""
    if network is not None:
        return tuple(network["warnings"] or ())
    named = zip(stations["station"], stations["status"], stations["reason"], strict=True)
    return tuple(f"{name}: {reason}" for name, status, reason in named if status != "ok")


def _checks(
    catalogue: Catalogue, solution: Solution, stations: Columns, network: Mapping[str, Any] | None
) -> tuple[Check, ...]:
    """Return the checks of centres, stations and control, as far as they can be made."""
    errors = _vectors(stations, "error")
    known = np.isfinite(errors).all(axis=1)
    found = [_centres(catalogue, solution, stations, network)]
    if known.any():
        # stations of one survey share control and rig: their errors may be a single draw
        compared = Compared(stations["station"][known].tolist(), errors[known])
        covariances = _covariances(stations)[known]
        found.append(acceptance.check_errors("stations", compared, covariances, 3.0))
    found.append(_control(catalogue, solution, stations))
    return tuple(one for one in found if one is not None)


def _centres(
    catalogue: Catalogue, solution: Solution, stations: Columns, network: Mapping[str, Any] | None
) -> Check | None:
    """Return the check of centres: against truth if it is known, else by residuals."""
    key = {"id": solution.survey_id, "method": solution.fit_method}
    rows = catalogue.columns(_CENTRES, key)
    if not len(rows["name"]):  # of single stations the residuals are those at control
        return None if network is None else _residuals(catalogue, solution, stations, network)
    covariances = _covariances(rows)
    zero = np.zeros(len(rows["name"]))
    heading = np.stack([-rows["y_m"], rows["x_m"], zero], axis=1) * rows["sigma_heading"][:, None]
    line = np.stack([rows[f"unit_{axis}"] for axis in "xyz"], axis=1)
    shared = np.stack([heading, line * rows["sigma_range"][:, None]], axis=1)
    _, scans = np.unique(rows["scan"].astype(str), return_inverse=True)
    dof = acceptance.independent_coordinates(covariances, shared, scans)
    compared = Compared(rows["name"].tolist(), _vectors(rows, "error"))
    return acceptance.check_errors("centres", compared, covariances, dof)


def _residuals(
    catalogue: Catalogue, solution: Solution, stations: Columns, network: Mapping[str, Any] | None
) -> Check | None:
    """Return the check of centres by their residuals, over the redundancy of all."""
    if network is not None:
        rows = catalogue.columns(_NETWORK_RESIDUALS, {"id": solution.adjustment_id})
        factor, dof = network["variance_factor_centres"], float(np.nansum(rows["redundancy"]))
    else:
        rows = catalogue.columns(_STATION_RESIDUALS, {"id": solution.survey_id})
        dofs = np.nan_to_num(stations["dof"].astype(np.float64))
        sigma0 = np.nan_to_num(stations["sigma0"].astype(np.float64))
        dof = float(dofs.sum())
        factor = float(np.sum(dofs * sigma0**2) / dof) if dof else None
    if not len(rows["name"]):
        return None
    ratio = float("nan") if factor is None else float(np.sqrt(factor))
    compared = Compared(rows["name"].tolist(), _vectors(rows, "residual"))
    return acceptance.check_of("centres", _RESIDUAL, compared, ratio, dof)


def _control(catalogue: Catalogue, solution: Solution, stations: Columns) -> Check | None:
    """Return the check of control: marks left out in turn, or residuals of single stations."""
    if solution.is_free:
        return None
    if solution.adjustment_id is not None:
        rows = catalogue.columns(_CHECKS, {"id": solution.adjustment_id})
        if not len(rows["mark"]):
            return None
        sigmas = _vectors(rows, "sigma")
        return acceptance.check_control(rows["mark"].tolist(), _vectors(rows, "difference"), sigmas)
    found = _residuals(catalogue, solution, stations, None)
    return found and replace(found, what="control")


def _vectors(rows: Columns, name: str) -> Array:
    """Return three columns as vectors."""
    columns = [rows[f"{name}_{axis}_m"].astype(np.float64) for axis in "xyz"]
    return np.stack(columns, axis=1)


def _covariances(rows: Columns) -> Array:
    """Return the covariances of rows, (n, 3, 3)."""
    columns = [rows[f"cov_{part}_m2"].astype(np.float64) for part in _PARTS]
    return np.stack(columns, axis=1).reshape(-1, 3, 3)
