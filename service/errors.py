"""Errors as problems (RFC 9457): one table from error class to status, one shape for all."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Self

from pydantic import BaseModel, Field

from spheremark.pipelines.errors import (
    ConflictError,
    InputError,
    NotFoundError,
    RecordingError,
    SolveError,
    SpheremarkError,
)
from spheremark.storage.catalogue.records import RecordingRecord
from spheremark.storage.catalogue.sandbox import QueryStarvedError, QueryTimeoutError
from spheremark.storage.confined import ReaderEndedError
from spheremark.storage.files import StorageError, StorageFullError


class TooLargeError(InputError):
    """The request's body is larger than this service accepts."""

    code: ClassVar[str] = "input.too_large"


class MalformedHeaderError(InputError):
    """A header of the request does not have the form that HTTP gives it."""

    code: ClassVar[str] = "input.header"


class MediaTypeError(InputError):
    """The request's body is of a type that this route does not read."""

    code: ClassVar[str] = "input.media_type"


class DigestError(InputError):
    """The request's body is not the one whose digest its header names."""

    code: ClassVar[str] = "input.digest"


class SlowBodyError(InputError):
    """The request's body came too slowly."""

    code: ClassVar[str] = "input.timeout"


class ChecksumError(InputError):
    """A part of a resumable upload is not the one whose checksum its header names."""

    code: ClassVar[str] = "input.checksum"


class TusVersionError(InputError):
    """A request for a resumable upload is of another version of the protocol."""

    code: ClassVar[str] = "input.tus_version"


class OffsetError(ConflictError):
    """A part of a resumable upload does not begin where the upload ends so far."""

    code: ClassVar[str] = "conflict.offset"


class LockedError(ConflictError):
    """Another request is writing to this upload."""

    code: ClassVar[str] = "conflict.locked"


class QuotaError(SpheremarkError):
    """The logs of this service take as much space as they may."""

    code: ClassVar[str] = "storage.quota"


class EmptyBodyError(InputError):
    """The request has no body where one is needed."""

    code: ClassVar[str] = "input.empty"


class UnknownNameError(InputError):
    """The query or the body of the request names something that does not exist."""

    code: ClassVar[str] = "input.unknown"


class ReusedKeyError(InputError):
    """An Idempotency-Key was used before with another request."""

    code: ClassVar[str] = "input.idempotency_key"


class BusyError(SpheremarkError):
    """The service has as many requests of this kind as it serves at once; try again later."""

    code: ClassVar[str] = "busy"


class RefusedRecordingError(RecordingError):
    """The recording was kept, but its preflight says that it cannot be processed."""

    code: ClassVar[str] = "input.recording.refused"

    def __init__(self, reason: str, recording: RecordingRecord) -> None:
        super().__init__(f"{reason} The file is kept.")
        self.recording = recording
        self.reason_code = str(recording.preflight.get("code") or self.code)

    @classmethod
    def of(cls, recording: RecordingRecord) -> Self:
        """Return the error that a refused recording deserves."""
        return cls(" ".join(recording.preflight.get("reasons", ())), recording)


class PredictionTimeoutError(InputError):
    """The prediction of a plan ran into its time limit."""

    code: ClassVar[str] = "prediction.timeout"


class ClientLeftError(SpheremarkError):
    """The client closed the connection before the response was ready."""

    code: ClassVar[str] = "client_left"


class UnauthorizedError(SpheremarkError):
    """The request does not carry the token of this service."""

    code: ClassVar[str] = "unauthorized"


class ForbiddenError(SpheremarkError):
    """The request comes from another site."""

    code: ClassVar[str] = "forbidden"


STATUS: Mapping[type[SpheremarkError], int] = {
    SpheremarkError: 500,
    InputError: 400,
    TooLargeError: 413,
    MediaTypeError: 415,
    SlowBodyError: 408,
    ChecksumError: 460,  # of tus
    TusVersionError: 412,
    ReusedKeyError: 422,
    UnknownNameError: 422,
    BusyError: 429,
    ClientLeftError: 499,  # as nginx has it; only the log sees it
    RecordingError: 422,
    QueryTimeoutError: 504,
    QueryStarvedError: 429,
    PredictionTimeoutError: 504,
    SolveError: 422,
    UnauthorizedError: 401,
    ForbiddenError: 403,
    NotFoundError: 404,
    ConflictError: 409,
    LockedError: 423,
    ReaderEndedError: 503,
    StorageError: 503,
    StorageFullError: 507,
    QuotaError: 507,
}
"""HTTP status by error class; a class without its own has that of its nearest ancestor."""

OTHER_KINDS: Mapping[str, tuple[str, int]] = {
    "input.validation": ("The request does not have the shape that this route reads.", 422),
    "method_not_allowed": ("The address does not support this method.", 405),
    "internal": ("The service failed for a reason that it does not know.", 500),
    "job_timeout": ("The job took longer than a job may.", 500),
    "worker_died": ("The worker process of a job died each time that it was tried.", 500),
}
"""Problems without an error class: code, sentence and status."""


class Problem(BaseModel):
    """What went wrong, in the shape of RFC 9457."""

    type: str = Field(description="Address that explains this kind of problem.")
    title: str = Field(description="The kind of problem as a sentence.")
    status: int = Field(description="The HTTP status, again.")
    detail: str = Field(description="What was found, what was expected, what to do.")
    instance: str = Field(description="Path of the request.")
    code: str = Field(description="Stable name of the kind of problem, for programs.")
    errors: list[dict[str, Any]] | None = Field(
        default=None, description="Each wrong field, where fields are wrong."
    )
    recording_id: str | None = Field(
        default=None, description="The recording that was kept, where one was refused."
    )


def status_of(kind: type[SpheremarkError]) -> int:
    """Return the HTTP status of an error class."""
    return next(STATUS[base] for base in kind.__mro__ if base in STATUS)


def sentence_of(kind: type[SpheremarkError]) -> str:
    """Return the sentence that an error class is for people."""
    return (kind.__doc__ or "").strip().splitlines()[0]


def problem_of(error: SpheremarkError, instance: str) -> Problem:
    """Return an error as a problem."""
    code, kind, recording_id = error.code, type(error), None
    if isinstance(error, RefusedRecordingError):
        code, recording_id = error.reason_code, error.recording.recording_id
        kind = next((one for one in kinds() if one.code == code), kind)
    return Problem(
        type=f"/api/v1/problems/{code}",
        title=sentence_of(kind),
        status=status_of(kind),
        detail=str(error) or sentence_of(kind),
        instance=instance,
        code=code,
        recording_id=recording_id,
    )


def kinds() -> tuple[type[SpheremarkError], ...]:
    """Return every error class that is known, by code."""
    found: dict[str, type[SpheremarkError]] = {}
    open_kinds = [SpheremarkError]
    while open_kinds:
        kind = open_kinds.pop()
        found[kind.code] = kind
        open_kinds.extend(kind.__subclasses__())
    return tuple(found[code] for code in sorted(found))
