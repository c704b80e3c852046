"""Stations and control marks as a table of coordinates (CSV), and as named points."""

from __future__ import annotations

import pyarrow as pa
from pyarrow import csv

from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.exports.points import NamedPoint

_COORDINATES = """
SELECT survey, 'mark' AS kind, mark AS name, NULL AS fit_method, NULL AS resection_method,
    'control' AS status, x_m, y_m, z_m, sqrt(sigma_x_m ^ 2 + sigma_y_m ^ 2 + sigma_z_m ^ 2)
    AS sigma_3d_m, NULL::DOUBLE AS error_3d_m
FROM control_marks JOIN (SELECT survey_id, name AS survey FROM surveys) USING (survey_id)
WHERE $survey::VARCHAR IS NULL OR survey_id = $survey OR survey = $survey
UNION ALL BY NAME
SELECT survey, 'station' AS kind, stop AS name, fit_method, resection_method, status, x_m, y_m, z_m,
    sigma_3d_m, error_3d_m
FROM latest_station_fixes
WHERE $survey::VARCHAR IS NULL OR survey_id = $survey OR survey = $survey
ORDER BY ALL
"""


def coordinates_csv(catalogue: Catalogue, survey: str | None) -> bytes:
    """Return the newest stations and the control marks as CSV, in the site frame.

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
    """Return the newest stations and the control marks as named points, in the site frame.

    Parameters
    ----------
    catalogue : Catalogue
        The database.
    survey : str or None
        Id or name of a survey; None for all.

    Returns
    -------
    list of NamedPoint
        Each mark, and each station by its first methods; without stations that failed.
    """
    rows = catalogue.rows(_COORDINATES, {"survey": survey})
    points: dict[tuple[str, str, str], NamedPoint] = {}
    for row in sorted(rows, key=lambda one: one["fit_method"] != "along_beam"):
        key = (row["survey"], row["kind"], row["name"])
        if row["x_m"] is not None:
            properties = {name: row[name] for name in ("survey", "status", "sigma_3d_m")}
            place = [row[f"{axis}_m"] for axis in "xyz"]
            points.setdefault(
                key, NamedPoint(kind=key[1], name=key[2], p_site=place, properties=properties)
            )
    return list(points.values())
