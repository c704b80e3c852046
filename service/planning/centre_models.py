"""The planner's model of centres from the results of surveys, wherever they are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from spheremark.pipelines.errors import InputError, NotFoundError
from spheremark.pipelines.placement import CentreModel, FitRows, Sensor, fitted_model, sensor_model

ROWS_MOST = 5_000
"""Fits that a model is made from at most: the newest."""

Query = Callable[[str], dict[str, Any]]
"""Executes one SELECT; returns ``columns`` and ``rows`` as ``POST /api/v1/sql`` does."""

_NUMBERS = (
    *("range_m", "n_points", "incidence_deg", "mean_intensity", "x_m", "y_m", "z_m"),
    *(f"cov_{axes}_m2" for axes in ("xx", "xy", "xz", "yy", "yz", "zz")),
    *("sigma_heading_deg", "duration_s", "dof", "sigma0"),
)
_SQL = """
WITH newest AS (
    SELECT r.*, row_number() OVER (PARTITION BY survey_id, recording_id ORDER BY finished_at DESC)
        AS age
    FROM runs AS r
)
SELECT v.name AS survey, r.finished_at, f.run_id || '/' || f.stop AS stop_key, f.range_m,
    f.n_points, f.incidence_deg, f.mean_intensity, f.x_m, f.y_m, f.z_m, f.cov_xx_m2, f.cov_xy_m2,
    f.cov_xz_m2, f.cov_yy_m2, f.cov_yz_m2, f.cov_zz_m2, s.sigma_heading_deg, s.duration_s, x.dof,
    x.sigma0
FROM marker_fits AS f
JOIN newest AS r ON r.run_id = f.run_id AND r.age = 1
JOIN surveys AS v ON v.survey_id = r.survey_id
JOIN stops AS s ON s.run_id = f.run_id AND s.stop = f.stop
LEFT JOIN station_fixes AS x ON x.run_id = f.run_id AND x.stop = f.stop
    AND x.fit_method = f.fit_method AND x.resection_method = 'free_station'
WHERE f.status = 'ok' AND f.mark IS NOT NULL AND f.fit_method = '{method}'
    AND f.cov_xx_m2 IS NOT NULL AND abs(f.radius_m - {radius}) < 0.001
    AND ('{survey}' = '' OR v.name = '{survey}' OR v.survey_id = '{survey}')
ORDER BY r.finished_at DESC, f.run_id, f.stop, f.marker
LIMIT {most}
"""
_KNOWN = "SELECT name FROM surveys WHERE name = '{survey}' OR survey_id = '{survey}'"
_NAME_MOST = 200  # characters


def model_of(
    query: Query | None,
    sensor: Sensor,
    radius: float,
    survey: str = "",
    fit_method: str = "along_beam",
) -> CentreModel:
    """Return the model of surveys; that of the sensor without results or with too few fits."""
    rows = query and read_fit_rows(query, radius, survey=survey, fit_method=fit_method)
    return fitted_model(sensor, radius, rows) if rows else sensor_model(sensor, radius)


def require_survey(query: Query, survey: str) -> None:
    """Raise NotFoundError for a survey that does not exist; no name means all surveys."""
    if survey and not query(_KNOWN.format(survey=quoted(survey)))["rows"]:
        raise NotFoundError(f"There is no survey {survey!r} whose fits could be taken.")


def read_fit_rows(query: Query, radius: float, *, survey: str, fit_method: str) -> FitRows | None:
    """Return the newest fits of surveys, if there are any."""
    if len(survey) > _NAME_MOST:
        raise InputError(f"The name of the survey has {len(survey)} characters.")
    sql = _SQL.format(
        method=quoted(fit_method), survey=quoted(survey), radius=float(radius), most=ROWS_MOST
    )
    found = query(sql)
    if not found["rows"]:
        return None
    names = [column["name"] for column in found["columns"]]
    columns = dict(zip(names, zip(*found["rows"], strict=True), strict=True))
    numbers = {
        name: np.array([np.nan if v is None else v for v in columns[name]], dtype=np.float64)
        for name in _NUMBERS
    }
    _, stops = np.unique(np.array(columns["stop_key"]), return_inverse=True)
    return FitRows(
        ranges=numbers["range_m"],
        n_points=numbers["n_points"],
        incidences=np.radians(numbers["incidence_deg"]),
        intensities=numbers["mean_intensity"],
        variances=_variances(numbers),
        turns=numbers["duration_s"],
        stops=stops.astype(np.intp),
        dof=numbers["dof"],
        sigma0=numbers["sigma0"],
        surveys=tuple(sorted(set(columns["survey"]))),
        fit_method=fit_method,
        newest=str(max(columns["finished_at"])),
    )


def quoted(text: str) -> str:
    """Return a text escaped for a literal of SQL."""
    return text.replace("'", "''")


def _variances(numbers: dict[str, np.ndarray]) -> np.ndarray:
    """Return variances towards, left and up, without that of the heading [m^2]."""
    p = np.column_stack([numbers["x_m"], numbers["y_m"], numbers["z_m"]])
    keys = (("xx", "xy", "xz"), ("xy", "yy", "yz"), ("xz", "yz", "zz"))
    cov = np.stack(
        [np.stack([numbers[f"cov_{key}_m2"] for key in row], axis=-1) for row in keys], axis=-2
    )
    towards = p / np.linalg.norm(p, axis=1, keepdims=True)
    flat = np.hypot(p[:, 0], p[:, 1])
    left = np.column_stack([-p[:, 1], p[:, 0], np.zeros(len(p))]) / flat[:, None]
    axes = np.stack([towards, left, np.cross(towards, left)], axis=1)
    variances = np.einsum("nij,njk,nik->ni", axes, cov, axes)
    heading2 = (np.radians(numbers["sigma_heading_deg"]) * flat) ** 2
    variances[:, 1] = np.maximum(variances[:, 1] - heading2, 0.05 * variances[:, 1])
    return np.asarray(variances)
