"""The result of a survey: its chosen solution, the checks of its uncertainty, and the decision."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.accuracy import acceptance
from spheremark.pipelines.accuracy.acceptance import (
    Check,
    Compared,
    Decision,
    Lengths,
    SolutionQuality,
)
from spheremark.pipelines.model import Array
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.catalogue.rows import natural
from spheremark.storage.catalogue.solutions import Solution, chosen_solution

Columns = Mapping[str, NDArray[Any]]

_STATIONS = """
SELECT * FROM chosen_stations WHERE survey_id = $id ORDER BY {natural}
""".replace("{natural}", natural("station"))
_ADJUSTMENT = "SELECT * FROM adjustments WHERE adjustment_id = $id"
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
_CHECKS = "SELECT * FROM control_checks WHERE adjustment_id = $id ORDER BY mark"
_SOLUTIONS = "SELECT * FROM chosen_solutions WHERE list_contains($ids::VARCHAR[], survey_id)"
_DECISIVE = """
SELECT survey_id, recording_id, run_id, stop, fit_method, resection_method, adjustment_id, station,
    passes_global_test, dof, sigma0, status, reason,
    cov_xx_m2, cov_xy_m2, cov_xz_m2, cov_yy_m2, cov_yz_m2, cov_zz_m2
FROM chosen_stations WHERE list_contains($ids::VARCHAR[], survey_id) ORDER BY survey_id, station
"""
_MISSING = """
SELECT r.survey_id, list_sort(list(DISTINCT x.stop)) AS stops
FROM stops AS x JOIN latest_runs AS r USING (run_id)
ANTI JOIN (
    SELECT unnest($survey_id::VARCHAR[]) AS survey_id,
        unnest($recording_id::VARCHAR[]) AS recording_id, unnest($stop::VARCHAR[]) AS stop
) AS c ON c.survey_id = r.survey_id AND c.recording_id = r.recording_id AND c.stop = x.stop
WHERE list_contains($ids::VARCHAR[], r.survey_id) GROUP BY r.survey_id
"""
_RESIDUAL_SUMS = """
SELECT c.survey_id, count(*) AS n, max(length_m) AS largest_m, sqrt(avg(length_m ^ 2)) AS rms_m,
    arg_max(name, length_m) AS worst
