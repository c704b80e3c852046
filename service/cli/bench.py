"""The commands ``spheremark bench`` and ``spheremark reproduce``: speed, accuracy, the study."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spheremark.service.cli.terminal import err, out, print_json, progress, settings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from spheremark.pipelines.evaluation.experiment import Experiment, Plain, Table

_STOPS_OF_COVERAGE = 15  # of each survey
_STOPS_OF_ACCURACY = 3
_WORLDS_OF_EXTRACTION = 3  # of each scenario

AsJson = Annotated[bool, typer.Option("--json", help="JSON for programs.")]


def bench(
    log: Annotated[
        Path | None, typer.Argument(exists=True, dir_okay=False, help="Log; simulated if missing.")
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, help="The best of so many counts.")] = 15,
    quick: Annotated[bool, typer.Option("--quick", help="Without the usual libraries.")] = False,
    long: Annotated[
        bool, typer.Option("--long", help="Also logs of 1, 3, 10 and 30 million returns.")
    ] = False,
    extraction: Annotated[
        bool, typer.Option("--extraction", help="Precision and recall of extraction instead.")
    ] = False,
    worlds: Annotated[
        int,
        typer.Option(
            min=0,
            help="Detection, centres and stations in so many random worlds instead; with "
            "--extraction, worlds of each scenario.",
            show_default="3 with --extraction",
        ),
    ] = 0,
    accuracy: Annotated[
        bool, typer.Option("--accuracy", help="Precision of centres by every method instead.")
    ] = False,
    coverage: Annotated[
        int, typer.Option(min=0, help="Do error ellipses hold? So many surveys instead.")
    ] = 0,
    networks: Annotated[
        int, typer.Option(min=0, help="Accuracy of adjusted surveys; so many instead.")
    ] = 0,
    plans: Annotated[
        int, typer.Option(min=0, help="Optimised marks beside the best of so many at random.")
    ] = 0,
    promises: Annotated[
        int,
        typer.Option(min=0, help="Stations of so many random worlds over what plans promise."),
    ] = 0,
    wrong_rig: Annotated[
        bool, typer.Option("--wrong-rig", help="With wrong rigs, calibrated, for --networks.")
    ] = False,
    stops: Annotated[
        int,
        typer.Option(
            min=0,
            help="Stops of 120 markers for --accuracy; with --worlds, surveys of so many stops.",
            show_default="3 for --accuracy",
        ),
    ] = 0,
    full: Annotated[
        bool, typer.Option("--full", help="Over 1000 fits at each distance for --accuracy.")
    ] = False,
    load: Annotated[
        float,
        typer.Option(
            min=0, help="Times, errors and memory of a service under load, for minutes instead."
        ),
    ] = 0.0,
    upload: Annotated[
        int,
        typer.Option(min=0, help="Memory of a service that receives a file of so many MB instead."),
    ] = 0,
    seed: Annotated[
        int,
        typer.Option(
            "--seed",
            "--first-seed",
            min=0,
            help="Seed of the first of them; of random worlds every other one follows.",
        ),
    ] = 0,
    as_json: AsJson = False,
) -> None:
    """Measure each step against one read of the file with a checksum, in the same run."""
    if load or upload:
        _served(load, upload * 1_000_000, as_json=as_json)
    elif extraction:
        from spheremark.pipelines.evaluation import detection

        seeds = range(seed, seed + (worlds or _WORLDS_OF_EXTRACTION))
        _run(detection.extraction(detection.DETECTION_PLAN, seeds), as_json=as_json)
    elif worlds:
        _worlds(worlds, seed, stops, is_quick=quick, as_json=as_json)
    elif coverage:
        _coverage(coverage, seed, as_json=as_json)
    elif networks:
        from spheremark.pipelines.evaluation import networks as surveys

        _run(surveys.networks(networks, seed=seed, is_rig_wrong=wrong_rig), as_json=as_json)
    elif plans:
        from spheremark.pipelines.evaluation import plans as planning

        _run(planning.plans(plans, seed), as_json=as_json)
    elif promises:
        from spheremark.pipelines.evaluation.promises import promises as over_promises

        _run(over_promises(promises, seed), as_json=as_json)
    elif accuracy:
        from spheremark.pipelines.evaluation.precision import full_precision, precision

        n_stops = stops or _STOPS_OF_ACCURACY
        _run(full_precision(seed) if full else precision(n_stops, seed), as_json=as_json)
    else:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in workers, before NumPy's import
        from spheremark.service.bench.speed import SpeedOptions, speed, speed_tables

        options = SpeedOptions(repeats=repeats, is_quick=quick, is_long=long)
        with progress() as show:
            report = speed(log, options, show)
        _print(report, speed_tables, as_json=as_json)


def reproduce(
    folder: Annotated[
        Path, typer.Argument(metavar="[OUT]", help="Folder for page, tables and figures.")
    ] = Path("reproduction"),
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer worlds: about a minute, with wider intervals.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Source of chance.")] = 0,
    real: Annotated[
        Path | None,
        typer.Option(exists=True, file_okay=False, help="Folder of real scans to set beside."),
    ] = None,
    tolerance_m: Annotated[float, typer.Option(help="Error that is accepted \\[m].")] = 0.03,
    as_json: AsJson = False,
) -> None:
    """Regenerate the study's tables and figures in simulation, both methods side by side."""
    from spheremark.service.bench import reproduce as study

    options = study.ReproductionOptions(seed=seed, is_quick=quick, real=real, tolerance=tolerance_m)
    with progress() as show:
        report = study.reproduce(folder, options, show)
    _print(report, study.reproduction_tables, as_json=as_json)


