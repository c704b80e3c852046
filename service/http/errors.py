"""Errors as HTTP: one table from error class to status, one shape (RFC 9457) for all of them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from http import HTTPStatus
from typing import Any, ClassVar, Self, cast

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException

from spheremark.pipelines.errors import (
    ConflictError,
    InputError,
    NotFoundError,
    RecordingError,
    SolveError,
    SpheremarkError,
)
from spheremark.storage.catalogue.records import RecordingRecord
from spheremark.storage.catalogue.sandbox import QueryTimeoutError

logger = logging.getLogger(__name__)

MEDIA_TYPE = "application/problem+json"


class TooLargeError(InputError):
    """The request's body is larger than this service accepts."""

    code: ClassVar[str] = "input.too_large"


class MalformedHeaderError(InputError):
    """A header of the request does not have the form that HTTP gives it."""

    code: ClassVar[str] = "input.header"


class MediaTypeError(InputError):
    """The request's body is of a type that this route does not read."""

    code: ClassVar[str] = "input.media_type"


class EmptyBodyError(InputError):
    """The request has no body where one is needed."""

    code: ClassVar[str] = "input.empty"


class ReusedKeyError(InputError):
    """An Idempotency-Key was used before with another request."""

    code: ClassVar[str] = "input.idempotency_key"


class RefusedRecordingError(RecordingError):
    """The recording was kept, but its preflight says that it cannot be processed."""

    code: ClassVar[str] = "input.recording.refused"

    def __init__(self, reason: str, recording: RecordingRecord) -> None:
        super().__init__(f"{reason} The log is kept as recording {recording.recording_id}.")
        self.recording = recording
        self.reason_code = str(recording.preflight.get("code") or self.code)

    @classmethod
    def of(cls, recording: RecordingRecord) -> Self:
        """Return the error that a refused recording deserves."""
        return cls(" ".join(recording.preflight.get("reasons", ())), recording)


class UnauthorizedError(SpheremarkError):
    """The request does not carry the token of this service."""

    code: ClassVar[str] = "unauthorized"


class ForbiddenError(SpheremarkError):
    """The request comes from another site."""

    code: ClassVar[str] = "forbidden"


class UnavailableError(SpheremarkError):
    """A part of the service is not running."""

    code: ClassVar[str] = "unavailable"


STATUS: Mapping[type[SpheremarkError], int] = {
    SpheremarkError: 500,
    InputError: 400,
    TooLargeError: 413,
    MediaTypeError: 415,
    ReusedKeyError: 422,
    RecordingError: 422,
    QueryTimeoutError: 504,
    SolveError: 422,
    UnauthorizedError: 401,
    ForbiddenError: 403,
    NotFoundError: 404,
    ConflictError: 409,
    UnavailableError: 503,
}
"""The one table: an error answers with the status of its nearest ancestor here."""

HTTP_CODES: Mapping[int, str] = {
    404: "not_found",
    405: "method_not_allowed",
    413: "input.too_large",
}
OTHER_KINDS: Mapping[str, tuple[str, int]] = {
    "input.validation": ("The request does not have the shape that this route reads.", 422),
    "method_not_allowed": ("The address does not answer to this method.", 405),
    "internal": ("The service failed at something that nobody foresaw.", 500),
    "worker_died": ("The worker process of a job died each time that it was tried.", 500),
}
"""Problems that are no error of ours: code, sentence and status."""


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


ErrorPage = Callable[[Request, Problem], Response]


def install(app: FastAPI, page: ErrorPage | None = None) -> None:
    """Let an application answer every error as a problem, or as a page where one was asked for."""

    def answer(request: Request, problem: Problem, headers: Mapping[str, str] | None) -> Response:
        if page is not None and _wants_page(request):
            return page(request, problem)
        return problem_response(problem, headers)

    def ours(request: Request, error: Exception) -> Response:
        return answer(request, problem_of(cast(SpheremarkError, error), request.url.path), None)

    def http(request: Request, error: Exception) -> Response:
        known = cast(HTTPException, error)
        if known.status_code in (204, 304):
            return Response(status_code=known.status_code, headers=known.headers)
        return answer(request, _http_problem(request, known), known.headers)

    def invalid(request: Request, error: Exception) -> Response:
        found = cast(RequestValidationError, error).errors()
        return answer(request, _validation_problem(request, found), None)

    def unexpected(request: Request, error: Exception) -> Response:
        logger.error("%s %s failed", request.method, request.url.path, exc_info=error)
        return answer(request, _internal_problem(request), None)

    app.add_exception_handler(SpheremarkError, ours)
    app.add_exception_handler(HTTPException, http)
    app.add_exception_handler(RequestValidationError, invalid)
    app.add_exception_handler(Exception, unexpected)


def problem_response(problem: Problem, headers: Mapping[str, str] | None = None) -> JSONResponse:
    """Return a problem as a response."""
    return JSONResponse(
        problem.model_dump(exclude_none=True),
        status_code=problem.status,
        headers=dict(headers or {}),
        media_type=MEDIA_TYPE,
    )


def _wants_page(request: Request) -> bool:
    """Whether a person with a browser asked, and not a program."""
    return "text/html" in request.headers.get("accept", "") and not request.url.path.startswith(
        "/api/"
    )


def _http_problem(request: Request, error: HTTPException) -> Problem:
    """Return one of the framework's own errors as a problem."""
    title = HTTPStatus(error.status_code).phrase
    code = HTTP_CODES.get(error.status_code, f"http_{error.status_code}")
    detail = {
        404: f"There is nothing at {request.url.path}; /api/v1/openapi.json lists the routes.",
        405: f"{request.url.path} does not answer to {request.method}.",
    }.get(error.status_code, str(error.detail))
    return Problem(
        type=f"/api/v1/problems/{code}",
        title=title,
        status=error.status_code,
        detail=detail,
        instance=request.url.path,
        code=code,
    )


def _validation_problem(request: Request, found: Sequence[Any]) -> Problem:
    """Return what is wrong with the fields of a request: 400 if not even readable, else 422."""
    errors = [
        {"field": ".".join(str(part) for part in one["loc"]), "reason": one["msg"]} for one in found
    ]
    unreadable = any(one["type"] == "json_invalid" for one in found)
    return Problem(
        type="/api/v1/problems/input.validation",
        title="The request does not have the shape that this route reads.",
        status=400 if unreadable else 422,
        detail="; ".join(f"{one['field']}: {one['reason']}" for one in errors),
        instance=request.url.path,
        code="input.validation",
        errors=errors,
    )


def _internal_problem(request: Request) -> Problem:
    """Return what a caller learns of an error that nobody foresaw."""
    return Problem(
        type="/api/v1/problems/internal",
        title="The service failed at this request.",
        status=500,
        detail="Something that nobody foresaw went wrong; the log of the service says what.",
        instance=request.url.path,
        code="internal",
    )
