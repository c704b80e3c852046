"""Where the processes of the service come from: one that has loaded what they need forks them.

So a worker that ended is replaced in a moment, and all share the memory of modules and kernels.
"""

from __future__ import annotations

import os
import sys
from multiprocessing import forkserver, get_context
from multiprocessing.context import BaseContext

METHOD = "forkserver" if sys.platform == "linux" else "spawn"
_LOADED = "spheremark.service.jobs.loaded"


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
