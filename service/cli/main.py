"""The command ``spheremark``: each verb is one call of a function that the service calls too.

Results go to standard output, as tables for people or JSON for programs; progress and errors go
to standard error. Exit codes: 0 done, 1 failed, 2 misused. Heavy imports are inside the commands.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from enum import StrEnum
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spheremark.pipelines.errors import ConfigError, SpheremarkError
from spheremark.service.cli.bench import bench, reproduce
from spheremark.service.cli.jobs import jobs
from spheremark.service.cli.options import AsJson, Field, RadiusM, SigmaClockS, grouped
from spheremark.service.cli.plan import plan
from spheremark.service.cli.reading import Logs, OneLog, Reading
from spheremark.service.cli.report import report
from spheremark.service.cli.site import site
from spheremark.service.cli.spheres import spheres
from spheremark.service.cli.survey import adjust, calibrate
from spheremark.service.cli.terminal import announce_compilation, err, out
from spheremark.service.cli.terminal import print_json as _print_json
from spheremark.service.cli.terminal import progress as _progress
from spheremark.service.cli.terminal import settings as _settings
from spheremark.service.cli.tokens import token
from spheremark.service.cli.upkeep import backup, doctor, restore
from spheremark.service.cli.watch import watch

if TYPE_CHECKING:
    from spheremark.pipelines.model import StopResult

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
# Groups of commands in the help
_START, _LOGS, _RESULTS, _PLANS = "Start", "Logs to positions", "Results", "Plans"
_KEEPING, _MEASURING = "Running a service", "Measuring this program"

app.add_typer(plan, name="plan", rich_help_panel=_PLANS)
app.add_typer(token, name="token", rich_help_panel=_KEEPING)

_EXPORTS = "results.duckdb, or points as .csv, .dxf, .xml (LandXML) or .geojson."


class Format(StrEnum):
    """What simulated LiDARs write."""

    POINTS = "points"
    PACKETS = "packets"


class Compression(StrEnum):
    """How the chunks of a log can be compressed."""

    NONE = "none"
    LZ4 = "lz4"
    ZSTD = "zstd"


class Frame(StrEnum):
    """Frames in which centres can be given."""

    STATION = "station"
    BASE = "base"


@app.callback(invoke_without_command=True)
def about(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Station positions from spherical markers and a gimbal-mounted LiDAR."""
    if version:
        sys.stdout.write(f"{metadata.version('spheremark')}\n")
        raise typer.Exit


def main() -> None:
    """Run the command line; an error of ours becomes one sentence, or a problem as JSON."""
    announce_compilation()
    try:
        app()
    except SpheremarkError as error:
        if "--json" in sys.argv:
            from spheremark.service.errors import problem_of

            _print_json(problem_of(error, " ".join(sys.argv[1:2])).model_dump(exclude_none=True))
        _print_error(str(error))
        raise SystemExit(2 if isinstance(error, ConfigError) else 1) from None
    except OSError as error:
        if error.filename is None:
            raise
        _print_error(f"{error.filename}: {error.strerror}.")
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        raise SystemExit(130) from None


def _print_error(sentence: str) -> None:
    """Print what went wrong; nothing in it is markup."""
    err.print("[bold red]Error:[/] ", end="")
    err.print(sentence, markup=False, emoji=False, highlight=False, soft_wrap=True)


@app.command(rich_help_panel=_START)
def demo() -> None:
    """Simulate, upload, process and serve one lane of the study's field."""
    from spheremark.service.cli.demo import run

    run(_settings(), out)


@app.command(rich_help_panel=_START)
def serve(
    host: Annotated[
        str | None, typer.Option(help="Address to listen on.", show_default="127.0.0.1")
    ] = None,
    port: Annotated[
        int | None, typer.Option(help="Port; 0 takes a free one.", show_default="8000")
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(help="Folder of database, logs and clouds.", show_default="data"),
    ] = None,
) -> None:
    """Run the service; every setting can come from the environment (SPHEREMARK_...)."""
    from spheremark.service.serving import serve as run

    given = {"host": host, "port": port, "data": data}
    settings = _settings(**{name: value for name, value in given.items() if value is not None})
    run(settings, ready=lambda address: err.print(f"Serving on [bold]{address}[/]"))


