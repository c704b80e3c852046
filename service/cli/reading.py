"""The options that say how a log is read, shared by all commands that read logs."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from enum import StrEnum
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

if TYPE_CHECKING:  # what commands get; the command line gives paths
    from spheremark.storage.recordings import LogFile

    OneLog = LogFile
    LogFiles = list[LogFile]
else:
    _KINDS = "MCAP, .db3, .bag, PCAP, a zip of these, or a folder of ros2 bag."
    LogFiles = Annotated[
        list[Path], typer.Argument(metavar="LOG...", exists=True, help=f"Logs: {_KINDS}")
    ]
    OneLog = Annotated[Path, typer.Argument(metavar="LOG", exists=True, help=f"Log: {_KINDS}")]


class Stamp(StrEnum):
    """Which instant of a cloud its stamp is."""

    AUTO = "auto"
    START = "start"
    END = "end"


_OPTIONS: dict[str, tuple[Any, Any]] = {
    "topic": (
        Annotated[
            list[str] | None,
            typer.Option(help="Topic to use for what it holds; again for more."),
        ],
        None,
    ),
    "joint": (
        Annotated[str, typer.Option(help="Joint of the gimbal, frame that turns, or topic.")],
        "",
    ),
    "joint_sign": (
        Annotated[int, typer.Option(help="-1: angles grow clockwise seen from above.")],
        1,
    ),
    "joint_unit": (
        Annotated[str, typer.Option(help="rad, deg, turn, or the steps of a full turn.")],
        "rad",
    ),
    "joint_offset_deg": (
        Annotated[
            float,
            typer.Option(
                "--joint-offset-deg", "--joint-offset", help="Added to the angle \\[deg]."
            ),
        ],
        0.0,
    ),
    "lidar_offset_s": (
        Annotated[float, typer.Option(help="Added to the LiDAR's stamps \\[s].")],
        0.0,
    ),
    "stamp": (
        Annotated[Stamp, typer.Option(help="Instant of a cloud that its stamp is.")],
        Stamp.AUTO,
    ),
    "recover": (
        Annotated[bool, typer.Option("--recover", help="Use what is readable of a damaged log.")],
        False,
    ),
    "pcap": (
        Annotated[
            list[Path] | None,
            typer.Option(exists=True, help="PCAP, or another file of the same log."),
        ],
        None,
    ),
}


def reads_logs(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options to a command, which gets its logs as ``LogFile`` values."""

    @wraps(command)
    def run(**given: Any) -> None:
        from spheremark.storage.recordings import LogFile, LogOptions

        values = {name: given.pop(name) for name in _OPTIONS}
        beside = tuple(values.pop("pcap") or ())
        values["topic"] = tuple(values["topic"] or ())
        values["stamp"] = values["stamp"].value
        options = LogOptions(**values)
        key = "logs" if "logs" in given else "log"
        paths = given[key] if key == "logs" else [given[key]]
        if beside and len(paths) > 1:
            from spheremark.pipelines.errors import ConfigError

            raise ConfigError("--pcap belongs to one log; name a single LOG with it.")
        files = [LogFile(path=path, options=options, beside=beside) for path in paths]
        given[key] = files if key == "logs" else files[0]
        command(**given)

    hints = get_type_hints(command, include_extras=True)
    signature = inspect.signature(command)
    own = [one.replace(annotation=hints[name]) for name, one in signature.parameters.items()]
    kind = inspect.Parameter.KEYWORD_ONLY
    added = [
        inspect.Parameter(name, kind, default=default, annotation=hint)
        for name, (hint, default) in _OPTIONS.items()
    ]
    run.__signature__ = signature.replace(parameters=[*own, *added])  # type: ignore[attr-defined]
    run.__annotations__ = hints | {name: hint for name, (hint, _) in _OPTIONS.items()}
    return run
