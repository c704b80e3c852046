"""Routes of resumable uploads: the protocol tus 1.0 (https://tus.io/protocols/resumable-upload)."""

from __future__ import annotations

import asyncio
import base64
from collections.abc import Mapping
from email.utils import formatdate
from typing import Annotated, Any

from fastapi import APIRouter, Header, Path, Request, Response
from pydantic import ValidationError

from spheremark.pipelines.errors import InputError
from spheremark.service.errors import MediaTypeError, TooLargeError, TusVersionError
from spheremark.service.http.api.recordings import check_survey, start_job
from spheremark.service.http.state import Current, Service
from spheremark.service.http.uploads import Received, Upload, enter, media_type_of
from spheremark.service.jobs.handlers import Reading
from spheremark.storage.recordings import LogOptions

router = APIRouter(prefix="/uploads", tags=["recordings"])

VERSION = "1.0.0"
PART = "application/offset+octet-stream"
EXTENSIONS = "creation,creation-with-upload,checksum,expiration,termination"
ALGORITHMS = ("sha256", "sha1", "md5")
_BODY = {
    "requestBody": {"content": {PART: {"schema": {"type": "string", "format": "binary"}}}},
}
_HEADERS = {
    "Tus-Resumable": ("Version of the protocol.", "string"),
    "Tus-Version": ("Versions that are known.", "string"),
    "Tus-Extension": ("Extensions that are known.", "string"),
    "Tus-Max-Size": ("Longest log that is accepted [bytes].", "integer"),
    "Tus-Checksum-Algorithm": ("Algorithms for the digest of a part.", "string"),
    "Location": ("Address of the upload.", "string"),
    "Upload-Offset": ("How many bytes are here.", "integer"),
    "Upload-Length": ("Length of the log [bytes].", "integer"),
    "Upload-Expires": ("Until when an unfinished upload is kept.", "string"),
    "Content-Location": ("Address of the recording, once the log is complete.", "string"),
    "Link": ("Address of the job that was started.", "string"),
    "Cache-Control": ("no-store.", "string"),
}


def _headers_of(status: int, what: str, *names: str) -> dict[int | str, dict[str, Any]]:
    """Describe in OpenAPI a response that is headers alone."""
    headers = {
        name: {"description": text, "schema": {"type": kind}}
        | ({"example": _EXAMPLES[name]} if name in _EXAMPLES else {})
        for name, (text, kind) in _HEADERS.items()
        if name in ("Tus-Resumable", *names)
    }
    return {status: {"description": what, "headers": headers}}


_STATE = ("Upload-Offset", "Upload-Expires", "Content-Location", "Link")

_EXAMPLES = {
    "Tus-Resumable": VERSION,
    "Tus-Version": VERSION,
    "Tus-Extension": EXTENSIONS,
    "Tus-Max-Size": 8589934592,
    "Tus-Checksum-Algorithm": ",".join(ALGORITHMS),
}

UploadId = Annotated[str, Path(description="Id of the upload.")]
Tus = Annotated[str | None, Header(alias="Tus-Resumable", description=f"{VERSION}.")]
Checksum = Annotated[
    str | None,
    Header(alias="Upload-Checksum", description="Algorithm and Base64 of the part's digest."),
]


@router.options(
    "",
    name="describe_uploads",
    status_code=204,
    response_class=Response,
    responses=_headers_of(
        204, "What is supported.", *(n for n in _HEADERS if n.startswith("Tus-"))
    ),
)
def describe_uploads(service: Current) -> Response:
    """Say what of tus is supported."""
    return _response(
        {
            "Tus-Version": VERSION,
            "Tus-Extension": EXTENSIONS,
            "Tus-Max-Size": str(service.settings.max_upload_bytes),
            "Tus-Checksum-Algorithm": ",".join(ALGORITHMS),
        }
    )


@router.post(
    "",
    name="create_upload",
    status_code=201,
    response_class=Response,
    openapi_extra=_BODY,
    responses=_headers_of(201, "The upload has begun.", "Location", *_STATE),
)
async def create_upload(
    request: Request,
    service: Current,
    length: Annotated[
        int, Header(alias="Upload-Length", ge=1, description="Length of the log [bytes].")
    ],
    metadata: Annotated[
        str,
        Header(
            alias="Upload-Metadata",
            description="Pairs of a key and Base64: filename, survey, process (true or false), "
            "joint, joint_unit and the others of the query of POST /recordings.",
        ),
    ] = "",
    tus: Tus = None,
    checksum: Checksum = None,
) -> Response:
    """Begin an upload; a body is its first part."""
    _check_version(tus)
    if length > service.settings.max_upload_bytes:
        most = service.settings.max_upload_bytes
        raise TooLargeError(f"The log has {length:,} bytes; {most:,} are accepted.")
    about, expected = _metadata(metadata), _checksum(checksum)
    await asyncio.to_thread(_check, service, about)
    upload = await asyncio.to_thread(service.uploads.create, length, about)
    headers = {"Location": f"/api/v1/uploads/{upload.upload_id}", **_expiry(upload)}
    if media_type_of(request.headers) == PART:
        headers |= await _append(service, upload, request, 0, expected)
    return _response(headers, 201)


