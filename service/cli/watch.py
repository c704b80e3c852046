"""``spheremark watch``: a decision on each stop as soon as its recording is closed."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from spheremark.service.cli.options import AsJson, Field, RadiusM, grouped
from spheremark.service.cli.reading import Reading
from spheremark.service.cli.terminal import err, out, settings

_LOOK = 0.5  # [s] between two looks into the folder; a listing costs milliseconds on any disk


@dataclass(frozen=True, kw_only=True)
class Service:
    """The running service that processes the logs, in place of this command."""

    server: Annotated[
        str | None,
        typer.Option(
            "--server",
            "--url",
            help="Address of a running service: it takes and processes each log, and its page "
            "/live shows the stops.",
        ),
    ] = None
    survey: Annotated[str, typer.Option(help="Survey in that service.")] = ""


@grouped
def watch(
    folder: Annotated[
        Path,
        typer.Argument(exists=True, file_okay=False, help="Where the rover's bags are recorded."),
    ],
    reading: Reading,
    field: Field,
    service: Service,
    tolerance_m: Annotated[float, typer.Option(help="Error that is accepted \\[m].")] = 0.03,
    radius_m: RadiusM = 0.100,
    existing: Annotated[
        bool, typer.Option("--existing", help="Take the logs that are there already, too.")
    ] = False,
    count: Annotated[
        int, typer.Option(min=0, help="End after so many logs; 0 goes on until Ctrl-C.")
    ] = 0,
    as_json: AsJson = False,
) -> None:
    """Decide on each stop as soon as its bag is closed: good enough, what is bad, what would help.

    Runs beside `ros2 bag record`, which closes a bag by its metadata.yaml; an MCAP file is closed
    by its footer. Each log is a line of JSON with --json.
    """
    from spheremark.pipelines.errors import ConfigError, SpheremarkError
    from spheremark.storage.recordings import closed_logs

    if bool(service.server) != bool(service.survey):
        raise ConfigError("--server and --survey belong together: give both, or neither.")
    if service.server and (field.control or field.rig):
        raise ConfigError(
            "--control and --rig are those of the survey when a --server processes the logs."
        )
    decide = (
        _remote(service, reading)
        if service.server
        else _local(reading, field, {"tolerance": tolerance_m, "marker_radius": radius_m})
    )
    known = set() if existing else set(closed_logs(folder))
    err.print(f"Watching {folder}. Ctrl-C ends.")  # from here on, each log that is closed is taken
    for n, log in enumerate(_closed(folder, known), start=1):
        begin = time.monotonic()
        try:
            found = decide(log)
        except SpheremarkError as error:
            found = {"log": log.name, "code": error.code, "error": str(error)}
        found["seconds"] = round(time.monotonic() - begin, 1)
        if as_json:
            sys.stdout.write(json.dumps(found, allow_nan=False) + "\n")
            sys.stdout.flush()
        else:
            _show(found)
        if n == count:
            return


def _closed(folder: Path, known: set[Path]) -> Iterator[Path]:
    """Yield each recording that is not known once, when it is closed."""
    from spheremark.storage.recordings import closed_logs

    while True:
        for log in closed_logs(folder):
            if log not in known:
                known.add(log)
                yield log
        time.sleep(_LOOK)


def _local(
    reading: Reading, field: Field, values: dict[str, float]
) -> Callable[[Path], dict[str, Any]]:
    """Return what processes a log in this process, whose kernels are loaded once."""
    from spheremark.pipelines.config import SurveyConfig
    from spheremark.pipelines.stop_decisions import decide
    from spheremark.service.log_files import process_file

    marks, rig = field.read()
    config = SurveyConfig.from_mapping(
        {**values, "resection": {"subset_methods": ["free_station"]}}
    )

    def decided(log: Path) -> dict[str, Any]:
        (file,) = reading.files([log])
        found = process_file(file, config, lambda _share, _what: None, rig=rig, marks=marks)
        stops = [decide(stop, config, marks) for stop in found.stops]
        return {"log": log.name, "stops": [one.to_mapping() for one in stops]}

    return decided


def _remote(service: Service, reading: Reading) -> Callable[[Path], dict[str, Any]]:
    """Return what has a log processed by a running service."""
    from spheremark.service.client import Client

    client = Client(service.server or "", token=settings().token_text, timeout=120.0)

    def decided(log: Path) -> dict[str, Any]:
        (file,) = reading.files([log])
        sent = client.upload(log, survey=service.survey, reading=file.options.to_mapping())
        job = client.wait(sent)
        return {
            "log": log.name,
            "job_id": job["job_id"],
            "page": f"{client.url}/jobs/{job['job_id']}",
            "message": job["message"],
        }

    return decided


def _show(found: dict[str, Any]) -> None:
    """Print the decisions on the stops of a log."""

    def say(text: str, style: str = "") -> None:
        out.print(text, style=style, markup=False, highlight=False, soft_wrap=True)

    if "error" in found:
        say(f"{found['log']}: no result, {found['seconds']} s", "bold red")
        say(f"  {found['error']}")
    elif "message" in found:
        is_bad = "not good enough." in found["message"]
        say(f"{found['log']}: {found['seconds']} s", "bold yellow" if is_bad else "bold green")
        say(f"  {found['message']}")
        say(f"  {found['page']}")
    for stop in found.get("stops", ()):
        grade = "good enough" if stop["is_good_enough"] else "not good enough"
        style = "bold green" if stop["is_good_enough"] else "bold yellow"
        say(f"{stop['stop']}: {grade}, {found['seconds']} s", style)
        for sentence in (stop["summary"], *stop["bad_markers"], *stop["advice"]):
            say(f"  {sentence}")
