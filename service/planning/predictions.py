"""Predictions of plans in processes of their own: bounded in time and memory, and ended at will.

The processes start with the first request and stay, with the compiled code. One that is ended is
replaced.
"""

from __future__ import annotations

import resource
import signal
import sys
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import Any

from pebble import ProcessExpired, ProcessPool

from spheremark.pipelines.errors import SolveError
from spheremark.pipelines.progress import checkpoint
from spheremark.pipelines.threads import end_with_parent
from spheremark.service.errors import PredictionTimeoutError
from spheremark.service.processes import forked
from spheremark.service.serialise.plans import Plain

_LOOK_EVERY = 0.2  # [s] whether the caller still waits


class Predictions:
    """A few processes that compute.

    Parameters
    ----------
    n_processes : int
        Their number.
    seconds, memory_bytes : float, int
        What one prediction may take.
    """

    def __init__(self, *, n_processes: int, seconds: float, memory_bytes: int) -> None:
        self._seconds, self._memory_bytes = seconds, memory_bytes
        self._pool = ProcessPool(
            max_workers=n_processes,
            initializer=_confine,
            initargs=(memory_bytes,),
            context=forked(),
        )

    def run(self, function: Callable[..., Plain], *arguments: Any) -> Plain:
        """Return what a function returns; its process is killed where a checkpoint raises.

        Raises PredictionTimeoutError and SolveError where time or memory do not suffice.
        """
        future = self.start(function, *arguments)
        try:
            while not wait((future,), _LOOK_EVERY).done:
                checkpoint()
            return self.result_of(future)
        finally:
            future.cancel()

    def start(self, function: Callable[..., Plain], *arguments: Any) -> Future[Plain]:
        """Start a function in a process; cancelling the future ends it."""
        future: Future[Plain] = self._pool.schedule(function, arguments, timeout=self._seconds)
        return future

    def result_of(self, future: Future[Plain]) -> Plain:
        """Return what a function has returned; raise as ``run`` does."""
        try:
            return future.result()
        except TimeoutError as error:
            raise PredictionTimeoutError(
                f"The prediction was ended after {self._seconds:g} s, its time limit. Ask for "
                "fewer marks, stops or places."
            ) from error
        except (MemoryError, ProcessExpired) as error:
            raise SolveError(
                f"The prediction needs more than {self._memory_bytes >> 20} MiB of memory, its "
                "limit. Ask for fewer marks, stops or places."
            ) from error

    def close(self) -> None:
        """End all processes."""
        self._pool.stop()  # type: ignore[no-untyped-call]
        self._pool.join()


def _confine(memory_bytes: int) -> None:
    """Bound the memory of this process, and let it end with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the service
    end_with_parent()
    if sys.platform == "linux":
        resource.setrlimit(resource.RLIMIT_DATA, (memory_bytes, memory_bytes))
