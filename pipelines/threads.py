"""Parallel execution: rows of a scan on two threads, simulated worlds in processes."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed, wait
from itertools import pairwise
from multiprocessing import get_context
from typing import TypeVar

_Part = TypeVar("_Part")
_World = TypeVar("_World")

_N_PARTS = 2  # always: sums are taken part by part, and must not depend on the machine
_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of Linux
_POOL = ThreadPoolExecutor(32)  # kept: to start a thread costs more than many parts; for 32 callers


def side_by_side(
    work: Callable[[int, int], _Part], n_rows: int, *, threaded_from: int = 50_000
) -> list[_Part]:
    """Run a function on the two halves of a range of rows at the same time.

    Parameters
    ----------
    work : callable
        Takes the first row of a part and the row behind its last; compiled loops run in parallel,
        because they release Python's lock.
    n_rows : int
        Number of rows.
    threaded_from : int
        With fewer rows there is only one part, because starting a thread would take longer.

    Returns
    -------
    list
        Results of ``work``, in the order of the rows.
    """
    if n_rows < threaded_from:
        return [work(0, n_rows)]
    edges = [part * n_rows // _N_PARTS for part in range(_N_PARTS + 1)]
    others = [_POOL.submit(work, *span) for span in pairwise(edges[1:])]
    try:
        own = work(edges[0], edges[1])
    finally:
        wait(others)
    return [own, *(other.result() for other in others)]


def by_turns(
    work: Callable[[int, int], _Part], n_rows: int, *, size: int, threaded_from: int
) -> list[_Part]:
    """Run a function on pieces of a range of rows, each on the next free one of two threads.

    Parameters
    ----------
    work : callable
        As for ``side_by_side``; its results must not depend on the division into pieces.
    n_rows : int
        Number of rows.
    size : int
        Rows of a piece.
    threaded_from : int
        With fewer rows there is only one piece.

    Returns
    -------
    list
        Results of ``work``, in the order of the rows.
    """
    if n_rows < threaded_from:
        return [work(0, n_rows)]
    found: dict[int, _Part] = {}
    begins = iter(range(0, n_rows, size))

    def take() -> None:
        for begin in begins:
            found[begin] = work(begin, min(begin + size, n_rows))

    other = _POOL.submit(take)
    try:
        take()
    finally:
        wait([other])
    other.result()
    return [found[begin] for begin in sorted(found)]


def in_processes(
    work: Callable[[_World], _Part],
    worlds: Sequence[_World],
    *,
    n_processes: int | None = None,
    progress: Callable[[float, str], None] = lambda _share, _what: None,
) -> list[_Part]:
    """Run a function on many worlds in new processes.

    Parameters
    ----------
    work : callable
        Takes a world; a function of a module, or a partial of one, so that it can be pickled.
    worlds : sequence
        Arguments of ``work``: seeds, for instance. They are pickled.
    n_processes : int, optional
        Number of processes; by default that of the processors. With 1 all runs in this process.
    progress : callable
        Receives the finished share, 0 to 1, and a text; may raise to cancel.

    Returns
    -------
    list
        Results of ``work``, in the order of the worlds.
    """
    n, found = len(worlds), dict[int, _Part]()

    def enter(place: int, part: _Part) -> None:
        found[place] = part
        progress(len(found) / n, f"{len(found)} of {n} done")

    n_processes = min(n_processes or os.cpu_count() or 1, n)
    progress(0.0, f"0 of {n} done")
    if n_processes <= 1:
        for place, world in enumerate(worlds):
            enter(place, work(world))
        return [found[place] for place in range(n)]
    with ProcessPoolExecutor(n_processes, get_context("spawn"), end_with_parent) as pool:
        places = {pool.submit(work, world): place for place, world in enumerate(worlds)}
        try:
            for done in as_completed(places):
                enter(places[done], done.result())
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return [found[place] for place in range(n)]


def end_with_parent() -> None:
    """Let this process end when its parent does, however that ends; on Linux alone."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_DEATH_SIGNAL, signal.SIGKILL)
