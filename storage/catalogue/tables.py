"""Writes rows of results, and their errors when the truth changes.

Names of tables and columns in the generated statements come from the schemas of this package.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import duckdb
import pyarrow as pa

from spheremark.pipelines.errors import InputError
from spheremark.pipelines.model import Truth
from spheremark.storage.catalogue import adjustments, results
from spheremark.storage.catalogue.database import Planned, execute_on, fetch
from spheremark.storage.catalogue.marks import read_truth
from spheremark.storage.catalogue.schema import SCHEMAS

CALIBRATION_TABLES = ("calibrations", "calibrated_parameters", "calibration_gaps")
_RUN_TABLES = tuple(name for name in results.TABLES if name != "rigs")
_APPENDED = (*adjustments.TABLES, *CALIBRATION_TABLES, "site_products", "documents")
_OF_JOBS = (*results.TABLES, *_APPENDED)
_REPLACED = ("control_marks", "true_marks", "true_stops")  # of a survey, by primary key
_KEYS = {
    "marker_fits": ("run_id", "stop", "fit_method", "marker"),
    "station_fixes": ("run_id", "stop", "fit_method", "resection_method"),
    "resections": ("run_id", "stop", "fit_method", "resection_method", "marks"),
    "adjusted_stations": ("adjustment_id", "station"),
    "adjusted_marks": ("adjustment_id", "mark"),
}
"""Tables whose errors follow the truth, with the columns that identify a row."""
_SURVEY_OF_JOB = "SELECT survey_id FROM jobs WHERE job_id = ?"
_RIGS = "SELECT rig_digest FROM rigs"
_PUT_RIG = "INSERT INTO rigs (rig_digest, name, rig) VALUES ($rig_digest, $name, $rig)"


def check_tables(tables: Mapping[str, pa.Table]) -> None:
    """Refuse results for tables that no job writes."""
    unknown = sorted(set(tables) - set(_OF_JOBS))
    if unknown:
        raise InputError(f"No job writes {unknown[0]!r}; it writes {', '.join(_OF_JOBS)}.")


class TableWriter:
    """Appends rows to tables and updates their errors.

    Parameters
    ----------
    cursor : DuckDBPyConnection
        The only cursor that writes; not in a transaction now, but at each call of a method.

    Notes
    -----
    A statement costs half a millisecond. The tables of a run are therefore one statement, planned
    once, and rigs and truths that only this cursor changes are cached.
    """

    def __init__(self, cursor: duckdb.DuckDBPyConnection) -> None:
        self._cursor = cursor
        schemas = {name: SCHEMAS[name] for name in _RUN_TABLES}
        self._results = Planned(cursor, "results", _insert_run(), schemas)
        self._rigs: set[str] = set()
        self._truths: dict[str, Truth | None] = {}

    def append(self, tables: Mapping[str, pa.Table]) -> None:
        """Append rows to tables; those of marks and true stops replace rows of the same key."""
        self._results.run({name: rows for name, rows in tables.items() if name in _RUN_TABLES})
        for name, rows in tables.items():
            if name == "rigs":
                self._append_rigs(rows)
            elif name not in _RUN_TABLES and rows.num_rows:
                verb = "INSERT OR REPLACE" if name in _REPLACED else "INSERT"
                sql = f"{verb} INTO {name} BY NAME SELECT * FROM incoming"  # noqa: S608
                execute_on(self._cursor, sql, rows)

    def _append_rigs(self, table: pa.Table) -> None:
        """Append those rigs that the database does not have."""
        if self._rigs.issuperset(table["rig_digest"].to_pylist()):
            return
        rows = {row["rig_digest"]: row for row in table.to_pylist()}
        self._rigs = {digest for (digest,) in self._cursor.execute(_RIGS).fetchall()}
        for digest in rows.keys() - self._rigs:
            self._cursor.execute(_PUT_RIG, rows[digest])

    def survey_of(self, job_id: str) -> str:
        """Return the survey of a job."""
        return str(self._cursor.execute(_SURVEY_OF_JOB, [job_id]).fetchall()[0][0])

    def truth(self, survey_id: str) -> Truth | None:
        """Return the truth of a survey, as ``read_truth`` does."""
        if survey_id not in self._truths:
            self._truths[survey_id] = read_truth(self._cursor, survey_id)
        return self._truths[survey_id]

    def refresh_errors(self, survey_id: str) -> None:
        """Compute the errors of a survey's results again, against a truth that has changed."""
        self._truths.pop(survey_id, None)  # not cached: the transaction may fail
        truth = read_truth(self._cursor, survey_id)
        of_runs = ("stops", "marker_fits", "station_fixes", "resections")
        of_networks = ("adjustments", "adjusted_stations", "adjusted_marks")
        fresh = results.with_errors(self._rows(of_runs, "runs", survey_id), truth)
        fresh |= adjustments.with_errors(self._rows(of_networks, "adjustments", survey_id), truth)
        for name in _KEYS:
            execute_on(self._cursor, _update_errors(name, fresh[name].column_names), fresh[name])

    def _rows(self, names: Sequence[str], parent: str, survey_id: str) -> dict[str, pa.Table]:
        """Return the rows of a survey of tables that refer to one with ``survey_id``."""
        key = {"runs": "run_id", "adjustments": "adjustment_id"}[parent]
        return {
            name: fetch(
                self._cursor,
                f"SELECT x.* FROM {name} AS x JOIN {parent} AS p USING ({key}) "  # noqa: S608
                "WHERE p.survey_id = $id",
                {"id": survey_id},
            )
            for name in names
        }


def _insert_run() -> str:
    """Return the statement that writes all tables of a run."""
    inserts = [
        f"{name}_rows AS (INSERT INTO {name} SELECT * FROM incoming_{name})"  # noqa: S608
        for name in _RUN_TABLES
    ]
    return f"WITH {', '.join(inserts)} SELECT 1"


def _update_errors(table: str, columns: Sequence[str]) -> str:
    """Return the statement that updates the errors of a table from ``incoming``."""
    errors = ", ".join(f"{name} = i.{name}" for name in columns if name.startswith("error_"))
    same = " AND ".join(f"x.{name} = i.{name}" for name in _KEYS[table])
    return f"UPDATE {table} AS x SET {errors} FROM incoming AS i WHERE {same}"  # noqa: S608
