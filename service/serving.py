"""Running the application: a server that says why it cannot start, and goes quietly when told."""

from __future__ import annotations

import logging
import signal
import socket
from collections.abc import Callable

import uvicorn
from fastapi import FastAPI

from spheremark.pipelines.errors import ConflictError
from spheremark.service.http.app import create_app
from spheremark.service.settings import Settings

Ready = Callable[[str], None]
_PATIENCE = 5  # [s] that open requests have when the server is told to stop


class _Server(uvicorn.Server):
    """A server that tells when it is ready, and ends streams that would never end themselves."""

    def __init__(self, config: uvicorn.Config, app: FastAPI, ready: Callable[[], None]) -> None:
        super().__init__(config)
        self._app = app
        self._ready = ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Open the service, then the doors."""
        await super().startup(sockets)
        self._ready()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Close everything, event streams first."""
        await self._app.state.service.jobs.events.close()
        await super().shutdown(sockets)


def serve(settings: Settings, *, ready: Ready) -> None:
    """Serve until SIGINT or SIGTERM; tell the address once requests are answered."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    app = create_app(settings)
    with _listener(settings) as listener:
        address = address_of(settings, listener.getsockname()[1])
        config = uvicorn.Config(
            app,
            log_level="critical",  # what goes wrong is logged once, by the service
            access_log=False,
            timeout_graceful_shutdown=_PATIENCE,
            server_header=False,
        )
        for one in (signal.SIGINT, signal.SIGTERM):
            signal.signal(one, lambda _number, _frame: None)  # uvicorn raises them again at its end
        try:
            _Server(config, app, lambda: ready(address)).run(sockets=[listener])
        except SystemExit:
            raise app.state.failure from None


def address_of(settings: Settings, port: int) -> str:
    """Return the address that a browser on this machine opens."""
    host = {"0.0.0.0": "127.0.0.1", "::": "[::1]", "::1": "[::1]"}.get(settings.host, settings.host)
    return f"http://{host}:{port}"


def _listener(settings: Settings) -> socket.socket:
    """Take the port before anything else is opened."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    listener = socket.socket(family)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((settings.host, settings.port))
    except OSError as error:
        listener.close()
        raise ConflictError(
            f"Port {settings.port} of {settings.host} cannot be used: {error.strerror}. "
            "Choose another with SPHEREMARK_PORT; 0 takes a free one."
        ) from error
    return listener
