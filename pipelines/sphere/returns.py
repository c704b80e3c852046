"""The returns of all candidates of a stop as columns, with what is known before any sphere is.

Coordinates are the first axis of an array, so that each coordinate is one contiguous column.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.model import Array, Beams, Index, Mask

_THIN = 1e-6  # [m]; a thinner footprint is treated as a ray
BENT = 2.0
"""Standard deviations of a direction by which a gimbal that starts or stops may be off."""

_POLE_BEGINS = 1.0  # radii below the centre: a footprint that begins lower is on the pole
_POLE_HALF = 0.35  # radii from the vertical through the centre: half width of the pole's region
_SAME_PLACE = 0.25  # half widths of a beam within which returns show the same of a limb
_LINE = 0.01  # [s] between returns of different scan lines, at the least


class Returns(NamedTuple):
    """Returns, candidate by candidate.

    Attributes
    ----------
    starts : (m + 1,)
        First return of each candidate, and the end of the last.
    markers : (n,)
        Candidate of each return.
    origins, directions : (3, n)
        Beams in the base frame [m], [1].
    first_axes, second_axes : (3, n)
        Unit vectors along the axes of the elliptic footprints.
    half_widths : (2, n)
        Semi-axes of the footprints [m].
    ranges : (n,)
        Measured ranges [m].
    vertical : (2, n)
        The vertical projected on the footprint's axes, as a unit vector. The sign of its first
        component is that of the gimbal's sweep, upward or downward.
    vertical_half_widths : (2, n)
        Half widths of the footprint along that vertical and across it [m].
    lasers, classes : (n,)
        Index of the laser among those of the stop, and class of reflectivity.
    sigmas : (n,)
        Prior standard deviation of the range [m].
    sigmas_lateral : (n,)
        Standard deviation across the beam by the noise of the direction [m].
    speeds : (n,)
        Angular speed of the gimbal about that at the mean return [rad/s].
    shares : (n,)
        One over the number of returns of the same candidate at the same place: where scan lines
        fall on each other, the limb is seen no better than by one of them.
    """

    starts: Index
    markers: Index
    origins: Array
    directions: Array
    first_axes: Array
    second_axes: Array
    half_widths: Array
    ranges: Array
    vertical: Array
    vertical_half_widths: Array
    lasers: Index
    classes: Index
    sigmas: Array
    sigmas_lateral: Array
    speeds: Array
    shares: Array


def returns_of(
    beams: Beams,
    starts: Index,
    up: Array,
    lasers: Index,
    noise: tuple[Index, Array, Array | float],
    speeds: Array | None = None,
) -> Returns:
    """Build the columns.

    Parameters
    ----------
    beams : Beams
        Returns, candidate by candidate.
    starts : (m + 1,)
        First return of each candidate, and the end of the last.
    up : (3,)
        Upward direction in base.
    lasers : (n,)
        Index of the laser among those of the stop.
    noise : tuple
        Classes of reflectivity, (n,), and sigmas of ranges, (n,) [m], and of directions [rad].
    speeds : (n,), optional
        Angular speeds of the gimbal [rad/s]; even where they are not given.

    Returns
    -------
    ``Returns``
        Columns with coordinates as first axis.
    """
    classes, sigmas, sigma_direction = noise
    speeds = np.zeros(len(lasers)) if speeds is None else speeds
    origins, directions, first_axes = (
        np.ascontiguousarray(vectors.T)
        for vectors in (beams.origins_base, beams.directions_base, beams.across_base)
    )
    second_axes = np.ascontiguousarray(np.cross(beams.directions_base, beams.across_base).T)
    half_widths = np.maximum(0.5 * beams.ranges * beams.divergence[:, None], _THIN)
    vertical = np.stack([up @ first_axes, up @ second_axes])
    vertical /= np.linalg.norm(vertical, axis=0)
    markers = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    return Returns(
        starts=starts,
        markers=markers,
        origins=origins,
        directions=directions,
        first_axes=first_axes,
        second_axes=second_axes,
        half_widths=half_widths,
        ranges=beams.ranges,
        vertical=vertical,
        vertical_half_widths=np.stack(
            [np.hypot(*(half_widths * sides)) for sides in (vertical, vertical[::-1])]
        ),
        lasers=lasers,
        classes=classes,
        sigmas=sigmas,
        sigmas_lateral=sigma_direction * beams.ranges,
        speeds=np.asarray(speeds - np.sum(speeds) / max(len(lasers), 1)),
        shares=_shares_of(markers, directions, beams.divergence),
    )


def _shares_of(markers: Index, directions: Array, divergence: Array) -> Array:
    """Return one over the number of returns of a candidate in a cell of directions."""
    cell = _SAME_PLACE * 0.5 * float(np.sqrt(np.prod(divergence)))
    places = np.floor(directions / max(cell, _THIN)).astype(np.int64)
    _, own, counts = np.unique(
        np.vstack([markers, places]), axis=1, return_inverse=True, return_counts=True
    )
    return np.asarray(1.0 / counts[own.ravel()])


def of_markers(returns: Returns, markers: Index) -> tuple[Returns, Index]:
    """Return the returns of some candidates, and their places among all returns."""
    rows, counts = np.flatnonzero(np.isin(returns.markers, markers)), np.diff(returns.starts)
    columns = {
        name: np.ascontiguousarray(column[..., rows])
        for name, column in returns._asdict().items()
        if name not in {"starts", "markers"}
    }
    columns["starts"] = np.concatenate([[0], np.cumsum(counts[markers])])
    columns["markers"] = np.repeat(np.arange(len(markers)), counts[markers])
    return Returns(**columns), rows


def moved_faces(returns: Returns, moves: Array) -> Returns:
    """Shift the beams of upward sweeps by ``-moves``, (m, 3), those of downward sweeps by it."""
    shifts = returns.vertical[0] * moves[returns.markers].T
    return returns._replace(origins=returns.origins - shifts)


def swept(returns: Returns) -> Array:
    """Return how fast spheres seem to move with the offset of the gimbal's clock, (3, n) [m/s].

    The gimbal was at ``angle - offset * speed``. At an even speed that is a turn of everything.
    """
    x, y, _ = returns.origins + returns.ranges * returns.directions
    return np.asarray(returns.speeds * np.stack([-y, x, np.zeros(len(x))]))


def may_be_sphere(returns: Returns, offsets: Array, margins: Array, radius: float) -> Mask:
    """Tell which returns may be the sphere by their place: inside its limb, and not on its pole.

    Notes
    -----
    A footprint may lie outside the limb by as much as the centre is uncertain (``margins``, (m,)):
    to drop returns that the present centre misses would confirm any centre.
    """
    x, y = offsets
    up_x, up_y = returns.vertical
    along, across = returns.vertical_half_widths
    is_low = x * up_x + y * up_y - along < -_POLE_BEGINS * radius
    is_middle = np.abs(x * up_y - y * up_x) < _POLE_HALF * radius + across
    distances, halves = distances_and_halves(returns, offsets)
    is_inside = distances - radius - halves < margins[returns.markers]
    return np.asarray(is_inside & ~(is_low & is_middle))


def distances_and_halves(returns: Returns, offsets: Array) -> tuple[Array, Array]:
    """Return the footprints' distances from the centre, and half widths along that line [m]."""
    distances = np.maximum(np.hypot(*offsets), 1e-9)
    halves = np.hypot(*(returns.half_widths * offsets)) / distances
    return distances, np.maximum(halves, _THIN)


def scan_lines(times: Array) -> Index:
    """Return the scan line of each return of a sphere, in the order of time.

    Parameters
    ----------
    times : (n,)
        Instants of the returns [s].

    Returns
    -------
    (n,)
        Numbers from 0 on; lasers that cross the sphere together count as one line.
    """
    order = np.argsort(times, kind="stable")
    lines = np.zeros(len(times), dtype=np.intp)
    lines[order[1:]] = np.cumsum(np.diff(times[order]) > _LINE)
    return lines


def n_lines(times: Array) -> int:
    """Return the number of scan lines of returns, one at the least."""
    return 1 + int(scan_lines(times).max(initial=0))
