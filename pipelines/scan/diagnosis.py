"""Why a scan is not consistent: wrong signs, units and clocks, by the distance of its two faces.

In a full turn of the gimbal everything is swept twice, in each half of the turn once. What stands
up from the ground lies at the same place in both halves only if angles and clocks are right.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from spheremark.pipelines.config import StitchingConfig
from spheremark.pipelines.model import Array, Mask, Rig, ScanLog
from spheremark.pipelines.scan.stitching import choose_rig, split_stops

_RETURNS_MAX = 400_000
_POINTS_MIN = 200  # of each face that stand up from the ground
_POINTS_MAX = 5_000  # of each face that are compared
_CELL = 1.0  # [m] of the grid of lowest points
_STANDS = (0.3, 3.0)  # [m] above the ground around
_RANGES = (1.0, 15.0)  # [m] where beams lie close enough
_FAR = 0.5  # [m]; farther apart, faces do not show the same thing
_BETTER = 0.6  # of the distance as read: less is no chance, by the scatter of the mean below
_SHIFTS = (-1.0, -0.5, -0.2, -0.1, -0.05, 0.05, 0.1, 0.2, 0.5, 1.0)  # [s] of clocks
_STEPS = tuple(1 << bits for bits in range(10, 21))  # of a full turn, as encoders have
_TURNS = (0.5, 4.0)  # full turns of a stop: less shows nothing twice, more no gimbal makes


@dataclass(frozen=True, slots=True, kw_only=True)
class Cause:
    """A change of how a log is read, and what it makes of its faces.

    Attributes
    ----------
    option : str
        The option of the command line that makes the change; empty as it was read.
    distance : float
        Mean distance of the two faces [m].
    """

    option: str
    distance: float


def diagnose(
    log: ScanLog,
    rig: Rig | None,
    others: Iterable[tuple[str, ScanLog]] = (),
    *,
    joint_scale: float = 1.0,
    lidar_offset: float = 0.0,
) -> tuple[str, ...]:
    """Try the likely mistakes in the reading of a log, on its first stop.

    Parameters
    ----------
    log : ScanLog
        One stop or many.
    rig : Rig or None
        How the LiDAR sits on the gimbal; that of the log by default.
    others : iterable of (str, ScanLog)
        The same log read with an option of the command line that changes its LiDAR.
    joint_scale : float
        Angle that a recorded 1 was taken for, with its sign [rad].
    lidar_offset : float
        What was added to the stamps of the LiDAR [s].

    Returns
    -------
    tuple of str
        Sentences: the option that makes the faces agree, or that none does.

    Raises
    ------
    MissingRigError
        If neither the log nor the caller gives the mounting of the LiDAR.

    Notes
    -----
    A shift of clocks while the gimbal turns evenly turns the whole scan about its axis and shows
    in nothing. Takes seconds: each change turns some hundred thousand returns.
    """
    rig = choose_rig(log, rig)
    thin = _thinned(log)
    causes = [_cause(thin, rig, "", 1.0, 0.0)]
    for option, scale in _scales(thin, joint_scale):
        causes.append(_cause(thin, rig, option, scale, 0.0))
    for shift in _SHIFTS:
        option = f"--lidar-offset-s {lidar_offset + shift:g}"
        causes.append(_cause(thin, rig, option, 1.0, shift))
    causes += [_cause(_thinned(other), rig, option, 1.0, 0.0) for option, other in others]
    return _sentences([cause for cause in causes if cause is not None])


def _thinned(log: ScanLog) -> ScanLog:
    """Return the first stop with some of its returns, those from where beams lie close enough."""
    log = next(iter(split_stops(log, StitchingConfig())), log)
    stride = len(log.stamps_lidar_ns) // _RETURNS_MAX + 1
    ranges = np.linalg.norm(log.p_lidar[::stride].astype(np.float64), axis=1)
    rows = np.flatnonzero((ranges > _RANGES[0]) & (ranges < _RANGES[1])) * stride
    return replace(
        log,
        p_lidar=log.p_lidar[rows],
        intensities=log.intensities[rows],
        rings=log.rings[rows],
        stamps_lidar_ns=log.stamps_lidar_ns[rows],
    )


def _scales(log: ScanLog, as_read: float) -> list[tuple[str, float]]:
    """Return other units and signs of the angle: option, and factor of the angle as it was read."""
    full = 2.0 * np.pi
    turned = float(np.ptp(log.gimbal_angles)) / abs(as_read) if len(log.gimbal_angles) else 0.0
    units = {"rad": 1.0, "deg": full / 360.0, "turn": full}
    units |= {str(n): full / n for n in _STEPS if _TURNS[0] < turned / n < _TURNS[1]}
    scales = []
    for unit, scale in units.items():
        for sign in (1, -1):
            parts = [f"--joint-unit {unit}"] if scale != abs(as_read) else []
            parts += [f"--joint-sign {sign}"] if sign < 0 or as_read < 0 else []
            if sign * scale != as_read:
                scales.append((" ".join(parts), sign * scale / as_read))
    return scales


def _cause(log: ScanLog, rig: Rig, option: str, scale: float, shift: float) -> Cause | None:
    """Return what a change makes of the faces; None where they show too little."""
    stamps = (log.stamps_lidar_ns - log.stamps_gimbal_ns[0]) * 1e-9 + shift
    times = (log.stamps_gimbal_ns - log.stamps_gimbal_ns[0]) * 1e-9
    inside = (stamps >= times[0]) & (stamps <= times[-1])
    angles = np.interp(stamps[inside], times, np.unwrap(scale * log.gimbal_angles))
    p_head = log.p_lidar[inside] @ rig.T_head_lidar[:3, :3].T + rig.T_head_lidar[:3, 3]
    c, s = np.cos(angles), np.sin(angles)
    x, y, z = p_head.T
    p = np.stack([c * x - s * y, s * x + c * y, z], axis=1)
    is_first = np.arange(len(p)) < len(p) // 2
    stands = _stands(p)
    first, second = p[stands & is_first], p[stands & ~is_first]
    if min(len(first), len(second)) < _POINTS_MIN:
        return None
    return Cause(option=option, distance=(_distance(first, second) + _distance(second, first)) / 2)


def _stands(p: Array) -> Mask:
    """Return which points stand up from the lowest points around them."""
    cells = np.floor(p[:, :2] / _CELL).astype(np.int64)
    cells -= cells.min(axis=0) - 1
    lowest = np.full(tuple(cells.max(axis=0) + 2), np.inf)
    np.minimum.at(lowest, (cells[:, 0], cells[:, 1]), p[:, 2])
    padded = np.pad(lowest, 1, constant_values=np.inf)
    around = np.min(
        [
            padded[i : i + lowest.shape[0], j : j + lowest.shape[1]]
            for i in range(3)
            for j in range(3)
        ],
        axis=0,
    )
    height = p[:, 2] - around[cells[:, 0], cells[:, 1]]
    return np.asarray((height > _STANDS[0]) & (height < _STANDS[1]))


def _distance(p: Array, others: Array) -> float:
    """Return the mean distance from some points to the nearest of others, at most ``_FAR``."""
    rows = np.linspace(0, len(p) - 1, min(len(p), _POINTS_MAX)).astype(np.intp)
    distances, _ = cKDTree(others).query(p[rows], distance_upper_bound=_FAR)
    return float(np.minimum(distances, _FAR).mean())


def _in_request(options: str) -> str:
    """Return options of the command line as those of a request."""
    pairs = re.findall(r"--(\S+) (\S+)", options)
    return "&".join(f"{name.replace('-', '_')}={value}" for name, value in pairs)


def _sentences(causes: list[Cause]) -> tuple[str, ...]:
    """Return what the changes show."""
    as_read = next((one for one in causes if not one.option), None)
    others = [one for one in causes if one.option]
    if not others and as_read is None:
        return (
            "Sign, unit and clock cannot be judged: too little stands up from the ground, or the "
            "gimbal did not turn by 360 deg.",
        )
    best = min(causes, key=lambda one: one.distance)
    was = _FAR if as_read is None else as_read.distance
    if best.option and best.distance < _BETTER * was:
        option = f"{best.option} ({_in_request(best.option)} in a request)"
        return (
            f"With {option} what was swept twice agrees to {1000 * best.distance:.0f} mm, as "
            f"read to {1000 * was:.0f} mm: read the log so.",
        )
    return (
        f"What was swept twice agrees to {1000 * was:.0f} mm as read, and no other sign, unit "
        "or clock makes it much better: the log seems to be read as it was recorded. If spheres "
        "are missing, check their radius, their distance and the rig.",
    )