@router.head(
    "/{upload}",
    name="get_upload",
    response_class=Response,
    responses=_headers_of(
        200, "What is here.", "Upload-Offset", "Upload-Length", "Upload-Expires", "Cache-Control"
    ),
)
def get_upload(upload: UploadId, service: Current, tus: Tus = None) -> Response:
    """Say how many bytes of an upload are here."""
    _check_version(tus)
    found = service.uploads.get(upload)
    headers = {"Upload-Offset": str(found.offset), "Upload-Length": str(found.length)}
    return _response(headers | _expiry(found) | {"Cache-Control": "no-store"}, 200)


@router.patch(
    "/{upload}",
    name="append_to_upload",
    status_code=204,
    response_class=Response,
    openapi_extra=_BODY,
    responses=_headers_of(204, "The part is kept.", *_STATE),
)
async def append_to_upload(
    upload: UploadId,
    request: Request,
    service: Current,
    offset: Annotated[
        int, Header(alias="Upload-Offset", ge=0, description="Where the part begins [bytes].")
    ],
    tus: Tus = None,
    checksum: Checksum = None,
) -> Response:
    """Add the next part; the last one makes a recording (Content-Location)."""
    _check_version(tus)
    if media_type_of(request.headers) != PART:
        raise MediaTypeError(f"The part must be of the type {PART}.")
    found = service.uploads.get(upload)
    return _response(await _append(service, found, request, offset, _checksum(checksum)))


@router.delete(
    "/{upload}",
    name="end_upload",
    status_code=204,
    response_class=Response,
    responses=_headers_of(204, "It is forgotten."),
)
def end_upload(upload: UploadId, service: Current, tus: Tus = None) -> Response:
    """Forget an upload and its bytes."""
    _check_version(tus)
    service.uploads.end(service.uploads.get(upload).upload_id)
    return _response({})


async def _append(
    service: Service,
    upload: Upload,
    request: Request,
    offset: int,
    checksum: tuple[str, bytes] | None,
) -> dict[str, str]:
    """Add a part, and enter the log that it completes; return the headers that say so."""
    received = await service.uploads.append(upload, offset, request.stream(), checksum)
    if received is None:
        return {"Upload-Offset": str(upload.offset), **_expiry(upload)}
    headers = await service.inspect(_enter, service, received, upload.metadata)
    return {"Upload-Offset": str(upload.length), **headers}


def _enter(service: Service, received: Received, about: Mapping[str, str]) -> dict[str, str]:
    """Enter a log; its own verdict says whether it can be processed."""
    name = about.get("filename") or received.digest[:8]
    recording, _ = enter(service.catalogue, received, name, _reading(about))
    headers = {"Content-Location": f"/api/v1/recordings/{recording.recording_id}"}
    if survey := about.get("survey"):
        service.catalogue.add_to_survey(survey, recording.recording_id)
        if about.get("process") == "true" and recording.verdict != "refused":
            job = start_job(service, survey, recording)
            headers["Link"] = f'</api/v1/jobs/{job.job_id}>; rel="related"; title="job"'
    return headers


def _check(service: Service, about: Mapping[str, str]) -> None:
    """Refuse an upload before its first byte."""
    _reading(about)
    if about.get("process") == "true" or "survey" in about:
        check_survey(service, about.get("survey"))


def _reading(about: Mapping[str, str]) -> LogOptions:
    """Return how a log is to be read, by the keys that the query of an upload has too."""
    given: dict[str, Any] = {name: about[name] for name in Reading.model_fields if name in about}
    if "topic" in given:
        given["topic"] = [given["topic"]]
    try:
        return Reading.model_validate(given).options()
    except ValidationError as error:
        raise InputError(f"Upload-Metadata: {error.errors()[0]['msg']}.") from error


def _check_version(version: str | None) -> None:
    """Refuse a request of another version of the protocol."""
    if version != VERSION:
        raise TusVersionError(f"Tus-Resumable is {version!r}; {VERSION} is expected.")


def _metadata(text: str) -> dict[str, str]:
    """Return what the sender says of the file."""
    pairs = (pair.strip().partition(" ") for pair in text.split(",") if pair.strip())
    try:
        return {key: base64.b64decode(value, validate=True).decode() for key, _, value in pairs}
    except ValueError as error:
        raise InputError(
            f"Upload-Metadata is {text[:80]!r}; pairs of a key and its value in Base64 of UTF-8, "
            f"with commas between them, are expected ({error})."
        ) from error


def _checksum(text: str | None) -> tuple[str, bytes] | None:
    """Return algorithm and digest of a part."""
    if text is None:
        return None
    name, _, value = text.partition(" ")
    try:
        digest = base64.b64decode(value, validate=True)
    except ValueError:
        digest = b""
    if name not in ALGORITHMS or not digest:
        raise InputError(
            f"Upload-Checksum is {text[:80]!r}; one of {', '.join(ALGORITHMS)} and a "
            "digest in Base64 is expected."
        )
    return name, digest


def _expiry(upload: Upload) -> dict[str, str]:
    """Return until when an upload is kept."""
    return {"Upload-Expires": formatdate(upload.expires_at, usegmt=True)}


def _response(headers: Mapping[str, str], status: int = 204) -> Response:
    """Return a response of the protocol."""
    return Response(status_code=status, headers={"Tus-Resumable": VERSION, **headers})
