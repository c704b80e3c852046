"""Rows of the catalogue as values: what the typed verbs of ``storage.catalogue`` take and give."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import Any, Generic, TypeVar

_Record = TypeVar("_Record")


class JobStatus(StrEnum):
    """Where a job stands; the words are those of OGC API - Processes."""

    ACCEPTED = "accepted"
    RUNNING = "running"
    SUCCESSFUL = "successful"
    FAILED = "failed"
    DISMISSED = "dismissed"

    @property
    def is_final(self) -> bool:
        """Whether a job that stands here never changes again."""
        return self not in (JobStatus.ACCEPTED, JobStatus.RUNNING)


@dataclass(frozen=True, slots=True, kw_only=True)
class Page(Generic[_Record]):
    """A part of a list.

    Attributes
    ----------
    items : tuple
        The records, newest first.
    next : str or None
        What to pass as ``after`` to get the part that follows; none at the end.
    """

    items: tuple[_Record, ...]
    next: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyRecord:
    """A field with its marks and logs.

    Attributes
    ----------
    survey_id : str
        Given by the catalogue, never reused.
    name : str
        Given by people, unique.
    tolerance : float
        Error that the survey accepts [m].
    created_at : datetime
        When it was made, in UTC.
    n_control_marks : int
        Number of its control marks.
    n_true_stops : int
        Number of its stops whose truth is known.
    n_recordings : int
        Number of different logs that jobs of this survey have asked for.
    """

    survey_id: str
    name: str
    tolerance: float
    created_at: datetime
    n_control_marks: int
    n_true_stops: int
    n_recordings: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingRecord:
    """An uploaded log.

    Attributes
    ----------
    recording_id : str
        SHA-256 of its bytes, in hexadecimal.
    name : str
        Stem of the name that it was uploaded under.
    size_bytes : int
        Length of the file.
    uploaded_at : datetime
        When it came, in UTC.
    url : str
        Where its bytes are.
    verdict : str
        Outcome of the preflight: ``ok``, ``weak`` or ``refused``.
    preflight : mapping
        The whole report.
    """

    recording_id: str
    name: str
    size_bytes: int
    uploaded_at: datetime
    url: str
    verdict: str
    preflight: Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class JobRecord:
    """Work that was asked for.

    Attributes
    ----------
    job_id : str
        Given by the catalogue.
    kind : str
        What is done, for instance ``process``.
    survey_id, survey : str
        The survey that it belongs to: id and name.
    recording_id, recording : str or None
        The log that it reads: digest and name; none for work on the survey as a whole.
    config : mapping
        The effective configuration.
    status : JobStatus
        Where it stands.
    progress_percent : float
        0 to 100.
    message : str
        What is being done, as a sentence for people.
    attempts : int
        How often it was started.
    created_at : datetime
        When it was asked for, in UTC.
    started_at, finished_at : datetime or None
        When its last attempt began, and when it came to its end.
    error_code, error_reason, error_traceback : str or None
        Why it failed: stable code, sentence, and where in the code.
    """

    job_id: str
    kind: str
    survey_id: str
    survey: str
    recording_id: str | None
    recording: str | None
    config: Mapping[str, Any]
    status: JobStatus
    progress_percent: float
    message: str
    attempts: int
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    error_code: str | None
    error_reason: str | None
    error_traceback: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRecord:
    """A recording processed with one configuration by one version of the code.

    Attributes
    ----------
    run_id : str
        Names the rows of this run in every table.
    job_id, survey_id, recording_id : str
        Where it belongs.
    config : mapping
        The effective configuration.
    config_digest, code_version, rig_digest : str
        What the numbers depend on.
    finished_at : datetime
        When, in UTC.
    duration : float
        Time that the run took [s].
    peak_memory_bytes : int or None
        Largest resident size of the worker's process.
    """

    run_id: str
    job_id: str
    survey_id: str
    recording_id: str
    config: Mapping[str, Any]
    config_digest: str
    code_version: str
    rig_digest: str
    finished_at: datetime
    duration: float
    peak_memory_bytes: int | None
