"""What is kept of jobs and of the runs that they made, beside all that people gave."""

from __future__ import annotations

import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import duckdb
import pyarrow as pa

from spheremark.pipelines.errors import ConflictError, NotFoundError
from spheremark.storage.catalogue import adjustments, results
from spheremark.storage.catalogue.database import fetch
from spheremark.storage.catalogue.lists import page_of
from spheremark.storage.catalogue.records import (
    JobRecord,
    JobStatus,
    Page,
    RunRecord,
    job_of,
    json_text,
    run_of,
)
from spheremark.storage.catalogue.surveys import Surveys, check_name, now
from spheremark.storage.catalogue.tables import check_tables

_NO_OPTIONS: Mapping[str, Any] = {}

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
_STANDING = "SELECT status FROM jobs WHERE job_id = $id"
_SUCCEED = """
UPDATE jobs SET status = 'successful', progress_percent = 100, message = ?, finished_at = ?
WHERE job_id = ? AND status = 'running'
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
    """The results, the surveys that they belong to, and the jobs that made them.

    Opened as a ``Database`` is: with the path of the file and a folder for snapshots.
    """

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
        check_name("The kind of a job", kind)
        survey_id = self.get_survey(survey).survey_id
        if recording_id is not None:
            self.get_recording(recording_id)
        job_id = secrets.token_hex(8)
        texts = [json_text(config), json_text(options)]
        row = [job_id, kind, survey_id, recording_id, *texts, now()]
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
        return page_of(rows, limit, "created_at", "job_id", job_of)

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
                [now(), job_id],
            )
            self._tables.survey_of(job_id)  # asked for now, so that the end need not wait for it
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
            Rows by table, as ``results.tables`` makes them.
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
        taken against the truth that is known now. To write the rows of one scan takes some
        milliseconds, almost whatever they are.
        """
        check_tables(tables)
        with self.writing() as cursor:
            ending = [message, now(), job_id]
            if cursor.execute(self._statement(_SUCCEED), ending).fetchall() == [(0,)]:
                status = _standing(cursor, job_id)
                if status is JobStatus.SUCCESSFUL:
                    return
                _require(job_id, status, JobStatus.RUNNING)
            truth = self._tables.truth(self._tables.survey_of(job_id))
            compared = adjustments.with_errors(results.with_errors(tables, truth), truth)
            self._tables.append(compared)

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
                [now(), code, reason, traceback, job_id],
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
                [now(), job_id],
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
        return page_of(rows, limit, "finished_at", "run_id", run_of)

    @contextmanager
    def _changing(self, job_id: str, *allowed: JobStatus) -> Iterator[duckdb.DuckDBPyConnection]:
        """Hold a transaction on a job that stands where it may be changed."""
        with self.writing() as cursor:
            _require(job_id, _standing(cursor, job_id), *allowed)
            yield cursor


def _require(job_id: str, status: JobStatus, *allowed: JobStatus) -> None:
    """Refuse to change a job that stands elsewhere."""
    if status not in allowed:
        raise ConflictError(f"Job {job_id} is {status}, not {' or '.join(allowed)}.")


def _standing(cursor: duckdb.DuckDBPyConnection, job_id: str) -> JobStatus:
    """Read inside a transaction how a job stands."""
    rows = cursor.execute(_STANDING, {"id": job_id}).fetchall()
    if not rows:
        raise NotFoundError(f"There is no job {job_id!r}.")
    return JobStatus(rows[0][0])
