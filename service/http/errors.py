"""Handlers that turn every error of a request into a problem, or a page for browsers."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from http import HTTPStatus
from typing import Any, cast

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from spheremark.pipelines.errors import NotFoundError, SpheremarkError
from spheremark.service.errors import Problem, UnknownNameError, problem_of

logger = logging.getLogger(__name__)

MEDIA_TYPE = "application/problem+json"
HTTP_CODES: Mapping[int, str] = {
    400: "input.validation",  # FastAPI: the body cannot be parsed
    404: "not_found",
    405: "method_not_allowed",
    408: "input.timeout",
    413: "input.too_large",
}
_RETRY_AFTER = "5"  # [s] what is refused for want of room or places
ErrorPage = Callable[[Request, Problem], Response]


def install(app: FastAPI, page: ErrorPage | None = None) -> None:
    """Let an application return every error as a problem, or as a page to browsers."""

    def respond(request: Request, problem: Problem, headers: Mapping[str, str] | None) -> Response:
        if page is not None and _wants_page(request):
            return page(request, problem)
        return problem_response(problem, headers)

    def ours(request: Request, error: Exception) -> Response:
        found = cast(SpheremarkError, error)
        if isinstance(found, NotFoundError) and not request.path_params:
            found = UnknownNameError(str(found))  # the address exists
        problem = problem_of(found, request.url.path)
        if problem.status >= 500:
            logger.error("%s %s failed: %s", request.method, request.url.path, problem.detail)
        headers = {"Retry-After": _RETRY_AFTER} if problem.status in (429, 503, 507) else None
        return respond(request, problem, headers)

    def http(request: Request, error: Exception) -> Response:
        known = cast(HTTPException, error)
        if known.status_code in (204, 304):
            return Response(status_code=known.status_code, headers=known.headers)
        return respond(request, _http_problem(request, known), known.headers)

    def invalid(request: Request, error: Exception) -> Response:
        found = cast(RequestValidationError, error).errors()
        return respond(request, _validation_problem(request, found), None)

    def unexpected(request: Request, error: Exception) -> Response:
        logger.error("%s %s failed", request.method, request.url.path, exc_info=error)
        return respond(request, _internal_problem(request), None)

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
    """Whether the request accepts a page, as those of browsers do."""
    return "text/html" in request.headers.get("accept", "") and not request.url.path.startswith(
        "/api/"
    )


def _http_problem(request: Request, error: HTTPException) -> Problem:
    """Return one of the framework's own errors as a problem."""
    title = HTTPStatus(error.status_code).phrase
    code = HTTP_CODES.get(error.status_code, f"http_{error.status_code}")
    way = "the overview leads to every page"
    if not _wants_page(request):
        way = "/api/v1/openapi.json lists the routes"
    detail = {
        404: f"There is nothing at {request.url.path}; {way}.",
        405: f"{request.url.path} does not support {request.method}.",
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
    """Return an unexpected error as a problem."""
    return Problem(
        type="/api/v1/problems/internal",
        title="The service failed at this request.",
        status=500,
        detail="An unexpected error; the log of the service has the details.",
        instance=request.url.path,
        code="internal",
    )
