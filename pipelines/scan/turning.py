"""Returns of a turning LiDAR -> points in the base frame: the compiled loops.

A run is a series of pulses between two joint samples. The loop over a run needs no table, so that
the compiler can vectorise it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import Array, Column, Index, Nanos, Rings
from spheremark.pipelines.threads import side_by_side

_BLOCK = 512  # returns of a run at the most: their table values stay in the nearest cache
_SMALL_TURN = 0.1  # [rad]; below it the series in `_turn_run` are good to 1.4e-9


class Joints(NamedTuple):
    """Gimbal on the LiDAR's clock; its rate [rad/ns] from each sample on is NaN if not known."""

    stamps_ns: Nanos
    angles: Array
    rates: Array


class Lidar(NamedTuple):
    """Rig for the kernel: mounting, bias and height [m] of every ring, and wanted ranges [m]."""

    T_head_lidar: tuple[float, ...]  # twelve numbers, row by row
    biases: Array
    heights: Array
    has_biases: bool
    height_share: float  # of the heights that coordinates in the cloud have: 0 or 1
    range_limits: tuple[float, float]


class Pulses(NamedTuple):
    """Returns, in the frame of the LiDAR or in the base frame."""

    p: Column
    intensities: Column
    rings: Rings
    stamps_ns: Nanos


class Tally(NamedTuple):
    """Counts of returns that were kept or left out, and the first and last instant."""

    n_kept: int
    n_without_angle: int
    n_not_finite: int
    n_out_of_range: int
    first_ns: int
    last_ns: int


def turn_returns(
    pulses: Pulses, joints: Joints, lidar: Lidar
) -> tuple[Pulses, Tally, Index | slice]:
    """Transform returns from the LiDAR's frame into the base frame; return which were kept."""
    n = len(pulses.rings)
    p_lidar, p_base = pulses.p.reshape(-1), np.empty(3 * n, np.float32)
    keep = np.ones(n, np.bool_)
    knots_ns, table = _knots(joints)

    def turn(first: int, end: int) -> Index:
        rows, flat = slice(first, end), slice(3 * first, 3 * end)
        columns = (p_lidar[flat], pulses.rings[rows], pulses.stamps_ns[rows])
        counts: Index = _turn_part(columns, knots_ns, table, lidar, p_base[flat], keep[rows])
        return counts

    counts = np.sum(side_by_side(turn, n), axis=0).tolist()
    limits, stamps_ns = np.iinfo(np.int64), pulses.stamps_ns
    first, last = stamps_ns.min(initial=limits.max), stamps_ns.max(initial=limits.min)
    tally = Tally._make([*counts, int(first), int(last)])
    found = pulses._replace(p=p_base.reshape(n, 3))
    if tally.n_kept == n:
        return found, tally, slice(None)
    rows = np.flatnonzero(keep)
    return Pulses._make(column.take(rows, axis=0) for column in found), tally, rows


def _knots(joints: Joints) -> tuple[Nanos, Array]:
    """Cut time at the joint samples, and so finely that the gimbal turns little in between.

    Returns the instants, and cosine, sine and rate from each on; NaN outside the samples.
    """
    spans = np.diff(joints.stamps_ns, append=joints.stamps_ns[-1:] + 1)
    turns = np.nan_to_num(np.abs(joints.rates * spans))
    n_pieces = np.ceil(turns / _SMALL_TURN).astype(np.intp).clip(1)
    sample = np.repeat(np.arange(len(spans)), n_pieces)
    piece = np.arange(len(sample)) - np.repeat(np.cumsum(n_pieces) - n_pieces, n_pieces)
    since = (piece * (spans / n_pieces)[sample]).astype(np.int64)
    knots_ns = joints.stamps_ns[sample] + since
    angles, rates = joints.angles[sample] + joints.rates[sample] * since, joints.rates[sample]
    ends = np.iinfo(np.int64)
    knots_ns = np.concatenate([[ends.min], knots_ns, joints.stamps_ns[-1:] + 1, [ends.max]])
    table = np.full((len(knots_ns), 3), np.nan)
    table[1:-2] = np.stack([np.cos(angles), np.sin(angles), rates], axis=1)
    return knots_ns, table


