"""Requests that take long: a few at a time on threads of their own, ended when their client leaves.

Others wait, and beyond a number of those are refused with 429: neither pages nor uploads nor health
wait behind them.
"""

from __future__ import annotations

import asyncio
import contextvars
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from fastapi import Request

from spheremark.pipelines.progress import checked_by
from spheremark.service.errors import BusyError, ClientLeftError

_Result = TypeVar("_Result")
_LOOK_EVERY = 0.5  # [s] whether the client is still there


class Places:
    """Threads for requests of one kind.

    Parameters
    ----------
    what : str
        What they do, for the refusal.
    at_once, waiting : int
        Requests that run, and that wait.
    """

    def __init__(self, what: str, at_once: int, waiting: int) -> None:
        self._what, self._most = what, at_once + waiting
        self._threads = ThreadPoolExecutor(at_once, what)
        self._n = 0

    async def run(
        self, request: Request, function: Callable[..., _Result], *arguments: Any
    ) -> _Result:
        """Return what a function returns; raise BusyError where too many wait already."""
        if self._n >= self._most:
            raise BusyError(
                f"{self._n} {self._what} run or wait; {self._most} are the most. Try again later."
            )
        self._n += 1
        gone = threading.Event()

        def call() -> _Result:
            with checked_by(lambda: _go_on(gone)):
                _go_on(gone)  # it may have left while it waited
                return function(*arguments)

        loop, context = asyncio.get_running_loop(), contextvars.copy_context()
        future = loop.run_in_executor(self._threads, context.run, call)
        future.add_done_callback(self._leave)
        while not (await asyncio.wait((future,), timeout=_LOOK_EVERY))[0]:
            if not gone.is_set() and await request.is_disconnected():
                gone.set()
        return future.result()

    @property
    def n_taken(self) -> int:
        """Number of requests that run or wait."""
        return self._n

    def _leave(self, future: asyncio.Future[Any]) -> None:
        """Count one less."""
        self._n -= 1
        future.cancelled() or future.exception()  # seen, also where its request was ended

    def close(self) -> None:
        """Start nothing that waits."""
        self._threads.shutdown(wait=False, cancel_futures=True)


def _go_on(gone: threading.Event) -> None:
    """Raise once the client has left."""
    if gone.is_set():
        raise ClientLeftError("The client has left.")
