"""Options that several commands share, in groups: a field is an option with its default."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from enum import StrEnum
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from spheremark.pipelines.errors import ConfigError

if TYPE_CHECKING:
    from spheremark.pipelines.model import ControlMarks, Rig
    from spheremark.pipelines.placement import Sensor

AsJson = Annotated[bool, typer.Option("--json", help="JSON for programs.")]
RadiusM = Annotated[float, typer.Option(help="Radius of the spheres \\[m].")]
SigmaClockS = Annotated[
    float,
    typer.Option(help="Sigma of the offset between the clocks of gimbal and LiDAR \\[s]."),
]


def grouped(function: Callable[..., None]) -> Callable[..., None]:
    """Return a command that takes the options of each parameter that is a group of options."""
    hints = get_type_hints(function, include_extras=True)
    signature = inspect.signature(function)
    groups: dict[str, Any] = {name: one for name, one in hints.items() if is_dataclass(one)}
    parameters, annotations = [], {}
    for name, parameter in signature.parameters.items():
        found = inspect.signature(groups[name]).parameters if name in groups else {name: parameter}
        kinds = get_type_hints(groups[name], include_extras=True) if name in groups else hints
        for option, one in found.items():
            annotations[option] = kinds[option]
            parameters.append(one.replace(kind=one.KEYWORD_ONLY, annotation=kinds[option]))

    @wraps(function)
    def command(**options: Any) -> None:
        made = {
            name: group(**{field.name: options.pop(field.name) for field in fields(group)})
            for name, group in groups.items()
        }
        function(**made, **options)

    command.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    command.__annotations__ = annotations
    return command


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


@dataclass(frozen=True, kw_only=True)
class Field:
    """The control marks of a survey and the rig of its logs."""

    control: Annotated[
        Path | None, typer.Option(exists=True, dir_okay=False, help="Control marks (CSV).")
    ] = None
    control_axes: Annotated[
        Axes,
        typer.Option(help="Order of coordinates that are not called by name in the control file."),
    ] = Axes.ENU
    control_unit: Annotated[Unit, typer.Option(help="Unit of the control file.")] = Unit.METRE
    target_height_m: Annotated[
        float,
        typer.Option(help="Height of the centres above the points of the control file \\[m]."),
    ] = 0.0
    rig: Annotated[
        Path | None, typer.Option(exists=True, dir_okay=False, help="Rig (JSON), if not the log's.")
    ] = None

    def read(self) -> tuple[ControlMarks | None, Rig | None]:
        """Read control marks and rig."""
        from spheremark.storage.imports import survey_files

        layout = survey_files.ControlLayout(
            axes=self.control_axes.value,
            unit=self.control_unit.value,
            target_height=self.target_height_m,
        )
        marks = survey_files.read_control(self.control, layout) if self.control else None
        return marks, survey_files.read_rig(self.rig) if self.rig else None


@dataclass(frozen=True, kw_only=True)
class Scans:
    """The motion of gimbal and LiDAR in the scans of a plan."""

    turn_s: Annotated[float, typer.Option(help="Time of a full turn of the gimbal \\[s].")] = 13.2
    rpm: Annotated[float, typer.Option(help="Speed of the LiDAR [1/min].")] = 600.0
    sweep_deg: Annotated[
        float, typer.Option(help="Angle that the gimbal turns through \\[deg]; evaluation only.")
    ] = 360.0
    step_deg: Annotated[
        float, typer.Option(help="Step of a gimbal that rests between \\[deg]; 0 turns evenly.")
    ] = 0.0
    rest_revolutions: Annotated[
        int, typer.Option(help="Revolutions of the LiDAR during each rest.")
    ] = 3
    noise_m: Annotated[
        float | None,
        typer.Option(help="Noise of a range to a sphere \\[m]; of a VLP-16 if not given."),
    ] = None

    def sensor(self) -> Sensor:
        """Return the sensor of the core."""
        from spheremark.pipelines.placement import Sensor

        return Sensor(
            turn=self.turn_s,
            spin_rpm=self.rpm,
            sweep=math.radians(self.sweep_deg),
            step=math.radians(self.step_deg),
            rest_revolutions=self.rest_revolutions,
            noise=self.noise_m,
        )


@dataclass(frozen=True, kw_only=True)
class Results:
    """The results whose fits give the accuracy of centres."""

    data: Annotated[
        Path | None,
        typer.Option(file_okay=False, help="Data folder whose fits give the accuracy of centres."),
    ] = None
    server: Annotated[
        str | None,
        typer.Option("--url", "--server", help="Address of a running service, for the same."),
    ] = None
    survey: Annotated[str, typer.Option(help="Only the fits of this survey.")] = ""

    def query(self) -> Any:
        """Return the function that executes SQL on the results, if a place was named."""
        if self.data is None and self.server is None:
            if self.survey:
                raise ConfigError("--survey needs --data or --url, which say where its fits are.")
            return None
        from spheremark.service.cli.source import Source
        from spheremark.service.planning.centre_models import require_survey
        from spheremark.service.settings import Settings

        settings = Settings(data=self.data) if self.data else Settings()
        query = Source(settings, self.server, folder=self.data).query
        require_survey(query, self.survey)
        return query
