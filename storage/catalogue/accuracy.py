"""Accuracy over surveys, aggregated by the database: bins, quantiles, the worst rows by name.

No query returns a row for each centre: the size of an answer does not grow with the surveys. The
texts are static; ``as_text`` writes the values into a query for a person to run again.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from spheremark.storage.catalogue.database import Database
from spheremark.storage.catalogue.rows import natural

N_WORST = 12  # rows of each bin that keep their names

# root mean square of an error whitened by its covariance (adjugate over determinant)
_WHITENED = """sqrt(greatest((error_x_m ^ 2 * (cov_yy_m2 * cov_zz_m2 - cov_yz_m2 ^ 2)
        + error_y_m ^ 2 * (cov_xx_m2 * cov_zz_m2 - cov_xz_m2 ^ 2)
        + error_z_m ^ 2 * (cov_xx_m2 * cov_yy_m2 - cov_xy_m2 ^ 2)
        + 2 * error_x_m * error_y_m * (cov_xz_m2 * cov_yz_m2 - cov_xy_m2 * cov_zz_m2)
        + 2 * error_x_m * error_z_m * (cov_xy_m2 * cov_yz_m2 - cov_xz_m2 * cov_yy_m2)
        + 2 * error_y_m * error_z_m * (cov_xy_m2 * cov_xz_m2 - cov_xx_m2 * cov_yz_m2))
        / nullif(3 * (cov_xx_m2 * (cov_yy_m2 * cov_zz_m2 - cov_yz_m2 ^ 2)
            - cov_xy_m2 * (cov_xy_m2 * cov_zz_m2 - cov_yz_m2 * cov_xz_m2)
            + cov_xz_m2 * (cov_xy_m2 * cov_yz_m2 - cov_yy_m2 * cov_xz_m2)), 0), 0))"""
_FITS = """
SELECT {place}s.name AS survey, r.recording_id, m.run_id, m.stop, m.fit_method, m.marker, m.mark,
    m.status, m.reason, m.range_m, m.n_points, m.incidence_deg, m.sigma_3d_m, m.error_3d_m,
    m.error_radial_m, {whitened} AS error_over_sigma,
    CASE WHEN $is_error THEN m.error_3d_m ELSE m.sigma_3d_m END AS value_m
FROM marker_fits AS m JOIN latest_runs AS r USING (run_id) JOIN surveys AS s USING (survey_id)
WHERE (len($surveys::VARCHAR[]) = 0 OR list_contains($surveys::VARCHAR[], s.name))
    AND (len($methods::VARCHAR[]) = 0 OR list_contains($methods::VARCHAR[], m.fit_method))
    AND ($stop = '' OR m.stop = $stop) AND ($status = '' OR m.status = $status)
    AND m.range_m BETWEEN $range_from_m AND $range_to_m
    AND m.n_points BETWEEN $count_from AND $count_to
    AND coalesce(m.incidence_deg, 0) BETWEEN $incidence_from_deg AND $incidence_to_deg
""".replace("{whitened}", _WHITENED)
FITS = _FITS.replace("{place}", "")
"""The centres of a selection: of newest runs, with error or predicted sigma as ``value_m``."""

_PLACED = _FITS.replace("{place}", "m.rowid AS place, ")

# names are read for the worst rows alone: with each row they take twice the time of all the rest
_BINNED = """
WITH bins AS (
    SELECT fit_method, {low} AS bin_from, {high} AS bin_to, count(*) AS n,
        count(DISTINCT hash(run_id, stop)) AS n_stops, avg({x}) AS mean_x,
        quantile_cont(value_m, [0.025, 0.5, 0.95, 0.975]) AS quantiles_m,
        sqrt(avg(value_m ^ 2)) AS rms_m, sqrt(avg(sigma_3d_m ^ 2)) AS sigma_rms_m,
        arg_max(place, value_m, {n_worst}) AS places
    FROM ({rows}) WHERE value_m IS NOT NULL AND {x} IS NOT NULL GROUP BY ALL
), worst AS (
    SELECT b.fit_method, b.bin_from, list({{'survey': survey, 'stop': stop, 'marker': marker,
        'x': {x}, 'value_m': value_m, 'status': status}} ORDER BY value_m DESC, place) AS worst
    FROM (SELECT fit_method, bin_from, unnest(places) AS place FROM bins) AS b
        JOIN ({rows}) AS x USING (place) GROUP BY ALL
)
SELECT fit_method, bin_from, bin_to, n, n_stops, mean_x, quantiles_m[1] AS p025_m,
    quantiles_m[2] AS median_m, quantiles_m[3] AS p95_m, quantiles_m[4] AS p975_m, rms_m,
    sigma_rms_m, worst
