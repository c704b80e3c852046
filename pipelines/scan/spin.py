"""When pulses were fired whose messages have one time only: a steady spin is a clock.

While the gimbal rests, one angle serves a whole message. In the order of firing, the azimuths of
its returns show when each pulse was fired, and so which pulses had no return.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from spheremark.pipelines.model import Array, Column, Index, Mask, Nanos, Rig, Rings
from spheremark.pipelines.scan.rigs import FIRING_CYCLE, LASER_DELAYS, N_LASERS

_NS = 1e-9  # [s] in a nanosecond
_CYCLE_NS = round(FIRING_CYCLE / _NS)
_N_SAMPLE = 100_000  # returns that show by how much the spin advances between two firings
_ADVANCES = (1e-3, 1e-2)  # [rad] between two firings: 180 to 1,700 revolutions in a minute
_EVEN, _MOSTLY = 0.25, 0.9  # of a firing, by which advances may be off; and share that are not
_PAUSES = (1.5, 0.75)  # in usual times between messages, and in revolutions: more is a pause
_SPANS = (0.3, 0.5)  # least share of their time that pulses take; revolutions that they may exceed


def stamps_by_spin(
    p_lidar: Column, rings: Rings, stamps_ns: Nanos, is_good: Mask, rig: Rig
) -> Nanos | None:
    """Return when each pulse was fired.

    Parameters
    ----------
    p_lidar : (n, 3)
        Returns in the frame of the LiDAR, in the order of firing, none of them NaN [m].
    rings : (n,)
        Their lasers.
    stamps_ns : (n,)
        Instants of their messages.
    is_good : (n,)
        Whether the gimbal rests during the message.
    rig : Rig
        The rig, with its lasers.

    Returns
    -------
    (n,) or None
        Instants, a whole number of firings apart but for the delays of the lasers. Returns of other
        messages, and of those that do not follow the firing cycle of a VLP-16, keep the instants of
        their messages. None where most are of that kind.
    """
    rows = np.flatnonzero(is_good)
    if len(rig.laser_elevations) != N_LASERS or not len(rows) or rings.max() >= N_LASERS:
        return None
    advance = _advance_of(p_lidar[rows[:_N_SAMPLE]], rings[rows[:_N_SAMPLE]])
    if not _ADVANCES[0] < advance < _ADVANCES[1]:
        return None
    found, n_found, delays_ns = stamps_ns.copy(), 0, np.rint(LASER_DELAYS / _NS).astype(np.int64)
    begins, lasting_ns = _runs_of(rows, stamps_ns, 2.0 * np.pi / advance * _CYCLE_NS)
    for begin, end in pairwise((*begins.tolist(), len(rows))):
        own = rows[begin:end]
        numbers = _firings_of(p_lidar[own], rings[own], advance)
        if numbers is None:
            continue
        first_ns, last_ns = int(stamps_ns[own[0]]), int(stamps_ns[own[-1]])
        span, known = int(numbers[-1]) * _CYCLE_NS, last_ns - first_ns + lasting_ns
        if _SPANS[0] * known < span < known + _SPANS[1] * 2.0 * np.pi / advance * _CYCLE_NS:
            start_ns = -(-first_ns // _CYCLE_NS) * _CYCLE_NS
            found[own] = start_ns + _CYCLE_NS * numbers + delays_ns[rings[own]]
            n_found += len(own)
    return found if 2 * n_found > len(rows) else None


def _azimuths(p_lidar: Column) -> Array:
    """Return azimuths of points, clockwise [rad]."""
    return np.arctan2(-p_lidar[:, 1], p_lidar[:, 0]).astype(np.float64)


def _advance_of(p_lidar: Column, rings: Rings) -> float:
    """Return by how much the spin advances between two firings [rad]; 0 if returns do not show."""
    by_laser = np.argsort(rings, kind="stable")
    steps = np.diff(_azimuths(p_lidar)[by_laser])[np.diff(rings[by_laser].astype(np.int64)) == 0]
    steps = steps[(steps > _ADVANCES[0]) & (steps < _ADVANCES[1])]
    if not len(steps):
        return 0.0
    single = steps[np.abs(steps / np.median(steps) - 1.0) < _EVEN]
    return float(np.mean(single))  # azimuths are rounded: their median step is too


def _runs_of(rows: Index, stamps_ns: Nanos, revolution_ns: float) -> tuple[Index, float]:
    """Return where a pause is before a message, and how long one usually takes [ns]."""
    later_ns = np.diff(stamps_ns)
    lasting_ns = float(np.median(later_ns[later_ns > 0])) if (later_ns > 0).any() else np.inf
    longest_ns = max(_PAUSES[0] * lasting_ns, _PAUSES[1] * revolution_ns)
    is_next = (np.diff(rows) == 1) & (np.diff(stamps_ns[rows]) <= longest_ns)
    return np.flatnonzero(np.append(True, ~is_next)), lasting_ns


def _firings_of(p_lidar: Column, rings: Rings, advance: float) -> Nanos | None:
    """Return how many firings after the first each return's is; None where they are uneven."""
    firings = _azimuths(p_lidar) / advance - LASER_DELAYS[rings] / FIRING_CYCLE
    passed = np.diff(firings, prepend=firings[0])
    passed = (passed + _EVEN) % (2.0 * np.pi / advance) - _EVEN
    whole = np.rint(passed)
    if np.mean(np.abs(passed - whole) < _EVEN) < _MOSTLY:
        return None
    return np.cumsum(whole.astype(np.int64))
