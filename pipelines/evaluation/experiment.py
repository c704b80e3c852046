"""The frame of all experiments: worlds by methods, pooled into tables with units."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from spheremark.pipelines.threads import in_processes

Plain = dict[str, Any]
Progress = Callable[[float, str], None]

World = TypeVar("World")
Found = TypeVar("Found")
Report = TypeVar("Report")

_PER_SI = {"mm": 1e3, "ms": 1e3, "ns": 1e9, "MB": 1e-6, "%": 100.0}  # units that scale a cell


class Column(NamedTuple):
    """One column of a table: a key of the rows, or a function from a row to the cell's text.

    Values of the rows are SI, and ``unit`` is the one shown. A column with a format is flush right;
    ``>`` does that for text.
    """

    key: str | Callable[[Plain], Any]
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
        return format(_PER_SI.get(self.unit, 1) * value, self.form)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Table:
    """Rows of plain values with the columns to show, and sentences above and below."""

    title: str = ""
    columns: Sequence[Column] = ()
    rows: Sequence[Plain] = ()
    notes: Sequence[str] = ()

    def to_texts(self) -> Plain:
        """Return the table as shown: headings with whether they are of numbers, rows of cells.

        Returns
        -------
        dict
            Plain values.
        """
        return {
            "title": self.title,
            "headings": [[column.heading, bool(column.form)] for column in self.columns],
            "rows": [[column.cell(row) for column in self.columns] for row in self.rows],
            "notes": list(self.notes),
        }


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
