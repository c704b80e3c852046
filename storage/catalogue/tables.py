"""What is appended to the database and taken anew: rows of results, and their errors."""

from __future__ import annotations

import json
from collections.abc import Mapping

import duckdb
import numpy as np
import pyarrow as pa

from spheremark.pipelines.errors import InputError
from spheremark.pipelines.model import ControlMarks, StopTruth, Truth
from spheremark.pipelines.scan.rigs import rig_from_mapping
from spheremark.storage.catalogue import adjustments, results
from spheremark.storage.catalogue.database import Planned, execute_on, fetch
from spheremark.storage.catalogue.records import coordinates_of, pose_of

_TRUE_MARKS = "SELECT * FROM true_marks WHERE survey_id = $id ORDER BY place"
_TRUE_STOPS = "SELECT * FROM true_stops WHERE survey_id = $id ORDER BY stop"
_TRUE_WORLD = "SELECT rig, about FROM true_worlds WHERE survey_id = $id"
_ADJUSTED_OF_SURVEY = {
    "adjustments": "SELECT * FROM adjustments WHERE survey_id = $id",
    "adjusted_stations": (
        "SELECT x.* FROM adjusted_stations AS x JOIN adjustments USING (adjustment_id) "
        "WHERE survey_id = $id"
    ),
    "adjusted_marks": (
        "SELECT x.* FROM adjusted_marks AS x JOIN adjustments USING (adjustment_id) "
        "WHERE survey_id = $id"
    ),
}
_REFRESH_ADJUSTED = {
    "adjusted_stations": """
        UPDATE adjusted_stations AS x SET error_x_m = i.error_x_m, error_y_m = i.error_y_m,
            error_z_m = i.error_z_m, error_yaw_deg = i.error_yaw_deg, error_3d_m = i.error_3d_m
        FROM incoming AS i WHERE x.adjustment_id = i.adjustment_id AND x.station = i.station
    """,
    "adjusted_marks": """
        UPDATE adjusted_marks AS x SET error_x_m = i.error_x_m, error_y_m = i.error_y_m,
            error_z_m = i.error_z_m, error_3d_m = i.error_3d_m
        FROM incoming AS i WHERE x.adjustment_id = i.adjustment_id AND x.mark = i.mark
    """,
}
_RESULTS_OF_SURVEY = {
    "stops": "SELECT x.* FROM stops AS x JOIN runs USING (run_id) WHERE survey_id = $id",
    "marker_fits": (
        "SELECT x.* FROM marker_fits AS x JOIN runs USING (run_id) WHERE survey_id = $id"
    ),
    "station_fixes": (
        "SELECT x.* FROM station_fixes AS x JOIN runs USING (run_id) WHERE survey_id = $id"
    ),
    "resections": (
        "SELECT x.* FROM resections AS x JOIN runs USING (run_id) WHERE survey_id = $id"
    ),
}
_TRUE_TABLES = ("true_marks", "true_stops")
_INSERT_RESULTS = """
WITH a AS (INSERT INTO runs SELECT * FROM incoming_runs),
    b AS (INSERT INTO stops SELECT * FROM incoming_stops),
    c AS (INSERT INTO marker_fits SELECT * FROM incoming_marker_fits),
    d AS (INSERT INTO rejections SELECT * FROM incoming_rejections),
    e AS (INSERT INTO station_fixes SELECT * FROM incoming_station_fixes),
    f AS (INSERT INTO observations SELECT * FROM incoming_observations),
    g AS (INSERT INTO resections SELECT * FROM incoming_resections)
SELECT 1
"""
_INSERT = {
    "adjustments": "INSERT INTO adjustments BY NAME SELECT * FROM incoming",
    "adjusted_stations": "INSERT INTO adjusted_stations BY NAME SELECT * FROM incoming",
    "adjusted_marks": "INSERT INTO adjusted_marks BY NAME SELECT * FROM incoming",
    "adjusted_observations": "INSERT INTO adjusted_observations BY NAME SELECT * FROM incoming",
    "refused_stations": "INSERT INTO refused_stations BY NAME SELECT * FROM incoming",
    "control_checks": "INSERT INTO control_checks BY NAME SELECT * FROM incoming",
    "repeated_stops": "INSERT INTO repeated_stops BY NAME SELECT * FROM incoming",
    "calibrations": "INSERT INTO calibrations BY NAME SELECT * FROM incoming",
    "calibrated_parameters": "INSERT INTO calibrated_parameters BY NAME SELECT * FROM incoming",
    "calibration_gaps": "INSERT INTO calibration_gaps BY NAME SELECT * FROM incoming",
    "site_products": "INSERT INTO site_products BY NAME SELECT * FROM incoming",
    "documents": "INSERT INTO documents BY NAME SELECT * FROM incoming",
    "control_marks": "INSERT OR REPLACE INTO control_marks BY NAME SELECT * FROM incoming",
    "true_marks": "INSERT OR REPLACE INTO true_marks BY NAME SELECT * FROM incoming",
    "true_stops": "INSERT OR REPLACE INTO true_stops BY NAME SELECT * FROM incoming",
}
_OF_JOBS = (
    *results.TABLES,
    *(name for name in _INSERT if name not in ("control_marks", *_TRUE_TABLES)),
)
_REFRESH = {
    "marker_fits": """
        UPDATE marker_fits AS x SET error_x_m = i.error_x_m, error_y_m = i.error_y_m,
            error_z_m = i.error_z_m, error_radial_m = i.error_radial_m, error_3d_m = i.error_3d_m
        FROM incoming AS i WHERE x.run_id = i.run_id AND x.stop = i.stop
            AND x.fit_method = i.fit_method AND x.marker = i.marker
    """,
    "station_fixes": """
        UPDATE station_fixes AS x SET error_x_m = i.error_x_m, error_y_m = i.error_y_m,
            error_z_m = i.error_z_m, error_yaw_deg = i.error_yaw_deg,
            error_horizontal_m = i.error_horizontal_m, error_3d_m = i.error_3d_m
        FROM incoming AS i WHERE x.run_id = i.run_id AND x.stop = i.stop
            AND x.fit_method = i.fit_method AND x.resection_method = i.resection_method
    """,
    "resections": """
        UPDATE resections AS x
        SET error_horizontal_m = i.error_horizontal_m, error_3d_m = i.error_3d_m
        FROM incoming AS i WHERE x.run_id = i.run_id AND x.stop = i.stop
            AND x.fit_method = i.fit_method AND x.resection_method = i.resection_method
            AND x.marks = i.marks
    """,
}
_SURVEY_OF_JOB = "SELECT survey_id FROM jobs WHERE job_id = ?"
_RIGS = "SELECT rig_digest FROM rigs"
_PUT_RIG = "INSERT INTO rigs (rig_digest, name, rig) VALUES ($rig_digest, $name, $rig)"


