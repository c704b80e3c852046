"""What the C library does with freed memory.

It returns large arrays to the system at once, and the system clears every page that it maps again:
in a virtual machine that costs a scan more than some of its steps do. Of many threads it keeps a
heap for each, of which a service with small requests never needs the sum.
"""

from __future__ import annotations

import ctypes
from contextlib import suppress

_ARENA_MAX, _MMAP_MAX, _MMAP_THRESHOLD, _TRIM_THRESHOLD = -8, -4, -3, -1  # glibc's <malloc.h>
_N_ARENAS = 4  # few threads wait for each other; more arenas would keep more memory
_LARGE = 1 << 20  # [bytes] of a block that is returned at once; fixed, it does not grow with use
_KEPT = 512 << 20  # [bytes] that may stay unused; a scan of three million returns takes half


def keep_memory() -> None:
    """Let this process keep freed memory up to a limit (glibc); call it before threads start."""
    with suppress(OSError, AttributeError, TypeError):
        libc = ctypes.CDLL(None)
        libc.mallopt(_ARENA_MAX, _N_ARENAS)
        libc.mallopt(_MMAP_MAX, 0)
        libc.mallopt(_TRIM_THRESHOLD, _KEPT)


def return_memory() -> None:
    """Let this process return freed memory (glibc); call it before threads start."""
    with suppress(OSError, AttributeError, TypeError):
        libc = ctypes.CDLL(None)
        libc.mallopt(_ARENA_MAX, _N_ARENAS)
        libc.mallopt(_MMAP_THRESHOLD, _LARGE)
        libc.mallopt(_TRIM_THRESHOLD, _LARGE)
