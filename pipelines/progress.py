"""Progress of a computation, and where its caller may end it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Progress = Callable[[float, str], None]
"""Takes the finished share of the computation, 0 to 1, and the next step; may raise to cancel."""


def part_of(progress: Progress, begin: float, end: float) -> Progress:
    """Return the progress of a part of a computation.

    Parameters
    ----------
    progress : callable
        Progress of the whole.
    begin, end : float
        Shares of the whole at the begin and the end of the part.

    Returns
    -------
    callable
        Progress of the part, 0 to 1.
    """
    return lambda share, step: progress(begin + (end - begin) * share, step)


_CHECK: ContextVar[Callable[[], None] | None] = ContextVar("check", default=None)


@contextmanager
def checked_by(check: Callable[[], None]) -> Iterator[None]:
    """Let a function be called at every checkpoint of the computations inside.

    Parameters
    ----------
    check : callable
        Raises to end the computation.

    Yields
    ------
    None
        Once, for the computations.
    """
    before = _CHECK.set(check)
    try:
        yield
    finally:
        _CHECK.reset(before)


def checkpoint() -> None:
    """Call the function of ``checked_by``, if there is one: here a computation can end."""
    check = _CHECK.get()
    if check is not None:
        check()
