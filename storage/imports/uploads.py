"""Logs and documents that others have sent, read in confined processes.

What comes back from there is checked by the classes of its values: a file may have forged it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from spheremark.pipelines.errors import RecordingError
from spheremark.pipelines.model import ControlMarks, Origin, Rig, ScanLog, Truth
from spheremark.pipelines.scan.rigs import rig_from_mapping
from spheremark.storage.confined import READY, Limits, UnreadableFileError, run_confined
from spheremark.storage.imports.survey_files import (
    ControlLayout,
    parse_control,
    parse_rig,
    parse_truth,
)
from spheremark.storage.recordings import LogOptions, Preflight, TopicReport

_SECONDS, _BYTES_PER_SECOND = 60.0, 1e6  # the slowest format that is known takes five of them
_MEMORY_BYTES, _EXPANSION = 2 << 30, 12  # ... and what a file stands for, unpacked and decoded
_DOCUMENT = Limits(seconds=30.0, memory_bytes=512 << 20, result_bytes=32 << 20)


def inspect_upload(path: Path, options: LogOptions | None = None, name: str = "") -> Preflight:
    """Inspect a log in a confined process.

    Parameters
    ----------
    path : Path
        The file.
    options : LogOptions, optional
        How to read it.
    name : str
        Its name in reasons; that of the file by default.

    Returns
    -------
    Preflight
        As from ``inspect_log``; refused where the process was ended by a limit or by a crash.
    """
    options = options or LogOptions()
    try:
        found = _run("inspect", path, name or path.stem, options)["report"]
        return _report(found)
    except UnreadableFileError as error:
        return Preflight(
            verdict="refused",
            code=RecordingError.code,
            reasons=(str(error),),
            size_bytes=path.stat().st_size,
            reading=options.to_mapping(),
        )


def read_upload(path: Path, options: LogOptions, origin: Origin) -> ScanLog:
    """Read a log in a confined process.

    Parameters
    ----------
    path : Path
        The file.
    options : LogOptions
        How to read it.
    origin : Origin
        Its name and digest.

    Returns
    -------
    ScanLog
        As from ``read_log``.

    Raises
    ------
    RecordingError
        If it cannot be read, or not within the limits.
    """
    try:
        found = _run("read", path, origin.digest or path.stem, options)
        rig = None if found["rig"] is None else rig_from_mapping(found["rig"])
        texts = {name: tuple(map(str, found[name])) for name in ("notes", "weaknesses")}
        return ScanLog(**{**found, **texts, "rig": rig, "origin": origin})
    except (UnreadableFileError, KeyError, TypeError, ValueError) as error:
        raise RecordingError(str(error)) from error


def control_of(text: str, layout: ControlLayout | None = None) -> ControlMarks:
    """Return the control marks of a table, parsed in a confined process.

    Parameters
    ----------
    text : str
        As for ``parse_control``.
    layout : ControlLayout, optional
        The layout where the header does not specify it.

    Returns
    -------
    ControlMarks
        The marks.
    """
    given = asdict(layout or ControlLayout())
    return parse_control(_parsed(text, "control", layout=given))


def rig_of(text: str) -> Rig:
    """Return the rig of a JSON text, parsed in a confined process.

    Parameters
    ----------
    text : str
        As for ``parse_rig``.

    Returns
    -------
    Rig
        The rig.
    """
    return parse_rig(_parsed(text, "rig"))


def truth_of(text: str) -> Truth:
    """Return the truth of a JSON text, parsed in a confined process.

    Parameters
    ----------
    text : str
        As for ``parse_truth``.

    Returns
    -------
    Truth
        The truth.
    """
    return parse_truth(_parsed(text, "truth"))


def _run(function: str, path: Path, name: str, options: LogOptions) -> dict[str, Any]:
    """Run a reader of logs within what a file of this size needs."""
    size = path.stat().st_size
    memory = _MEMORY_BYTES + _EXPANSION * size
    limits = Limits(
        seconds=_SECONDS + size / _BYTES_PER_SECOND, memory_bytes=memory, result_bytes=memory
    )
    plain = options.to_mapping()
    return run_confined(f"{READY}:{function}", path, limits, name=name, by_path=True, options=plain)


def _report(values: Mapping[str, Any]) -> Preflight:
    """Return a report from its plain values."""
    lists = {key: tuple(one) for key, one in values.items() if isinstance(one, list)}
    lists["topics"] = tuple(TopicReport(**one) for one in lists["topics"])
    return Preflight(**{**values, **lists})


def _parsed(text: str, kind: str, **more: Any) -> str:
    """Return a document as this program writes it."""
    with tempfile.TemporaryFile() as file:
        file.write(text.encode())
        file.seek(0)
        name = f"the {kind} file"
        return str(
            run_confined(f"{READY}:read_document", file, _DOCUMENT, name=name, kind=kind, **more)[
                "text"
            ]
        )