def _served(minutes: float, n_bytes: int, *, as_json: bool) -> None:
    """Measure a service of its own under load, or while it receives a large file."""
    from spheremark.service.bench import served

    with progress() as show:
        if minutes:
            report, tables = served.load(minutes, show), served.load_tables
        else:
            report, tables = served.upload(n_bytes, show), served.upload_tables
    _print(report, tables, as_json=as_json)


def _worlds(n: int, seed: int, n_stops: int, *, is_quick: bool, as_json: bool) -> None:
    """Measure the chain in random worlds, and keep the report for the service."""
    from spheremark.pipelines.evaluation import networks as surveys
    from spheremark.pipelines.evaluation import worlds as chain
    from spheremark.service.bench.peers import PEERS, spheres_of_peers
    from spheremark.service.provenance import made_now
    from spheremark.storage.exports.reports import keep_worlds

    if n_stops:
        _run(surveys.random_networks(n, seed=seed, n_stops=n_stops), as_json=as_json)
        return
    peers = None if is_quick else chain.Peers(PEERS, spheres_of_peers)
    experiment = chain.worlds(n, seed, peers)
    with progress() as show:
        report = made_now() | experiment.run(show)
    shown = [table.to_texts() for table in experiment.tables(report)]
    path = keep_worlds(report | {"tables": shown}, settings().data)
    _print(report, experiment.tables, as_json=as_json)
    if not as_json:
        err.print(f"Kept as {path}, with tables beside it; the service shows it at /worlds.")


def _coverage(n_surveys: int, seed: int, *, as_json: bool) -> None:
    """Measure the coverage of error ellipses, and keep the report for the service."""
    from spheremark.pipelines.evaluation.ellipse_coverage import ellipse_coverage
    from spheremark.service.provenance import made_now
    from spheremark.storage.exports.reports import keep_coverage

    experiment = ellipse_coverage(n_surveys, _STOPS_OF_COVERAGE, seed)
    with progress() as show:
        report = made_now() | experiment.run(show)
    path = keep_coverage(report, settings().data)
    _print(report, experiment.tables, as_json=as_json)
    if not as_json:
        err.print(f"Kept as {path}; the service shows it at /coverage.")


def _run(experiment: Experiment[Any, Any, Plain], *, as_json: bool) -> None:
    """Run an experiment and print its report."""
    with progress() as show:
        report = experiment.run(show)
    _print(report, experiment.tables, as_json=as_json)


def _print(report: Plain, tables: Callable[[Plain], Iterable[Table]], *, as_json: bool) -> None:
    """Print a report as JSON or as tables."""
    from spheremark.service.cli.render import print_tables

    if as_json:
        print_json(report)
    else:
        print_tables(out, tables(report))
