"""Memory of a process that runs one scan after another.

The C library returns large arrays to the system at once, and the system clears every page that it
maps again: in a virtual machine that costs a scan more than some of its steps do.
"""

from __future__ import annotations

import ctypes
from contextlib import suppress

_ARENA_MAX, _MMAP_MAX, _TRIM_THRESHOLD = -8, -4, -1  # names of glibc's <malloc.h>
_N_ARENAS = 4  # few threads wait for each other; more arenas would keep more memory
_KEPT = 512 << 20  # [bytes] that may stay unused; a scan of three million returns takes half


def keep_memory() -> None:
    """Let this process keep freed memory up to a limit (glibc); call it before threads start."""
    with suppress(OSError, AttributeError, TypeError):
        libc = ctypes.CDLL(None)
        libc.mallopt(_ARENA_MAX, _N_ARENAS)
        libc.mallopt(_MMAP_MAX, 0)
        libc.mallopt(_TRIM_THRESHOLD, _KEPT)
