"""Cut a log into stops: hides rests of the gimbal and pauses of the LiDAR."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spheremark.pipelines.config import StitchingConfig
from spheremark.pipelines.model import Mask, ScanLog

_NS = 1e-9  # [s] in a nanosecond
_STILL = np.radians(0.1)  # a gimbal at rest stays within this, encoder jitter included
_NOT_TURNED = np.radians(1.0)  # less is not turning
_SCRAP = np.radians(30.0)  # less after a stop is no scan but the gimbal finding its place
_WINDOW = 12  # samples of the gimbal angle per rest when looking for rests
_PROBES_PER_REST = 30  # pulses that are tested in the time of a gap when searching for gaps
_PAUSE = 0.3  # [s]; three revolutions without a return are a pause
_PAUSE_TURN = np.radians(1.0)  # a pause of a gimbal at rest costs nothing


def split_stops(log: ScanLog, config: StitchingConfig) -> tuple[ScanLog, ...]:
    """Split a log into stops: the rover still while the gimbal turns.

    Parameters
    ----------
    log : ScanLog
        One or more stops, in the order of time.
    config : StitchingConfig
        How long a rest is.

    Returns
    -------
    tuple of ScanLog
        One stop keeps the log's name; several are called name-1, name-2 ...

    Notes
    -----
    A stop ends where the gimbal rests, or the LiDAR pauses, for longer than ``config.rest`` after
    the gimbal has turned by half a turn or more since the stop began, so that the rests of a
    step-and-shoot scan do not split it. Returns of such rests, and of rests before the first and
    after the last turn, belong to no stop: the rover may be moving. Nor do those of a turn under
    30 degrees after the last stop. A log whose gimbal never turns is one stop.
    """
    if not len(log.stamps_lidar_ns) or len(log.stamps_gimbal_ns) < 2:
        return (log,)
    breaks = _merged([*_rests(log, config.rest), *_lidar_gaps(log, config.rest)])
    spans = _spans(log, breaks) if breaks else []
    stops = [stop for stop in (_cut(log, *span) for span in spans) if len(stop.stamps_lidar_ns)]
    left_out = len(log.stamps_lidar_ns) - sum(len(stop.stamps_lidar_ns) for stop in stops)
    if not stops or (not left_out and len(stops) == 1):
        return (log,)
    note = f"{left_out} returns were made while the gimbal rested and belong to no stop."
    notes = (*log.notes, note) if left_out else log.notes
    if len(stops) == 1:
        return (replace(stops[0], notes=notes),)
    return tuple(
        replace(stop, notes=notes, origin=replace(log.origin, name=f"{log.origin.name}-{number}"))
        for number, stop in enumerate(stops, start=1)
    )


def _rests(log: ScanLog, rest: float) -> list[tuple[int, int]]:
    """Return start and end [ns] of each time longer than ``rest`` in which the gimbal is still."""
    first, last = int(log.stamps_gimbal_ns[0]), int(log.stamps_gimbal_ns[-1])
    step = rest / _WINDOW
    times = np.arange(0.0, (last - first) * _NS + step, step)
    if len(times) <= _WINDOW:
        return []
    angles = np.interp(times, (log.stamps_gimbal_ns - first) * _NS, log.gimbal_angles)
    windows = np.lib.stride_tricks.sliding_window_view(angles, _WINDOW + 1)
    still = np.flatnonzero(np.ptp(windows, axis=1) < _STILL)
    runs = np.split(still, np.flatnonzero(np.diff(still) > 1) + 1) if len(still) else []
    return [
        (first + int(times[run[0]] / _NS), first + int(times[run[-1] + _WINDOW] / _NS))
        for run in runs
    ]


def _lidar_gaps(log: ScanLog, rest: float) -> list[tuple[int, int]]:
    """Return start and end [ns] of each time longer than ``rest`` without a return."""
    stamps_ns = log.stamps_lidar_ns
    duration = max(int(stamps_ns[-1]) - int(stamps_ns[0]), 0) * _NS if len(stamps_ns) else 0.0
    stride = int(len(stamps_ns) * rest / (_PROBES_PER_REST * (duration + rest))) + 1
    probes = stamps_ns[::stride]
    gaps = []
    for k in np.flatnonzero(np.diff(probes) > rest / _NS):
        block = np.sort(stamps_ns[k * stride : (k + 1) * stride + 1])
        widest = int(np.argmax(np.diff(block)))
        gaps.append((int(block[widest]), int(block[widest + 1])))
    return gaps


def _merged(spans: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the union of spans of time [ns], in order."""
    union: list[tuple[int, int]] = []
    for start, end in sorted(spans):
        if union and start <= union[-1][1]:
            union[-1] = (union[-1][0], max(end, union[-1][1]))
        else:
            union.append((start, end))
    return union


def _spans(log: ScanLog, breaks: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return start and end [ns] of each stop, given the rests and gaps in order of time."""
    begins = [int(log.stamps_lidar_ns.min()), *(end for _, end in breaks)]
    ends = [*(start for start, _ in breaks), int(log.stamps_lidar_ns.max())]
    spans: list[tuple[int, int]] = []
    is_open = False  # whether the last span has not yet turned by half a turn
    for begin, end in zip(begins, ends, strict=True):
        if _turned(log, begin, end) < _NOT_TURNED:
            continue
        if is_open:
            begin = spans.pop()[0]
        spans.append((begin, end + 1))
        is_open = _turned(log, begin, end) < np.pi
    if is_open and len(spans) > 1 and _turned(log, *spans[-1]) < _SCRAP:
        spans.pop()
    return spans


def _turned(log: ScanLog, start: int, end: int) -> float:
    """Return the angle [rad] between the gimbal's extreme positions from start to end [ns]."""
    low, high = np.searchsorted(log.stamps_gimbal_ns, (start, end))
    return float(np.ptp(log.gimbal_angles[low:high])) if high > low else 0.0


def _cut(log: ScanLog, start: int, end: int) -> ScanLog:
    """Return the log from ``start`` to before ``end`` [ns]; views where the stamps ascend."""
    stamps = log.stamps_lidar_ns
    rows: slice | Mask
    if np.all(stamps[1:] >= stamps[:-1]):
        rows = slice(*np.searchsorted(stamps, (start, end)))
    else:
        rows = (stamps >= start) & (stamps < end)
    low, high = np.searchsorted(log.stamps_gimbal_ns, (start, end))
    joints = slice(max(low - 1, 0), high + 1)  # one more on either side covers the edge pulses
    imu = slice(*np.searchsorted(log.stamps_imu_ns, (start, end)))
    return replace(
        log,
        p_lidar=log.p_lidar[rows],
        intensities=log.intensities[rows],
        rings=log.rings[rows],
        stamps_lidar_ns=stamps[rows],
        gimbal_angles=log.gimbal_angles[joints],
        stamps_gimbal_ns=log.stamps_gimbal_ns[joints],
        quaternions_imu=log.quaternions_imu[imu],
        stamps_imu_ns=log.stamps_imu_ns[imu],
    )


def pause_notes(log: ScanLog) -> tuple[str, ...]:
    """Return notes on the times without a return while the gimbal turned.

    Parameters
    ----------
    log : ScanLog
        One stop.

    Returns
    -------
    tuple of str
        A sentence for each pause.
    """
    return tuple(
        f"The LiDAR was silent for {(end - start) * _NS:.1f} s while the gimbal turned by "
        f"{np.degrees(turned):.0f} deg: what stands there was swept on one face only or not at all."
        for start, end in _lidar_gaps(log, _PAUSE)
        if (turned := _turned(log, start, end)) > _PAUSE_TURN
    )
