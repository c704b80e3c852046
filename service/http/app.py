"""The application: routes, middleware, lifespan and error handlers."""

from __future__ import annotations

import logging
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib import metadata, resources
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

from fastapi import APIRouter, FastAPI, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from fastapi.staticfiles import StaticFiles
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest
from starlette.types import ASGIApp

from spheremark.pipelines.errors import InputError
from spheremark.service.errors import Problem, UnauthorizedError
from spheremark.service.http import api, errors, examples, observation, pages, security
from spheremark.service.http.pages import frame
from spheremark.service.http.representation import Representation
from spheremark.service.http.state import Current, opened
from spheremark.service.logs import event_level
from spheremark.service.settings import Settings
from spheremark.service.tokens import Tokens
from spheremark.storage.files import StorageError
from spheremark.web.pages.base import Frame
from spheremark.web.templating import render

ROOT = "/api/v1"
STATIC = Path(str(resources.files("spheremark.web"))) / "static"

about = APIRouter(include_in_schema=False)


class _Application(FastAPI):
    """FastAPI whose responses to unexpected errors, outside all middleware, have the headers."""

    _describing = threading.Lock()  # the first requests may come at once

    def openapi(self) -> dict[str, Any]:
        """Return the description of the interface, in which problems have their media type."""
        with self._describing:
            if self.openapi_schema is None:
                self.openapi_schema = self._described()
        return self.openapi_schema

    def _described(self) -> dict[str, Any]:
        """Return FastAPI's description with the types of problems, summaries and examples."""
        found = super().openapi()
        self.openapi_schema = None  # not whole yet
        for path in found["paths"].values():
            for operation in path.values():
                content = operation["responses"]["default"]["content"]
                content[errors.MEDIA_TYPE] = content.pop(next(iter(content)))
                operation["summary"] = operation["description"].partition("\n")[0].rstrip(".")
                examples.add_to(operation, found["components"]["schemas"])
        return found

    def build_middleware_stack(self) -> ASGIApp:
        """Return the whole application."""
        app: ASGIApp = super().build_middleware_stack()
        app = observation.Observation(app, self.state.metrics, self.state.event_level)
        return security.SecureHeaders(app)


def create_app(settings: Settings) -> FastAPI:
    """Return the service as an application; it opens its files and its cluster when it starts."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        logging.getLogger("spheremark").setLevel(settings.log_level.upper())
        try:
            async with opened(settings) as service:
                app.state.service = service
                app.state.metrics.register(collector := observation.ServiceCollector(service))
                yield
                app.state.metrics.unregister(collector)
        except BaseException as error:
            app.state.failure = error  # for the server process; uvicorn only logs it
            raise

    app = _Application(
        title="spheremark",
        version=metadata.version("spheremark"),
        summary="Station positions from spherical markers and a gimbal-mounted LiDAR.",
        lifespan=lifespan,
        openapi_url=f"{ROOT}/openapi.json",
        docs_url=None,  # FastAPI's pages load their scripts from another host
        redoc_url=None,
        generate_unique_id_function=lambda route: route.name,
        responses={"default": {"model": Problem, "description": "The problem."}},
    )
    app.state.metrics = observation.new_registry()
    app.state.event_level = event_level(settings.log_format)
    app.add_middleware(Representation)
    app.add_middleware(security.SecurityMiddleware, settings=settings)
    app.include_router(api.router, prefix=ROOT)
    app.include_router(about)
    for router in pages.ROUTERS:
        app.include_router(router)
    app.mount("/static", StaticFiles(directory=STATIC), name="static")
    errors.install(app, frame.error_page)
    return app


@about.get("/healthz")
async def health(service: Current) -> dict[str, Any]:
    """Report that the service responds, and how its parts are; it waits for none of them."""
    workers = service.jobs.n_workers()
    is_open = service.catalogue.is_usable
    return {
        "status": "ok" if workers and is_open else "degraded",
        "version": metadata.version("spheremark"),
        "database": "ok" if is_open else "unavailable",
        "cluster": {"status": "ok" if workers else "no workers", "workers": workers},
    }


@about.get("/readyz")
def readiness(service: Current, response: Response) -> dict[str, Any]:
    """Report whether each part of the service can take work now; 503 if one cannot."""
    try:
        service.catalogue.rows("SELECT 1 AS one")
        database = "ok"
    except StorageError as error:
        database = str(error)
    try:
        service.inbox.require_room(0)
        disk = "ok"
    except StorageError as error:
        disk = str(error)
    cluster = "ok" if service.jobs.n_workers() else "no workers"
    parts = {"database": database, "disk": disk, "cluster": cluster}
    is_ready = set(parts.values()) == {"ok"}
    response.status_code = 200 if is_ready else 503
    return {"status": "ready" if is_ready else "not ready", **parts}


@about.get("/metrics")
async def metrics(request: Request) -> Response:
    """Return the metrics of this process, in the format of Prometheus; it waits for nothing."""
    text = generate_latest(request.app.state.metrics)
    return Response(text, media_type=CONTENT_TYPE_LATEST)


@about.get("/login", response_class=HTMLResponse)
def login_page(request: Request) -> Response:
    """Show the form that takes a token; one in the address would be kept in histories and logs."""
    if "token" in request.query_params:
        raise InputError("A token does not belong into an address; open /login and enter it there.")
    return HTMLResponse(render("login.html", frame=Frame()))


@about.post("/login")
async def login(request: Request, service: Current) -> Response:
    """Exchange a token for a cookie."""
    form = parse_qs((await request.body()).decode(errors="replace"))
    tokens = Tokens(service.settings.data, service.settings.token_text)
    found = tokens.of_text(form.get("token", [""])[0])
    if found is None and tokens.all():
        raise UnauthorizedError("That is no token of this service; open /login and try again.")
    response = RedirectResponse("/", status_code=303)
    if found is not None:
        response.set_cookie(
            security.COOKIE,
            found.cookie,
            httponly=True,
            samesite="strict",
            secure=request.url.scheme == "https",
        )
    return response