FROM bins JOIN worst USING (fit_method, bin_from) ORDER BY fit_method, bin_from
"""
_PAIRS = """
SELECT s.name AS survey, x.rowid AS place, x.run_id, x.stop, x.fit_method,
    array_to_string(x.marks, ' + ') AS marker,
    '' AS status, x.included_angle_max_deg, x.sigma_horizontal_m AS sigma_3d_m,
    CASE WHEN $is_error THEN x.error_horizontal_m ELSE x.sigma_horizontal_m END AS value_m
FROM resections AS x JOIN latest_runs AS r USING (run_id) JOIN surveys AS s USING (survey_id)
WHERE (len($surveys::VARCHAR[]) = 0 OR list_contains($surveys::VARCHAR[], s.name))
    AND (len($methods::VARCHAR[]) = 0 OR list_contains($methods::VARCHAR[], x.fit_method))
    AND ($stop = '' OR x.stop = $stop)
    AND x.n_marks = $n_marks AND x.resection_method = $resection
"""


def _binned(rows: str, x: str, low: str, high: str) -> str:
    """Return the query of the bins of a variable."""
    return _BINNED.format(rows=rows.strip(), x=x, low=low, high=high, n_worst=N_WORST)


def _on_fits(sql: str) -> str:
    """Return a query on the centres of a selection."""
    return sql.replace("{fits}", FITS.strip())


# 3000 errors of each method for a model, of whole stops; 600 stations of a map, 60 surveys of a
# figure: more are neither legible nor fast
QUERIES: Mapping[str, str] = {
    "distance": _binned(_PLACED, "range_m", "floor(range_m)", "floor(range_m) + 1"),
    "count": _binned(
        _PLACED,
        "n_points",
        "floor(10 ^ (floor(6 * log10(greatest(n_points, 1)) + 1e-9) / 6))",
        "floor(10 ^ ((floor(6 * log10(greatest(n_points, 1)) + 1e-9) + 1) / 6))",
    ),
    "incidence": _binned(
        _PLACED, "incidence_deg", "2 * floor(incidence_deg / 2)", "2 * floor(incidence_deg / 2) + 2"
    ),
    "angle": _binned(
        _PAIRS,
        "included_angle_max_deg",
        "10 * floor(included_angle_max_deg / 10)",
        "10 * floor(included_angle_max_deg / 10) + 10",
    ),
    "distribution": _on_fits("""
SELECT fit_method, count(*) AS n, count(DISTINCT (run_id, stop)) AS n_stops,
    count(*) FILTER (value_m <= $tolerance_m) AS n_within, max(value_m) AS largest_m,
    sqrt(avg(value_m ^ 2)) AS rms_m, quantile_cont(value_m, 0.5) AS median_m,
    quantile_cont(value_m, 0.95) AS p95_m, sqrt(avg(error_over_sigma ^ 2)) AS ratio_rms,
    quantile_cont(value_m, [0.005, 0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35,
        0.4, 0.45, 0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.93, 0.95, 0.97, 0.98, 0.99,
        0.995]) AS quantiles_m
FROM ({fits}) WHERE value_m IS NOT NULL GROUP BY ALL ORDER BY fit_method
"""),
    "surveys": _on_fits("""
SELECT survey, fit_method, count(*) AS n, count(DISTINCT (run_id, stop)) AS n_stops,
    quantile_cont(value_m, 0.025) AS p025_m, quantile_cont(value_m, 0.5) AS median_m,
    quantile_cont(value_m, 0.95) AS p95_m, quantile_cont(value_m, 0.975) AS p975_m,
    sqrt(avg(value_m ^ 2)) AS rms_m, sqrt(avg(sigma_3d_m ^ 2)) AS sigma_rms_m,
    max(value_m) AS largest_m
FROM ({fits}) WHERE value_m IS NOT NULL GROUP BY survey, fit_method
QUALIFY dense_rank() OVER (ORDER BY survey) <= 60 ORDER BY survey, fit_method
"""),
    "within": _on_fits("""
