"""The frame of all experiments: worlds by methods, pooled into tables with units."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from spheremark.pipelines.tables import Column, Plain, Table
from spheremark.pipelines.threads import in_processes

__all__ = ["Column", "Experiment", "Plain", "Progress", "Table", "to_json"]

Progress = Callable[[float, str], None]

World = TypeVar("World")
Found = TypeVar("Found")
Report = TypeVar("Report")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Experiment(Generic[World, Found, Report]):
    """Worlds of known truth, what is measured in each, and how that is pooled.

    Attributes
    ----------
    worlds : sequence
        Arguments of ``run_world``: seeds, or small values that can be pickled.
    run_world : callable
        Simulates one world, runs the methods and compares with the truth; a function of a module,
        or a partial of one, since it may run in another process.
    pool : callable
        Makes the report from what all worlds gave, in their order.
    tables : callable
        Lays the report out in tables.
    """

    worlds: Sequence[World]
    run_world: Callable[[World], Found]
    pool: Callable[[list[Found]], Report]
    tables: Callable[[Report], Sequence[Table]] = lambda _report: ()

    def run(
        self,
        progress: Progress = lambda _share, _what: None,
        *,
        n_processes: int | None = None,
    ) -> Report:
        """Run all worlds, some at a time, and pool them.

        Parameters
        ----------
        progress : callable
            Takes the share of the worlds that are done, 0 to 1, and how many; may raise to cancel.
        n_processes : int, optional
            How many run at a time; by default as many as there are processors.

        Returns
        -------
        object
            The report; the same whatever the number of processes.
        """
        found = in_processes(
            self.run_world, self.worlds, n_processes=n_processes, progress=progress
        )
        return self.pool(found)


def to_json(value: Any) -> Any:
    """Return plain values with null for numbers that are not finite, which JSON does not have.

    Parameters
    ----------
    value : object
        Plain values in mappings and sequences.

    Returns
    -------
    object
        The same in dicts and lists.
    """
    if isinstance(value, Mapping):
        return {key: to_json(one) for key, one in value.items()}
    if isinstance(value, Iterable) and not isinstance(value, str):
        return [to_json(one) for one in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
