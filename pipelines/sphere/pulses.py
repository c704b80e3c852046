"""All pulses that pass a sphere, including those without a recorded return."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.geometry import levelling_rotation
from spheremark.pipelines.model import Array, Index, Mask, StitchedCloud
from spheremark.pipelines.scan.firings import (
    Clock,
    Pulses,
    in_base,
    near_of,
    numbers_of,
    pulses_about,
)
from spheremark.pipelines.scan.rigs import N_LASERS

_REACH = 1.5  # radii: pulses that pass a centre closer are taken
_DEPTH = 2.0  # radii before and behind the centre within which a return is the sphere's own
_BLOCK = 500_000  # returns whose pulses are numbered at once
_POLE_FROM, _POLE = 0.6, 0.35  # radii below the centre, and from the vertical: may be the pole


class Passing(NamedTuple):
    """Pulses that pass one sphere closely, in the plane across the line of sight.

    Attributes
    ----------
    places : (n, 2)
        Intersections with the plane [m].
    half_widths : (n, 2, 2)
        Their footprints there: half widths times axes [m].
    has_hit : (n,)
        Whether they returned from the sphere.
    axes : (2, 3)
        Unit vectors of the plane.
    centre : (3,)
        Origin of the plane [m].
    distance : float
        From the base to the centre [m].
    """

    places: Array
    half_widths: Array
    has_hit: Mask
    axes: Array
    centre: Array
    distance: float


def passing_of(cloud: StitchedCloud, clock: Clock, centres: Array, radius: float) -> list[Passing]:
    """Return the pulses that pass each sphere closely, except those that may have met its pole."""
    about = [pulses_about(clock, p, _REACH * radius) for p in centres]
    wanted = np.unique(np.concatenate([pulses.numbers for pulses, _, _ in about]))
    rows = _rows_of(cloud, clock, wanted)
    return [
        _passing(cloud, (p, radius), one, rows[np.searchsorted(wanted, one[0].numbers)])
        for p, one in zip(centres, about, strict=True)
    ]


def _rows_of(cloud: StitchedCloud, clock: Clock, wanted: Index) -> Index:
    """Return the rows of the returns of some pulses, by their numbers.

    -1 without one, -2 where it is nearer than the least range.
    """
    found, n = np.full(len(wanted), -1), len(cloud.p_base)
    found[np.isin(wanted, near_of(cloud, clock))] = -2
    for begin in range(0, n if len(wanted) else 0, _BLOCK):
        rows = np.arange(begin, min(begin + _BLOCK, n))
        rows = rows[cloud.rings[rows] < N_LASERS]
        numbers = numbers_of(cloud, clock, rows)
        places = np.searchsorted(wanted, numbers).clip(max=len(wanted) - 1)
        is_wanted = wanted[places] == numbers
        found[places[is_wanted]] = rows[is_wanted]
    return found


def _passing(
    cloud: StitchedCloud,
    sphere: tuple[Array, float],
    about: tuple[Pulses, Array, Array],
    rows: Index,
) -> Passing:
    """Return the pulses that pass one sphere, of those about it with the rows of their returns."""
    (p, radius), (pulses, passing, along), rig = sphere, about, cloud.rig
    u, passed = (in_base(rig, v, pulses.angles).T for v in (pulses.directions, passing))
    axes = _plane(p / np.linalg.norm(p), levelling_rotation(cloud.levelling)[2])
    places = passed @ axes.T
    behind = np.sum((cloud.p_base[rows] - p) * u, axis=1)
    depth = np.where(rows < 0, np.inf, behind) / radius
    spin_axes = in_base(rig, np.eye(3)[:, 2:], pulses.angles).T
    across = np.cross(spin_axes, u)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    both = np.stack([across, np.cross(u, across)], axis=1) @ axes.T
    half_widths = 0.5 * along[:, None, None] * rig.divergence[:, None] * both
    is_pole = (places[:, 1] < -_POLE_FROM * radius) & (np.abs(places[:, 0]) < _POLE * radius)
    is_taken = (depth > -_DEPTH) & (rows > -2) & ~is_pole
    has_hit = (depth < _DEPTH)[is_taken]
    distance = float(np.linalg.norm(p))
    return Passing(places[is_taken], half_widths[is_taken], has_hit, axes, p, distance)


def _plane(sight: Array, up: Array) -> Array:
    """Return two unit vectors across a line of sight, the second one upward, (2, 3)."""
    side = np.cross(sight, up)
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(side, sight)])
