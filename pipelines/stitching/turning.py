"""Returns of a turning LiDAR -> points in the base frame: the loops, block by block.

Hides how a return finds its gimbal angle and how a block of returns is turned at once. What a block
needs in between stays in the cache, and each loop does one thing to few arrays, so that the
compiler can do it to many returns at a time.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from pipelines.threads import side_by_side
from pipelines.values import Array, Column, Index, Mask, Nanos, Rings

_BLOCK = 4096  # returns: few enough for the cache, enough to make the overhead of a block small
_SMALL_TURN = 0.1  # [rad]; below it the series in `_by_series` is good to 1.4e-9


class Shots(NamedTuple):
    """Columns of the log that are read."""

    p_lidar: Column
    intensities: Column
    rings: Rings
    stamps_ns: Nanos


class Joints(NamedTuple):
    """Gimbal on the LiDAR's clock; ``table`` has angle, cosine, sine, turning rate [rad/ns]."""

    stamps_ns: Nanos
    angles: Array
    table: Array


class Lidar(NamedTuple):
    """Rig for the kernel; ``lasers``, (3, 256), has height in the cloud, bias, height [m]."""

    T_head_lidar: tuple[float, ...]  # twelve numbers, row by row
    lasers: Array
    has_biases: bool
    range_limits: tuple[float, float]


class Columns(NamedTuple):
    """Columns of the cloud."""

    p_base: Column
    gimbal_angles: Column
    intensities: Column
    rings: Rings
    times: Column


class _Scratch(NamedTuple):
    """What is known of the returns of a block."""

    x: Array
    y: Array
    z: Array
    cosines: Array
    sines: Array
    by_laser: Array
    keep: Mask


