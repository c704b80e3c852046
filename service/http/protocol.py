"""HTTP on a connection: a request's header must arrive in time, and refusals have the headers."""

from __future__ import annotations

import asyncio
from http import HTTPStatus

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from spheremark.service.http.security import HEADERS

HEADER_SECONDS = 15.0
"""From a connection, or the first byte of a request, to the end of the request's header."""


class BoundedProtocol(H11Protocol):
    """Uvicorn's protocol with a limit of time for headers, which it does not have."""

    _waiting: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn
        """Begin to wait for a request."""
        super().connection_made(transport)
        self._wait()

    def connection_lost(self, exc: Exception | None) -> None:
        """End all waiting."""
        self._stop_waiting()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Read on; what is no whole header yet must become one in time."""
        super().data_received(data)
        if self.conn.their_state is not h11.IDLE:
            self._stop_waiting()
        elif self._waiting is None:
            self._wait()

    def send_400_response(self, msg: str) -> None:
        """Refuse what is no HTTP."""
        self._refuse(HTTPStatus.BAD_REQUEST, msg)

    def _wait(self) -> None:
        """Set the limit."""
        self._waiting = self.loop.call_later(HEADER_SECONDS, self._end)

    def _stop_waiting(self) -> None:
        """Remove the limit."""
        if self._waiting is not None:
            self._waiting.cancel()
            self._waiting = None

    def _end(self) -> None:
        """Close a connection whose request did not begin, or whose header did not end."""
        has_begun = bool(self.conn.trailing_data[0])
        if has_begun and self.conn.our_state is h11.IDLE:
            text = f"The header of the request did not end within {HEADER_SECONDS:g} s."
            self._refuse(HTTPStatus.REQUEST_TIMEOUT, text)
        self.transport.close()

    def _refuse(self, status: HTTPStatus, text: str) -> None:
        """Send a refusal and close the connection."""
        headers = {"Content-Type": "text/plain; charset=utf-8", "Connection": "close", **HEADERS}
        response = h11.Response(
            status_code=status,
            headers=[(name.lower().encode(), value.encode()) for name, value in headers.items()],
            reason=status.phrase.encode(),
        )
        for event in (response, h11.Data(data=text.encode()), h11.EndOfMessage()):
            self.transport.write(self.conn.send(event) or b"")
        self.transport.close()
