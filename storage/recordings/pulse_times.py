"""The meaning of the time of a point, by its type and size; senseless times are refused.

Float32 seconds since the message's stamp (Velodyne), whole nanoseconds since it (Ouster, Livox),
absolute float64 seconds (Hesai, RoboSense) or nanoseconds. Some simulators and drivers leave the
field zero, constant, or filled for half of the cloud only: that counts as no time.
"""

from __future__ import annotations

from math import isfinite

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.model import Array, Mask, Nanos

NO_FIELD = "there is no such field"
PULSES_MIN = 32  # points that a message needs before its times can be judged
_REVOLUTION_LIMIT = 10.0  # [s] no message spans more; a larger time has another meaning
_OTHER_UNITS = (1e6, 1e3, 1.0)  # [ns] of floating times that are too large for seconds
_EPOCH = 1e6  # [s] a larger time is absolute
_EPOCH_NS = 1e15  # the same in nanoseconds
_ZEROS_MAX = 0.25  # share of zero times that a message with times may have


def pulse_times(times: NDArray[np.generic] | None, stamp_ns: int, out: Nanos) -> tuple[int, str]:
    """Write the instant of each return of a message; return their span [ns], and the fault."""
    fault = NO_FIELD
    if times is not None:
        if not len(times):
            return 0, ""
        span, fault = _written(times, stamp_ns, out)
        if not fault:
            return span, ""
    out[:] = stamp_ns
    return 0, fault


def _written(times: NDArray[np.generic], stamp_ns: int, out: Nanos) -> tuple[int, str]:
    """Write instants, and return their span [ns] and the fault."""
    low, high = float(times.min()), float(times.max())
    fault = fault_of(low, high, int((times == 0).sum()), len(times))
    if fault:
        return 0, fault
    offsets = _offsets_ns(times, low, high, stamp_ns)
    if offsets is None:
        return 0, f"its times run from {low:g} to {high:g}, which no unit of time explains"
    out[:] = offsets + stamp_ns
    return int(offsets.max()), ""


def fault_of(low: float, high: float, n_zeros: int, n: int) -> str:
    """Return the fault of the times of a message; empty if there is none."""
    if not isfinite(high - low):
        return "some of its times are not finite"
    if n < PULSES_MIN:
        return ""
    if low == high:
        return f"its times are all {low:g}"
    return f"{n_zeros:,} of {n:,} times are 0" if n_zeros > _ZEROS_MAX * n else ""


def plain_spans(kind: str, low: Array, high: Array, n_zeros: Nanos, n: Nanos) -> tuple[Nanos, Mask]:
    """Return the spans [ns] of messages whose times count from the stamp, and which these are."""
    scale = _scale(kind[0])
    is_near = np.maximum(np.abs(low), np.abs(high)) * scale <= _REVOLUTION_LIMIT * 1e9
    is_plain = is_near & (low < high) & (n >= PULSES_MIN) & (n_zeros <= _ZEROS_MAX * n)
    return np.rint(np.where(is_plain, high, 0.0) * scale).astype(np.int64), is_plain


def plain_span(kind: str, low: float, high: float) -> int | None:
    """Return the span [ns] of a message if its times count from the stamp."""
    scale = _scale(kind[0])
    is_plain = max(abs(low), abs(high)) * scale <= _REVOLUTION_LIMIT * 1e9
    return round(high * scale) if is_plain else None


def _scale(kind: str) -> float:
    """Return the unit of times since a stamp [ns]."""
    return 1.0 if kind in "iu" else 1e9


def _offsets_ns(times: NDArray[np.generic], low: float, high: float, stamp_ns: int) -> Nanos | None:
    """Return nanoseconds since the stamp, or None if the times are neither unit."""
    is_whole = times.dtype.kind in "iu"
    if low > (_EPOCH_NS if is_whole else _EPOCH):
        absolute = _absolute_ns(times, is_ns=low > _EPOCH_NS)
        # A driver may stamp points by the sensor's clock and messages by the computer's.
        far = stamp_ns and abs(int(absolute[0]) - stamp_ns) > _REVOLUTION_LIMIT * 1e9
        return absolute - (int(absolute.min()) if far else stamp_ns)
    most = max(abs(low), abs(high))
    units = (_scale(times.dtype.kind), *_OTHER_UNITS)
    scale = next((one for one in units if most * one <= _REVOLUTION_LIMIT * 1e9), None)
    if scale is None:
        return None
    return np.rint(times.astype(np.float64) * scale).astype(np.int64)


def _absolute_ns(times: NDArray[np.generic], *, is_ns: bool) -> Nanos:
    """Return absolute times, in nanoseconds or seconds, as nanoseconds."""
    if is_ns:
        return times.astype(np.int64)
    seconds = np.floor(times.astype(np.float64))
    fractions = np.rint((times.astype(np.float64) - seconds) * 1e9)
    return np.asarray(seconds.astype(np.int64) * 1_000_000_000 + fractions.astype(np.int64))
