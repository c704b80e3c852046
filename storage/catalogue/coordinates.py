"""Stations and control marks as a table of coordinates (CSV), and as named points."""

from __future__ import annotations

import pyarrow as pa
from pyarrow import csv

from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.exports.points import NamedPoint

_COORDINATES = """
SELECT survey, 'mark' AS kind, mark AS name, NULL AS solution, NULL AS adjustment_id,
    NULL AS fit_method, NULL AS resection_method, 'control' AS status, x_m, y_m, z_m,
    sqrt(sigma_x_m ^ 2 + sigma_y_m ^ 2 + sigma_z_m ^ 2) AS sigma_3d_m,
    NULL::DOUBLE AS error_3d_m
FROM control_marks JOIN (
    SELECT survey_id, name AS survey FROM surveys
    WHERE survey_id NOT IN (SELECT survey_id FROM deleted_surveys)
) USING (survey_id)
WHERE $survey::VARCHAR IS NULL OR survey_id = $survey OR survey = $survey
UNION ALL BY NAME
SELECT survey, 'mark' AS kind, mark AS name, c.solution, adjustment_id, c.fit_method, x.status,
    x.x_m, x.y_m, x.z_m, x.sigma_3d_m, x.error_3d_m
FROM chosen_solutions AS c JOIN adjusted_marks AS x USING (adjustment_id)
WHERE NOT x.is_control AND ($survey::VARCHAR IS NULL OR survey_id = $survey OR survey = $survey)
UNION ALL BY NAME
SELECT survey, 'station' AS kind, station AS name, solution, adjustment_id, fit_method,
    resection_method, status, x_m, y_m, z_m, sigma_3d_m, error_3d_m
FROM chosen_stations
WHERE $survey::VARCHAR IS NULL OR survey_id = $survey OR survey = $survey
ORDER BY survey, kind, name
"""


def coordinates_csv(catalogue: Catalogue, survey: str | None) -> bytes:
    """Return the stations of the chosen solution, and the marks, as CSV; the solution is a column.

    Parameters
    ----------
    catalogue : Catalogue
        The database.
    survey : str or None
        Id or name of a survey; None for all.

    Returns
    -------
    bytes
        The table, with a line of headings.
    """
    sink = pa.BufferOutputStream()
    csv.write_csv(catalogue.table(_COORDINATES, {"survey": survey}), sink)
    return bytes(sink.getvalue().to_pybytes())


def named_points(catalogue: Catalogue, survey: str | None) -> list[NamedPoint]:
    """Return the stations of the chosen solution, and the marks, as named points.

    Parameters
    ----------
    catalogue : Catalogue
        The database.
    survey : str or None
        Id or name of a survey; None for all.

    Returns
    -------
    list of NamedPoint
        Each mark and each station, with the solution that it is from.
    """
    return [
        NamedPoint(
            kind=row["kind"],
            name=row["name"],
            p_site=[row[f"{axis}_m"] for axis in "xyz"],
            properties={name: row[name] for name in ("survey", "solution", "status", "sigma_3d_m")},
        )
        for row in catalogue.rows(_COORDINATES, {"survey": survey})
    ]
