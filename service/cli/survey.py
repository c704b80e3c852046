"""The commands of a whole survey: ``spheremark adjust`` and ``spheremark calibrate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spheremark.service.cli.options import AsJson, Field, RadiusM, SigmaClockS, grouped
from spheremark.service.cli.reading import Logs, Reading
from spheremark.service.cli.terminal import out, print_json, progress


@grouped
def adjust(
    logs: Logs,
    reading: Reading,
    field: Field,
    calibrating: Annotated[
        bool, typer.Option("--calibrate", help="Estimate the rig in the same adjustment.")
    ] = False,
    method: Annotated[str, typer.Option(help="Fitting method.")] = "along_beam",
    radius_m: RadiusM = 0.100,
    sigma_clock_s: SigmaClockS = 0.03,
    gama: Annotated[
        Path | None, typer.Option(dir_okay=False, help="Write input of GNU Gama (XML).")
    ] = None,
    csv: Annotated[
        Path | None, typer.Option(dir_okay=False, help="Write stations and marks (CSV).")
    ] = None,
    evidence: Annotated[
        Path | None,
        typer.Option(dir_okay=False, help="Write what each station says of each mark (CSV)."),
    ] = None,
    report: Annotated[
        Path | None, typer.Option(dir_okay=False, help="Write the whole report (text).")
    ] = None,
    truth: Annotated[
        list[Path] | None,
        typer.Option(
            exists=True, dir_okay=False, help="Truth (JSON); adds errors, no more. Again for more."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Adjust all stations and marks of a survey together."""
    from spheremark.pipelines.config import SurveyConfig
    from spheremark.pipelines.network import compare
    from spheremark.service import log_files
    from spheremark.service.cli import render
    from spheremark.service.serialise import network as serialise
    from spheremark.service.serialise.network_report import report as format_report
    from spheremark.storage.exports.network import (
        format_coordinates,
        format_evidence,
        format_gama,
    )
    from spheremark.storage.imports import survey_files as site_files

    config = SurveyConfig.from_mapping(
        {
            "marker_radius": radius_m,
            "stitching": {"sigma_clock": sigma_clock_s},
            "fitting": {"methods": [method]},
        }
    )
    marks, given = field.read()
    files = reading.files(logs)
    with progress() as track:
        book = log_files.read_scans(files, config, given, track)
        if calibrating:
            book = log_files.with_calibration(book, files, config, given, track)
    result = log_files.adjust_scans(book, marks, config)
    found = log_files.adjusted_rig(result, book)
    plain = serialise.serialise_network(result, config, rig=found, uncalibrated=book.uncalibrated)
    if truth:
        true = log_files.merged_truth([site_files.read_truth(path) for path in truth])
        errors = compare(result, true)
        plain["errors"] = serialise.serialise_network_errors(result, errors, true.marks.names)
    if gama:
        gama.write_text(format_gama(result), encoding="utf-8")
    if csv:
        csv.write_text(format_coordinates(result), encoding="utf-8")
    if evidence:
        evidence.write_text(format_evidence(result), encoding="utf-8")
    if report:
        report.write_text(format_report(plain), encoding="utf-8")
    if as_json:
        print_json(plain)
    else:
        render.print_network(out, plain)


@grouped
def calibrate(
    logs: Logs,
    reading: Reading,
    rig: Annotated[
        Path | None,
        typer.Option(
            exists=True, dir_okay=False, help="Rig to start with (JSON), if not the logs'."
        ),
    ] = None,
    radius_m: RadiusM = 0.100,
    target: Annotated[
        Path | None, typer.Option("--out", dir_okay=False, help="Write a rig file for --rig.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Estimate the rig from the two faces of the spheres in logs."""
    from spheremark.pipelines.config import SurveyConfig
    from spheremark.service.cli import render
    from spheremark.service.log_files import calibrate_files
    from spheremark.service.serialise.calibration import serialise_calibration
    from spheremark.storage.imports import survey_files as site_files

    config = SurveyConfig.from_mapping({"marker_radius": radius_m})
    start = site_files.read_rig(rig) if rig else None
    with progress() as track:
        found = calibrate_files(reading.files(logs), config, start, track)
    if target:
        target.write_text(site_files.format_rig(found.rig), encoding="utf-8")
    plain = serialise_calibration(found)
    if as_json:
        print_json(plain)
    else:
        render.print_calibration(out, plain)
