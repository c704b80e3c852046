"""When pulses were fired whose messages have one time only: a steady spin is a clock.

While the gimbal rests, such a message is good for its points. Its pulses are known by the azimuths
of the returns in the order of firing, and with them those that had no return.
"""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.model import RING_UNKNOWN, Array, Column, Index, Mask, Nanos, Rig, Rings
from spheremark.pipelines.scan.rigs import FIRING_CYCLE, FIRING_ORDER, LASER_CYCLE, N_LASERS

_NS = 1e-9  # [s] in a nanosecond
_CYCLE_NS = round(FIRING_CYCLE / _NS)
_DELAYS = np.argsort(FIRING_ORDER) * LASER_CYCLE  # [s] of each laser within its firing
_N_SAMPLE = 100_000  # returns that show by how much the spin advances between two firings
_ADVANCES = (1e-3, 1e-2)  # [rad] between two firings: 180 to 1,700 revolutions in a minute
_EVEN, _MOSTLY = 0.25, 0.9  # of a firing, by which advances may be off; and share that are not
_PAUSE = 1.5  # times the usual time between messages: more is no spin that goes on
_SPANS = (0.3, 1.3)  # of the time of some messages that their pulses may take: half may be sky


def pulse_stamps(
    p_lidar: Column, rings: Rings, stamps_ns: Nanos, is_good: Mask, rig: Rig
) -> Nanos | None:
    """Return when each pulse was fired.

    Parameters
    ----------
    p_lidar : (n, 3)
        Returns in the frame of the LiDAR, in the order of firing [m].
    rings : (n,)
        Their lasers.
    stamps_ns : (n,)
        Instants of their messages.
    is_good : (n,)
        Whether the gimbal rests during the message; others keep its instant.
    rig : Rig
        The rig, with its lasers.

    Returns
    -------
    (n,) or None
        Instants, a whole number of firings apart but for the delays of the lasers. None where rings
        are not known, the LiDAR is no VLP-16, or the returns do not follow its firing cycle.
    """
    rows = np.flatnonzero(is_good)
    if len(rig.laser_elevations) != N_LASERS or not len(rows) or rings.max() == RING_UNKNOWN:
        return None
    azimuths = np.arctan2(-p_lidar[rows, 1], p_lidar[rows, 0]).astype(np.float64)
    lasers, stamps_ns = rings[rows], stamps_ns.copy()
    advance = _advance_of(azimuths[:_N_SAMPLE], lasers[:_N_SAMPLE])
    if not _ADVANCES[0] < advance < _ADVANCES[1]:
        return None
    begins, lasting_ns = _runs_of(rows, stamps_ns)
    firings = azimuths / advance - _DELAYS[lasers] / FIRING_CYCLE
    passed = np.diff(firings, prepend=firings[0])
    passed = (passed + _EVEN) % (2.0 * np.pi / advance) - _EVEN
    passed[begins] = 0.0
    numbers = np.cumsum(np.rint(passed).astype(np.int64))
    ends, lengths = np.append(begins[1:], len(rows)) - 1, np.diff(np.append(begins, len(rows)))
    spans_ns = _CYCLE_NS * (numbers[ends] - numbers[begins])
    known_ns = stamps_ns[rows[ends]] - stamps_ns[rows[begins]] + lasting_ns
    is_steady = np.mean(np.abs(passed - np.rint(passed)) < _EVEN) > _MOSTLY
    if not (is_steady and _SPANS[0] < np.median(spans_ns / known_ns) < _SPANS[1]):
        return None
    first_ns = -(-stamps_ns[rows[begins]] // _CYCLE_NS) * _CYCLE_NS - _CYCLE_NS * numbers[begins]
    stamps_ns[rows] = (
        np.repeat(first_ns, lengths)
        + _CYCLE_NS * numbers
        + np.rint(_DELAYS / _NS).astype(np.int64)[lasers]
    )
    return stamps_ns


def _advance_of(azimuths: Array, lasers: Rings) -> float:
    """Return by how much the spin advances between two firings [rad]; 0 if returns do not show."""
    by_laser = np.argsort(lasers, kind="stable")
    steps = np.diff(azimuths[by_laser])[np.diff(lasers[by_laser].astype(np.int64)) == 0]
    steps = steps[(steps > _ADVANCES[0]) & (steps < _ADVANCES[1])]
    if not len(steps):
        return 0.0
    single = steps[np.abs(steps / np.median(steps) - 1.0) < _EVEN]
    return float(np.mean(single))  # azimuths are rounded: their median step is too


def _runs_of(rows: Index, stamps_ns: Nanos) -> tuple[Index, float]:
    """Return where messages begin that do not follow the ones before, and how long one takes."""
    later_ns = np.diff(stamps_ns)
    lasting_ns = float(np.median(later_ns[later_ns > 0])) if (later_ns > 0).any() else np.inf
    is_next = (np.diff(rows) == 1) & (np.diff(stamps_ns[rows]) <= _PAUSE * lasting_ns)
    return np.flatnonzero(np.append(True, ~is_next)), lasting_ns
