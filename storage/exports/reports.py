"""Reports of experiments: tables, figures and pages, and the report that the service shows."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

_COVERAGE, _WORLDS = "coverage.json", "worlds.json"  # in the data folder, with tables beside them


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows as CSV, with the keys of the first as header.

    Parameters
    ----------
    path : Path
        The file.
    rows : sequence of mapping
        One row or more, all with the same keys.
    """
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def write_pages(folder: Path, texts: Mapping[str, str], copies: Sequence[Path] = ()) -> None:
    """Write texts into a folder, and files beside them.

    Parameters
    ----------
    folder : Path
        The folder; made if it is missing.
    texts : mapping of str to str
        Contents by path within the folder.
    copies : sequence of Path
        Files to copy there.
    """
    for name, text in texts.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    for source in copies:
        shutil.copyfile(source, folder / source.name)


def keep_coverage(report: Mapping[str, Any], data: Path) -> Path:
    """Write the report on the coverage of error ellipses into a data folder.

    Parameters
    ----------
    report : mapping
        The report, with rows ``levels`` and ``curve`` that go into a CSV too.
    data : Path
        The data folder.

    Returns
    -------
    Path
        The report.
    """
    path = _keep(report, data / _COVERAGE)
    write_csv(path.with_suffix(".csv"), [*report["levels"], *report["curve"]])
    return path


def keep_worlds(report: Mapping[str, Any], data: Path) -> Path:
    """Write the report on random worlds into a data folder.

    Parameters
    ----------
    report : mapping
        The report; each of its lists of rows goes into a CSV of its own too.
    data : Path
        The data folder.

    Returns
    -------
    Path
        The report.
    """
    path = _keep(report, data / _WORLDS)
    for name in ("markers", "methods", "decoys", "curve", "families"):
        if report[name]:
            write_csv(path.with_name(f"{path.stem}-{name}.csv"), report[name])
    return path


def kept_coverage(data: Path) -> dict[str, Any]:
    """Return the report on the coverage of error ellipses of a data folder, else the released one.

    Parameters
    ----------
    data : Path
        The data folder.

    Returns
    -------
    dict
        What ``keep_coverage`` wrote, here or, with ``is_released``, before the release.
    """
    released = resources.files(__package__).joinpath("released", _COVERAGE)
    kept = _kept(data / _COVERAGE)
    return kept or {**json.loads(released.read_text("utf-8")), "is_released": True}


def kept_worlds(data: Path) -> dict[str, Any] | None:
    """Return the report on random worlds of a data folder, if there is one.

    Parameters
    ----------
    data : Path
        The data folder.

    Returns
    -------
    dict or None
        What ``keep_worlds`` wrote.
    """
    return _kept(data / _WORLDS)


def _keep(report: Mapping[str, Any], path: Path) -> Path:
    """Write a report."""
    write_pages(path.parent, {path.name: json.dumps(report, indent=1)})
    return path


def _kept(path: Path) -> dict[str, Any] | None:
    """Return a report, if there is one."""
    return json.loads(path.read_text("utf-8")) if path.exists() else None
