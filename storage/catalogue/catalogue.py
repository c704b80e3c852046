"""The catalogue of the service: surveys and logs, jobs, and the runs that jobs made."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from typing import Any

import duckdb
import pyarrow as pa

from spheremark.pipelines.errors import ConflictError, NotFoundError
from spheremark.storage.catalogue import adjustments, results
from spheremark.storage.catalogue.database import Changed, fetch
from spheremark.storage.catalogue.records import (
    JobRecord,
    JobStatus,
    Page,
    RunRecord,
    json_text,
    record_of,
)
from spheremark.storage.catalogue.surveys import Surveys, check_name, now
from spheremark.storage.catalogue.tables import check_tables

_NO_OPTIONS: Mapping[str, Any] = {}
_ACTIVE = (JobStatus.ACCEPTED, JobStatus.RUNNING)

_JOBS = """
SELECT j.*, s.name AS survey, r.name AS recording, coalesce((
    SELECT list(w.job_id ORDER BY w.created_at, w.job_id) FROM jobs AS w
    WHERE j.status = 'accepted' AND w.status IN ('accepted', 'running')
        AND w.survey_id = j.survey_id AND (w.created_at, w.job_id) < (j.created_at, j.job_id)
        AND (w.kind = 'process' AND j.kind IN ('adjust', 'site')
            OR w.kind = 'adjust' AND j.kind = 'site')
), []) AS waits_for
FROM jobs AS j JOIN surveys AS s USING (survey_id) LEFT JOIN recordings AS r USING (recording_id)
LEFT JOIN deleted_surveys AS d ON d.survey_id = j.survey_id
"""
_JOB = _JOBS + "WHERE j.job_id = $id"
_JOBS_AFTER = (
    _JOBS
    + """
WHERE ($at::TIMESTAMPTZ IS NULL OR (j.created_at, j.job_id) < ($at::TIMESTAMPTZ, $id))
    AND d.survey_id IS NULL
    AND ($survey_id::VARCHAR IS NULL OR j.survey_id = $survey_id)
    AND ($recording_id::VARCHAR IS NULL OR j.recording_id = $recording_id)
    AND ($status::VARCHAR IS NULL OR j.status = $status)
ORDER BY j.created_at DESC, j.job_id DESC LIMIT $n
"""
)
_STATUS = "SELECT status FROM jobs WHERE job_id = $id"
_CREATE = """
INSERT INTO jobs (job_id, kind, survey_id, recording_id, config, options, created_at, status,
    progress_percent, message, attempts)
VALUES (?, ?, ?, ?, ?, ?, ?, 'accepted', 0, 'Waiting for a worker.', 0)
"""
_WAIT = "UPDATE jobs SET message = ? WHERE job_id = ?"
_KEY = "SELECT request, job_id FROM idempotency_keys WHERE key = $key"
_KEEP_KEY = "INSERT INTO idempotency_keys VALUES (?, ?, ?, ?)"
_START = """
UPDATE jobs SET status = 'running', started_at = ?, attempts = attempts + 1, progress_percent = 0,
    message = 'Started.'
WHERE job_id = ?
"""
_PROGRESS = """
UPDATE jobs SET progress_percent = ?, message = ? WHERE job_id = ? AND status = 'running'
"""
_SAME = """
SELECT j.job_id FROM jobs AS j
LEFT JOIN runs AS r ON r.job_id = j.job_id
LEFT JOIN control_changes AS c ON c.survey_id = j.survey_id
WHERE j.kind = $kind AND j.survey_id = $survey AND j.recording_id = $recording
    AND j.config = $config::JSON AND j.options = $options::JSON
    AND (j.status IN ('accepted', 'running')
        OR (j.status = 'successful' AND r.code_version = $version
            AND j.created_at >= coalesce(c.changed_at, j.created_at)))
ORDER BY j.created_at DESC LIMIT 1
"""
_SUCCEED = """
UPDATE jobs SET status = 'successful', progress_percent = 100, message = ?, finished_at = ?
WHERE job_id = ? AND status = 'running'
"""
_FAIL = """
UPDATE jobs SET status = 'failed', message = 'Failed.', finished_at = ?, error_code = ?,
    error_reason = ?, error_traceback = ?