@compiled
def _turn_part(columns, knots_ns, table, lidar, p_base, keep):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Turn some returns, mark which to keep, and count as ``Tally`` does."""
    p, rings, stamps = columns
    counts = np.zeros(4, np.int64)
    heights, scales = np.empty(_BLOCK), np.ones(_BLOCK)
    begin, n = 0, len(rings)
    while begin < n:
        j = min(np.searchsorted(knots_ns, stamps[begin], side="right"), len(table) - 1) - 1
        most = min(n, begin + _BLOCK)
        end = _run_end(stamps, begin, most, knots_ns[j], knots_ns[j + 1])
        if np.isnan(table[j, 2]):
            keep[begin:end] = False
            counts[1] += end - begin
        else:
            _look_up(lidar.heights, rings, begin, end, heights)
            if lidar.has_biases:
                _look_up(lidar.biases, rings, begin, end, scales)
                _find_scales(p, begin, end, lidar.height_share, heights, scales)
            at = (knots_ns[j], table[j, 0], table[j, 1], table[j, 2])
            n_kept = _turn_run(p, stamps, begin, end, at, lidar, heights, scales, p_base)
            if n_kept < end - begin:
                _select(p, begin, end, lidar, heights, keep, counts)
            counts[0] += n_kept
        begin = end
    return counts


@compiled
def _run_end(stamps, begin, most, since, until):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Return the end of the run of pulses in the same interval as the first one."""
    end = begin + 1
    while end + 64 <= most:
        n_inside = 0
        for i in range(np.uint64(end), np.uint64(end + 64)):
            n_inside += (since <= stamps[i]) & (stamps[i] < until)
        if n_inside < 64:
            break
        end += 64
    while end < most and since <= stamps[end] < until:
        end += 1
    return end


@compiled
def _look_up(table, rings, begin, end, out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Write the table value of each return's laser."""
    first = np.uint64(begin)
    for i in range(np.uint64(end - begin)):
        out[i] = table[rings[first + i]]


@compiled
def _beam(p, row, lowered):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Return a point relative to the origin of its beam, and its squared range."""
    x, y = np.float64(p[np.uint64(3) * row]), np.float64(p[np.uint64(3) * row + np.uint64(1)])
    z = p[np.uint64(3) * row + np.uint64(2)] - lowered
    return x, y, z, x * x + y * y + z * z


@compiled
def _find_scales(p, begin, end, height_share, heights, scales):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Replace range biases by the factors that remove them from the coordinates."""
    first = np.uint64(begin)
    for i in range(np.uint64(end - begin)):
        _, _, _, reach2 = _beam(p, first + i, height_share * heights[i])
        scales[i] = 1.0 - scales[i] / np.sqrt(reach2)


@compiled
def _turn_run(p, stamps, begin, end, at, lidar, heights, scales, p_base):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0913
    """Transform the returns of a run to the base; count those within the limits of range."""
    xx, xy, xz, dx, yx, yy, yz, dy, zx, zy, zz, dz = lidar.T_head_lidar
    least2, most2, share = (
        lidar.range_limits[0] ** 2,
        lidar.range_limits[1] ** 2,
        lidar.height_share,
    )
    since, cosine, sine, rate = at
    first, n_within = np.uint64(begin), 0
    for i in range(np.uint64(end - begin)):
        row = first + i
        a, b, c, reach2 = _beam(p, row, share * heights[i])
        n_within += (least2 <= reach2) & (reach2 <= most2)
        a, b, c = scales[i] * a, scales[i] * b, scales[i] * c + heights[i]
        u, v = xx * a + xy * b + xz * c + dx, yx * a + yy * b + yz * c + dy
        step = rate * (stamps[row] - since)
        square = step * step
        less = 1.0 - square * (0.5 - square * (1.0 / 24.0))
        more = step * (1.0 - square * (1.0 / 6.0 - square * (1.0 / 120.0)))
        cos, sin = cosine * less - sine * more, sine * less + cosine * more
        p_base[np.uint64(3) * row] = cos * u - sin * v
        p_base[np.uint64(3) * row + np.uint64(1)] = sin * u + cos * v
        p_base[np.uint64(3) * row + np.uint64(2)] = zx * a + zy * b + zz * c + dz
    return n_within


@compiled
def _select(p, begin, end, lidar, heights, keep, counts):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202, PLR0913
    """Mark which returns of a run to keep; count those not finite and out of range."""
    for i in range(begin, end):
        _, _, _, reach2 = _beam(p, np.uint64(i), lidar.height_share * heights[i - begin])
        keep[i] = lidar.range_limits[0] ** 2 <= reach2 <= lidar.range_limits[1] ** 2
        counts[2] += not np.isfinite(reach2)
        counts[3] += np.isfinite(reach2) and not keep[i]
