"""``spheremark doctor``, ``backup`` and ``restore``: a data folder, in use or not."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from time import time
from typing import Annotated

import typer

from spheremark.service.cli.terminal import err, out, print_json
from spheremark.service.cli.terminal import settings as read_settings

Data = Annotated[Path | None, typer.Option(file_okay=False, help="Data folder.")]
Url = Annotated[str | None, typer.Option(help="Address of the service that uses it.")]


def doctor(
    data: Data = None,
    url: Url = None,
    mend: Annotated[
        bool, typer.Option("--mend", help="Remove what ended workers left; stop the service first.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="JSON for programs.")] = False,
) -> None:
    """Check files, digests, rows and schema of a data folder, while it is in use or not."""
    from spheremark.pipelines.errors import ConflictError
    from spheremark.storage import upkeep

    begin = time()
    with _copy(data, url) as (database, folder, is_served):
        if mend and is_served:
            raise ConflictError("A service uses this data folder; stop it before --mend.")
        found = upkeep.examine(database, folder, begin if is_served else math.inf)
    if mend:
        found = upkeep.mend(found)
    if as_json:
        print_json([asdict(one) for one in found])
    for one in [] if as_json else found:
        out.print(f"{one.kind}  {one.place}\n    {one.advice}", markup=False, soft_wrap=True)
    if found:
        raise typer.Exit(1)
    err.print("Nothing is wrong.")


def backup(
    target: Annotated[Path, typer.Argument(metavar="FOLDER", file_okay=False, help="The backup.")],
    data: Data = None,
    url: Url = None,
) -> None:
    """Copy a data folder while it is in use; the same folder again takes only what is new."""
    from spheremark.storage import upkeep

    with _copy(data, url) as (database, folder, _):
        n = upkeep.back_up(database, folder, target)
    err.print(f"{n} files are in {target}.", highlight=False)


def restore(
    source: Annotated[
        Path, typer.Argument(metavar="FOLDER", exists=True, file_okay=False, help="The backup.")
    ],
    data: Data = None,
) -> None:
    """Make a new data folder of a backup, after each file was compared with its digest."""
    from spheremark.storage import upkeep

    folder = data or read_settings().data
    n = upkeep.restore(source, folder)
    err.print(f"{n} files are in {folder}; start the service on it.", highlight=False)


@contextmanager
def _copy(data: Path | None, url: str | None) -> Iterator[tuple[Path, Path, bool]]:
    """Yield a copy of the database, the data folder, and whether a service uses it."""
    from spheremark.pipelines.errors import ConflictError
    from spheremark.service.cli.source import Source
    from spheremark.storage.scratch import scratch

    settings = read_settings(**({"data": data} if data else {}))
    folder = settings.data.resolve()
    with scratch() as temporary:
        copy = temporary / "results.duckdb"
        try:
            Source(settings, url, folder=None if url else folder).export(copy, None, None)
            is_served = url is not None
        except ConflictError:  # a service has it open
            Source(settings, settings.address(), folder=None).export(copy, None, None)
            is_served = True
        yield copy, folder, is_served