def turned(shots: Shots, joints: Joints, lidar: Lidar, start_ns: int) -> tuple[Columns, Index]:
    """Turn returns into points in the base frame.

    Parameters
    ----------
    shots : Shots
        The returns.
    joints : Joints
        The gimbal.
    lidar : Lidar
        The rig, and which ranges are wanted.
    start_ns : int
        The instant that times are counted from.

    Returns
    -------
    columns : Columns
        The returns that are kept, in their order.
    counts : (4,)
        How many were kept, had no angle, were not finite, were out of range.

    Notes
    -----
    The first part is filled from its last row down, the second from its first row up: what they
    keep meets in the middle, and nothing has to be moved to close a gap.
    """
    n = len(shots.p_lidar)
    out = Columns(
        np.empty((n, 3), np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.uint8),
        np.empty(n, np.float32),
    )

    def part(first: int, end: int) -> tuple[int, int, Index]:
        is_upward = first > 0 or end == n
        counts = _turn_part(shots, joints, lidar, start_ns, out, first, end, is_upward)
        kept = int(counts[0])
        return (first, first + kept, counts) if is_upward else (end - kept, end, counts)

    parts = side_by_side(part, n)
    rows = slice(parts[0][0], parts[-1][1])
    kept = Columns(out[0][rows], out[1][rows], out[2][rows], out[3][rows], out[4][rows])
    return kept, np.sum([counts for _, _, counts in parts], axis=0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _turn_part(shots, joints, lidar, start, out, first, end, is_upward):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0913
    """Fill a part of ``out``; count kept, no angle, not finite, out of range."""
    a = np.empty((6, _BLOCK + 16))  # not a power of two: columns would share places in the cache
    scratch = _Scratch(a[0], a[1], a[2], a[3], a[4], a[5], np.empty(_BLOCK, np.bool_))
    counts = np.zeros(4, np.int64)
    place = first if is_upward else end
    for done in range(0, end - first, _BLOCK):
        low = first + done if is_upward else max(end - done - _BLOCK, first)
        n = min(_BLOCK, end - first - done)
        to = place if is_upward else place - n
        kept = _turn_block(shots, joints, lidar, start, out, low, low + n, to, scratch, counts)
        if kept < n:
            _close_up(out, to, scratch.keep[:n], is_upward)
        place += kept if is_upward else -kept
    return counts


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _turn_block(shots, joints, lidar, start, out, low, high, to, scratch, counts):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0913
    """Fill as many rows of ``out`` as the block has, tell which to keep, and return how many."""
    n = high - low
    x, y, z = scratch.x[:n], scratch.y[:n], scratch.z[:n]
    c, s, laser = scratch.cosines[:n], scratch.sines[:n], scratch.by_laser[:n]
    stamps, rings = shots.stamps_ns[low:high], shots.rings[low:high]
    n_known = _angles(stamps, joints, c, s, out.gimbal_angles[to : to + n])
    _spread(shots.p_lidar[low:high], x, y, z)
    _look_up(lidar.lasers[0], rings, laser)
    _subtract(z, laser)
    n_kept = _n_within(x, y, z, lidar.range_limits)
    if n_kept < n or n_known < n:
        n_kept = _judge(x, y, z, c, lidar.range_limits, scratch.keep[:n], counts)
    counts[0] += n_kept
    if lidar.has_biases:
        _look_up(lidar.lasers[1], rings, laser)
        _shorten(x, y, z, laser)
    _look_up(lidar.lasers[2], rings, laser)
    _turn(lidar.T_head_lidar, x, y, z, laser, c, s)
    _gather(x, y, z, out.p_base[to : to + n])
    _durations(stamps, start, out.times[to : to + n])
    out.intensities[to : to + n] = shots.intensities[low:high]
    out.rings[to : to + n] = rings
    return n_kept


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _angles(stamps, joints, cosines, sines, angles):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Find cosine, sine and angle of each shot; those without have no number as cosine.

    Shots mostly come in the order of time: those between two joint samples are done at once.
    Returns how many have an angle.
    """
    samples, i, n_known = joints.stamps_ns, 0, 0
    while i < len(stamps):
        j = np.searchsorted(samples, stamps[i], side="right") - 1
        if j < 0 or stamps[i] > samples[-1]:
            cosines[i], angles[i] = np.nan, np.nan
            i += 1
            continue
        since = samples[j]
        until = samples[j + 1] if j + 1 < len(samples) else since + 1
        end = i + 1
        while end < len(stamps) and since <= stamps[end] < until:
            end += 1
        _angles_between(
            stamps[i:end],
            since,
            until,
            joints.table[j],
            cosines[i:end],
            sines[i:end],
            angles[i:end],
        )
        n_known += (end - i) * np.isfinite(joints.table[j, 3])
        i = end
    return n_known


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _angles_between(stamps, since, until, sample, cosines, sines, angles):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0913
    """Find cosine, sine and angle of shots between two joint samples."""
    angle, cosine, sine, rate = sample[0], sample[1], sample[2], sample[3]
    if abs(rate) * (until - since) < _SMALL_TURN:
        _by_series(stamps, since, cosine, sine, rate, cosines, sines)
    else:  # also where the rate is no number
        for i in range(len(stamps)):
            full = angle + rate * (stamps[i] - since)
            cosines[i], sines[i] = np.cos(full), np.sin(full)
    for i in range(len(stamps)):
        turns = (angle + rate * (stamps[i] - since)) * (0.5 / np.pi)
        angles[i] = 2.0 * np.pi * (turns - np.floor(turns + 0.5))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _by_series(stamps, since, cosine, sine, rate, cosines, sines):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0913
    """Find cosine and sine of an angle plus small steps."""
    for i in range(len(stamps)):
        step = rate * (stamps[i] - since)
        square = step * step
        c = 1.0 - square * (0.5 - square * (1.0 / 24.0))
        s = step * (1.0 - square * (1.0 / 6.0 - square * (1.0 / 120.0)))
        cosines[i] = cosine * c - sine * s
        sines[i] = sine * c + cosine * s


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _spread(points, x, y, z):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Copy coordinates into columns."""
    for i in range(len(x)):
        x[i], y[i], z[i] = points[i, 0], points[i, 1], points[i, 2]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _gather(x, y, z, points):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Copy columns into coordinates."""
    for i in range(len(x)):
        points[i, 0], points[i, 1], points[i, 2] = x[i], y[i], z[i]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _look_up(table, rings, out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Find what a table says of each laser."""
    for i in range(len(rings)):
        out[i] = table[rings[i]]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _subtract(values, less):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Take one column off another."""
    for i in range(len(values)):
        values[i] -= less[i]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _n_within(x, y, z, limits):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Count the returns within the limits of range."""
    n, least2, most2 = 0, limits[0] ** 2, limits[1] ** 2
    for i in range(len(x)):
        reach2 = x[i] * x[i] + y[i] * y[i] + z[i] * z[i]
        n += (least2 <= reach2) & (reach2 <= most2)
    return n


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _judge(x, y, z, cosines, limits, keep, counts):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0913
    """Tell which returns to keep; count those with no angle, not finite, out of range."""
    n_kept = 0
    for i in range(len(x)):
        reach2 = x[i] * x[i] + y[i] * y[i] + z[i] * z[i]
        has_angle = not np.isnan(cosines[i])
        keep[i] = has_angle and limits[0] ** 2 <= reach2 <= limits[1] ** 2
        n_kept += keep[i]
        counts[1] += not has_angle
        counts[2] += has_angle and not np.isfinite(reach2)
        counts[3] += has_angle and np.isfinite(reach2) and not keep[i]
    return n_kept


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _shorten(x, y, z, biases):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Take the biases of the lasers off along the beams."""
    for i in range(len(x)):
        scale = 1.0 - biases[i] / np.sqrt(x[i] * x[i] + y[i] * y[i] + z[i] * z[i])
        x[i], y[i], z[i] = scale * x[i], scale * y[i], scale * z[i]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _turn(T, x, y, z, heights, cosines, sines):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0913
    """Move returns from the lasers to the head, and turn the head."""
    xx, xy, xz, dx, yx, yy, yz, dy, zx, zy, zz, dz = T
    for i in range(len(x)):
        a, b, c = x[i], y[i], z[i] + heights[i]
        u, v = xx * a + xy * b + xz * c + dx, yx * a + yy * b + yz * c + dy
        x[i] = cosines[i] * u - sines[i] * v
        y[i] = sines[i] * u + cosines[i] * v
        z[i] = zx * a + zy * b + zz * c + dz


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _durations(stamps, start, times):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Find the time since the start [s]."""
    for i in range(len(stamps)):
        times[i] = (stamps[i] - start) * 1e-9


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _close_up(out, to, keep, is_upward):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Move what is kept of a block to its first rows, or to its last."""
    step = 1 if is_upward else -1
    k = to if is_upward else to + len(keep) - 1
    for i in range(len(keep)):
        row = to + i if is_upward else to + len(keep) - 1 - i
        if not keep[row - to]:
            continue
        out.p_base[k, 0], out.p_base[k, 1] = out.p_base[row, 0], out.p_base[row, 1]
        out.p_base[k, 2] = out.p_base[row, 2]
        out.gimbal_angles[k], out.times[k] = out.gimbal_angles[row], out.times[row]
        out.intensities[k], out.rings[k] = out.intensities[row], out.rings[row]
        k += step
