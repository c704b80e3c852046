"""The frame of all experiments: worlds by methods, pooled into tables with units."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from spheremark.pipelines.threads import in_processes

Plain = dict[str, Any]
Progress = Callable[[float, str], None]

_World = TypeVar("_World")
_Found = TypeVar("_Found")
_Pooled = TypeVar("_Pooled")

_PER_SI = {"mm": 1e3, "ms": 1e3, "ns": 1e9, "MB": 1e-6, "%": 100.0}  # units that scale a cell


class Column(NamedTuple):
    """One column of a table.

    Attributes
    ----------
    key : str or callable
        Key of the rows, whose values are SI; or a function that gives the cell's text from a row.
    title : str
        Its heading, without the unit.
    unit : str
        Unit in which numbers are shown.
    form : str
        Format of numbers; a column without one holds text and is flush left.
    """

    key: str | Callable[[Plain], str]
    title: str
    unit: str = ""
    form: str = ""

    @property
    def heading(self) -> str:
        """Title with the unit in brackets."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    def cell(self, row: Plain) -> str:
        """Return the text of one cell; a hyphen where there is no value."""
        value = self.key(row) if callable(self.key) else row.get(self.key)
        if value is None:
            return "-"
        if not self.form or isinstance(value, str):
            return str(value)
        return format(_PER_SI.get(self.unit, 1.0) * value, self.form)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Table:
    """Rows of an experiment with what is needed to show them.

    Attributes
    ----------
    title : str
        What the rows are.
    columns : sequence of Column
        What is shown of them.
    rows : sequence of dict
        Plain values by names that carry the unit, as JSON and CSV have them.
    notes : sequence of str
        Sentences below the table.
    """

    title: str = ""
    columns: Sequence[Column] = ()
    rows: Sequence[Plain] = ()
    notes: Sequence[str] = ()


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Experiment(Generic[_World, _Found, _Pooled]):
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
    """

    worlds: Sequence[_World]
    run_world: Callable[[_World], _Found]
    pool: Callable[[list[_Found]], _Pooled]

    def run(
        self,
        progress: Progress = lambda _share, _what: None,
        *,
        n_processes: int | None = None,
    ) -> _Pooled:
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
            What ``pool`` makes of them; the same whatever the number of processes.
        """
        found = in_processes(
            self.run_world, self.worlds, n_processes=n_processes, progress=progress
        )
        return self.pool(found)


def to_json(value: Any) -> Any:
    """Return plain values with null for numbers that are not finite, which JSON has not.

    Parameters
    ----------
    value : object
        Mappings and sequences of plain values.

    Returns
    -------
    object
        The same as dicts and lists.
    """
    if isinstance(value, Mapping):
        return {key: to_json(one) for key, one in value.items()}
    if isinstance(value, Iterable) and not isinstance(value, str):
        return [to_json(one) for one in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
