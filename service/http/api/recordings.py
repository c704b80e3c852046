"""Routes of recordings: uploaded logs, their preflight reports and their bytes."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.responses import FileResponse
from pydantic import Field

from spheremark.pipelines.errors import InputError
from spheremark.service.errors import MediaTypeError, TooLargeError
from spheremark.service.http.api.jobs import start
from spheremark.service.http.api.models import Job, Listing, NewJob, Recording, Upload
from spheremark.service.http.api.surveys import After, Limit
from spheremark.service.http.folders import FORM
from spheremark.service.http.state import Current, Service
from spheremark.service.http.uploads import media_type_of, take_in
from spheremark.service.jobs.handlers import Reading
from spheremark.storage.catalogue.records import RecordingRecord
from spheremark.storage.recordings.preflight import Preflight

router = APIRouter(prefix="/recordings", tags=["recordings"])

Digest = Annotated[str, Path(description="SHA-256 of the log.", pattern="^[0-9a-f]{64}$")]
MCAP = "application/vnd.mcap"
_MEDIA_TYPES = (
    MCAP,
    "application/octet-stream",  # a log is known by its first bytes
    "application/zip",
    "application/x-zip-compressed",
    "application/vnd.sqlite3",
    "application/x-sqlite3",
    "application/vnd.tcpdump.pcap",
    FORM,  # the files of a folder
)
_BODY = {
    "requestBody": {
        "required": True,
        "content": {
            one: {"schema": {"type": "string", "format": "binary"}} for one in _MEDIA_TYPES
        },
    }
}


class NewUpload(Reading):
    """The query of an upload."""

    name: str = Field(min_length=1, max_length=200, description="Name of the log.")
    survey: str | None = Field(default=None, description="Id or name of its survey.")
    process: bool = Field(default=False, description="Whether to start a job at once.")


@router.post(
    "",
    name="upload_recording",
    status_code=201,
    openapi_extra=_BODY,
    responses={200: {"model": Upload, "description": "The same log was here already."}},
)
async def upload_recording(
    request: Request,
    response: Response,
    service: Current,
    query: Annotated[NewUpload, Query()],
) -> Upload:
    """Take in a log: the body is the file, streamed to disk; a refused log is kept as well.

    MCAP, a part of rosbag2 (.db3), a ROS 1 bag, a PCAP, or a zip of these; or a form with the files
    of a folder, which are one log.
    """
    most, survey, options = service.settings.max_upload_bytes, query.survey, query.options()
    _check_upload(request, most)
    if query.process or survey is not None:
        await asyncio.to_thread(check_survey, service, survey)
    received = await service.inbox.receive(request.stream(), most, request.headers)
    recording, is_new = await service.inspect(
        take_in, service.catalogue, received, query.name, options
    )
    response.status_code = 201 if is_new else 200
    response.headers["Location"] = f"/api/v1/recordings/{recording.recording_id}"
    if survey is not None:
        await asyncio.to_thread(service.catalogue.add_to_survey, survey, recording.recording_id)
    start = query.process
    job = await asyncio.to_thread(start_job, service, survey, recording) if start else None
    return Upload(**Recording.of(recording).model_dump(), job=job)


@router.get("", name="list_recordings")
def list_recordings(
    service: Current, after: After = None, limit: Limit = 100
) -> Listing[Recording]:
    """List uploaded logs, newest first."""
    page = service.catalogue.list_recordings(after=after, limit=limit)
    return Listing(items=[Recording.of(record) for record in page.items], next=page.next)


@router.get("/{recording}", name="get_recording")
def get_recording(recording: Digest, service: Current) -> Recording:
    """Return an uploaded log."""
    return Recording.of(service.catalogue.get_recording(recording))


@router.get("/{recording}/preflight", name="get_preflight")
def get_preflight(recording: Digest, service: Current) -> Preflight:
    """Return what a log holds and lacks."""
    return Recording.of(service.catalogue.get_recording(recording)).preflight


@router.get(
    "/{recording}/file",
    name="download_recording",
    response_class=FileResponse,
    responses={200: {"content": {MCAP: {}}}},
)
def download_recording(recording: Digest, service: Current) -> FileResponse:
    """Return the bytes of a log, as they were uploaded."""
    known = service.catalogue.get_recording(recording)
    return FileResponse(known.url, media_type=MCAP, filename=f"{known.name}.mcap")


def _check_upload(request: Request, max_bytes: int) -> None:
    """Refuse a body by its headers, before a byte of it is read."""
    media_type = media_type_of(request.headers)
    if media_type not in _MEDIA_TYPES:
        raise MediaTypeError(
            f"The body is {media_type or 'of no type'}; send the log itself as {MCAP}."
        )
    declared = request.headers.get("content-length", "")
    if declared.isdecimal() and int(declared) > max_bytes:
        raise TooLargeError(f"The log has {int(declared):,} bytes; {max_bytes:,} are accepted.")


def check_survey(service: Service, survey: str | None) -> str:
    """Return the survey that a job shall belong to."""
    if survey is None:
        raise InputError("process=true needs survey=<id or name>: results belong to a survey.")
    return service.catalogue.id_of_survey(survey)


def start_job(service: Service, survey: str | None, recording: RecordingRecord) -> Job:
    """Start a job for a log that just came, unless one that would give the same is there."""
    new = NewJob(survey=check_survey(service, survey), recording=recording.recording_id)
    with service.keys:
        return start(service, new, is_repeated=False)
