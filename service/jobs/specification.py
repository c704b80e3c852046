"""What the service sends to a worker and what comes back, the same for every kind of job."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.errors import ConfigError
from spheremark.pipelines.model import ControlMarks, Origin, Rig, ScanLog
from spheremark.service.provenance import code_version

if TYPE_CHECKING:
    import pyarrow as pa

    from spheremark.pipelines.survey import Progress
    from spheremark.storage.catalogue.catalogue import Catalogue
    from spheremark.storage.recordings import LogOptions


Row = dict[str, Any]


class JobKind(StrEnum):
    """Kinds of jobs."""

    PROCESS = "process"
    ADJUST = "adjust"
    CALIBRATE = "calibrate"
    SITE = "site"


@dataclass(frozen=True, slots=True, kw_only=True)
class Log:
    """An uploaded log: its digest, its name, the address of its bytes, and how to read it.

    ``reading`` are options as ``LogOptions.from_mapping`` takes them.
    """

    recording_id: str
    name: str
    url: str
    reading: Mapping[str, Any] = field(default_factory=dict)

    @property
    def options(self) -> LogOptions:
        """Its reading as the reader of logs takes it."""
        from spheremark.storage.recordings.options import LogOptions

        return LogOptions.from_mapping(self.reading)

    def read(self, name: str | None = None) -> ScanLog:
        """Read the log in a confined process, under the name of its recording or a given one."""
        return self.read_with(self.options, name)

    def read_with(self, options: LogOptions, name: str | None = None) -> ScanLog:
        """Read the log with other options."""
        from spheremark.storage.imports.uploads import read_upload
        from spheremark.storage.recordings import local_copy

        origin = Origin(name=name or self.name, digest=self.recording_id)
        with local_copy(self.url) as path:
            return read_upload(path, options, origin)


@dataclass(frozen=True, slots=True, kw_only=True)
class JobSpecification:
    """The input of a worker: values and addresses, never arrays of a scan, never truth.

    ``result_id`` is new for each attempt and identifies its rows; ``rig`` replaces those of the
    logs; ``known`` are the rows of the database that the kind gathered.
    """

    job_id: str
    kind: JobKind
    result_id: str
    survey_id: str
    logs: tuple[Log, ...]
    config: SurveyConfig
    marks: ControlMarks | None
    rig: Rig | None
    clouds_url: str
    options: Mapping[str, Any] = field(default_factory=dict)
    known: Mapping[str, pa.Table] = field(default_factory=dict)

    def columns(self, start: float) -> Row:
        """Return the columns of every result of a job that began at this reading of the timer."""
        return {
            "job_id": self.job_id,
            "survey_id": self.survey_id,
            "finished_at": datetime.now(UTC),
            "config": self.config.text,
            "config_digest": self.config.digest,
            "code_version": code_version(),
            "duration_s": perf_counter() - start,
        }

    @property
    def log_names(self) -> tuple[str, ...]:
        """Name of each log in the job: one that has the name of another gets a number."""
        names: list[str] = []
        for log in self.logs:
            name, again = log.name, 1
            while name in names:
                again += 1
                name = f"{log.name} ({again})"
            names.append(name)
        return tuple(names)


@dataclass(frozen=True, slots=True, kw_only=True)
class JobResult:
    """The output of a worker: rows by table of the database, and a sentence for people."""

    tables: dict[str, pa.Table]
    message: str


class Options(BaseModel):
    """Options of a kind beside logs, rig and configuration; none by default."""

    model_config = ConfigDict(extra="forbid")


class Reading(Options):
    """How the logs of a job are read, where that differs from their uploads."""

    topic: list[str] | None = Field(default=None, description="Topics to use.")
    joint: str | None = Field(
        default=None, description="Joint of the gimbal, frame that turns, or topic of numbers."
    )
    joint_sign: int | None = Field(
        default=None, description="-1 where angles grow clockwise seen from above."
    )
    joint_unit: str | None = Field(
        default=None, description="rad, deg, turn, or the number of steps of a full turn."
    )
    joint_offset_deg: float | None = Field(default=None, description="Added to the angle.")
    lidar_offset_s: float | None = Field(default=None, description="Added to the LiDAR's stamps.")
    stamp: Literal["auto", "start", "end"] | None = Field(
        default=None, description="Instant of a cloud that its stamp is."
    )
    time_unit: Literal["auto", "s", "ms", "us", "ns"] | None = Field(
        default=None, description="Unit of the times of points."
    )
    recover: bool | None = Field(
        default=None, description="Whether to use what is readable of a damaged log."
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Refuse values that cannot be, before a job reads them."""
        try:
            self.options()
        except ConfigError as error:
            raise ValueError(str(error)) from error
        return self

    def options(self) -> LogOptions:
        """Return the options as the reader of logs takes them."""
        from spheremark.storage.recordings.options import LogOptions

        return LogOptions.from_mapping(self.given())

    def given(self) -> dict[str, Any]:
        """Return what is given as plain values."""
        values = ((name, getattr(self, name)) for name in Reading.model_fields)
        return {name: value for name, value in values if value is not None}


def _nothing(_catalogue: Catalogue, _spec: JobSpecification) -> Mapping[str, pa.Table]:
    """Return no rows."""
    return {}


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """One kind of job.

    ``handle`` runs in a worker process and imports heavy modules itself; it can be stopped wherever
    it reports progress. ``gather`` runs in the service and reads the rows that ``handle`` needs.
    """

    handle: Callable[[JobSpecification, Progress], JobResult]
    takes_one_log: bool = False
    begins_with_rig_of_survey: bool = True
    options: type[Options] = Options
    gather: Callable[[Catalogue, JobSpecification], Mapping[str, pa.Table]] = _nothing
