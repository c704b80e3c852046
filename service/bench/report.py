"""Reports of all experiments on the terminal."""

from __future__ import annotations

from collections.abc import Iterable

from rich import table as rich_table
from rich.console import Console
from rich.markup import escape

from spheremark.pipelines.evaluation.experiment import Table


def print_tables(out: Console, tables: Iterable[Table]) -> None:
    """Print tables with their titles and notes."""
    for one in tables:
        if one.title:
            out.print(f"[bold]{escape(one.title)}[/]", highlight=False, soft_wrap=True)
        if one.rows:
            out.print(_drawn(one))
        for note in one.notes:
            out.print(escape(note), highlight=False, soft_wrap=True)


def _drawn(table: Table) -> rich_table.Table:
    """Return a table for the terminal: text flush left, numbers right."""
    drawn = rich_table.Table(box=None, pad_edge=False, header_style="bold")
    for column in table.columns:
        drawn.add_column(escape(column.heading), justify="right" if column.form else "left")
    for row in table.rows:
        drawn.add_row(*(escape(column.cell(row)) for column in table.columns))
    return drawn