def check_tables(tables: Mapping[str, pa.Table]) -> None:
    """Refuse results for tables that no job writes."""
    unknown = sorted(set(tables) - set(_OF_JOBS))
    if unknown:
        raise InputError(f"No job writes {unknown[0]!r}; it writes {', '.join(_OF_JOBS)}.")


class Tables:
    """The tables, as the one who writes them all sees them.

    Parameters
    ----------
    cursor : DuckDBPyConnection
        The only one that writes; not inside a transaction yet, but whenever something is appended
        or taken anew.

    Notes
    -----
    A statement costs half a millisecond. Results are one, planned once, and what nobody else can
    have changed is not read again: rigs that are there, truths, and the surveys of jobs.
    """

    def __init__(self, cursor: duckdb.DuckDBPyConnection) -> None:
        self._cursor = cursor
        schemas = {name: one for name, one in results.SCHEMAS.items() if name != "rigs"}
        self._results = Planned(cursor, "results", _INSERT_RESULTS, schemas)
        self._rigs: set[str] = set()
        self._truths: dict[str, Truth | None] = {}
        self._surveys: dict[str, str] = {}

    def append(self, tables: Mapping[str, pa.Table]) -> None:
        """Append rows to tables."""
        ours = self._results.names
        self._results.run({name: rows for name, rows in tables.items() if name in ours})
        for name, rows in tables.items():
            if name == "rigs":
                self._append_rigs(rows)
            elif name not in ours and rows.num_rows:
                execute_on(self._cursor, _INSERT[name], rows)

    def _append_rigs(self, table: pa.Table) -> None:
        """Append those rigs that are not there; only of these does the database have to tell."""
        if self._rigs.issuperset(table["rig_digest"].to_pylist()):
            return
        rows = {row["rig_digest"]: row for row in table.to_pylist()}
        self._rigs = {digest for (digest,) in self._cursor.execute(_RIGS).fetchall()}
        for digest in rows.keys() - self._rigs:
            self._cursor.execute(_PUT_RIG, rows[digest])

    def survey_of(self, job_id: str) -> str:
        """Return the survey of a job."""
        if job_id not in self._surveys:
            ((self._surveys[job_id],),) = self._cursor.execute(_SURVEY_OF_JOB, [job_id]).fetchall()
        return self._surveys[job_id]

    def truth(self, survey_id: str) -> Truth | None:
        """Return the truth of a survey, as ``read_truth`` does."""
        if survey_id not in self._truths:
            self._truths[survey_id] = read_truth(self._cursor, survey_id)
        return self._truths[survey_id]

    def refresh_errors(self, survey_id: str) -> None:
        """Take the errors of a survey's results anew against a truth that has changed."""
        self._truths.pop(survey_id, None)  # and not kept: the transaction may fail
        truth = read_truth(self._cursor, survey_id)
        fresh = results.with_errors(self._fetched(_RESULTS_OF_SURVEY, survey_id), truth)
        for name, sql in _REFRESH.items():
            execute_on(self._cursor, sql, fresh[name])
        fresh = adjustments.with_errors(self._fetched(_ADJUSTED_OF_SURVEY, survey_id), truth)
        for name, sql in _REFRESH_ADJUSTED.items():
            execute_on(self._cursor, sql, fresh[name])

    def _fetched(self, queries: Mapping[str, str], survey_id: str) -> dict[str, pa.Table]:
        """Return what queries say of a survey."""
        return {name: fetch(self._cursor, sql, {"id": survey_id}) for name, sql in queries.items()}


def read_truth(cursor: duckdb.DuckDBPyConnection, survey_id: str) -> Truth | None:
    """Read the truth of a survey."""
    worlds = cursor.execute(_TRUE_WORLD, {"id": survey_id}).fetchall()
    if not worlds:
        return None
    rig, about = worlds[0]
    marks = fetch(cursor, _TRUE_MARKS, {"id": survey_id}).to_pylist()
    stops = fetch(cursor, _TRUE_STOPS, {"id": survey_id}).to_pylist()
    return Truth(
        marks=ControlMarks(
            names=tuple(row["mark"] for row in marks),
            p_site=coordinates_of(marks),
            cov_p_site=np.zeros((len(marks), 3, 3)),
        ),
        stops=tuple(StopTruth(name=row["stop"], T_site_base=pose_of(row)) for row in stops),
        rig=None if rig is None else rig_from_mapping(json.loads(rig)),
        about=json.loads(about),
    )
