"""When a log has messages of each topic, where its gimbal points, and when the rover stands."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from spheremark.pipelines.model import Nanos, ScanLog

N_BINS = 120
"""Equal parts of a log in which messages are counted."""
_GAP = 5.0  # usual intervals between messages that make a pause
_GAP_MIN = 100_000_000  # [ns]; shorter pauses are jitter of the recorder
_GAPS_MAX = 20  # longest ones of a topic
_ANGLES = 240  # samples of the gimbal's angle
_FAR = 60_000_000_000  # [ns] between a sensor's clock and the recorder's that are the same


def counts(times_ns: Nanos, start_ns: int, end_ns: int) -> tuple[int, ...]:
    """Return the number of messages in each part of a log.

    Parameters
    ----------
    times_ns : (n,)
        Log times.
    start_ns, end_ns : int
        First and last of the log.

    Returns
    -------
    tuple of int
        ``N_BINS`` numbers.
    """
    edges = (times_ns - start_ns) * (N_BINS / max(end_ns - start_ns, 1))
    rows = np.clip(edges.astype(np.int64), 0, N_BINS - 1)
    return tuple(np.bincount(rows, minlength=N_BINS).tolist())


def gaps(times_ns: Nanos, start_ns: int) -> tuple[tuple[float, float], ...]:
    """Return the pauses of a topic, begin and end, in the order of time [s].

    Parameters
    ----------
    times_ns : (n,)
        Log times in ascending order.
    start_ns : int
        Zero of the result.

    Returns
    -------
    tuple of (float, float)
        Pauses of more than five usual intervals and a tenth of a second.
    """
    steps = times_ns[1:] - times_ns[:-1]
    if not len(steps):
        return ()
    rows = np.flatnonzero(steps > max(_GAP * float(np.median(steps)), _GAP_MIN))
    longest = np.sort(rows[np.argsort(steps[rows])[-_GAPS_MAX:]])
    pairs = np.column_stack([times_ns[longest], times_ns[longest + 1]])
    return tuple((float(a), float(b)) for a, b in np.round((pairs - start_ns) * 1e-9, 3))


def of_log(log: ScanLog, stops: Sequence[ScanLog], start_ns: int, end_ns: int) -> dict[str, Any]:
    """Return the angle of the gimbal and the stops of a log over time.

    Parameters
    ----------
    log : ScanLog
        The log.
    stops : sequence of ScanLog
        Its stops.
    start_ns, end_ns : int
        First and last log time; where sensors have another clock, their first return is at zero.

    Returns
    -------
    dict
        ``gimbal_times_s``, ``gimbal_angles_deg`` and ``stop_spans_s``.
    """
    first, last = (int(log.stamps_lidar_ns[i]) for i in (0, -1))
    is_same_clock = start_ns - _FAR < first and last < end_ns + _FAR
    zero = start_ns if is_same_clock else first
    n = len(log.stamps_gimbal_ns)
    rows = np.rint(np.linspace(0, n - 1, min(n, _ANGLES))).astype(np.intp)
    times = (log.stamps_gimbal_ns[rows] - zero) * 1e-9
    spans = [
        ((s.stamps_lidar_ns[0] - zero) * 1e-9, (s.stamps_lidar_ns[-1] - zero) * 1e-9) for s in stops
    ]
    return {
        "gimbal_times_s": tuple(np.round(times, 3).tolist()),
        "gimbal_angles_deg": tuple(np.round(np.degrees(log.gimbal_angles[rows]), 2).tolist()),
        "stop_spans_s": tuple((round(float(a), 3), round(float(b), 3)) for a, b in spans),
    }
