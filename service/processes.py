"""Where the processes of the service come from: one that has loaded what they need forks them.

So a worker that ended is replaced in a moment, and all share the memory of modules and kernels.
A simulation is a command of its own, which ends with the service.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from multiprocessing import forkserver, get_context
from multiprocessing.context import BaseContext
from pathlib import Path
from typing import ClassVar

from spheremark.pipelines.errors import SpheremarkError

METHOD = "forkserver" if sys.platform == "linux" else "spawn"
_LOADED = "spheremark.service.jobs.loaded"
_POLL = 0.2  # [s] in which a simulation notices that the service stops


class SimulationFailedError(SpheremarkError):
    """The process that simulates a survey ended before it was done."""

    code: ClassVar[str] = "simulation_failed"


def forked() -> BaseContext:
    """Return how processes start; the first one does after all imports, the others at once."""
    context = get_context(METHOD)
    context.set_forkserver_preload([_LOADED])
    return context


def load() -> None:
    """Start the process that forks the others; it imports what they need while this one goes on."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in workers, before NumPy's import
    forked()
    if METHOD == "forkserver":
        forkserver.ensure_running()


def simulated(
    folder: Path, stops: Sequence[str], leaving: threading.Event
) -> Iterator[dict[str, str]]:
    """Yield each stop of the study's field as soon as a process of its own has written it."""
    command = [sys.executable, "-m", "spheremark.service.cli", "simulate", str(folder)]
    with subprocess.Popen(
        [*command, "--json", "--stops", ",".join(stops)],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,  # the service handles Ctrl-C and then ends this
    ) as process:
        threading.Thread(target=_end_with, args=(leaving, process), daemon=True).start()
        with suppress(ValueError):  # a failure is written as an object of many lines
            for line in process.stdout or ():
                yield json.loads(line)
    if process.returncode and not leaving.is_set():
        raise SimulationFailedError("The simulation failed; its message is above.")


def _end_with(leaving: threading.Event, process: subprocess.Popen[str]) -> None:
    """End a process when the service stops."""
    while process.poll() is None and not leaving.wait(_POLL):
        pass
    process.terminate()
