"""How logs are read: a group of options of all commands that read them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from spheremark.pipelines.errors import ConfigError

if TYPE_CHECKING:
    from spheremark.storage.recordings import LogFile

_KINDS = "MCAP, .db3, .bag, PCAP, a zip of these, or a folder of ros2 bag."
Logs = Annotated[list[Path], typer.Argument(metavar="LOG...", exists=True, help=f"Logs: {_KINDS}")]
OneLog = Annotated[Path, typer.Argument(metavar="LOG", exists=True, help=f"Log: {_KINDS}")]


class Stamp(StrEnum):
    """Which instant of a cloud its stamp is."""

    AUTO = "auto"
    START = "start"
    END = "end"


class TimeUnit(StrEnum):
    """Unit of the times of points."""

    AUTO = "auto"
    S = "s"
    MS = "ms"
    US = "us"
    NS = "ns"


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How logs are read."""

    topic: Annotated[
        list[str] | None, typer.Option(help="Topic to use for what it holds; again for more.")
    ] = None
    joint: Annotated[str, typer.Option(help="Joint of the gimbal, frame that turns, or topic.")] = (
        ""
    )
    joint_sign: Annotated[int, typer.Option(help="-1: angles grow clockwise seen from above.")] = 1
    joint_unit: Annotated[
        str, typer.Option(help="rad, deg, turn, or the steps of a full turn.")
    ] = "rad"
    joint_offset_deg: Annotated[
        float,
        typer.Option("--joint-offset-deg", "--joint-offset", help="Added to the angle \\[deg]."),
    ] = 0.0
    lidar_offset_s: Annotated[float, typer.Option(help="Added to the LiDAR's stamps \\[s].")] = 0.0
    stamp: Annotated[Stamp, typer.Option(help="Instant of a cloud that its stamp is.")] = Stamp.AUTO
    time_unit: Annotated[TimeUnit, typer.Option(help="Unit of the times of points.")] = (
        TimeUnit.AUTO
    )
    recover: Annotated[
        bool, typer.Option("--recover", help="Use what is readable of a damaged log.")
    ] = False
    pcap: Annotated[
        list[Path] | None,
        typer.Option(exists=True, help="PCAP, or another file of the same log."),
    ] = None

    def files(self, paths: list[Path]) -> list[LogFile]:
        """Return logs with the options to read them."""
        from spheremark.storage.recordings import LogFile, LogOptions

        if self.pcap and len(paths) > 1:
            raise ConfigError("--pcap belongs to one log; name a single LOG with it.")
        values = asdict(self) | {"topic": tuple(self.topic or ())}
        values |= {"stamp": self.stamp.value, "time_unit": self.time_unit.value}
        del values["pcap"]
        options, beside = LogOptions(**values), tuple(self.pcap or ())
        return [LogFile(path=path, options=options, beside=beside) for path in paths]
