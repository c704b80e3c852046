"""The sphere that is searched for, and how beams pass it.

A beam passes a centre across and up, square to the line of sight; depth is along it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import Array, Column

_POLE = 0.5  # radii: half the width of a pole
ASIDE = 1.9
"""Radii: anything farther to a side may be another object."""


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
    """Return whether a beam passes a sphere below it and beside its pole; all in radii."""
    is_out = across * across + along * along > (1.2 + blur) ** 2
    return bool(is_out and along < -0.3 and _POLE + blur < abs(across) < ASIDE + blur)


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
def rays_of(points: Column, rows: NDArray[np.integer]) -> Array:
    """Return the rays to some returns."""
    rays = np.empty((4, len(rows)))
    x, y, z, distances = rays[0], rays[1], rays[2], rays[3]
    for i in range(len(rows)):
        x[i], y[i], z[i] = points[rows[i], 0], points[rows[i], 1], points[rows[i], 2]
    for i in range(len(rows)):
        distances[i] = np.sqrt(x[i] * x[i] + y[i] * y[i] + z[i] * z[i])
        share = 1.0 / distances[i]
        x[i], y[i], z[i] = share * x[i], share * y[i], share * z[i]
    return rays


@compiled
def passing(view: View, rays: Array, i: int) -> tuple[float, float, float]:
    """Return how far across and up a ray passes a centre, and how much deeper its return lies."""
    x, y, z = rays[0, i], rays[1, i], rays[2, i]
    nearest = view.x * x + view.y * y + view.z * z
    across = nearest * (x * view.across[0] + y * view.across[1] + z * view.across[2])
    along = nearest * (x * view.up[0] + y * view.up[1] + z * view.up[2])
    return across, along, rays[3, i] - nearest


@compiled
def seen_from(rays: Array, view: View) -> Array:
    """Return how some rays pass a centre, (3, n), as ``passing``."""
    seen = np.empty((3, rays.shape[1]))
    for i in range(rays.shape[1]):
        seen[0, i], seen[1, i], seen[2, i] = passing(view, rays, i)
    return seen
