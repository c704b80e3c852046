"""What is kept of surveys, recordings, jobs and runs: typed put and get on the one database."""

from __future__ import annotations

import base64
import json
import re
import secrets
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Any, TypeVar

import duckdb
import numpy as np
import pyarrow as pa

from pipelines.errors import ConflictError, InputError, NotFoundError
from pipelines.rigs import rig_digest, rig_from_mapping, rig_to_mapping
from pipelines.values import ControlMarks, Rig, StopTruth, Truth
from storage import adjustments, results
from storage.database import Database, execute_on, fetch
from storage.records import (
    JobRecord,
    JobStatus,
    Page,
    RecordingRecord,
    RunRecord,
    SurveyRecord,
    check_marks,
    coordinates_of,
    job_of,
    json_text,
    marks_table,
    pose_of,
    recording_of,
    rig_text,
    run_of,
    survey_of,
    true_stops_table,
)

_Record = TypeVar("_Record")

_PAGE_MAX = 1000  # records in one part of a list
_DIGEST = re.compile(r"[0-9a-f]{64}")
_VERDICTS = ("ok", "weak", "refused")
_NO_OPTIONS: Mapping[str, Any] = {}

_SURVEYS = """
SELECT s.survey_id, s.name, s.tolerance_m, s.created_at, s.rig_digest,
    (SELECT count(*) FROM control_marks AS c WHERE c.survey_id = s.survey_id) AS n_control_marks,
    (SELECT count(*) FROM true_stops AS t WHERE t.survey_id = s.survey_id) AS n_true_stops,
    (SELECT count(*) FROM (
        SELECT j.recording_id FROM jobs AS j
        WHERE j.survey_id = s.survey_id AND j.recording_id IS NOT NULL
        UNION SELECT o.recording_id FROM survey_recordings AS o WHERE o.survey_id = s.survey_id
    )) AS n_recordings
FROM surveys AS s
"""
_SURVEY_BY_KEY = _SURVEYS + "WHERE s.survey_id = $key OR s.name = $key ORDER BY s.survey_id <> $key"
_SURVEYS_AFTER = (
    _SURVEYS
    + """
WHERE ($at::TIMESTAMPTZ IS NULL OR (s.created_at, s.survey_id) < ($at::TIMESTAMPTZ, $id))
ORDER BY s.created_at DESC, s.survey_id DESC LIMIT $n
"""
)
_RECORDING = "SELECT * FROM recordings WHERE recording_id = $id"
_RECORDINGS_AFTER = """
SELECT * FROM recordings
WHERE ($at::TIMESTAMPTZ IS NULL OR (uploaded_at, recording_id) < ($at::TIMESTAMPTZ, $id))
ORDER BY uploaded_at DESC, recording_id DESC LIMIT $n
"""
_JOBS = """
SELECT j.*, s.name AS survey, r.name AS recording
FROM jobs AS j JOIN surveys AS s USING (survey_id) LEFT JOIN recordings AS r USING (recording_id)
"""
_JOB = _JOBS + "WHERE j.job_id = $id"
_JOBS_AFTER = (
    _JOBS
    + """
WHERE ($at::TIMESTAMPTZ IS NULL OR (j.created_at, j.job_id) < ($at::TIMESTAMPTZ, $id))
    AND ($survey_id::VARCHAR IS NULL OR j.survey_id = $survey_id)
    AND ($recording_id::VARCHAR IS NULL OR j.recording_id = $recording_id)
    AND ($status::VARCHAR IS NULL OR j.status = $status)
ORDER BY j.created_at DESC, j.job_id DESC LIMIT $n
"""
)
_STANDING = "SELECT status, survey_id FROM jobs WHERE job_id = $id"
_JOBS_ACCEPTED = _JOBS + "WHERE j.status = 'accepted' ORDER BY j.created_at, j.job_id"
_RUN = "SELECT * FROM runs WHERE run_id = $id"
_RUNS_AFTER = """
SELECT * FROM runs
WHERE ($at::TIMESTAMPTZ IS NULL OR (finished_at, run_id) < ($at::TIMESTAMPTZ, $id))
    AND ($survey_id::VARCHAR IS NULL OR survey_id = $survey_id)
    AND ($recording_id::VARCHAR IS NULL OR recording_id = $recording_id)
    AND ($job_id::VARCHAR IS NULL OR job_id = $job_id)
ORDER BY finished_at DESC, run_id DESC LIMIT $n
"""
_RIG = "SELECT rig FROM rigs WHERE rig_digest = $digest"
_PUT_RIG = """
INSERT INTO rigs SELECT $rig_digest, $name, $rig
WHERE NOT EXISTS (FROM rigs WHERE rig_digest = $rig_digest)
"""  # half of what INSERT OR IGNORE costs; writes take turns
_RECORDINGS_OF_SURVEY = """
SELECT recording_id, name FROM recordings WHERE recording_id IN (
    SELECT recording_id FROM jobs WHERE survey_id = $id AND status <> 'dismissed'
    UNION SELECT recording_id FROM runs WHERE survey_id = $id
    UNION SELECT recording_id FROM survey_recordings WHERE survey_id = $id
) ORDER BY uploaded_at, recording_id
"""
_CONTROL = "SELECT * FROM control_marks WHERE survey_id = $id ORDER BY place"
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
_APPENDED = results.TABLES[1:]  # as they are, column by column: much the quickest way
_OF_JOBS = (
    "rigs",
    *_APPENDED,
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


class Catalogue(Database):
    """The results, the surveys that they belong to, and the jobs that made them.

    Opened as a ``Database`` is: with the path of the file and a folder for snapshots.
    """

    # Surveys, their marks and their truth

    def create_survey(self, name: str, *, tolerance: float = 0.03) -> SurveyRecord:
        """Make a survey.

        Parameters
        ----------
        name : str
            Unique, 1 to 200 printable characters.
        tolerance : float
            Error that it accepts [m].

        Returns
        -------
        SurveyRecord
            The new survey.

        Raises
        ------
        InputError
            If the name or the tolerance cannot be used.
        ConflictError
            If the name is taken.
        """
        _check_name("The name of a survey", name)
        if not 0.0 < tolerance <= 1.0:
            raise InputError(f"The tolerance is {tolerance!r} m; it must be above 0 and at most 1.")
        with self.writing() as cursor:
            if fetch(cursor, _SURVEY_BY_KEY, {"key": name}).num_rows:
                raise ConflictError(f"There is already a survey called {name!r}; choose another.")
            survey_id = secrets.token_hex(8)
            cursor.execute(
                "INSERT INTO surveys (survey_id, name, tolerance_m, created_at) "
                "VALUES (?, ?, ?, ?)",
                [survey_id, name, tolerance, _now()],
            )
        return self.get_survey(survey_id)

    def get_survey(self, key: str) -> SurveyRecord:
        """Return a survey by its id or its name; NotFoundError if there is none.

        Parameters
        ----------
        key : str
            Id or name.

        Returns
        -------
        SurveyRecord
            The survey.
        """
        return survey_of(self._one(_SURVEY_BY_KEY, {"key": key}, f"survey {key!r}"))

    def list_surveys(self, *, after: str | None = None, limit: int = 100) -> Page[SurveyRecord]:
        """Return a part of the surveys, newest first; ``after`` is ``next`` of the part before.

        Parameters
        ----------
        after : str, optional
            ``next`` of the part before; the first part without.
        limit : int
            Records in the part, 1 to 1000.

        Returns
        -------
        Page of SurveyRecord
            The part, and where the next begins.
        """
        rows = self._part(_SURVEYS_AFTER, {}, after, limit)
        return _page(rows, limit, "created_at", "survey_id", survey_of)

    def put_control_marks(self, survey: str, marks: ControlMarks) -> None:
        """Give a survey its control marks, in place of those that it had.

        Parameters
        ----------
        survey : str
            Id or name.
        marks : ControlMarks
            With independent coordinates: only their standard deviations are kept.

        Raises
        ------
        ControlError
            If coordinates are not finite, names are not different, or coordinates are correlated.
        NotFoundError
            If there is no such survey.
        """
        check_marks(marks)
        sigmas = np.sqrt(np.diagonal(marks.cov_p_site, axis1=1, axis2=2))
        survey_id = self.get_survey(survey).survey_id
        table = marks_table(survey_id, marks)
        for axis, name in enumerate(("sigma_x_m", "sigma_y_m", "sigma_z_m")):
            table = table.append_column(name, pa.array(sigmas[:, axis]))
        with self.writing() as cursor:
            _insert(cursor, "control_marks", table)
            cursor.execute(
                "DELETE FROM control_marks WHERE survey_id = ? AND NOT list_contains(?, mark)",
                [survey_id, list(marks.names)],
            )

    def control_marks(self, survey: str) -> ControlMarks | None:
        """Return the control marks of a survey (id or name), as they were put; None without.

        Parameters
        ----------
        survey : str
            Id or name.

        Returns
        -------
        ControlMarks or None
            In the order that they were put in.
        """
        rows = self.rows(_CONTROL, {"id": self.get_survey(survey).survey_id})
        if not rows:
            return None
        sigmas = np.array([[row[f"sigma_{axis}_m"] for axis in "xyz"] for row in rows])
        return ControlMarks(
            names=tuple(row["mark"] for row in rows),
            p_site=coordinates_of(rows),
            cov_p_site=np.eye(3) * np.square(sigmas)[:, None, :],
        )

    def put_truth(self, survey: str, truth: Truth) -> None:
        """Give a survey its truth, and all its results their errors.

        Parameters
        ----------
        survey : str
            Id or name.
        truth : Truth
            Its marks and rig take the place of those known; its stops are added to those known, so
            that the truth of a survey may come stop by stop.

        Raises
        ------
        NotFoundError
            If there is no such survey.
        """
        check_marks(truth.marks)
        survey_id = self.get_survey(survey).survey_id
        with self.writing() as cursor:
            _insert(cursor, "true_marks", marks_table(survey_id, truth.marks))
            cursor.execute(
                "DELETE FROM true_marks WHERE survey_id = ? AND NOT list_contains(?, mark)",
                [survey_id, list(truth.marks.names)],
            )
            _insert(cursor, "true_stops", true_stops_table(survey_id, truth.stops))
            cursor.execute(
                "INSERT OR REPLACE INTO true_worlds VALUES (?, ?, ?)",
                [survey_id, rig_text(truth), json_text(truth.about)],
            )
            _refresh_errors(cursor, survey_id)

    def truth(self, survey: str) -> Truth | None:
        """Return the truth of a survey (id or name); None when it is not known.

        Parameters
        ----------
        survey : str
            Id or name.

        Returns
        -------
        Truth or None
            Stops in the order of their names.
        """
        survey_id = self.get_survey(survey).survey_id
        with self.reading() as cursor:
            return _truth(cursor, survey_id)

    # Recordings

    def add_recording(
        self, digest: str, *, name: str, size_bytes: int, url: str, preflight: Mapping[str, Any]
    ) -> RecordingRecord:
        """Enter an uploaded log; the same bytes twice are one recording, as first entered.

        Parameters
        ----------
        digest : str
            SHA-256 of the bytes, in hexadecimal.
        name : str
            Stem of the name of the file.
        size_bytes : int
            Length of the file.
        url : str
            Where the bytes are.
        preflight : mapping
            The report; its ``verdict`` is ``ok``, ``weak`` or ``refused``.

        Returns
        -------
        RecordingRecord
            The recording, whether new or known.

        Raises
        ------
        InputError
            If one of the values cannot be used.
        """
        _check_name("The name of a recording", name)
        verdict = str(preflight.get("verdict"))
        if not _DIGEST.fullmatch(digest):
            raise InputError(f"The digest {digest!r} is not a SHA-256: 64 lower-case hex digits.")
        if verdict not in _VERDICTS or size_bytes < 0:
            raise InputError(
                f"The recording {name} has the verdict {verdict!r} and {size_bytes} bytes; a "
                f"verdict is one of {', '.join(_VERDICTS)}, and a size is not negative."
            )
        row = [digest, name, size_bytes, _now(), url, verdict, json_text(preflight)]
        with self.writing() as cursor:
            cursor.execute("INSERT OR IGNORE INTO recordings VALUES (?, ?, ?, ?, ?, ?, ?)", row)
        return self.get_recording(digest)

    def get_recording(self, recording_id: str) -> RecordingRecord:
        """Return a recording by its digest; NotFoundError if there is none.

        Parameters
        ----------
        recording_id : str
            SHA-256 of the bytes, in hexadecimal.

        Returns
        -------
        RecordingRecord
            The recording.
        """
        row = self._one(_RECORDING, {"id": recording_id}, f"recording {recording_id!r}")
        return recording_of(row)

    def list_recordings(
        self, *, after: str | None = None, limit: int = 100
    ) -> Page[RecordingRecord]:
        """Return a part of the recordings, newest first.

        Parameters
        ----------
        after : str, optional
            ``next`` of the part before; the first part without.
        limit : int
            Records in the part, 1 to 1000.

        Returns
        -------
        Page of RecordingRecord
            The part, and where the next begins.
        """
        rows = self._part(_RECORDINGS_AFTER, {}, after, limit)
        return _page(rows, limit, "uploaded_at", "recording_id", recording_of)

    def add_to_survey(self, survey: str, recording_id: str) -> None:
        """Note that a log belongs to a survey; twice is once.

        Parameters
        ----------
        survey : str
            Id or name.
        recording_id : str
            SHA-256 of the log.
        """
        row = [self.get_survey(survey).survey_id, self.get_recording(recording_id).recording_id]
        with self.writing() as cursor:
            cursor.execute("INSERT OR IGNORE INTO survey_recordings VALUES (?, ?)", row)

    def recordings_of_survey(self, survey: str) -> tuple[str, ...]:
        """Return the logs that were uploaded for a survey (id or name), or read by its jobs.

        Parameters
        ----------
        survey : str
            Id or name.

        Returns
        -------
        tuple of str
            Digests, in the order of their upload; those only of dismissed jobs are left out.
        """
        rows = self.rows(_RECORDINGS_OF_SURVEY, {"id": self.get_survey(survey).survey_id})
        return tuple(row["recording_id"] for row in rows)

    # Rigs

    def put_rig(self, rig: Rig) -> str:
        """Keep a rig; the same rig twice is one.

        Parameters
        ----------
        rig : Rig
            The rig.

        Returns
        -------
        str
            Its digest.
        """
        digest = rig_digest(rig)
        with self.writing() as cursor:
            text = json_text(rig_to_mapping(rig))
            cursor.execute(_PUT_RIG, {"rig_digest": digest, "name": rig.name, "rig": text})
        return digest

    def get_rig(self, digest: str) -> Rig:
        """Return a rig by its digest; NotFoundError if there is none.

        Parameters
        ----------
        digest : str
            First 16 hexadecimal digits of the SHA-256 of the canonical rig.

        Returns
        -------
        Rig
            The rig.
        """
        row = self._one(_RIG, {"digest": digest}, f"rig {digest!r}")
        return rig_from_mapping(json.loads(row["rig"]))

    def choose_rig(self, survey: str, digest: str | None) -> SurveyRecord:
        """Let the jobs of a survey use a rig where they name none.

        Parameters
        ----------
        survey : str
            Id or name.
        digest : str or None
            A rig that is kept; none for the one that each log describes.

        Returns
        -------
        SurveyRecord
            The survey as it is now.

        Raises
        ------
        NotFoundError
            If there is no such survey or rig.
        """
        survey_id = self.get_survey(survey).survey_id
        if digest is not None:
            self.get_rig(digest)
        with self.writing() as cursor:
            cursor.execute(
                "UPDATE surveys SET rig_digest = ? WHERE survey_id = ?", [digest, survey_id]
            )
        return self.get_survey(survey_id)

    # Jobs

    def create_job(
        self,
        kind: str,
        *,
        survey: str,
        recording_id: str | None,
        config: Mapping[str, Any],
        options: Mapping[str, Any] = _NO_OPTIONS,
    ) -> JobRecord:
        """Accept work.

        Parameters
        ----------
        kind : str
            What is to be done, for instance ``process``.
        survey : str
            Id or name.
        recording_id : str or None
            The log to read; none for work on the survey as a whole.
        config : mapping
            The effective configuration.
        options : mapping
            What was chosen beside it.

        Returns
        -------
        JobRecord
            With status ``accepted``.

        Raises
        ------
        NotFoundError
            If there is no such survey or recording.
        """
        _check_name("The kind of a job", kind)
        survey_id = self.get_survey(survey).survey_id
        if recording_id is not None:
            self.get_recording(recording_id)
        job_id = secrets.token_hex(8)
        texts = [json_text(config), json_text(options)]
        row = [job_id, kind, survey_id, recording_id, *texts, _now()]
        with self.writing() as cursor:
            cursor.execute(
                "INSERT INTO jobs (job_id, kind, survey_id, recording_id, config, options, "
                "created_at, status, progress_percent, message, attempts) "
                "VALUES (?, ?, ?, ?, ?, ?, ?, 'accepted', 0, 'Waiting for a worker.', 0)",
                row,
            )
        return self.get_job(job_id)

    def get_job(self, job_id: str) -> JobRecord:
        """Return a job; NotFoundError if there is none.

        Parameters
        ----------
        job_id : str
            The job.

        Returns
        -------
        JobRecord
            The job.
        """
        return job_of(self._one(_JOB, {"id": job_id}, f"job {job_id!r}"))

    def list_jobs(
        self,
        *,
        survey: str | None = None,
        recording_id: str | None = None,
        status: JobStatus | None = None,
        after: str | None = None,
        limit: int = 100,
    ) -> Page[JobRecord]:
        """Return a part of the jobs, newest first, of one survey, recording or status if named.

        Parameters
        ----------
        survey : str, optional
            Only those of one survey, by id or name.
        recording_id : str, optional
            Only those of one recording.
        status : JobStatus, optional
            Only jobs that stand there.
        after : str, optional
            ``next`` of the part before; the first part without.
        limit : int
            Records in the part, 1 to 1000.

        Returns
        -------
        Page of JobRecord
            The part, and where the next begins.
        """
        survey_id = None if survey is None else self.get_survey(survey).survey_id
        wanted = {"survey_id": survey_id, "recording_id": recording_id, "status": status}
        rows = self._part(_JOBS_AFTER, wanted, after, limit)
        return _page(rows, limit, "created_at", "job_id", job_of)

    def start_job(self, job_id: str) -> JobRecord:
        """Begin an attempt at an accepted job; ConflictError if it stands elsewhere.

        Parameters
        ----------
        job_id : str
            The job.

        Returns
        -------
        JobRecord
            With status ``running`` and one more attempt.
        """
        with self._changing(job_id, JobStatus.ACCEPTED) as cursor:
            cursor.execute(
                "UPDATE jobs SET status = 'running', started_at = ?, attempts = attempts + 1, "
                "progress_percent = 0, message = 'Started.' WHERE job_id = ?",
                [_now(), job_id],
            )
        return self.get_job(job_id)

    def report_progress(self, job_id: str, percent: float, message: str) -> None:
        """Say how far a running job is, 0 to 100; silent about one that runs no more.

        Parameters
        ----------
        job_id : str
            The job.
        percent : float
            0 to 100; what is beyond is cut.
        message : str
            A sentence for people.

        Notes
        -----
        Costs a millisecond, and does not make the newest snapshot old.
        """
        with self.writing(is_result=False) as cursor:
            cursor.execute(
                "UPDATE jobs SET progress_percent = ?, message = ? "
                "WHERE job_id = ? AND status = 'running'",
                [min(max(float(percent), 0.0), 100.0), message, job_id],
            )

    def finish_job(
        self, job_id: str, tables: Mapping[str, pa.Table], *, message: str = "Done."
    ) -> None:
        """Write the results of a running job and its end, both or neither.

        Parameters
        ----------
        job_id : str
            The job; successful afterwards.
        tables : mapping of str to Table
            Rows by table, as ``storage.results.tables`` makes them.
        message : str
            What the job gave, as a sentence for people.

        Raises
        ------
        ConflictError
            If the job neither runs nor is successful already.
        InputError
            If there is no table of such a name.

        Notes
        -----
        Results are written once: finishing a successful job again changes nothing. Errors are
        taken against the truth that is known now. Each statement costs a millisecond, almost
        whatever it writes.
        """
        _check_tables(tables)
        with self.writing() as cursor:
            status, survey_id = _standing(cursor, job_id)
            if status is JobStatus.SUCCESSFUL:
                return
            _require(job_id, status, JobStatus.RUNNING)
            truth = _truth(cursor, survey_id)
            compared = adjustments.with_errors(results.with_errors(tables, truth), truth)
            for name, table in compared.items():
                _insert(cursor, name, table)
            cursor.execute(
                "UPDATE jobs SET status = 'successful', progress_percent = 100, "
                "message = ?, finished_at = ? WHERE job_id = ?",
                [message, _now(), job_id],
            )

    def fail_job(
        self, job_id: str, *, code: str, reason: str, traceback: str | None = None
    ) -> JobRecord:
        """Record that a job failed and why; ConflictError if it came to another end before.

        Parameters
        ----------
        job_id : str
            The job, accepted or running.
        code : str
            Stable code of the error.
        reason : str
            The error as a sentence for people.
        traceback : str, optional
            Where in the code.

        Returns
        -------
        JobRecord
            With status ``failed``.
        """
        with self._changing(job_id, JobStatus.ACCEPTED, JobStatus.RUNNING) as cursor:
            cursor.execute(
                "UPDATE jobs SET status = 'failed', message = 'Failed.', finished_at = ?, "
                "error_code = ?, error_reason = ?, error_traceback = ? WHERE job_id = ?",
                [_now(), code, reason, traceback, job_id],
            )
        return self.get_job(job_id)

    def dismiss_job(self, job_id: str) -> JobRecord:
        """Give up a job that has not come to its end; ConflictError if it has.

        Parameters
        ----------
        job_id : str
            The job.

        Returns
        -------
        JobRecord
            With status ``dismissed``.
        """
        with self._changing(job_id, JobStatus.ACCEPTED, JobStatus.RUNNING) as cursor:
            cursor.execute(
                "UPDATE jobs SET status = 'dismissed', message = 'Dismissed.', finished_at = ? "
                "WHERE job_id = ?",
                [_now(), job_id],
            )
        return self.get_job(job_id)

    def requeue_job(self, job_id: str, message: str) -> JobRecord:
        """Make a running job accepted again, for another attempt, and say why.

        Parameters
        ----------
        job_id : str
            The job.
        message : str
            A sentence for people.

        Returns
        -------
        JobRecord
            With status ``accepted``.
        """
        with self._changing(job_id, JobStatus.RUNNING) as cursor:
            cursor.execute(
                "UPDATE jobs SET status = 'accepted', progress_percent = 0, message = ? "
                "WHERE job_id = ?",
                [message, job_id],
            )
        return self.get_job(job_id)

    def take_up_jobs(self) -> tuple[JobRecord, ...]:
        """Make jobs that were running accepted again and return all accepted ones, oldest first.

        For the start of the service: nothing can be running then.

        Returns
        -------
        tuple of JobRecord
            To be started, in this order.
        """
        with self.writing() as cursor:
            cursor.execute(
                "UPDATE jobs SET status = 'accepted', progress_percent = 0, "
                "message = 'Taken up again after a restart.' WHERE status = 'running'"
            )
            return tuple(job_of(row) for row in fetch(cursor, _JOBS_ACCEPTED, {}).to_pylist())

    def get_run(self, run_id: str) -> RunRecord:
        """Return a run; NotFoundError if there is none.

        Parameters
        ----------
        run_id : str
            The run.

        Returns
        -------
        RunRecord
            The run.
        """
        return run_of(self._one(_RUN, {"id": run_id}, f"run {run_id!r}"))

    def list_runs(
        self,
        *,
        survey: str | None = None,
        recording_id: str | None = None,
        job_id: str | None = None,
        after: str | None = None,
        limit: int = 100,
    ) -> Page[RunRecord]:
        """Return a part of the runs, newest first, of one survey, recording or job if named.

        Parameters
        ----------
        survey : str, optional
            Only those of one survey, by id or name.
        recording_id : str, optional
            Only those of one recording.
        job_id : str, optional
            Only those of one job.
        after : str, optional
            ``next`` of the part before; the first part without.
        limit : int
            Records in the part, 1 to 1000.

        Returns
        -------
        Page of RunRecord
            The part, and where the next begins.
        """
        survey_id = None if survey is None else self.get_survey(survey).survey_id
        wanted = {"survey_id": survey_id, "recording_id": recording_id, "job_id": job_id}
        rows = self._part(_RUNS_AFTER, wanted, after, limit)
        return _page(rows, limit, "finished_at", "run_id", run_of)

    # What the verbs share

    @contextmanager
    def _changing(self, job_id: str, *allowed: JobStatus) -> Iterator[duckdb.DuckDBPyConnection]:
        """Hold a transaction on a job that stands where it may be changed."""
        with self.writing() as cursor:
            _require(job_id, _standing(cursor, job_id)[0], *allowed)
            yield cursor

    def _one(self, sql: str, parameters: Mapping[str, Any], what: str) -> dict[str, Any]:
        """Return the first row of a query."""
        rows = self.rows(sql, parameters)
        if not rows:
            raise NotFoundError(f"There is no {what}.")
        return rows[0]

    def _part(
        self, sql: str, wanted: Mapping[str, Any], after: str | None, limit: int
    ) -> list[dict[str, Any]]:
        """Return the rows of one part of a list, and one more to tell whether another follows."""
        if not 1 <= limit <= _PAGE_MAX:
            raise InputError(f"The limit is {limit}; it must be from 1 to {_PAGE_MAX}.")
        instant, identifier = (None, None) if after is None else _read_mark(after)
        return self.rows(sql, {**wanted, "at": instant, "id": identifier, "n": limit + 1})


def _insert(cursor: duckdb.DuckDBPyConnection, name: str, table: pa.Table) -> None:
    """Append an Arrow table to the table of that name."""
    if not table.num_rows:
        return
    if name in _APPENDED:
        cursor.from_arrow(table).insert_into(name)
    elif name == "rigs":
        for row in table.to_pylist():
            cursor.execute(_PUT_RIG, row)
    else:
        execute_on(cursor, _INSERT[name], table)


def _refresh_errors(cursor: duckdb.DuckDBPyConnection, survey_id: str) -> None:
    """Take the errors of a survey's results anew against the truth that is known now."""
    known = {
        name: fetch(cursor, sql, {"id": survey_id}) for name, sql in _RESULTS_OF_SURVEY.items()
    }
    truth = _truth(cursor, survey_id)
    fresh = results.with_errors(known, truth)
    for name, sql in _REFRESH.items():
        execute_on(cursor, sql, fresh[name])
    adjusted = {
        name: fetch(cursor, sql, {"id": survey_id}) for name, sql in _ADJUSTED_OF_SURVEY.items()
    }
    fresh = adjustments.with_errors(adjusted, truth)
    for name, sql in _REFRESH_ADJUSTED.items():
        execute_on(cursor, sql, fresh[name])


def _truth(cursor: duckdb.DuckDBPyConnection, survey_id: str) -> Truth | None:
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


def _check_name(what: str, name: str) -> None:
    """Refuse a name that people could not read or type."""
    if not name.strip() or len(name) > 200 or not name.isprintable():
        raise InputError(f"{what} is {name!r}; it must have 1 to 200 printable characters.")


def _check_tables(tables: Mapping[str, pa.Table]) -> None:
    """Refuse results for tables that no job writes."""
    unknown = sorted(set(tables) - set(_OF_JOBS))
    if unknown:
        raise InputError(f"No job writes {unknown[0]!r}; it writes {', '.join(_OF_JOBS)}.")


def _require(job_id: str, status: JobStatus, *allowed: JobStatus) -> None:
    """Refuse to change a job that stands elsewhere."""
    if status not in allowed:
        raise ConflictError(f"Job {job_id} is {status}, not {' or '.join(allowed)}.")


def _standing(cursor: duckdb.DuckDBPyConnection, job_id: str) -> tuple[JobStatus, str]:
    """Read inside a transaction how a job stands, and its survey."""
    rows = cursor.execute(_STANDING, {"id": job_id}).fetchall()
    if not rows:
        raise NotFoundError(f"There is no job {job_id!r}.")
    return JobStatus(rows[0][0]), rows[0][1]


def _page(
    rows: list[dict[str, Any]],
    limit: int,
    instant: str,
    identifier: str,
    build: Callable[[dict[str, Any]], _Record],
) -> Page[_Record]:
    """Build a part of a list from its rows, of which one more was asked for."""
    last = rows[limit - 1] if len(rows) > limit else None
    mark = None if last is None else _write_mark(last[instant], last[identifier])
    return Page(items=tuple(build(row) for row in rows[:limit]), next=mark)


def _write_mark(instant: datetime, identifier: str) -> str:
    """Return the place in a list as text that needs no quoting in a URL."""
    return base64.urlsafe_b64encode(f"{instant.isoformat()} {identifier}".encode()).decode()


def _read_mark(mark: str) -> tuple[datetime, str]:
    """Return the place in a list that ``_write_mark`` wrote."""
    try:
        instant, identifier = base64.urlsafe_b64decode(mark.encode()).decode().split(" ", 1)
        return datetime.fromisoformat(instant), identifier
    except ValueError as error:
        raise InputError(
            f"{mark!r} is no place in this list; pass the 'next' of the part before."
        ) from error


def _now() -> datetime:
    """Return this instant, in UTC."""
    return datetime.now(UTC)
