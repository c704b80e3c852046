"""The preflight of a foreign container in a process of its own: bounded memory and time.

SQLite, bz2 and protobuf are written in C, and what they do with a hostile file must not end or
block the service. The child has no network where the system allows that; MCAP, whose reader checks
what it reads, needs no child. The child is this module run as a program.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from spheremark.pipelines.errors import RecordingError
from spheremark.storage.confinement import leave_network, limit_resources
from spheremark.storage.recordings.options import LogOptions
from spheremark.storage.recordings.preflight import Preflight, TopicReport, inspect_log
from spheremark.storage.recordings.records import MAGIC

_SECONDS = 300.0  # of one log
_MEMORY_BYTES = 12 << 30  # addresses, those of libraries included
_EXPANSION_MAX = 100  # of what is unpacked, over the file
_AT_ONCE = threading.BoundedSemaphore(2)  # children; others wait, and so memory is bounded too


def inspect_apart(
    path: Path, options: LogOptions | None = None, *, seconds: float = _SECONDS
) -> Preflight:
    """Inspect an uploaded log, in a process of its own unless it is MCAP.

    Parameters
    ----------
    path : Path
        The file.
    options : LogOptions, optional
        How to read it.
    seconds : float
        After which the child is ended [s].

    Returns
    -------
    Preflight
        As from ``inspect_log``; refused where the child was ended by a limit or by a crash.
    """
    options = options or LogOptions()
    with path.open("rb") as file:
        if file.read(len(MAGIC)) == MAGIC:
            return inspect_log(path, options)
    request = json.dumps([str(path), options.to_mapping(), seconds])
    command = [sys.executable, "-P", "-m", "spheremark.storage.recordings.apart", request]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with _AT_ONCE, tempfile.TemporaryDirectory(prefix="spheremark-") as folder:
        environment["TMPDIR"] = folder  # what a killed child has unpacked goes with it
        done = subprocess.run(command, env=environment, capture_output=True, check=False)
    try:
        return _from_mapping(json.loads(done.stdout))
    except (ValueError, TypeError, KeyError):
        reason = (
            f"The log cannot be read within {seconds:g} s and {_MEMORY_BYTES >> 30} GiB: its "
            f"reader ended with code {done.returncode}. It is damaged, or too large."
        )
        return Preflight(
            verdict="refused",
            code=RecordingError.code,
            reasons=(reason,),
            size_bytes=path.stat().st_size,
            reading=options.to_mapping(),
        )


def _from_mapping(values: dict[str, object]) -> Preflight:
    """Return a report from its plain values."""
    lists = {key: tuple(one) for key, one in values.items() if isinstance(one, list)}
    lists["topics"] = tuple(TopicReport(**one) for one in lists["topics"])
    return Preflight(**{**values, **lists})  # type: ignore[arg-type]


def _main() -> None:
    """Write the report on the log that the argument names."""
    leave_network()
    path, options, seconds = json.loads(sys.argv[1])
    limit_resources(
        memory_bytes=_MEMORY_BYTES,
        seconds=seconds,
        file_bytes=_EXPANSION_MAX * max(Path(path).stat().st_size, 1 << 20),
    )
    report = inspect_log(path, LogOptions.from_mapping(options))
    sys.stdout.write(json.dumps(report.to_mapping()))


if __name__ == "__main__":
    _main()
