"""Progress of a computation: a callback that takes the finished share and the next step."""

from __future__ import annotations

from collections.abc import Callable

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
