"""What the service asks of a worker, and what it gets back: the same for every kind of job."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict

from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.model import ControlMarks, Rig

if TYPE_CHECKING:
    import pyarrow as pa

    from spheremark.pipelines.survey import Progress
    from spheremark.storage.catalogue.catalogue import Catalogue


class JobKind(StrEnum):
    """What can be asked for."""

    PROCESS = "process"
    ADJUST = "adjust"
    CALIBRATE = "calibrate"
    SITE = "site"


@dataclass(frozen=True, slots=True, kw_only=True)
class Log:
    """An uploaded log: its digest, what it is called, and where its bytes are."""

    recording_id: str
    name: str
    url: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """What a worker is asked to do: values and places, never arrays of a scan, never truth.

    ``result_id`` is new for each attempt and names the rows that it gives; ``rig`` is the one to
    use in place of the logs' own; ``known`` are rows of the database that the kind asked for.
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

    @property
    def log_names(self) -> tuple[str, ...]:
        """What each log is called in the job: one that has the name of another gets a number."""
        names: list[str] = []
        for log in self.logs:
            name, again = log.name, 1
            while name in names:
                again += 1
                name = f"{log.name} ({again})"
            names.append(name)
        return tuple(names)


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What a job gave: rows named as the tables of the database, and a sentence for people."""

    tables: dict[str, pa.Table]
    message: str


class Options(BaseModel):
    """What a kind lets one choose, beside logs, rig and configuration; here nothing."""

    model_config = ConfigDict(extra="forbid")


def _nothing(_catalogue: Catalogue, _order: Order) -> Mapping[str, pa.Table]:
    """Return no rows."""
    return {}


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """One kind of job.

    ``work`` runs in a worker process and imports what is heavy itself; it may be stopped wherever
    it reports progress. ``gather`` runs in the service and reads the rows that ``work`` needs.
    """

    work: Callable[[Order, Progress], Outcome]
    takes_one_log: bool = False
    begins_with_rig_of_survey: bool = True
    options: type[Options] = Options
    gather: Callable[[Catalogue, Order], Mapping[str, pa.Table]] = _nothing
