"""The server process: start-up with a reason for each failure, and shutdown on a signal."""

from __future__ import annotations

import os
import signal
import socket
import sys
from collections.abc import Callable

import uvicorn
from fastapi import FastAPI
from uvicorn.importer import import_from_string

from spheremark.pipelines.errors import ConflictError
from spheremark.service.jobs.memory import return_memory
from spheremark.service.logs import log_to_stderr
from spheremark.service.processes import load
from spheremark.service.settings import Settings

Ready = Callable[[str], None]
_APPLICATION = "spheremark.service.http.app:create_app"  # by name: commands do not import it
_PROTOCOL = "spheremark.service.http.protocol:BoundedProtocol"
_TURN = 0.0005  # [s] of a thread while others wait: a short request is not behind long ones
_KEEP_ALIVE = 75  # [s] between two requests: more than the 60 s of proxies, which then end it first
_PATIENCE = 5  # [s] that open requests have at shutdown


class _Server(uvicorn.Server):
    """A server that calls back when it is ready, and closes event streams at shutdown."""

    def __init__(self, config: uvicorn.Config, app: FastAPI, ready: Callable[[], None]) -> None:
        super().__init__(config)
        self._app = app
        self._ready = ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Open the service, then accept requests."""
        await super().startup(sockets)
        self._ready()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Close everything, event streams first."""
        await self._app.state.service.jobs.events.close()
        await super().shutdown(sockets)


def serve(settings: Settings, *, ready: Ready) -> None:
    """Serve until SIGINT or SIGTERM; ``ready`` gets the address once requests are accepted."""
    return_memory()
    sys.setswitchinterval(_TURN)
    os.umask(0o077)  # what the service and its workers write is for its user alone
    if not settings.scheduler:
        load()
    create_app = import_from_string(_APPLICATION)  # Dask, which it imports, configures logging too
    log_to_stderr(settings.log_format)
    app: FastAPI = create_app(settings)
    with _listener(settings) as listener:
        address = settings.address(listener.getsockname()[1])
        config = uvicorn.Config(
            app,
            http=_PROTOCOL,
            log_level="critical",  # what goes wrong is logged once, by the service
            access_log=False,
            timeout_keep_alive=_KEEP_ALIVE,
            timeout_graceful_shutdown=_PATIENCE,
            server_header=False,
        )
        for one in (signal.SIGINT, signal.SIGTERM):
            signal.signal(one, lambda _number, _frame: None)  # uvicorn raises them again at its end
        try:
            _Server(config, app, lambda: ready(address)).run(sockets=[listener])
        except SystemExit:
            raise app.state.failure from None


def _listener(settings: Settings) -> socket.socket:
    """Take the port before anything else is opened."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    listener = socket.socket(family)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # else a body waits 40 ms
    try:
        listener.bind((settings.host, settings.port))
    except OSError as error:
        listener.close()
        raise ConflictError(
            f"Port {settings.port} of {settings.host} cannot be used: {error.strerror}. "
            "Choose another with SPHEREMARK_PORT; 0 takes a free one."
        ) from error
    return listener
