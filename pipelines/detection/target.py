"""The sphere that is searched for, and how beams pass it.

A beam passes a centre across and up, square to the line of sight; depth is along it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import Array, Column

_POLE = 0.5  # radii: half the width of a pole
_TINY = 1e-3  # [m]
ASIDE, BROAD = 1.9, 1.3
"""Radii: anything farther to a side may be another object; and the head of a tripod is narrower."""

REACH = 3.0
"""Radii about a place within which its pulses without a return are known."""


class Target(NamedTuple):
    """The sphere that is searched for: radius [m], upward unit vector, beam divergence [rad]."""

    radius: float
    up: Array
    divergence: float


@compiled
def blur_at(c: Array, target: Target) -> float:
    """Return half the width of a beam at a place."""
    return float(0.5 * target.divergence * np.sqrt(c[0] ** 2 + c[1] ** 2 + c[2] ** 2))


@compiled
def is_beside_pole(across: float, along: float, blur: float) -> bool:
    """Return whether a beam passes a sphere below it and beside its pole; all in radii.

    And so near that its pulses without a return are known.
    """
    gap2 = across * across + along * along
    is_out = (1.2 + blur) ** 2 < gap2 < REACH * REACH
    return bool(is_out and along < -0.3 and _POLE + blur < abs(across) < ASIDE + blur)


def slope_of(c: Array, up: Array) -> float:
    """Return how steeply the line of sight to a place rises."""
    rise = float(c @ up)
    return rise / max(float(np.linalg.norm(c - rise * up)), _TINY)


class View(NamedTuple):
    """A centre [m], and unit vectors across and up the view of it."""

    x: float
    y: float
    z: float
    across: tuple[float, float, float]
    up: tuple[float, float, float]


@compiled
def view_of(c: Array, up: Array) -> View:
    """Return the view of a centre from the sensor."""
    distance = np.sqrt(c[0] ** 2 + c[1] ** 2 + c[2] ** 2)
    x, y, z = c[0] / distance, c[1] / distance, c[2] / distance
    along = up[0] * x + up[1] * y + up[2] * z
    p, q, r = up[0] - along * x, up[1] - along * y, up[2] - along * z
    length = np.sqrt(p * p + q * q + r * r) + 1e-12
    p, q, r = p / length, q / length, r / length
    across = (q * z - r * y, r * x - p * z, p * y - q * x)
    return View(c[0], c[1], c[2], across, (p, q, r))


@compiled
def seen_from(points: Column, view: View) -> Array:
    """Return how far across and up beams pass a centre, and how much deeper they end, (3, n)."""
    seen = np.empty((3, len(points)))
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        distance = np.sqrt(x * x + y * y + z * z)
        nearest = (view.x * x + view.y * y + view.z * z) / distance
        share = nearest / distance
        seen[0, i] = share * (x * view.across[0] + y * view.across[1] + z * view.across[2])
        seen[1, i] = share * (x * view.up[0] + y * view.up[1] + z * view.up[2])
        seen[2, i] = distance - nearest
    return seen
