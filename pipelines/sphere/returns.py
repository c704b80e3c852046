"""The returns of all markers of a stop as columns, as the passes over them need them.

Hides what can be told of a return before any sphere is known: its footprint, the vertical across
it, and its noise. Coordinates are columns of their own, so that compiled loops take several returns
at once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import Array, Beams, Index, Mask

_THIN = 1e-6  # [m]; a thinner footprint is a ray, and this one differs from it by nothing
_POLE_BEGINS = 1.0  # radii below the centre: a footprint that begins lower is on the pole
_POLE_HALF = 0.25  # radii from the vertical through the centre within which the pole is


class Rows(NamedTuple):
    """Returns, those of one marker after those of another.

    Attributes
    ----------
    firsts : (m + 1,)
        First row of each marker, and the row behind the last.
    origins, directions, firsts_axis, seconds_axis : (3, n)
        Beams, and the axes of their footprints.
    ranges : (n,)
        What was measured [m].
    half_widths : (2, n)
        Of the footprint [m].
    up : (2, n)
        The vertical along the footprint's axes, as a unit vector.
    blurs : (2, n)
        Half widths of the footprint along the vertical and across it [m].
    lasers, classes : (n,)
        Place of each laser, and class of reflectivity.
    sigmas : (n,)
        Prior noise [m].
    lateral : (n,)
        What the noise of the direction moves a return to the side [m].
    """

    firsts: Index
    origins: Array
    directions: Array
    firsts_axis: Array
    seconds_axis: Array
    ranges: Array
    half_widths: Array
    up: Array
    blurs: Array
    lasers: Index
    classes: Index
    sigmas: Array
    lateral: Array


def rows_of(
    beams: Beams, firsts: Index, up: Array, lasers: Index, noise: tuple[Index, Array, float]
) -> Rows:
    """Return returns as the passes need them."""
    classes, sigmas, sigma_direction = noise
    origins, directions, across = (
        np.ascontiguousarray(vectors.T)
        for vectors in (beams.origins_base, beams.directions_base, beams.across_base)
    )
    seconds, half_widths, ups, blurs = _derived(
        directions, across, beams.ranges, beams.divergence, up
    )
    return Rows(
        firsts,
        origins,
        directions,
        across,
        seconds,
        beams.ranges,
        half_widths,
        ups,
        blurs,
        lasers,
        classes,
        sigmas,
        sigma_direction * beams.ranges,
    )


@compiled
def _derived(
    directions: Array, across: Array, ranges: Array, divergence: Array, up: Array
) -> tuple[Array, Array, Array, Array]:
    """Return second axes, half widths, the vertical along the axes, and half widths along it."""
    n = len(ranges)
    seconds, half_widths = np.empty((3, n)), np.empty((2, n))
    ups, blurs = np.empty((2, n)), np.empty((2, n))
    for i in range(n):
        u, a = directions[:, i], across[:, i]
        b = (u[1] * a[2] - u[2] * a[1], u[2] * a[0] - u[0] * a[2], u[0] * a[1] - u[1] * a[0])
        half_x = max(0.5 * ranges[i] * divergence[0], _THIN)
        half_y = max(0.5 * ranges[i] * divergence[1], _THIN)
        up_x = a[0] * up[0] + a[1] * up[1] + a[2] * up[2]
        up_y = b[0] * up[0] + b[1] * up[1] + b[2] * up[2]
        length = np.sqrt(up_x * up_x + up_y * up_y)
        up_x, up_y = up_x / length, up_y / length
        seconds[0, i], seconds[1, i], seconds[2, i] = b
        half_widths[0, i], half_widths[1, i] = half_x, half_y
        ups[0, i], ups[1, i] = up_x, up_y
        blurs[0, i] = np.sqrt((half_x * up_x) ** 2 + (half_y * up_y) ** 2)
        blurs[1, i] = np.sqrt((half_x * up_y) ** 2 + (half_y * up_x) ** 2)
    return seconds, half_widths, ups, blurs


@compiled
def rows_of_one(rows: Rows, m: int) -> Rows:
    """Return the returns of one marker."""
    first, behind = rows.firsts[m], rows.firsts[m + 1]
    return Rows(
        np.array([0, behind - first]),
        rows.origins[:, first:behind].copy(),
        rows.directions[:, first:behind].copy(),
        rows.firsts_axis[:, first:behind].copy(),
        rows.seconds_axis[:, first:behind].copy(),
        rows.ranges[first:behind],
        rows.half_widths[:, first:behind].copy(),
        rows.up[:, first:behind].copy(),
        rows.blurs[:, first:behind].copy(),
        rows.lasers[first:behind],
        rows.classes[first:behind],
        rows.sigmas[first:behind],
        rows.lateral[first:behind],
    )


def moved_faces(rows: Rows, moves: Array) -> Rows:
    """Return returns with what is swept upwards moved, and the other face against it."""
    return rows._replace(origins=_moved(rows, moves))


@compiled
def _moved(rows: Rows, moves: Array) -> Array:
    """Return the origins."""
    origins = np.empty(rows.origins.shape)
    for m in range(len(moves)):
        for j in range(3):
            for i in range(rows.firsts[m], rows.firsts[m + 1]):
                origins[j, i] = rows.origins[j, i] - rows.up[0, i] * moves[m, j]
    return origins


@compiled
def in_play(rows: Rows, offsets: Array, margins: Array, radius: float) -> Mask:
    """Tell which returns may be the sphere by their place: on its outline, and not on its pole.

    Notes
    -----
    What passes by no farther than the centre may be off is kept: to leave out returns of the limb
    wherever the present centre misses them would make every centre right in its own eyes.
    """
    is_in = np.empty(len(rows.ranges), dtype=np.bool_)
    for m in range(len(margins)):
        for i in range(rows.firsts[m], rows.firsts[m + 1]):
            x, y = offsets[0, i], offsets[1, i]
            up_x, up_y = rows.up[0, i], rows.up[1, i]
            is_low = x * up_x + y * up_y + rows.blurs[0, i] < -_POLE_BEGINS * radius
            is_middle = abs(x * up_y - y * up_x) < _POLE_HALF * radius + rows.blurs[1, i]
            off = max(np.sqrt(x * x + y * y), 1e-9)
            a, b = rows.half_widths[0, i] * x, rows.half_widths[1, i] * y
            half = np.sqrt(a * a + b * b) / off
            is_in[i] = off - radius - half < margins[m] and not (is_low and is_middle)
    return is_in