WITH fits AS ({fits} AND value_m IS NOT NULL), edges AS (
    SELECT unnest($edges_m::DOUBLE[]) AS range_from_m
), parts AS (
    SELECT f.fit_method, e.range_from_m, f.run_id, f.stop, count(*) AS n,
        count(*) FILTER (f.value_m <= $tolerance_m) AS k, max(f.range_m) AS farthest_m
    FROM fits AS f ASOF JOIN edges AS e ON f.range_m >= e.range_from_m GROUP BY ALL
)
SELECT fit_method, range_from_m, max(farthest_m) AS range_to_m, sum(n) AS n, sum(k) AS n_within,
    count(*) AS n_stops, sum(k * k) AS kk, sum(k * n) AS kn, sum(n * n) AS nn
FROM parts GROUP BY ALL ORDER BY fit_method, range_from_m
"""),
    "model": _on_fits("""
WITH fits AS ({fits} AND m.error_3d_m IS NOT NULL), sizes AS (
    SELECT fit_method, count(*) AS n_all FROM fits GROUP BY ALL
)
SELECT fit_method, run_id || stop AS stop, range_m, n_points, incidence_deg, error_3d_m
FROM fits JOIN sizes USING (fit_method)
WHERE n_all <= 3000 OR hash(run_id, stop) % 1000003 <= 1000003.0 * 3000 / n_all
ORDER BY ALL
"""),
    "map": _on_fits("""
WITH fixes AS (
    SELECT s.name AS survey, f.stop, f.fit_method, f.resection_method, f.status, f.reason,
        f.x_m, f.y_m, f.z_m, f.sigma_3d_m, sqrt(f.cov_zz_m2) AS sigma_z_m, f.ellipse_major_95_m,
        f.ellipse_minor_95_m, f.ellipse_bearing_deg, f.n_markers, f.error_x_m, f.error_y_m,
        f.error_z_m, f.error_3d_m
    FROM station_fixes AS f JOIN latest_runs AS r USING (run_id) JOIN surveys AS s USING (survey_id)
    WHERE (len($surveys::VARCHAR[]) = 0 OR list_contains($surveys::VARCHAR[], s.name))
        AND (len($methods::VARCHAR[]) = 0 OR list_contains($methods::VARCHAR[], f.fit_method))
        AND ($stop = '' OR f.stop = $stop) AND ($status = '' OR f.status = $status)
        AND f.x_m IS NOT NULL AND f.resection_method = $resection
)
SELECT *, count(*) OVER () AS n_all FROM fixes
ORDER BY coalesce(error_3d_m, sigma_3d_m) DESC, survey, stop, fit_method LIMIT 600
"""),
    "solution": """
SELECT * FROM (
    SELECT survey, station, stop, solution, x_m, y_m, z_m, sigma_3d_m, sqrt(cov_zz_m2) AS sigma_z_m,
        ellipse_major_95_m, ellipse_minor_95_m, ellipse_bearing_deg, error_x_m, error_y_m,
        error_z_m, error_3d_m, count(*) OVER () AS n_all
    FROM chosen_stations
    WHERE len($surveys::VARCHAR[]) = 0 OR list_contains($surveys::VARCHAR[], survey)
    ORDER BY coalesce(error_3d_m, sigma_3d_m) DESC, survey, station LIMIT 600
) ORDER BY survey, {natural}
""".replace("{natural}", natural("station")),
    "marks": """
SELECT s.name AS survey, c.mark, c.x_m, c.y_m, c.z_m
FROM control_marks AS c JOIN surveys AS s USING (survey_id)
WHERE len($surveys::VARCHAR[]) = 0 OR list_contains($surveys::VARCHAR[], s.name)
ORDER BY survey, c.place LIMIT 500
""",
}
"""Static queries by the name of what they answer; they take the parameters of a ``Selection``."""

TABLES: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "centres": (FITS, ("survey", "stop", "fit_method", "marker")),
    "stops": (
        _on_fits("""
SELECT a.*, f.status AS station_status, f.reason AS station_reason, f.x_m, f.y_m, f.z_m,
    f.sigma_3d_m AS station_sigma_3d_m, f.error_3d_m AS station_error_3d_m