@app.command(rich_help_panel=_LOGS)
def simulate(
    folder: Annotated[Path, typer.Argument(metavar="OUT", help="Folder for the logs.")],
    scenario: Annotated[
        str,
        typer.Option(
            "--scenario",
            "--world",
            help="World: paper-field, clutter-field, rock-field, range-lane; or random, "
            "with optics, rig and motion drawn too, but for those given.",
        ),
    ] = "paper-field",
    stops: Annotated[
        str,
        typer.Option(
            help="Names, lanes (lane3), numbers or ranges (1-7), or all.",
            show_default="lane3; stop1 of a random world; all of others",
        ),
    ] = "",
    seed: Annotated[int, typer.Option(min=0, help="Source of chance.")] = 0,
    turn_s: Annotated[
        float | None,
        typer.Option(help="Time of a full turn of the gimbal \\[s].", show_default="13.2"),
    ] = None,
    rpm: Annotated[
        float | None, typer.Option(help="Speed of the LiDAR [1/min].", show_default="600")
    ] = None,
    sigma_mm: Annotated[
        float | None, typer.Option(help="Noise of ranges \\[mm]; by reflectivity if not given.")
    ] = None,
    step_deg: Annotated[
        float | None,
        typer.Option(
            help="Angle between rests of the gimbal \\[deg]; 0 turns evenly.", show_default="0"
        ),
    ] = None,
    shot_times: Annotated[
        bool | None,
        typer.Option(
            help="Whether each point of a cloud carries a time.", show_default="shot-times"
        ),
    ] = None,
    form: Annotated[
        Format, typer.Option("--format", help="Point clouds, or raw packets of a VLP-16.")
    ] = Format.POINTS,
    compression: Annotated[Compression, typer.Option(help="Of the chunks.")] = Compression.NONE,
    as_json: AsJson = False,
) -> None:
    """Write logs as a recorder would (STOP.mcap), their truth (STOP.truth.json) and control.csv."""
    from spheremark.pipelines.simulation import SimulationConfig, commensurability, draw_config
    from spheremark.service.cli.fieldwork import RANDOM, Assignment, survey

    given: dict[str, Any] = {
        "turn": turn_s,
        "spin_rpm": rpm,
        "sigma_range": None if sigma_mm is None else sigma_mm / 1000.0,
        "step": None if step_deg is None else math.radians(step_deg),
        "shot_times": shot_times,
    }
    config = draw_config(seed) if scenario == RANDOM else SimulationConfig()
    config = replace(config, **{name: one for name, one in given.items() if one is not None})
    if warning := commensurability(config):
        err.print(f"[yellow]Warning:[/] {warning}", soft_wrap=True)
    assignment = Assignment(
        scenario=scenario,
        stops=stops,
        seed=seed,
        config=config,
        compression=compression,
        packets=form is Format.PACKETS,
    )
    with _progress() as progress:
        for made in survey(folder, assignment, progress=progress):
            paths = {"stop": made.name, "log": str(made.log), "truth": str(made.truth)}
            sys.stdout.write((json.dumps(paths) if as_json else paths["log"]) + "\n")
            sys.stdout.flush()


