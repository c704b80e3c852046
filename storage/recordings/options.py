"""What a caller says about a log: its topics, its joint, its clocks, and whether it is damaged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import isfinite, pi, radians
from typing import Any

from spheremark.pipelines.errors import ConfigError, RecordingError

UNITS = {"rad": 1.0, "deg": pi / 180.0, "turn": 2.0 * pi}
STAMPS = ("auto", "start", "end")
TIME_UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}  # [ns] that a recorded 1 stands for


@dataclass(frozen=True, slots=True, kw_only=True)
class LogOptions:
    """How to read a log.

    Attributes
    ----------
    topic : tuple of str
        Topics to use. Where one is named for a role (LiDAR, joint, frames, AHRS), others in that
        role are ignored; roles without a named topic are found by their message types.
    joint : str
        Name of the gimbal's joint, of the frame that turns, or of a topic of numbers; chosen by
        name and motion where it is empty.
    joint_sign : int
        -1 where recorded angles grow clockwise seen from above, else 1.
    joint_unit : str
        ``rad``, ``deg``, ``turn``, or the number of steps of a full turn.
    joint_offset_deg : float
        Added to the angle after sign and unit [deg].
    lidar_offset_s : float
        Added to the stamps of the LiDAR, to get the gimbal's clock [s].
    stamp : str
        Whether a cloud is stamped with the ``start`` or the ``end`` of its points; ``auto`` takes
        the start, unless the points would have been measured after they were recorded.
    time_unit : str
        Unit of the times of points, ``s``, ``ms``, ``us`` or ``ns``; ``auto`` takes the one in
        which clouds last until the next one.
    recover : bool
        Whether to use what can be read of a truncated or damaged log.
    """

    topic: tuple[str, ...] = ()
    joint: str = ""
    joint_sign: int = 1
    joint_unit: str = "rad"
    joint_offset_deg: float = 0.0
    lidar_offset_s: float = 0.0
    stamp: str = "auto"
    time_unit: str = "auto"
    recover: bool = False

    def __post_init__(self) -> None:
        if self.joint_sign not in (1, -1):
            raise ConfigError(f"joint_sign is {self.joint_sign!r}; it must be 1 or -1.")
        if self.stamp not in STAMPS:
            raise ConfigError(f"stamp is {self.stamp!r}; it must be auto, start or end.")
        if self.time_unit not in ("auto", *TIME_UNITS):
            raise ConfigError(f"time_unit is {self.time_unit!r}; it must be auto, s, ms, us or ns.")
        if not (isfinite(self.joint_offset_deg) and isfinite(self.lidar_offset_s)):
            raise ConfigError("joint_offset_deg and lidar_offset_s must be finite numbers.")
        _ = self.joint_scale

    @property
    def joint_scale(self) -> float:
        """Angle that a recorded 1 stands for, with its sign [rad]."""
        if self.joint_unit in UNITS:
            return self.joint_sign * UNITS[self.joint_unit]
        try:
            steps = float(self.joint_unit)
        except ValueError:
            steps = 0.0
        if not 0.0 < steps < float("inf"):
            raise ConfigError(
                f"joint_unit is {self.joint_unit!r}; it must be rad, deg, turn, or the number of "
                "steps of a full turn, such as 4096."
            )
        return self.joint_sign * 2.0 * pi / steps

    @property
    def joint_offset(self) -> float:
        """Angle that is added [rad]."""
        return radians(self.joint_offset_deg)

    def check(self, found: Mapping[str, str]) -> None:
        """Refuse names of topics that are not there."""
        missing = sorted(set(self.topic) - set(found))
        if missing:
            raise RecordingError(
                f"The recording has no topic {missing[0]}; it has {listed(found)}. Topics are "
                "named exactly as they were recorded."
            )

    def to_mapping(self) -> dict[str, Any]:
        """Return what differs from the defaults as plain values for JSON."""
        plain = LogOptions()
        values = {one.name: getattr(self, one.name) for one in fields(self)}
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in values.items()
            if value != getattr(plain, name)
        }

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> LogOptions:
        """Build options from plain values as ``to_mapping`` returns them; others are ignored."""
        known = {one.name: values[one.name] for one in fields(cls) if one.name in values}
        if "topic" in known:
            known["topic"] = tuple(known["topic"])
        return cls(**known)


def listed(found: Mapping[str, str]) -> str:
    """Return topics with their message types as a phrase."""
    return ", ".join(f"{t} ({s or 'no type'})" for t, s in sorted(found.items())) or "no topics"
