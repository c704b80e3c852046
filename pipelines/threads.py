"""Work side by side: hides how rows of a scan and simulated worlds are shared among processors."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed, wait
from itertools import pairwise
from multiprocessing import get_context
from typing import TypeVar

_Part = TypeVar("_Part")
_World = TypeVar("_World")

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


def by_turns(
    work: Callable[[int, int], _Part], n_rows: int, *, size: int, worth: int
) -> list[_Part]:
    """Do pieces of a range of rows, each by whichever of the threads is free.

    Parameters
    ----------
    work : callable
        As of ``side_by_side``; for what is not summed, so that it matters little if a thread starts
        late or its processor is slow.
    n_rows : int
        Number of rows.
    size : int
        Rows of a piece.
    worth : int
        With fewer rows the work is done before a thread has started: one piece, then.

    Returns
    -------
    list
        What ``work`` returned for each piece, in the order of the rows.
    """
    if n_rows < worth:
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
    """Do the same for many worlds, each in one of some fresh processes.

    Parameters
    ----------
    work : callable
        Takes a world; a function of a module, or a partial of one: another process must find it.
    worlds : sequence
        Arguments of ``work``: seeds, for instance. They are pickled.
    n_processes : int, optional
        How many at a time; as many as there are processors by default. With 1 there is none but
        this one.
    progress : callable
        Told the share of the work that is done, 0 to 1, and how much; may raise to cancel.

    Returns
    -------
    list
        What ``work`` returned for each world, in their order.
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
    with ProcessPoolExecutor(n_processes, get_context("spawn")) as pool:
        places = {pool.submit(work, world): place for place, world in enumerate(worlds)}
        try:
            for done in as_completed(places):
                enter(places[done], done.result())
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return [found[place] for place in range(n)]