FROM (
    SELECT *, stop || ' ' || marker AS name,
        sqrt(residual_x_m ^ 2 + residual_y_m ^ 2 + residual_z_m ^ 2) AS length_m
    FROM observations WHERE used AND residual_x_m IS NOT NULL
) AS o
JOIN (
    SELECT unnest($survey_id::VARCHAR[]) AS survey_id, unnest($run_id::VARCHAR[]) AS run_id,
        unnest($stop::VARCHAR[]) AS stop, unnest($fit_method::VARCHAR[]) AS fit_method,
        unnest($resection_method::VARCHAR[]) AS resection_method
) AS c USING (run_id, stop, fit_method, resection_method)
GROUP BY c.survey_id
"""
_OF_STOPS = ("survey_id", "recording_id", "stop")
_OF_FIXES = ("survey_id", "run_id", "stop", "fit_method", "resection_method")
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
    key = catalogue.id_of_survey(survey)
    return catalogue.computed(("survey_result", key), lambda: _survey_result(catalogue, key))


def _survey_result(catalogue: Catalogue, survey_id: str) -> SurveyResult:
    """Compute the result of a survey."""
    record, key = catalogue.get_survey(survey_id), {"id": survey_id}
    solution = chosen_solution(catalogue, survey_id)
    stations = catalogue.columns(_STATIONS, key)
    network = _network(catalogue, solution)
    missing = tuple(_missing(catalogue, [survey_id], stations).get(survey_id, ()))
    residuals = _residual_sums(catalogue, stations).get(survey_id)
    control = _control(catalogue, solution, stations, residuals)
    return SurveyResult(
        solution=solution,
        decision=acceptance.decide(
            _quality(solution, stations, missing, control, network), record.tolerance
        ),
        checks=() if solution is None else _checks(catalogue, solution, stations, network, control),
        stations=stations,
        missing=missing,
    )


def survey_decisions(
    catalogue: Catalogue, tolerances: Mapping[str, float]
) -> dict[str, tuple[Solution | None, Decision]]:
    """Return chosen solution and decision of each survey in ``tolerances`` (id to metres).

    The same as ``survey_result`` decides, by a few queries over all surveys.
    """
    return catalogue.computed(
        ("survey_decisions", tuple(tolerances.items())),
        lambda: _survey_decisions(catalogue, tolerances),
    )


def _survey_decisions(
    catalogue: Catalogue, tolerances: Mapping[str, float]
) -> dict[str, tuple[Solution | None, Decision]]:
    """Compute chosen solution and decision of each survey."""
    ids = {"ids": list(tolerances)}
    solutions = {row["survey_id"]: Solution(**row) for row in catalogue.rows(_SOLUTIONS, ids)}
    stations = catalogue.columns(_DECISIVE, ids)
    owners = stations["survey_id"].astype(str)
    missing = _missing(catalogue, ids["ids"], stations)
    sums = _residual_sums(catalogue, stations)
    found = {}
    for name, tolerance in tolerances.items():
        solution = solutions.get(name)
        own = slice(*(np.searchsorted(owners, name, side) for side in ("left", "right")))
        columns = {column: values[own] for column, values in stations.items()}
        control = _control(catalogue, solution, columns, sums.get(name))
        network = _network(catalogue, solution)
        quality = _quality(solution, columns, missing.get(name, ()), control, network)
        found[name] = solution, acceptance.decide(quality, tolerance)
    return found


def _missing(
    catalogue: Catalogue, surveys: Sequence[str], stations: Columns
) -> dict[str, Sequence[str]]:
    """Return the stops of each survey (id) that are not among its chosen stations."""
    keys = {name: stations[name].tolist() for name in _OF_STOPS}
    rows = catalogue.rows(_MISSING, keys | {"ids": list(surveys)})
    return {row["survey_id"]: row["stops"] for row in rows}


def _residual_sums(catalogue: Catalogue, stations: Columns) -> dict[str, dict[str, Any]]:
    """Return the residuals of single stations at control, summed by survey (id)."""
    single = np.array([one is None for one in stations["adjustment_id"]], dtype=bool)
    if not single.any():
        return {}
    keys = {name: stations[name][single].tolist() for name in _OF_FIXES}
    return {row["survey_id"]: row for row in catalogue.rows(_RESIDUAL_SUMS, keys)}


def _network(catalogue: Catalogue, solution: Solution | None) -> Mapping[str, Any] | None:
    """Return the adjustment of a solution; None of single stations."""
    if solution is None or solution.adjustment_id is None:
        return None
    return catalogue.rows(_ADJUSTMENT, {"id": solution.adjustment_id})[0]


def _quality(
    solution: Solution | None,
    stations: Columns,
    missing: Sequence[str],
    control: Check | None,
    network: Mapping[str, Any] | None,
) -> SolutionQuality:
    """Return what the decision on a solution depends on."""
    tested = zip(stations["station"], stations["passes_global_test"], strict=True)
    return SolutionQuality(
        stations=stations["station"].tolist(),
        covariances=_covariances(stations),
        failed=[name for name, good in tested if good is not None and not good],
        missing=missing,
        control=control,
        warnings=_warnings(stations, network),
        is_free=solution is not None and solution.is_free,
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
    catalogue: Catalogue,
    solution: Solution,
    stations: Columns,
    network: Mapping[str, Any] | None,
    control: Check | None,
) -> tuple[Check, ...]:
    """Return the checks of centres, stations and control, as far as they can be made."""
    errors = _vectors(stations, "error")
    known = np.isfinite(errors).all(axis=1)
    found = [_centres(catalogue, solution, network)]
    if known.any():
        # stations of one survey share control and rig: their errors may be a single draw
        compared = Compared(stations["station"][known].tolist(), errors[known])
        found.append(
            acceptance.check_errors("stations", compared, _covariances(stations)[known], 3.0)
        )
    found.append(control)
    return tuple(one for one in found if one is not None)


def _centres(
    catalogue: Catalogue, solution: Solution, network: Mapping[str, Any] | None
) -> Check | None:
    """Return the check of centres: against truth if it is known, else by residuals."""
    key = {"id": solution.survey_id, "method": solution.fit_method}
    rows = catalogue.columns(_CENTRES, key)
    if not len(rows["name"]):  # of single stations the residuals are those at control
        return None if network is None else _residuals(catalogue, network)
    covariances = _covariances(rows)
    zero = np.zeros(len(rows["name"]))
    heading = np.stack([-rows["y_m"], rows["x_m"], zero], axis=1) * rows["sigma_heading"][:, None]
    line = np.stack([rows[f"unit_{axis}"] for axis in "xyz"], axis=1)
    shared = np.stack([heading, line * rows["sigma_range"][:, None]], axis=1)
    _, scans = np.unique(rows["scan"].astype(str), return_inverse=True)
    dof = acceptance.independent_coordinates(covariances, shared, scans)
    compared = Compared(rows["name"].tolist(), _vectors(rows, "error"))
    return acceptance.check_errors("centres", compared, covariances, dof)


def _residuals(catalogue: Catalogue, network: Mapping[str, Any]) -> Check | None:
    """Return the check of the centres of a network by their residuals, over the redundancy."""
    rows = catalogue.columns(_NETWORK_RESIDUALS, {"id": network["adjustment_id"]})
    if not len(rows["name"]):
        return None
    factor, dof = network["variance_factor_centres"], float(np.nansum(rows["redundancy"]))
    ratio = float("nan") if factor is None else float(np.sqrt(factor))
    lengths = acceptance.lengths_of(Compared(rows["name"].tolist(), _vectors(rows, "residual")))
    return acceptance.check_of("centres", _RESIDUAL, lengths, ratio, dof)


def _control(
    catalogue: Catalogue,
    solution: Solution | None,
    stations: Columns,
    residuals: Mapping[str, Any] | None,
) -> Check | None:
    """Return the check of control: marks left out in turn, or residuals of single stations."""
    if solution is None or solution.is_free:
        return None
    if solution.adjustment_id is not None:
        rows = catalogue.columns(_CHECKS, {"id": solution.adjustment_id})
        if not len(rows["mark"]):
            return None
        sigmas = _vectors(rows, "sigma")
        return acceptance.check_control(rows["mark"].tolist(), _vectors(rows, "difference"), sigmas)
    if residuals is None:
        return None
    dofs = np.nan_to_num(stations["dof"].astype(np.float64))
    sigma0 = np.nan_to_num(stations["sigma0"].astype(np.float64))
    dof = float(dofs.sum())
    ratio = float(np.sqrt(np.sum(dofs * sigma0**2) / dof)) if dof else float("nan")
    sizes = (residuals[name] for name in ("n", "rms_m", "largest_m", "worst"))
    return acceptance.check_of("control", _RESIDUAL, Lengths(*sizes), ratio, dof)


def _vectors(rows: Columns, name: str) -> Array:
    """Return three columns as vectors."""
    columns = [rows[f"{name}_{axis}_m"].astype(np.float64) for axis in "xyz"]
    return np.stack(columns, axis=1)


def _covariances(rows: Columns) -> Array:
    """Return the covariances of rows, (n, 3, 3)."""
    columns = [rows[f"cov_{part}_m2"].astype(np.float64) for part in _PARTS]
    return np.stack(columns, axis=1).reshape(-1, 3, 3)
