"""What drivers mean by the time of a point: told by type and size, and refused when senseless.

Float32 seconds since the message's stamp (Velodyne), whole nanoseconds since it (Ouster, Livox),
absolute float64 seconds (Hesai, RoboSense) or nanoseconds. Simulators and drivers are known to
leave the field zero, constant, or filled for half of the cloud only: that counts as no time.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from pipelines.values import Nanos

SHOTS_MIN = 32  # points that a message needs before its times can be judged
_REVOLUTION_LIMIT = 10.0  # [s] no message spans more; a larger time has another meaning
_EPOCH = 1e6  # [s] a larger time is absolute
_EPOCH_NS = 1e15  # the same in nanoseconds
_ZEROS_MAX = 0.25  # share of zero times that a message with times may have


def shot_times(times: NDArray[np.generic] | None, stamp_ns: int, out: Nanos) -> tuple[int, str]:
    """Write the instant of each return of a message.

    Parameters
    ----------
    times : (n,) or None
        Times as recorded, of any type; none when the points have no such field.
    stamp_ns : int
        Stamp of the message.
    out : (n,)
        Receives the instants; the stamp throughout when the times are of no use.

    Returns
    -------
    span_ns : int
        From the stamp to the latest instant.
    fault : str
        Why the times are of no use, as the end of a sentence; empty when they are of use.
    """
    fault = "there is no such field"
    if times is not None:
        if not len(times):
            return 0, ""
        span, fault = _written(times, stamp_ns, out)
        if not fault:
            return span, ""
    out[:] = stamp_ns
    return 0, fault


def _written(times: NDArray[np.generic], stamp_ns: int, out: Nanos) -> tuple[int, str]:
    """Write instants, and return their span and what is wrong with them."""
    is_single = times.dtype == np.dtype("<f4")
    low, high, n_zeros = (
        _stamp_kernel(times, stamp_ns, out)
        if is_single
        else (float(times.min()), float(times.max()), int((times == 0).sum()))
    )
    fault = _fault(low, high, n_zeros, len(times))
    if fault or (is_single and max(abs(low), abs(high)) <= _REVOLUTION_LIMIT):
        return 0 if fault else round(high * 1e9), fault
    offsets = _offsets_ns(times, low, high, stamp_ns)
    if offsets is None:
        return 0, f"its times run from {low:g} to {high:g}, neither seconds nor nanoseconds"
    out[:] = offsets + stamp_ns
    return int(offsets.max()), ""


def _fault(low: float, high: float, n_zeros: int, n: int) -> str:
    """Say what is wrong with times by their extremes and their zeros."""
    if not np.isfinite(high - low):
        return "some of its times are not finite"
    if n < SHOTS_MIN:
        return ""
    if low == high:
        return f"its times are all {low:g}"
    return f"{n_zeros:,} of {n:,} times are 0" if n_zeros > _ZEROS_MAX * n else ""


def _offsets_ns(times: NDArray[np.generic], low: float, high: float, stamp_ns: int) -> Nanos | None:
    """Return nanoseconds since the stamp, or nothing if the times make no sense."""
    is_whole = times.dtype.kind in "iu"
    if low > (_EPOCH_NS if is_whole else _EPOCH):
        absolute = _absolute_ns(times, is_ns=low > _EPOCH_NS)
        # A driver may stamp points by the sensor's clock and messages by the computer's.
        far = stamp_ns and abs(int(absolute[0]) - stamp_ns) > _REVOLUTION_LIMIT * 1e9
        return absolute - (int(absolute.min()) if far else stamp_ns)
    scale = 1.0 if is_whole else 1e9
    if max(abs(low), abs(high)) * scale > _REVOLUTION_LIMIT * 1e9:
        return None
    return np.rint(times.astype(np.float64) * scale).astype(np.int64)


def _absolute_ns(times: NDArray[np.generic], *, is_ns: bool) -> Nanos:
    """Return absolute times, in nanoseconds or seconds, as nanoseconds."""
    if is_ns:
        return times.astype(np.int64)
    seconds = np.floor(times.astype(np.float64))
    fractions = np.rint((times.astype(np.float64) - seconds) * 1e9)
    return np.asarray(seconds.astype(np.int64) * 1_000_000_000 + fractions.astype(np.int64))


@numba.njit(cache=True, nogil=True)
def _stamp_kernel(times, stamp_ns, stamps):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Add float32 seconds to a stamp; return least and greatest time and the number of zeros."""
    low, high, n_zeros = np.float32(np.inf), np.float32(-np.inf), 0
    for i in range(len(times)):
        time = times[i]
        low, high = min(low, time), max(high, time)
        if time - time != 0:  # not a number, or infinite
            high = np.float32(np.inf)
        n_zeros += time == 0
        stamps[i] = stamp_ns + np.int64(np.rint(np.float64(time) * 1e9))
    return low, high, n_zeros
