"""The command ``spheremark bench``: how quick it is, and how good."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from spheremark.service.cli.terminal import err, out, print_json, progress, settings

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
    worlds: Annotated[int, typer.Option(min=1, help="Worlds of each scenario for that.")] = 3,
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
    wrong_rig: Annotated[
        bool, typer.Option("--wrong-rig", help="With wrong rigs, calibrated, for --networks.")
    ] = False,
    stops: Annotated[int, typer.Option(min=1, help="Stops of 120 markers for --accuracy.")] = 3,
    full: Annotated[
        bool, typer.Option("--full", help="Over 1000 fits at each distance for --accuracy.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first of them.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Measure each step against one read of the file with a checksum, in the same run."""
    if extraction:
        _bench_extraction(worlds, seed, as_json=as_json)
        return
    if coverage:
        _bench_coverage(coverage, seed, as_json=as_json)
        return
    if networks:
        _bench_networks(networks, seed, is_rig_wrong=wrong_rig, as_json=as_json)
        return
    if plans:
        _bench_plans(plans, seed, as_json=as_json)
        return
    if accuracy:
        _bench_accuracy(stops, seed, is_full=full, as_json=as_json)
        return
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as for workers; NumPy reads it when loaded
    from spheremark.service.bench import speed as benches
    from spheremark.service.cli import tables

    with progress() as told:
        wish = benches.Wish(repeats=repeats, is_quick=quick, is_long=long)
        report = benches.run(log, wish, told)
    if as_json:
        print_json(report)
    else:
        tables.print_bench(out, report)


def _bench_coverage(n_surveys: int, seed: int, *, as_json: bool) -> None:
    """Measure how often stations of simulated surveys lie within their ellipses; keep it."""
    from spheremark.service.bench import ellipse_coverage as coverage

    with progress() as told:
        report = coverage.run(n_surveys, seed, told)
    path = coverage.keep(report, settings().data)
    if as_json:
        print_json(report)
    else:
        coverage.print_report(out, report)
        err.print(f"Kept as {path}; the service shows it at /coverage.")


def _bench_networks(n_surveys: int, seed: int, *, is_rig_wrong: bool, as_json: bool) -> None:
    """Measure the accuracy of adjusted surveys, and how honest it is said."""
    from spheremark.service.bench import networks as network_trials

    wish = network_trials.Wish(n_surveys=n_surveys, seed=seed, is_rig_wrong=is_rig_wrong)
    with progress() as told:
        report = network_trials.run(wish, told)
    if as_json:
        print_json(report)
    else:
        network_trials.print_report(out, report)


def _bench_plans(n_drawn: int, seed: int, *, as_json: bool) -> None:
    """Measure how much better optimised marks are than chance, and how near to the best."""
    from spheremark.service.bench import plans as plan_bench

    with progress() as told:
        report = plan_bench.run(n_drawn, seed, told)
    if as_json:
        print_json(report)
    else:
        plan_bench.print_report(out, report)


def _bench_extraction(worlds: int, seed: int, *, as_json: bool) -> None:
    """Measure precision and recall of extraction in simulated worlds."""
    from spheremark.service.bench import detection

    with progress() as told:
        report = detection.run(worlds, seed, told)
    if as_json:
        print_json(report)
    else:
        detection.print_report(out, report)


def _bench_accuracy(stops: int, seed: int, *, is_full: bool, as_json: bool) -> None:
    """Measure the precision of centres against distance, by every method."""
    from spheremark.service.bench import precision

    with progress() as told:
        few = precision.Wish(n_stops=stops, seed=seed)
        report = precision.run(precision.full_wish(seed) if is_full else few, told)
    if as_json:
        print_json(report)
    else:
        precision.print_report(out, report)