FROM (
    SELECT survey, recording_id, run_id, stop, fit_method, count(*) AS n_markers,
        count(*) FILTER (mark IS NULL) AS n_on_no_mark, avg(range_m) AS mean_range_m,
        sqrt(avg(sigma_3d_m ^ 2)) AS sigma_rms_m, sqrt(avg(error_3d_m ^ 2)) AS error_rms_m,
        max(error_3d_m) AS error_max_m
    FROM ({fits}) GROUP BY ALL
) AS a LEFT JOIN station_fixes AS f ON f.run_id = a.run_id AND f.stop = a.stop
    AND f.fit_method = a.fit_method AND f.resection_method = $resection
"""),
        ("survey", "stop", "fit_method"),
    ),
    "surveys": (QUERIES["surveys"].partition("QUALIFY")[0], ("survey", "fit_method")),
}
"""Tables that are read in pages: a query and the columns that order rows of equal value."""

_HAS_ERRORS = """
SELECT EXISTS (
    SELECT 1 FROM marker_fits AS m JOIN latest_runs AS r USING (run_id)
        JOIN surveys AS s USING (survey_id)
    WHERE m.error_3d_m IS NOT NULL
        AND (len($surveys::VARCHAR[]) = 0 OR list_contains($surveys::VARCHAR[], s.name))
) AS has_errors
"""
_EDGES = _on_fits("""
SELECT quantile_disc(range_m, [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9]) AS edges_m
FROM ({fits}) WHERE value_m IS NOT NULL
""")
_PARAMETER = re.compile(r"\$([a-z]\w*)")


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """Which results are aggregated; an empty value does not restrict.

    Attributes
    ----------
    surveys, methods : tuple of str
        Names of surveys and of fitting methods.
    tolerance_m : float
        Error that is accepted, for shares within it.
    n_marks, resection
        Size of the subsets of marks, and the method that positioned from them.
    """

    surveys: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    stop: str = ""
    status: str = ""
    range_from_m: float = 0.0
    range_to_m: float = 1e9
    count_from: float = 0.0
    count_to: float = 1e12
    incidence_from_deg: float = 0.0
    incidence_to_deg: float = 180.0
    tolerance_m: float = 0.03
    n_marks: int = 2
    resection: str = "free_station"


def parameters(database: Database, selection: Selection) -> dict[str, Any]:
    """Return the values that the queries take.

    Parameters
    ----------
    database : Database
        Decides whether errors are known; without any, predicted sigmas are aggregated.
    selection : Selection
        Which results.

    Returns
    -------
    dict
        Values by the names of the parameters, ``is_error`` among them.
    """
    chosen = {name: getattr(selection, name) for name in Selection.__slots__}
    chosen |= {name: list(chosen[name]) for name in ("surveys", "methods")}
    known = {"surveys": chosen["surveys"]}
    found = database.computed(
        ("has_errors", selection.surveys), lambda: database.rows(_HAS_ERRORS, known)
    )
    return chosen | {"is_error": bool(found[0]["has_errors"])}


def edges(database: Database, values: Mapping[str, Any]) -> list[float]:
    """Return the lower ends of ten bins of distance with equally many centres.

    Parameters
    ----------
    database : Database
        The results.
    values : mapping
        As ``parameters`` gives them.

    Returns
    -------
    list of float
        Ascending [m]; empty without any centre.
    """
    found = database.rows(_EDGES, used_by(_EDGES, values))[0]["edges_m"]
    return sorted(set(found or ()))


def used_by(sql: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values that a query takes.

    Parameters
    ----------
    sql : str
        A query.
    values : mapping
        Values by name, perhaps more.

    Returns
    -------
    dict
        Those of the query: DuckDB refuses others.
    """
    return {name: values[name] for name in dict.fromkeys(_PARAMETER.findall(sql))}


def as_text(sql: str, values: Mapping[str, Any]) -> str:
    """Return a query with its values written into it, for a person to run again.

    Parameters
    ----------
    sql : str
        A query with parameters.
    values : mapping
        Their values.

    Returns
    -------
    str
        A query without parameters.
    """
    return _PARAMETER.sub(lambda found: _literal(values[found[1]]), sql).strip()


def _literal(value: object) -> str:
    """Return a value as SQL writes it."""
    if isinstance(value, str):
        return "'" + value.replace("'", "''") + "'"
    if isinstance(value, list):
        return f"[{', '.join(map(_literal, value))}]"
    if isinstance(value, float) and not math.isfinite(value):
        return f"'{value}'::DOUBLE"
    return str(value).lower() if isinstance(value, bool) else repr(value)
