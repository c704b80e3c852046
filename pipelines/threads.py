"""Compiled loops side by side: hides how the rows of a scan are shared among threads."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from itertools import pairwise
from typing import TypeVar

_Part = TypeVar("_Part")

_N_PARTS = 2  # always: sums are taken part by part, and must not depend on the machine
_N_CALLERS = 32  # that may wait for each other's parts; a thread starts when none is idle
_POOL = ThreadPoolExecutor(_N_CALLERS)  # kept: to start a thread costs more than many a part


def side_by_side(
    work: Callable[[int, int], _Part], n_rows: int, *, worth: int = 50_000
) -> list[_Part]:
    """Do the parts of a range of rows at the same time.

    Parameters
    ----------
    work : callable
        Told the first row of a part and the row behind its last; gains only as far as it runs
        without Python's lock, as compiled loops with ``nogil`` do.
    n_rows : int
        Number of rows.
    worth : int
        With fewer rows the work is done before a thread has started: one part, then.

    Returns
    -------
    list
        What ``work`` returned for each part, in the order of the rows.
    """
    if n_rows < worth:
        return [work(0, n_rows)]
    edges = [part * n_rows // _N_PARTS for part in range(_N_PARTS + 1)]
    others = [_POOL.submit(work, *span) for span in pairwise(edges[1:])]
    try:
        own = work(edges[0], edges[1])
    finally:
        wait(others)
    return [own, *(other.result() for other in others)]
