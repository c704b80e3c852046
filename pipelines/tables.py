"""Tables of plain values: columns with units, for terminals, pages and text reports."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

Plain = dict[str, Any]

_PER_SI = {"mm": 1e3, "ms": 1e3, "ns": 1e9, "MB": 1e-6, "%": 100.0}  # units that scale a cell


class Column(NamedTuple):
    """One column of a table: a key of the rows, or a function from a row to the cell's text.

    Values of the rows are SI, and ``unit`` is the one shown. A column with a format is flush right;
    ``>`` does that for text.
    """

    key: str | Callable[[Any], Any]
    title: str
    unit: str = ""
    form: str = ""

    @classmethod
    def mm(cls, key: str, title: str) -> Self:
        """Return a column of lengths in millimetres, with one decimal.

        Parameters
        ----------
        key, title : str
            Key of the rows and heading.

        Returns
        -------
        Column
            The column.
        """
        return cls(key, title, "mm", ".1f")

    @classmethod
    def whole(cls, key: str, title: str) -> Self:
        """Return a column of whole numbers, with commas.

        Parameters
        ----------
        key, title : str
            Key of the rows and heading.

        Returns
        -------
        Column
            The column.
        """
        return cls(key, title, "", ",d")

    @property
    def heading(self) -> str:
        """Title with the unit in brackets."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    def cell(self, row: Mapping[str, Any]) -> str:
        """Return the text of one cell; a hyphen where there is no value."""
        value = self.key(row) if callable(self.key) else row.get(self.key)
        if value is None:
            return "-"
        if not self.form or isinstance(value, str):
            return str(value)
        sign = self.form[:1] if self.form[:1] == "+" else ""
        form = f"{sign}z{self.form[len(sign) :]}" if self.form.endswith("f") else self.form
        return format(_PER_SI.get(self.unit, 1) * value, form)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Table:
    """Rows of plain values with the columns to show, and sentences above and below."""

    title: str = ""
    columns: Sequence[Column] = ()
    rows: Sequence[Mapping[str, Any]] = ()
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
