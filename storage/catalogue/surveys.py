"""Surveys with their marks, truth and logs, and rigs: typed put and get."""

from __future__ import annotations

import json
import re
import secrets
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

import pyarrow as pa
from duckdb import DuckDBPyConnection

from spheremark.pipelines.errors import ConflictError, InputError, NotFoundError
from spheremark.pipelines.model import ControlMarks, Rig, Truth
from spheremark.pipelines.scan.rigs import rig_digest, rig_from_mapping, rig_to_mapping
from spheremark.storage.catalogue.database import Changed, fetch
from spheremark.storage.catalogue.lists import Lists
from spheremark.storage.catalogue.marks import (
    check_marks,
    control_marks_of,
    control_table,
    marks_table,
    read_truth,
    rig_text,
    true_stops_table,
)
from spheremark.storage.catalogue.records import (
    Page,
    RecordingRecord,
    SurveyRecord,
    json_text,
    record_of,
)
from spheremark.storage.catalogue.tables import TableWriter

_DIGEST = re.compile(r"[0-9a-f]{64}")
_VERDICTS = ("ok", "weak", "refused")

_LOGS_OF = """
    SELECT recording_id FROM jobs
    WHERE survey_id = {id} AND recording_id IS NOT NULL AND status <> 'dismissed'
    UNION SELECT recording_id FROM runs WHERE survey_id = {id}
    UNION SELECT recording_id FROM survey_recordings WHERE survey_id = {id}
    EXCEPT SELECT recording_id FROM removed_recordings WHERE survey_id = {id}
"""
_SURVEYS = """
SELECT s.survey_id, s.name, s.tolerance_m, s.created_at, s.rig_digest,
    (SELECT count(*) FROM control_marks AS c WHERE c.survey_id = s.survey_id) AS n_control_marks,
    (SELECT count(*) FROM true_stops AS t WHERE t.survey_id = s.survey_id) AS n_true_stops,
    (SELECT count(*) FROM ({logs})) AS n_recordings
FROM surveys AS s
WHERE s.survey_id NOT IN (SELECT survey_id FROM deleted_surveys)
""".replace("{logs}", _LOGS_OF.replace("{id}", "s.survey_id"))
_SURVEY_BY_KEY = _SURVEYS + "AND (s.survey_id = $key OR s.name = $key) ORDER BY s.survey_id <> $key"
_ID_OF_SURVEY = """
SELECT survey_id FROM surveys
WHERE (survey_id = $key OR name = $key) AND survey_id NOT IN (SELECT survey_id FROM deleted_surveys)
ORDER BY survey_id <> $key
"""
_SURVEYS_AFTER = (
    _SURVEYS
    + """
AND ($at::TIMESTAMPTZ IS NULL OR (s.created_at, s.survey_id) < ($at::TIMESTAMPTZ, $id))
ORDER BY s.created_at DESC, s.survey_id DESC LIMIT $n
"""
)
_INSPECTED = "UPDATE recordings SET verdict = $v, preflight = $p WHERE recording_id = $id"
_RECORDING = "SELECT * FROM recordings WHERE recording_id = $id"
_RECORDINGS_AFTER = """
SELECT * FROM recordings
WHERE ($at::TIMESTAMPTZ IS NULL OR (uploaded_at, recording_id) < ($at::TIMESTAMPTZ, $id))
ORDER BY uploaded_at DESC, recording_id DESC LIMIT $n
"""
_RIG = "SELECT rig FROM rigs WHERE rig_digest = $digest"
_RECORDINGS_OF_SURVEY = """
SELECT recording_id, name FROM recordings WHERE recording_id IN ({logs})
ORDER BY uploaded_at, recording_id
""".replace("{logs}", _LOGS_OF.replace("{id}", "$id"))
_N_ACTIVE = """
SELECT count(*) AS n FROM jobs WHERE survey_id = $id AND status IN ('accepted', 'running')
"""
_DELETED = "SELECT * FROM deleted_surveys ORDER BY deleted_at DESC, survey_id"
_IS_REMOVED = "SELECT 1 FROM removed_recordings WHERE survey_id = ? AND recording_id = ?"
_PUT_BACK = "DELETE FROM removed_recordings WHERE survey_id = ? AND recording_id = ?"
_CONTROL = "SELECT * FROM control_marks WHERE survey_id = $id ORDER BY place"