@app.command(rich_help_panel=_LOGS)
@grouped
def inspect(
    log: OneLog,
    reading: Reading,
    diagnose: Annotated[
        bool,
        typer.Option("--diagnose", help="Try other signs, units and clocks; takes seconds."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Report what a log holds and lacks, and whether it can be processed."""
    from spheremark.service.cli import render
    from spheremark.storage.recordings import inspect_log

    (file,) = reading.files([log])
    report = inspect_log(file.path, file.options, beside=file.beside, diagnosing=diagnose)
    if as_json:
        _print_json(report.to_mapping())
    else:
        render.print_preflight(out, log.name, report)
    if report.verdict == "refused":
        raise typer.Exit(1)


@app.command(rich_help_panel=_LOGS)
@grouped
def process(
    logs: Logs,
    reading: Reading,
    field: Field,
    method: Annotated[
        list[str] | None, typer.Option(help="Fitting method; again for more. The first counts.")
    ] = None,
    resection: Annotated[
        list[str] | None,
        typer.Option(help="free_station, ranges or paper; again for more. The first counts."),
    ] = None,
    frame: Annotated[Frame, typer.Option(help="Frame of the centres.")] = Frame.STATION,
    tolerance_m: Annotated[float, typer.Option(help="Error that is accepted \\[m].")] = 0.03,
    radius_m: RadiusM = 0.100,
    sigma_clock_s: SigmaClockS = 0.03,
    truth: Annotated[
        Path | None,
        typer.Option(exists=True, dir_okay=False, help="Truth (JSON); adds errors, no more."),
    ] = None,
    mcap: Annotated[
        Path | None,
        typer.Option(
            dir_okay=False, help="Write spheres, clouds and poses (MCAP), for viewers of the log."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Find the markers of logs and position their stations."""
    from spheremark.pipelines.config import SurveyConfig
    from spheremark.service.cli import render
    from spheremark.service.log_files import process_file
    from spheremark.service.serialise.stops import serialise_log
    from spheremark.storage.imports.survey_files import read_truth

    config = SurveyConfig.from_mapping(
        {
            "marker_radius": radius_m,
            "tolerance": tolerance_m,
            "stitching": {"sigma_clock": sigma_clock_s},
            "fitting": {"methods": method or ["along_beam"]},
            "resection": {"methods": resection or ["free_station"]},
        }
    )
    marks, rig = field.read()
    true = read_truth(truth) if truth else None
    results = []
    with _result_log(mcap) as add:
        for log in reading.files(logs):
            with _progress() as progress:
                found = process_file(log, config, progress, rig=rig, marks=marks, truth=true)
            add(found.stops)
            results.append(serialise_log(found, frame=frame.value, truth=true))
            if not as_json:
                render.print_log(out, results[-1])
    if as_json:
        _print_json(results[0] if len(results) == 1 else results)


@contextmanager
def _result_log(path: Path | None) -> Iterator[Callable[[Sequence[StopResult]], None]]:
    """Yield a function that writes stops into a log of results, if there is a path for one."""
    if path is None:
        yield lambda _stops: None
        return
    from spheremark.storage.exports.result_log import ResultLog

    with closing(ResultLog(path)) as log:

        def add(stops: Sequence[StopResult]) -> None:
            for stop in stops:
                log.add(stop)

        yield add


for command in (adjust, calibrate, site, spheres, watch):
    app.command(rich_help_panel=_LOGS)(command)
app.command(rich_help_panel=_RESULTS)(report)


@app.command(rich_help_panel=_RESULTS)
def query(
    sql: Annotated[str, typer.Argument(help="One SELECT.")],
    url: Annotated[
        str | None, typer.Option("--url", "--server", help="Address of a running service.")
    ] = None,
    data: Annotated[Path | None, typer.Option(help="Data folder that no service uses.")] = None,
    as_json: AsJson = False,
    as_csv: Annotated[bool, typer.Option("--csv", help="CSV for programs.")] = False,
) -> None:
    """Run a query in SQL: in a running service, or on a data folder that none uses."""
    from spheremark.service.cli import render
    from spheremark.service.cli.source import Source

    source = Source(_settings(**({"data": data} if data else {})), url, folder=data)
    result = source.query(sql)
    if as_json:
        _print_json(result)
    elif as_csv:
        from spheremark.storage.catalogue.sandbox import csv_text

        names = [column["name"] for column in result["columns"]]
        sys.stdout.write(csv_text(names, result["rows"]))
    else:
        render.print_rows(out, result)
    if result["truncated"]:
        err.print(f"[yellow]Truncated:[/] only the first {result['row_limit']:,} rows are here.")


@app.command(rich_help_panel=_RESULTS)
def export(
    target: Annotated[Path, typer.Argument(metavar="OUT", help=_EXPORTS)],
    url: Annotated[
        str | None, typer.Option("--url", "--server", help="Address of a running service.")
    ] = None,
    data: Annotated[Path | None, typer.Option(help="Data folder that no service uses.")] = None,
    survey: Annotated[str | None, typer.Option(help="Only the points of this survey.")] = None,
    origin: Annotated[
        str | None,
        typer.Option(
            help="Origin of the site for GeoJSON: LON,LAT[,BEARING of y], WGS 84 \\[deg]."
        ),
    ] = None,
) -> None:
    """Copy the database, or stations and marks as coordinates, by the ending of OUT."""
    from spheremark.service.cli.source import Source

    Source(_settings(**({"data": data} if data else {})), url, folder=data).export(
        target, survey, origin
    )
    err.print(f"Wrote {target}.")


for command in (jobs, doctor, backup, restore):
    app.command(rich_help_panel=_KEEPING)(command)
for command in (bench, reproduce):
    app.command(rich_help_panel=_MEASURING)(command)


if __name__ == "__main__":
    main()