WHERE job_id = ?
"""
_DISMISS = """
UPDATE jobs SET status = 'dismissed', message = 'Dismissed.', finished_at = ? WHERE job_id = ?
"""
_REQUEUE = "UPDATE jobs SET status = 'accepted', progress_percent = 0, message = ? WHERE job_id = ?"
_GIVE_UP = """
UPDATE jobs SET status = 'failed', message = 'Failed.', finished_at = ?, error_code = 'worker_died',
    error_reason = ?
WHERE status = 'running' AND attempts >= ?
"""
_RELEASE = """
UPDATE jobs SET status = 'accepted', attempts = attempts - 1, progress_percent = 0,
    message = 'Waiting for the service.'
WHERE status = 'running'
"""
_RESUME = """
UPDATE jobs SET status = 'accepted', progress_percent = 0,
    message = 'Taken up again after a restart.'
WHERE status = 'running'
"""
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


class Catalogue(Surveys):
    """Results, the surveys that they belong to, and the jobs that made them.

    Opened like a ``Database``. A job that is changed from a status which does not allow it raises
    ``ConflictError``; a job or run that does not exist raises ``NotFoundError``.
    """

    def create_job(
        self,
        kind: str,
        *,
        survey: str,
        recording_id: str | None,
        config: Mapping[str, Any],
        options: Mapping[str, Any] = _NO_OPTIONS,
        key: tuple[str, str] | None = None,
    ) -> JobRecord:
        """Accept a job on a survey (id or name) and a log; without a log on the whole survey.

        ``key`` names the request, with a digest of it: see ``job_of_key``.
        """
        check_name("The kind of a job", kind)
        survey_id = self.id_of_survey(survey)
        if recording_id is not None:
            self.get_recording(recording_id)
        job_id = secrets.token_hex(8)
        texts = [json_text(config), json_text(options)]
        with self.writing(Changed.QUEUE) as cursor:
            cursor.execute(_CREATE, [job_id, kind, survey_id, recording_id, *texts, now()])
            if key is not None:
                cursor.execute(_KEEP_KEY, [*key, job_id, now()])
            (job,) = fetch(cursor, _JOB, {"id": job_id}).to_pylist()
            if before := job["waits_for"]:
                text = f"Waiting for {len(before)} job{'s' * (len(before) > 1)} of the survey."
                cursor.execute(_WAIT, [text, job_id])
        return self.get_job(job_id)

    def same_job(self, new: Mapping[str, Any], code_version: str) -> JobRecord | None:
        """Return the job on one log whose results those of another one would equal, if any.

        ``new`` has kind, survey (id), recording, config and options. A job that ended counts where
        this version of the code did it, and where the control marks were not set since.
        """
        texts = {name: json_text(new[name]) for name in ("config", "options")}
        rows = self.rows(_SAME, {**new, **texts, "version": code_version})
        return self.get_job(rows[0]["job_id"]) if rows else None

    def job_of_key(self, key: str) -> tuple[str, JobRecord] | None:
        """Return the request that has a key, as its digest, and its job; None if there is none."""
        rows = self.rows(_KEY, {"key": key})
        return (rows[0]["request"], self.get_job(rows[0]["job_id"])) if rows else None

    def get_job(self, job_id: str) -> JobRecord:
        """Return a job."""
        return record_of(JobRecord, self._one(_JOB, {"id": job_id}, f"job {job_id!r}"))

    def list_jobs(
        self,
        *,
        survey: str | None = None,
        recording_id: str | None = None,
        status: JobStatus | None = None,
        after: str | None = None,
        limit: int = 100,
    ) -> Page[JobRecord]:
        """Return a page of jobs, newest first, of one survey, log or status if given."""
        survey_id = None if survey is None else self.id_of_survey(survey)
        filters = {"survey_id": survey_id, "recording_id": recording_id, "status": status}
        return self._page(JobRecord, _JOBS_AFTER, filters, after, limit)

    def start_job(self, job_id: str) -> JobRecord:
        """Begin an attempt at an accepted job."""
        return self._change(job_id, (JobStatus.ACCEPTED,), _START, now())

    def report_progress(self, job_id: str, percent: float, message: str) -> None:
        """Set the progress of a running job, 0 to 100; no effect on a job that does not run.

        Notes
        -----
        Costs a millisecond, and does not outdate the newest snapshot.
        """
        with self.writing(Changed.PROGRESS) as cursor:
            cursor.execute(_PROGRESS, [min(max(float(percent), 0.0), 100.0), message, job_id])

    def finish_job(
        self, job_id: str, tables: Mapping[str, pa.Table], *, message: str = "Done."
    ) -> None:
        """Write the results of a running job and its end, both or neither.

        Parameters
        ----------
        job_id : str
            The job; successful afterwards.
        tables : mapping of str to Table
            Rows by table, as ``results.tables`` makes them.
        message : str
            The result of the job, as a sentence.

        Raises
        ------
        ConflictError
            If the job neither runs nor is successful already.
        InputError
            If no job writes a table of such a name.

        Notes
        -----
        Results are written once: finishing a successful job again changes nothing. Errors are
        computed against the truth that is known now. The rows of one scan take some milliseconds.
        """
        check_tables(tables)
        with self.writing() as cursor:
            ending = [message, now(), job_id]
            if cursor.execute(self._statement(_SUCCEED), ending).fetchall() == [(0,)]:
                status = _status(cursor, job_id)
                if status is JobStatus.SUCCESSFUL:
                    return
                _require(job_id, status, JobStatus.RUNNING)
            truth = self._tables.truth(self._tables.survey_of(job_id))
            compared = adjustments.with_errors(results.with_errors(tables, truth), truth)
            self._tables.append(compared)

    def fail_job(
        self, job_id: str, *, code: str, reason: str, traceback: str | None = None
    ) -> JobRecord:
        """Record the failure of a job: stable code, sentence and traceback."""
        return self._change(job_id, _ACTIVE, _FAIL, now(), code, reason, traceback)

    def dismiss_job(self, job_id: str) -> JobRecord:
        """Dismiss a job that has not ended."""
        return self._change(job_id, _ACTIVE, _DISMISS, now())

    def requeue_job(self, job_id: str, message: str) -> JobRecord:
        """Accept a running job again, for another attempt; the message gives the reason."""
        return self._change(job_id, (JobStatus.RUNNING,), _REQUEUE, message)

    def release_jobs(self) -> None:
        """Accept running jobs again at the end of the service; the attempt does not count."""
        with self.writing() as cursor:
            cursor.execute(_RELEASE)

    def take_up_jobs(self, attempts: int, reason: str) -> tuple[JobRecord, ...]:
        """Accept interrupted jobs again at the start of the service; return all, oldest first.

        Those that were begun so many times, and never came to an end, fail for this reason.
        """
        with self.writing() as cursor:
            cursor.execute(_GIVE_UP, [now(), reason, attempts])
            cursor.execute(_RESUME)
            rows = fetch(cursor, _JOBS_ACCEPTED, {}).to_pylist()
            return tuple(record_of(JobRecord, row) for row in rows)

    def get_run(self, run_id: str) -> RunRecord:
        """Return a run."""
        return record_of(RunRecord, self._one(_RUN, {"id": run_id}, f"run {run_id!r}"))

    def list_runs(
        self,
        *,
        survey: str | None = None,
        recording_id: str | None = None,
        job_id: str | None = None,
        after: str | None = None,
        limit: int = 100,
    ) -> Page[RunRecord]:
        """Return a page of the runs, newest first, of one survey, log or job if given."""
        survey_id = None if survey is None else self.id_of_survey(survey)
        filters = {"survey_id": survey_id, "recording_id": recording_id, "job_id": job_id}
        return self._page(RunRecord, _RUNS_AFTER, filters, after, limit)

    def _change(
        self, job_id: str, allowed: tuple[JobStatus, ...], sql: str, *values: object
    ) -> JobRecord:
        """Change a job in a transaction if its status is one of those allowed."""
        with self.writing(Changed.QUEUE) as cursor:
            _require(job_id, _status(cursor, job_id), *allowed)
            cursor.execute(sql, [*values, job_id])
        return self.get_job(job_id)


def _require(job_id: str, status: JobStatus, *allowed: JobStatus) -> None:
    """Refuse to change a job of another status."""
    if status not in allowed:
        raise ConflictError(f"Job {job_id} is {status}, not {' or '.join(allowed)}.")


def _status(cursor: duckdb.DuckDBPyConnection, job_id: str) -> JobStatus:
    """Read the status of a job inside a transaction."""
    rows = cursor.execute(_STATUS, {"id": job_id}).fetchall()
    if not rows:
        raise NotFoundError(f"There is no job {job_id!r}.")
    return JobStatus(rows[0][0])