class Surveys(Lists):
    """The inputs of jobs: surveys with marks and truth, logs, rigs. Opened like ``Database``."""

    def _open(self) -> None:
        """Open the file, and the writer of its tables."""
        super()._open()
        self._tables = TableWriter(self._writer)

    # Surveys, their marks and their truth

    def create_survey(self, name: str, *, tolerance: float = 0.03) -> SurveyRecord:
        """Create a survey."""
        check_address("The name of a survey", name)
        _check_tolerance(tolerance)
        with self.writing() as cursor:
            self._require_free(cursor, name)
            survey_id = secrets.token_hex(8)
            cursor.execute(
                "INSERT INTO surveys (survey_id, name, tolerance_m, created_at) "
                "VALUES (?, ?, ?, ?)",
                [survey_id, name, tolerance, now()],
            )
        return self.get_survey(survey_id)

    def get_survey(self, key: str) -> SurveyRecord:
        """Return a survey by its id or its name; NotFoundError if there is none."""
        row = self._one(_SURVEY_BY_KEY, {"key": key}, f"survey {key!r}")
        return record_of(SurveyRecord, row)

    def id_of_survey(self, key: str) -> str:
        """Return the id of a survey by its id or its name; NotFoundError if there is none."""
        found: str = self._one(_ID_OF_SURVEY, {"key": key}, f"survey {key!r}")["survey_id"]
        return found

    def list_surveys(self, *, after: str | None = None, limit: int = 100) -> Page[SurveyRecord]:
        """Return a page of the surveys, newest first; ``after`` is ``next`` of the page before."""
        return self._page(SurveyRecord, _SURVEYS_AFTER, {}, after, limit)

    def change_survey(
        self, survey: str, *, name: str | None = None, tolerance: float | None = None
    ) -> SurveyRecord:
        """Rename a survey, or set its tolerance; what is None stays."""
        known = self.get_survey(survey)
        name = known.name if name is None else name
        tolerance = known.tolerance if tolerance is None else tolerance
        check_address("The name of a survey", name)
        _check_tolerance(tolerance)
        with self.writing() as cursor:
            self._require_free(cursor, name, known.survey_id)
            cursor.execute(
                "UPDATE surveys SET name = ?, tolerance_m = ? WHERE survey_id = ?",
                [name, tolerance, known.survey_id],
            )
        return self.get_survey(known.survey_id)

    def delete_survey(self, survey: str) -> str:
        """Delete a survey until it is restored; return its id. Its name becomes free."""
        known = self.get_survey(survey)
        (active,) = self.rows(_N_ACTIVE, {"id": known.survey_id})
        if active["n"]:
            raise ConflictError(
                f"The survey {known.name} has {active['n']} active jobs; dismiss them first."
            )
        with self.writing() as cursor:
            row = [known.survey_id, known.name, now()]
            cursor.execute("INSERT INTO deleted_surveys VALUES (?, ?, ?)", row)
            cursor.execute(
                "UPDATE surveys SET name = ? WHERE survey_id = ?",
                [f"{known.name} (deleted {known.survey_id})", known.survey_id],
            )
        return known.survey_id

    def deleted_surveys(self) -> list[dict[str, Any]]:
        """Return id, name and instant of each deleted survey, newest first."""
        return self.rows(_DELETED)

    def restore_survey(self, survey_id: str) -> SurveyRecord:
        """Restore a deleted survey under its name, or with its id behind it if that is taken."""
        found = [row for row in self.deleted_surveys() if row["survey_id"] == survey_id]
        if not found:
            raise NotFoundError(f"There is no deleted survey {survey_id!r}.")
        name = found[0]["name"]
        with self.writing() as cursor:
            if fetch(cursor, _SURVEY_BY_KEY, {"key": name}).num_rows:
                name = f"{name} ({survey_id})"
            cursor.execute("DELETE FROM deleted_surveys WHERE survey_id = ?", [survey_id])
            cursor.execute("UPDATE surveys SET name = ? WHERE survey_id = ?", [name, survey_id])
        return self.get_survey(survey_id)

    @staticmethod
    def _require_free(cursor: DuckDBPyConnection, name: str, survey_id: str = "") -> None:
        """Refuse a name that another survey has."""
        known = fetch(cursor, _SURVEY_BY_KEY, {"key": name}).to_pylist()
        if any(row["survey_id"] != survey_id for row in known):
            raise ConflictError(f"There is already a survey called {name!r}; choose another.")

    def put_control_marks(self, survey: str, marks: ControlMarks) -> None:
        """Set the control marks of a survey, in place of those before."""
        check_marks(marks)
        survey_id = self.id_of_survey(survey)
        with self.writing() as cursor:
            self._tables.append({"control_marks": control_table(survey_id, marks)})
            cursor.execute(
                "DELETE FROM control_marks WHERE survey_id = ? AND NOT list_contains(?, mark)",
                [survey_id, list(marks.names)],
            )
            cursor.execute(
                "INSERT OR REPLACE INTO control_changes VALUES (?, ?)", [survey_id, now()]
            )

    def delete_control_marks(self, survey: str) -> None:
        """Take the control marks from a survey."""
        survey_id = self.id_of_survey(survey)
        with self.writing() as cursor:
            cursor.execute("DELETE FROM control_marks WHERE survey_id = ?", [survey_id])
            cursor.execute(
                "INSERT OR REPLACE INTO control_changes VALUES (?, ?)", [survey_id, now()]
            )

    def control_marks(self, survey: str) -> ControlMarks | None:
        """Return the control marks of a survey (id or name); None without."""
        rows = self.rows(_CONTROL, {"id": self.id_of_survey(survey)})
        return control_marks_of(rows) if rows else None

    def put_truth(self, survey: str, truth: Truth) -> None:
        """Set the truth of a survey, and compute the errors of all its results."""
        check_marks(truth.marks)
        survey_id = self.id_of_survey(survey)
        with self.writing() as cursor:
            self._tables.append({"true_marks": marks_table(survey_id, truth.marks)})
            cursor.execute(
                "DELETE FROM true_marks WHERE survey_id = ? AND NOT list_contains(?, mark)",
                [survey_id, list(truth.marks.names)],
            )
            self._tables.append({"true_stops": true_stops_table(survey_id, truth.stops)})
            cursor.execute(
                "INSERT OR REPLACE INTO true_worlds VALUES (?, ?, ?)",
                [survey_id, rig_text(truth), json_text(truth.about)],
            )
            self._tables.refresh_errors(survey_id)

    def truth(self, survey: str) -> Truth | None:
        """Return the truth of a survey (id or name); None without."""
        survey_id = self.id_of_survey(survey)
        with self.reading() as cursor:
            return read_truth(cursor, survey_id)

    # Recordings

    def add_recording(
        self, digest: str, *, name: str, size_bytes: int, url: str, preflight: Mapping[str, Any]
    ) -> RecordingRecord:
        """Add an uploaded log; the same bytes twice are one recording, as first added."""
        check_name("The name of a recording", name)
        verdict = str(preflight.get("verdict"))
        if not _DIGEST.fullmatch(digest):
            raise InputError(f"The digest {digest!r} is not a SHA-256: 64 lower-case hex digits.")
        if verdict not in _VERDICTS or size_bytes < 0:
            raise InputError(
                f"The recording {name} has the verdict {verdict!r} and {size_bytes} bytes; a "
                f"verdict is one of {', '.join(_VERDICTS)}, and a size is not negative."
            )
        row = [digest, name, size_bytes, now(), url, verdict, json_text(preflight)]
        with self.writing(Changed.QUEUE) as cursor:
            cursor.execute("INSERT OR IGNORE INTO recordings VALUES (?, ?, ?, ?, ?, ?, ?)", row)
        return self.get_recording(digest)

    def inspect_again(self, digest: str, preflight: Mapping[str, Any]) -> RecordingRecord:
        """Replace the preflight report of a recording, as after reading it with other options."""
        row = {"v": str(preflight["verdict"]), "p": json_text(preflight), "id": digest}
        with self.writing() as cursor:
            cursor.execute(_INSPECTED, row)
        return self.get_recording(digest)

    def get_recording(self, recording_id: str) -> RecordingRecord:
        """Return a recording by its digest; NotFoundError if there is none."""
        row = self._one(_RECORDING, {"id": recording_id}, f"recording {recording_id!r}")
        return record_of(RecordingRecord, row)

    def list_recordings(
        self, *, after: str | None = None, limit: int = 100
    ) -> Page[RecordingRecord]:
        """Return a page of the recordings, newest first."""
        return self._page(RecordingRecord, _RECORDINGS_AFTER, {}, after, limit)

    def add_to_survey(self, survey: str, recording_id: str) -> None:
        """Assign a log to a survey, or put it back with its results."""
        row = [self.id_of_survey(survey), self.get_recording(recording_id).recording_id]
        with self.writing(Changed.QUEUE) as cursor:
            cursor.execute("INSERT OR IGNORE INTO survey_recordings VALUES (?, ?)", row)
            is_removed = cursor.execute(_IS_REMOVED, row).fetchone() is not None
        if is_removed:
            with self.writing() as cursor:
                cursor.execute(_PUT_BACK, row)

    def remove_from_survey(self, survey: str, recording_id: str) -> None:
        """Take a log and its results out of a survey until it is assigned again."""
        known = self.get_survey(survey)
        if recording_id not in self.recordings_of_survey(known.survey_id):
            raise NotFoundError(f"The survey {known.name} has no recording {recording_id!r}.")
        with self.writing() as cursor:
            row = [known.survey_id, recording_id, now()]
            cursor.execute("INSERT OR REPLACE INTO removed_recordings VALUES (?, ?, ?)", row)

    def recordings_of_survey(self, survey: str) -> tuple[str, ...]:
        """Return the logs that are assigned to a survey (id or name) or read by its jobs."""
        rows = self.rows(_RECORDINGS_OF_SURVEY, {"id": self.id_of_survey(survey)})
        return tuple(row["recording_id"] for row in rows)

    # Rigs

    def put_rig(self, rig: Rig) -> str:
        """Add a rig; the same rig twice is one."""
        digest = rig_digest(rig)
        row = {"rig_digest": digest, "name": rig.name, "rig": json_text(rig_to_mapping(rig))}
        with self.writing():
            self._tables.append({"rigs": pa.Table.from_pylist([row])})
        return digest

    def get_rig(self, digest: str) -> Rig:
        """Return a rig by its digest; NotFoundError if there is none."""
        row = self._one(_RIG, {"digest": digest}, f"rig {digest!r}")
        return rig_from_mapping(json.loads(row["rig"]))

    def choose_rig(self, survey: str, digest: str | None) -> SurveyRecord:
        """Set the rig of those jobs of a survey that name none."""
        survey_id = self.id_of_survey(survey)
        if digest is not None:
            self.get_rig(digest)
        with self.writing() as cursor:
            cursor.execute(
                "UPDATE surveys SET rig_digest = ? WHERE survey_id = ?", [digest, survey_id]
            )
        return self.get_survey(survey_id)


def _check_tolerance(tolerance: float) -> None:
    """Refuse a tolerance that no survey can have."""
    if not 0.0 < tolerance <= 1.0:
        raise InputError(f"The tolerance is {tolerance!r} m; it must be above 0 and at most 1.")


def check_name(what: str, name: str) -> None:
    """Refuse a name that cannot be read or typed."""
    if not name.strip() or len(name) > 200 or not name.isprintable():
        raise InputError(f"{what} is {name!r}; it must have 1 to 200 printable characters.")


def check_address(what: str, name: str) -> None:
    """Refuse a name that cannot be read or typed, or be a part of an address."""
    check_name(what, name)
    if "/" in name or name in (".", ".."):
        raise InputError(
            f"{what} is {name!r}; it stands in addresses, which cannot hold '/' in a name or one "
            "of dots alone. Use '-' or '_' in its place."
        )


def now() -> datetime:
    """Return this instant."""
    return datetime.now(UTC)
