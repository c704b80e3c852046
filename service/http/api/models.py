"""The wire format: requests and responses. Units are in the names."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Generic, Literal, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, model_validator

from spheremark.pipelines.model import ControlMarks, Rig
from spheremark.pipelines.scan.rigs import rig_digest, rig_to_mapping
from spheremark.service.jobs.handlers import KINDS, JobKind
from spheremark.storage.catalogue.records import JobStatus
from spheremark.storage.imports.nesting import require_shallow
from spheremark.storage.recordings.preflight import Preflight

Item = TypeVar("Item")
SurveyKey = str  # id or name
Plain = dict[str, Any]  # an object of any keys; ``Strict`` checks its values


class Strict(BaseModel):
    """A request: an unknown field is an error, and so is a value that cannot be kept."""

    model_config = ConfigDict(extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _check_values(cls, given: Any) -> Any:
        """Refuse what is nested too deeply, halves of surrogate pairs, and too great numbers."""
        return require_shallow(given)


class Listing(BaseModel, Generic[Item]):
    """A part of a list."""

    items: list[Item]
    next: str | None = Field(default=None, description="Pass it as 'after' for what follows.")


class Recorded(BaseModel):
    """A record of the catalogue; fields without an alias are its attributes."""

    model_config = ConfigDict(from_attributes=True)

    @classmethod
    def of(cls, record: object) -> Self:
        """Return a record in the wire format."""
        return cls.model_validate(record)


class NewSurvey(Strict):
    """A survey to create."""

    name: str = Field(min_length=1, max_length=200, description="Unique name.")
    tolerance_m: float = Field(default=0.03, gt=0, le=1, description="Accepted error [m].")


class ChangedSurvey(Strict):
    """What to change of a survey."""

    name: str | None = Field(
        default=None, min_length=1, max_length=200, description="New name; null: as before."
    )
    tolerance_m: float | None = Field(
        default=None, gt=0, le=1, description="Accepted error [m]; null: as before."
    )


class DeletedSurvey(BaseModel):
    """A survey that was deleted and can be restored."""

    survey_id: str
    name: str
    deleted_at: datetime


class Survey(Recorded):
    """A field with its control marks and logs."""

    survey_id: str
    name: str
    tolerance_m: float = Field(validation_alias="tolerance")
    created_at: datetime
    rig_digest: str | None = Field(description="Rig of its jobs that name none.")
    n_control_marks: int
    n_true_stops: int
    n_recordings: int


class ResultCheck(BaseModel):
    """Errors or residuals of one kind of result over their sigmas."""

    what: str = Field(description="centres, stations or control.")
    measure: str = Field(description="What is compared: error, residual or difference.")
    n: int = Field(description="Compared positions.")
    ratio_rms: float | None = Field(
        description="Root mean square of error over sigma in each coordinate; 1 is expected."
    )
    ratio_low: float | None = Field(description="Lower end of its 95 % interval by chance.")
    ratio_high: float | None = Field(description="Upper end of its 95 % interval by chance.")
    rms_m: float
    largest_m: float
    largest_at: str


class SurveyResult(BaseModel):
    """The chosen solution of a survey, and the decision on it."""

    solution: str | None = Field(
        description="network with control, single stations, free network, or null without any."
    )
    adjustment_id: str | None
    fit_method: str | None
    resection_method: str | None
    status: Literal["accepted", "weak", "refused", "none"]
    sentence: str = Field(description="The decision as a sentence.")
    reasons: list[str] = Field(description="Why the survey is not accepted, or what is weak.")
    missing_stops: list[str] = Field(description="Stops without a position in the solution.")
    checks: list[ResultCheck]


class Mark(Strict):
    """A known sphere centre in the site frame."""

    mark: str
    x_m: float
    y_m: float
    z_m: float
    sigma_x_m: float = Field(default=0.0, ge=0.0)
    sigma_y_m: float = Field(default=0.0, ge=0.0)
    sigma_z_m: float = Field(default=0.0, ge=0.0)


class Control(Strict):
    """The control marks of a survey."""

    marks: list[Mark]

    @classmethod
    def of(cls, marks: ControlMarks | None) -> Self:
        """Return control marks in the wire format."""
        if marks is None:
            return cls(marks=[])
        return cls(
            marks=[
                Mark(
                    mark=name,
                    **dict(zip(("x_m", "y_m", "z_m"), map(float, p), strict=True)),
                    **{f"sigma_{axis}_m": float(cov[i, i] ** 0.5) for i, axis in enumerate("xyz")},
                )
                for name, p, cov in zip(marks.names, marks.p_site, marks.cov_p_site, strict=True)
            ]
        )


class ChosenRig(Strict):
    """The rig that later jobs of a survey use."""

    rig_digest: str | None = Field(
        description="Digest of a rig; null for the one that each log describes."
    )


class StoredRig(BaseModel):
    """A stored rig."""

    rig_digest: str
    rig: dict[str, Any] = Field(description="As in a rig file.")

    @classmethod
    def of(cls, rig: Rig) -> Self:
        """Return a rig in the wire format."""
        return cls(rig_digest=rig_digest(rig), rig=rig_to_mapping(rig))


class TruthSummary(BaseModel):
    """Extent of the truth of a survey; for comparison only."""

    n_marks: int
    n_stops: int


class Recording(Recorded):
    """An uploaded log."""

    recording_id: str = Field(description="SHA-256 of its bytes.")
    name: str
    size_bytes: int
    uploaded_at: datetime
    verdict: Literal["ok", "weak", "refused"]
    preflight: Preflight = Field(description="What the log holds and lacks, with reasons.")


class NewJob(Strict):
    """A job to start."""

    kind: JobKind = JobKind.PROCESS
    survey: SurveyKey = Field(description="Id or name of the survey.")
    recording: str | None = Field(
        default=None, description="Id of the recording; kinds that read several take 'recordings'."
    )
    recordings: list[str] | None = Field(
        default=None,
        min_length=1,
        description="Ids of recordings, for kinds that read several; all of the survey by default.",
    )
    rig: str | Plain | None = Field(
        default=None,
        description="Digest of a rig, or a rig file's JSON; by default the rig of the survey, "
        "and the one that each log describes where it has none.",
    )
    config: Plain = Field(
        default_factory=dict,
        description="What differs from the default configuration, nested as GET /config shows it.",
    )
    options: Plain = Field(default_factory=dict, description="Options of the kind.")

    @model_validator(mode="after")
    def _check_logs(self) -> Self:
        """Refuse logs that the kind does not take."""
        if not KINDS[self.kind].takes_one_log:
            if self.recording is not None and self.recordings is not None:
                raise ValueError("name the logs in 'recordings' alone, not in 'recording' too")
            return self
        if self.recording is None:
            raise ValueError(f"a job of the kind {self.kind} needs a recording")
        if self.recordings is not None:
            raise ValueError(f"a job of the kind {self.kind} reads one recording")
        return self


class Job(Recorded):
    """A job and its state; the traceback of an error stays in the database."""

    job_id: str
    kind: str
    survey_id: str
    survey: str
    recording_id: str | None
    recording: str | None
    config: dict[str, Any]
    options: dict[str, Any]
    status: JobStatus
    progress_percent: float
    message: str
    attempts: int
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    error_code: str | None
    error_reason: str | None
    waits_for: tuple[str, ...] = Field(
        default=(), description="Ids of the open jobs whose results this job reads."
    )


class Upload(Recording):
    """An uploaded log and the job that reads it."""

    job: Job | None = Field(default=None, description="The job, where process=true was set.")


class Run(Recorded):
    """A recording processed with one configuration by one version of the code."""

    run_id: str
    job_id: str
    survey_id: str
    recording_id: str
    config: dict[str, Any]
    config_digest: str
    code_version: str
    rig_digest: str
    finished_at: datetime
    duration_s: float = Field(validation_alias="duration")
    peak_memory_bytes: int | None


class ProblemKind(BaseModel):
    """A kind of problem."""

    code: str
    title: str
    status: int


QueryFormat = Literal["json", "csv", "parquet", "arrow"]
Scalar = bool | int | float | str | None
PARAMETERS_MAX = 50  # of one query


class NewQuery(Strict):
    """A query to keep under a name."""

    sql: str = Field(
        min_length=1, max_length=100_000, description="One SELECT; $name stands for a parameter."
    )
    parameters: dict[str, Scalar] = Field(
        default_factory=dict,
        max_length=PARAMETERS_MAX,
        description="Values of its parameters where an address gives none.",
    )


class SavedQuery(NewQuery):
    """A query that is kept."""

    name: str
    changed_at: datetime


class Query(Strict):
    """A query in SQL."""

    sql: str = Field(
        min_length=1, max_length=100_000, description="One SELECT; $name stands for a parameter."
    )
    format: QueryFormat = Field(default="json", description="Format of the response.")
    parameters: dict[str, Scalar] = Field(
        default_factory=dict, max_length=PARAMETERS_MAX, description="Values of the parameters."
    )


class Column(BaseModel):
    """A column of a query result."""

    model_config = ConfigDict(from_attributes=True)

    name: str
    type: str
    unit: str


class DescribedColumn(Column):
    """A column of a table or view."""

    comment: str


class Table(BaseModel):
    """A table or view."""

    model_config = ConfigDict(from_attributes=True)

    name: str
    kind: Literal["table", "view"]
    comment: str
    columns: list[DescribedColumn]


class QueryResponse(BaseModel):
    """The result of a query in SQL."""

    columns: list[Column]
    rows: list[list[Any]]
    truncated: bool = Field(description="Whether rows are missing because of the row limit.")
    row_limit: int
    elapsed_ms: float
    snapshot_at: datetime = Field(description="Results committed later are not included.")
