"""Standard output and standard error of the commands: one for results, the other for progress."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console

from spheremark.pipelines.compilation import watch_compilation

if TYPE_CHECKING:
    from spheremark.pipelines.placement import Report, SearchState
    from spheremark.pipelines.survey import Progress
    from spheremark.service.settings import Settings

_COMPILING = (
    "Compiling numerical kernels. They are kept for later runs; "
    "the first scan of a new version takes about a minute longer.\n"
)
_N_LINE = 10  # kernels between two lines; a first scan needs about 50
_WIDE = 160  # columns of a table that goes into a file or a pipe
out = Console(width=None if sys.stdout.isatty() else _WIDE)
err = Console(stderr=True)


@contextmanager
def progress() -> Iterator[Progress]:
    """Show a bar on standard error while something long runs."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.progress import TimeRemainingColumn as TimeLeft

    about = TextColumn("{task.description}")
    columns = (BarColumn(24), about, TimeElapsedColumn(), TextColumn("left"), TimeLeft())
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda share, what: bar.update(task, completed=share, description=what)


@contextmanager
def searching() -> Iterator[Report]:
    """Show how far a search of plans has come, with the best and the bound so far."""
    with progress() as shown:
        yield lambda state: shown(state.share, _closing_in(state))


def _closing_in(state: SearchState) -> str:
    """Return a search with its best arrangement and its bound."""
    found = f"best {1e3 * state.worst:.3f} mm" if state.worst < float("inf") else ""
    bound = f"none below {1e3 * state.bound:.3f} mm" if state.bound else ""
    near = f"within {100 * (state.worst / state.bound - 1):.1f} %" if found and bound else ""
    return "; ".join(part for part in (state.step, found, bound, near) if part)


def announce_compilation() -> None:
    """Write to standard error when kernels are compiled, which the first command has to."""
    watch_compilation(_announce)


def _announce(n_compiled: int) -> None:
    """Write a sentence before the first kernel, and then how many are compiled."""
    if n_compiled == 0:
        sys.stderr.write(_COMPILING)
    elif n_compiled % _N_LINE == 0:
        sys.stderr.write(f"{n_compiled} kernels compiled ...\n")


def print_json(value: Any) -> None:
    """Write JSON to standard output."""
    sys.stdout.write(json.dumps(value, indent=2, allow_nan=False) + "\n")


def settings(**given: Any) -> Settings:
    """Read the settings; exit with a sentence if one is wrong."""
    from pydantic import ValidationError

    from spheremark.service.settings import Settings

    try:
        return Settings(**given)
    except ValidationError as error:
        for one in error.errors():
            name = "_".join(["SPHEREMARK", *(str(part).upper() for part in one["loc"])])
            about = f"{name}: " if one["loc"] else ""  # rules of several settings name them
            text = about + one["msg"].removeprefix("Value error, ")
            err.print(f"[bold red]Error:[/] {text}", highlight=False, soft_wrap=True)
        raise typer.Exit(2) from None
