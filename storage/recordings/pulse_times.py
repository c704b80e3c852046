"""The meaning of the time of a point, by its type and size; senseless times are refused.

Float32 seconds since the message's stamp (Velodyne), whole nanoseconds since it (Ouster, Livox),
absolute float64 seconds (Hesai, RoboSense) or nanoseconds; some write micro- or milliseconds. Some
simulators and drivers leave the field zero, constant, or filled for half of the cloud only: that
counts as no time.
"""

from __future__ import annotations

from math import isfinite
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.model import Array, Mask, Nanos
from spheremark.storage.recordings.options import TIME_UNITS

NO_FIELD = "there is no such field"
PULSES_MIN = 32  # points that a message needs before its times can be judged
_REVOLUTION_LIMIT = 10.0  # [s] no message spans more; a larger time has another meaning
_EPOCH = 1e6  # a time that is always larger counts from another instant than the stamp
_EPOCH_NS = 1e15  # [ns] eleven days: the least age of that instant
_LATEST_NS = 9.2e18  # [ns] end of what 64 bits hold
_ZEROS_MAX = 0.25  # share of zero times that a message with times may have


class PulseTimes(NamedTuple):
    """The times of a message: the latest and the extent [ns], their unit [ns], and the fault.

    The unit is 0 where times are absolute, or are none.
    """

    span: int = 0
    extent: int = 0
    unit: int = 0
    fault: str = ""


def pulse_times(times: NDArray[np.generic] | None, stamp_ns: int, out: Nanos) -> PulseTimes:
    """Write the instant of each return of a message."""
    found = PulseTimes(fault=NO_FIELD)
    if times is not None:
        found = _written(times, stamp_ns, out) if len(times) else PulseTimes()
    if found.fault:
        out[:] = stamp_ns
    return found


def _written(times: NDArray[np.generic], stamp_ns: int, out: Nanos) -> PulseTimes:
    """Write instants, if there is no fault."""
    low, high = float(times.min()), float(times.max())
    fault = fault_of(low, high, int((times == 0).sum()), len(times))
    if fault:
        return PulseTimes(fault=fault)
    if absolute := _absolute_unit(low, high, times.dtype.kind):
        offsets, unit = _since(times, absolute, stamp_ns), 0
    elif unit := _unit(low, high, times.dtype.kind):
        offsets = np.rint(times.astype(np.float64) * unit).astype(np.int64)
    else:
        fault = f"its times run from {low:g} to {high:g}, which no unit of time explains"
        return PulseTimes(fault=fault)
    out[:] = offsets + stamp_ns
    return PulseTimes(int(offsets.max()), int(np.ptp(offsets)), unit)


def fault_of(low: float, high: float, n_zeros: int, n: int) -> str:
    """Return the fault of the times of a message; empty if there is none."""
    if not isfinite(high - low):
        return "some of its times are not finite"
    if n < PULSES_MIN:
        return ""
    if low == high:
        return f"its times are all {low:g}"
    return f"{n_zeros:,} of {n:,} times are 0" if n_zeros > _ZEROS_MAX * n else ""


def plain_spans(
    kind: str, low: Array, high: Array, n_zeros: Nanos, n: Nanos
) -> tuple[Nanos, Nanos, Nanos, Mask]:
    """Return spans, extents and units of messages as of ``PulseTimes``, and which are plain.

    Plain times count from the stamp, in the unit that their type has with most drivers.
    """
    unit = plain_unit(kind)
    is_near = np.maximum(np.abs(low), np.abs(high)) * unit <= _REVOLUTION_LIMIT * 1e9
    is_plain = is_near & (low < high) & (n >= PULSES_MIN) & (n_zeros <= _ZEROS_MAX * n)
    ends = (np.rint(np.where(is_plain, one, 0.0) * unit).astype(np.int64) for one in (low, high))
    earliest, latest = ends
    return latest, latest - earliest, np.where(is_plain, unit, 0), is_plain


def plain_times(kind: str, low: float, high: float) -> PulseTimes | None:
    """Return the times of a message if they count from the stamp in the plain unit."""
    unit = plain_unit(kind)
    is_plain = max(abs(low), abs(high)) * unit <= _REVOLUTION_LIMIT * 1e9
    if not is_plain:
        return None
    return PulseTimes(round(high * unit), round(high * unit) - round(low * unit), unit)


def plain_unit(kind: str) -> int:
    """Return the unit that times of a type have with most drivers [ns]."""
    return TIME_UNITS["ns" if kind[0] in "iu" else "s"]


def _unit(low: float, high: float, kind: str) -> int:
    """Return the largest unit in which times stay within a message [ns]; 0 if none does."""
    most = max(abs(low), abs(high))
    units = [one for one in TIME_UNITS.values() if one <= plain_unit(kind)]
    return next((one for one in units if most * one <= _REVOLUTION_LIMIT * 1e9), 0)


def _absolute_unit(low: float, high: float, kind: str) -> int:
    """Return the unit of absolute times [ns]; 0 if times count from the stamp.

    It is the largest in which they lie within a message and within 64 bits.
    """
    if kind in "iu" or low <= _EPOCH:
        return 0
    for unit in TIME_UNITS.values():
        is_short = (high - low) * unit <= _REVOLUTION_LIMIT * 1e9
        if is_short and low * unit >= _EPOCH_NS and high * unit < _LATEST_NS:
            return unit
    return 0


def _since(times: NDArray[np.generic], unit: int, stamp_ns: int) -> Nanos:
    """Return absolute times as nanoseconds since the stamp."""
    exact = times.astype(np.float64)
    whole = np.floor(exact)
    fractions = np.rint((exact - whole) * unit).astype(np.int64)
    absolute = whole.astype(np.int64) * np.int64(unit) + fractions
    # A driver may stamp points by the sensor's clock and messages by the computer's.
    is_far = stamp_ns and abs(int(absolute[0]) - stamp_ns) > _REVOLUTION_LIMIT * 1e9
    return np.asarray(absolute - (int(absolute.min()) if is_far else stamp_ns))
