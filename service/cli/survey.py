"""The commands of a whole survey: ``spheremark adjust`` and ``spheremark calibrate``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from spheremark.service.cli.reading import LogFiles, reads_logs
from spheremark.service.cli.terminal import out, print_json, progress

if TYPE_CHECKING:
    from spheremark.pipelines.model import ControlMarks

AsJson = Annotated[bool, typer.Option("--json", help="JSON for programs.")]


class Axes(StrEnum):
    """What three coordinates of control marks can be."""

    ENU = "enu"
    NEU = "neu"
    NED = "ned"


class Unit(StrEnum):
    """Units of control marks."""

    METRE = "m"
    MILLIMETRE = "mm"
    FOOT = "ft"
    US_FOOT = "us-ft"


ControlFile = Annotated[
    Path | None, typer.Option(exists=True, dir_okay=False, help="Control marks (CSV).")
]
ControlAxes = Annotated[
    Axes, typer.Option(help="Order of coordinates that are not called by name in the control file.")
]
ControlUnit = Annotated[Unit, typer.Option(help="Unit of the control file.")]
TargetHeight = Annotated[
    float, typer.Option(help="Height of the centres above the points of the control file \\[m].")
]
RigFile = Annotated[
    Path | None, typer.Option(exists=True, dir_okay=False, help="Rig (JSON), if not the logs'.")
]


def read_control(
    path: Path | None, axes: Axes, unit: Unit, target_height_m: float
) -> ControlMarks | None:
    """Read control marks in the given axes and unit."""
    from spheremark.storage.imports.survey_files import ControlLayout
    from spheremark.storage.imports.survey_files import read_control as read

    layout = ControlLayout(axes=axes.value, unit=unit.value, target_height=target_height_m)
    return read(path, layout) if path else None


@reads_logs
def adjust(
    logs: LogFiles,
    control: ControlFile = None,
    control_axes: ControlAxes = Axes.ENU,
    control_unit: ControlUnit = Unit.METRE,
    target_height_m: TargetHeight = 0.0,
    rig: RigFile = None,
    calibrating: Annotated[
        bool, typer.Option("--calibrate", help="Estimate the rig in the same adjustment.")
    ] = False,
    method: Annotated[str, typer.Option(help="Fitting method.")] = "along_beam",
    radius_m: Annotated[float, typer.Option(help="Radius of the spheres \\[m].")] = 0.100,
    gama: Annotated[
        Path | None, typer.Option(dir_okay=False, help="Write input of GNU Gama (XML).")
    ] = None,
    csv: Annotated[
        Path | None, typer.Option(dir_okay=False, help="Write stations and marks (CSV).")
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
    from spheremark.storage.exports.network import format_coordinates, format_gama
    from spheremark.storage.imports import survey_files as site_files

    config = SurveyConfig.from_mapping(
        {"marker_radius": radius_m, "fitting": {"methods": [method]}}
    )
    marks = read_control(control, control_axes, control_unit, target_height_m)
    given = site_files.read_rig(rig) if rig else None
    with progress() as track:
        book = log_files.read_scans(logs, config, given, track)
        if calibrating:
            book = log_files.with_calibration(book, logs, config, given, track)
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
    if report:
        report.write_text(format_report(plain), encoding="utf-8")
    if as_json:
        print_json(plain)
    else:
        render.print_network(out, plain)


@reads_logs
def calibrate(
    logs: LogFiles,
    rig: Annotated[
        Path | None,
        typer.Option(
            exists=True, dir_okay=False, help="Rig to start with (JSON), if not the logs'."
        ),
    ] = None,
    radius_m: Annotated[float, typer.Option(help="Radius of the spheres \\[m].")] = 0.100,
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
        found = calibrate_files(logs, config, start, track)
    if target:
        target.write_text(site_files.format_rig(found.rig), encoding="utf-8")
    plain = serialise_calibration(found)
    if as_json:
        print_json(plain)
    else:
        render.print_calibration(out, plain)
