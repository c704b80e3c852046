"""Routes of jobs: started, followed live, dismissed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import AsyncIterator
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import ValidationError
from starlette.exceptions import HTTPException

from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.errors import InputError
from spheremark.pipelines.scan.rigs import rig_digest
from spheremark.service.errors import RefusedRecordingError, ReusedKeyError
from spheremark.service.http.api.models import Job, Listing, NewJob
from spheremark.service.http.api.surveys import After, Limit
from spheremark.service.http.state import Current, Service
from spheremark.service.jobs.events import JobEvent
from spheremark.service.jobs.handlers import KINDS, Kind, Reading
from spheremark.service.provenance import code_version
from spheremark.storage.catalogue.records import JobRecord, JobStatus, SurveyRecord
from spheremark.storage.imports.uploads import rig_of

router = APIRouter(prefix="/jobs", tags=["jobs"])

JobId = Annotated[str, Path(description="Id of the job.")]
SurveyFilter = Annotated[str | None, Query(description="Id or name of a survey.")]
LastEvent = Annotated[int, Header(alias="Last-Event-ID", ge=0)]


@router.post("", name="create_job", status_code=202)
async def create_job(
    new: NewJob,
    request: Request,
    service: Current,
    response: Response,
    idempotency_key: Annotated[str | None, Header(min_length=1, max_length=200)] = None,
) -> Job:
    """Start a job; the same Idempotency-Key with the same request is the same job."""
    digest = hashlib.sha256(new.model_dump_json().encode()).hexdigest()
    if isinstance(new.rig, dict):
        rig = await service.readers.run(request, rig_of, json.dumps(new.rig))
        kept = await run_in_threadpool(service.catalogue.put_rig, rig)
        new = new.model_copy(update={"rig": kept})
    if idempotency_key is None:
        job = await run_in_threadpool(start, service, new)
    else:
        job = await run_in_threadpool(_once, service, new, idempotency_key, digest)
    response.headers["Location"] = f"/api/v1/jobs/{job.job_id}"
    return job


def _once(service: Service, new: NewJob, key: str, request: str) -> Job:
    """Start a job, or return the one that the request of this digest with this key has started."""
    with service.keys:
        known = service.catalogue.job_of_key(key)
        if known is None:
            return start(service, new, (key, request))
    if known[0] != request:
        raise ReusedKeyError(f"The Idempotency-Key {key!r} was used with another request.")
    return Job.of(known[1])


@router.get("", name="list_jobs")
def list_jobs(
    service: Current,
    survey: SurveyFilter = None,
    recording: Annotated[str | None, Query(description="Id of a recording.")] = None,
    status: JobStatus | None = None,
    after: After = None,
    limit: Limit = 100,
) -> Listing[Job]:
    """List jobs, newest first."""
    if recording is not None:
        service.catalogue.get_recording(recording)
    page = service.catalogue.list_jobs(
        survey=survey, recording_id=recording, status=status, after=after, limit=limit
    )
    return Listing(items=[Job.of(record) for record in page.items], next=page.next)


@router.get("/events", name="follow_jobs", response_class=EventSourceResponse)
async def follow_jobs(
    service: Current, last_event_id: LastEvent = 0
) -> AsyncIterator[ServerSentEvent]:
    """Follow all jobs: one stream for a page that shows many."""
    async for event in service.jobs.events.follow(last_event_id):
        yield _event(event)


@router.get("/{job}", name="get_job")
def get_job(job: JobId, service: Current) -> Job:
    """Return a job."""
    return Job.of(service.catalogue.get_job(job))


def _present(job: JobId, service: Current, last_event_id: LastEvent = 0) -> JobRecord:
    """Return the job to follow; end a client that has seen its end already (204)."""
    record = service.catalogue.get_job(job)
    if record.status.is_final and _end_of(record) <= last_event_id:
        raise HTTPException(204)
    return record


@router.get("/{job}/events", name="follow_job", response_class=EventSourceResponse)
async def follow_job(
    service: Current, job: Annotated[JobRecord, Depends(_present)], last_event_id: LastEvent = 0
) -> AsyncIterator[ServerSentEvent]:
    """Follow a job: what was missed since Last-Event-ID, then live, until its end."""
    known = service.jobs.events.since(last_event_id, job.job_id)
    if not known and job.status.is_final:
        yield _event(JobEvent(number=_end_of(job), job=job))
        return
    if not known:
        yield _event(JobEvent(number=last_event_id + 1, job=job))
    async for event in service.jobs.events.follow(last_event_id, job.job_id):
        yield _event(event)


@router.delete("/{job}", name="dismiss_job")
async def dismiss_job(job: JobId, service: Current) -> Job:
    """Dismiss a job that has not come to its end; nothing of it remains but its record."""
    return Job.of(await service.jobs.dismiss(job))


def start(
    service: Service,
    new: NewJob,
    key: tuple[str, str] | None = None,
    *,
    is_repeated: bool = True,
) -> Job:
    """Accept a job and submit it; unless repeated, one that would give the same is returned."""
    survey = service.catalogue.get_survey(new.survey)
    kind = KINDS[new.kind]
    recordings = _recordings(service, new, survey)
    config = SurveyConfig.from_mapping({"tolerance": survey.tolerance} | new.config)
    options = _options(kind, new) | _rig(service, new, survey)
    if not is_repeated and kind.takes_one_log:
        named = {"survey": survey.survey_id, "recording": recordings[0]}
        given = {"kind": new.kind, "config": config.to_mapping(), "options": options}
        if same := service.catalogue.same_job(named | given, code_version()):
            return Job.of(same)
    record = service.catalogue.create_job(
        new.kind,
        survey=survey.survey_id,
        recording_id=recordings[0] if kind.takes_one_log else None,
        config=config.to_mapping(),
        options=options if kind.takes_one_log else options | {"recordings": recordings},
        key=key,
    )
    service.jobs.submit(record)
    return Job.of(record)


def _recordings(service: Service, new: NewJob, survey: SurveyRecord) -> list[str]:
    """Return the logs that a job is to read: those named, else all that the survey has."""
    named = [new.recording] if new.recording is not None else new.recordings
    found = named or service.catalogue.recordings_of_survey(survey.survey_id)
    records = [service.catalogue.get_recording(one) for one in dict.fromkeys(found)]
    refused = [one for one in records if one.verdict == "refused"]
    is_read_anew = any(new.options.get(name) is not None for name in Reading.model_fields)
    if refused and named and not is_read_anew:
        raise RefusedRecordingError.of(refused[0])
    records = [one for one in records if one.verdict != "refused" or (named and is_read_anew)]
    if not records:
        raise InputError(
            f"The survey {survey.name} has no log that can be read; upload one with "
            "POST /api/v1/recordings?survey=..., or name 'recordings'."
        )
    return [one.recording_id for one in records]


def _options(kind: Kind, new: NewJob) -> dict[str, Any]:
    """Return all options of a kind, with its defaults."""
    try:
        return kind.options.model_validate(new.options).model_dump(mode="json")
    except ValidationError as error:
        found = [{**one, "loc": ("options", *one["loc"])} for one in error.errors()]
        raise RequestValidationError(found) from error


def _rig(service: Service, new: NewJob, survey: SurveyRecord) -> dict[str, str]:
    """Return the rig that a job is to use, as an option; none for the one of each log."""
    if isinstance(new.rig, str):
        return {"rig": rig_digest(service.catalogue.get_rig(new.rig))}
    if survey.rig_digest is None or not KINDS[new.kind].begins_with_rig_of_survey:
        return {}
    return {"rig": survey.rig_digest}


def _event(event: JobEvent) -> ServerSentEvent:
    """Return an event in the wire format: 'end' when nothing follows, 'progress' before."""
    kind = "end" if event.job.status.is_final else "progress"
    return ServerSentEvent(id=str(event.number), event=kind, data=Job.of(event.job))


def _end_of(job: JobRecord) -> int:
    """Return the number of the event that ended a job [ms since 1970]."""
    return int(job.finished_at.timestamp() * 1000) if job.finished_at else 0
