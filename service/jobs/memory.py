"""How a process that works on one scan after another keeps its memory.

The C library gives large arrays back to the system at once, and the system clears every page that
it hands out again: in a virtual machine that costs a scan more than some of its steps do.
"""

from __future__ import annotations

import ctypes
from contextlib import suppress

_ARENA_MAX, _MMAP_MAX, _TRIM_THRESHOLD = -8, -4, -1  # names of glibc's <malloc.h>
_N_ARENAS = 4  # so that threads do not wait for each other when they reserve; more would keep more
_KEPT = 512 << 20  # [bytes] that may stay unused; a scan of three million returns takes half


def keep_memory() -> None:
    """Let this process keep what it freed, up to some limit; elsewhere than on glibc do nothing.

    To be called before other threads have started: those that have stay as they were.
    """
    with suppress(OSError, AttributeError, TypeError):
        libc = ctypes.CDLL(None)
        libc.mallopt(_ARENA_MAX, _N_ARENAS)
        libc.mallopt(_MMAP_MAX, 0)
        libc.mallopt(_TRIM_THRESHOLD, _KEPT)
