"""Elementary shapes: boxes, cylinders, ellipsoids and loose facets.

The facets of round bodies lie some tenths of a millimetre inside their circles.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from spheremark.pipelines.geometry import rot_z
from spheremark.pipelines.simulation.rocks import ball
from spheremark.pipelines.simulation.scene import Mesh

_N_SIDES = 48  # of a cylinder: 0.6 mm inside a circle of 0.3 m
_LEVEL = 3  # of an ellipsoid: 1280 triangles


def box(centre: ArrayLike, sides: ArrayLike, heading: float, reflectivity: float) -> Mesh:
    """Return an upright box."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    corners = (signs * np.asarray(sides)) @ rot_z(heading).T + np.asarray(centre)
    faces = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    triangles = [t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))]
    return Mesh.even(corners, np.array(triangles, dtype=np.intp), reflectivity)


def cylinder(start: ArrayLike, end: ArrayLike, radius: float, reflectivity: float) -> Mesh:
    """Return a closed cylinder in any direction."""
    low, high = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    axis = (high - low) / np.linalg.norm(high - low)
    aside = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    aside /= np.linalg.norm(aside)
    up = np.cross(axis, aside)
    angles = np.arange(_N_SIDES) * 2 * np.pi / _N_SIDES
    ring = radius * (np.outer(np.cos(angles), aside) + np.outer(np.sin(angles), up))
    i = np.arange(_N_SIDES)
    j = np.roll(i, -1)
    foot, top = np.full(_N_SIDES, 2 * _N_SIDES), np.full(_N_SIDES, 2 * _N_SIDES + 1)
    jacket = ((i, j, i + _N_SIDES), (j, j + _N_SIDES, i + _N_SIDES))
    caps = ((j, i, foot), (i + _N_SIDES, j + _N_SIDES, top))
    triangles = np.concatenate([np.column_stack(columns) for columns in (*jacket, *caps)])
    return Mesh.even(np.vstack([ring + low, ring + high, low, high]), triangles, reflectivity)


def ellipsoid(centre: ArrayLike, axes: ArrayLike, heading: float, reflectivity: float) -> Mesh:
    """Return an upright ellipsoid."""
    directions, triangles = ball(_LEVEL)
    surface = (directions * np.asarray(axes)) @ rot_z(heading).T + np.asarray(centre)
    return Mesh.even(surface, triangles, reflectivity)


def leaves(
    rng: np.random.Generator, centre: ArrayLike, axes: ArrayLike, n: int, size: float
) -> Mesh:
    """Return loose facets that fill an ellipsoid evenly, as leaves fill a crown."""
    directions = rng.standard_normal((n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    places = directions * np.cbrt(rng.random((n, 1))) * np.asarray(axes) + np.asarray(centre)
    corners = places[:, None, :] + size / 2 * rng.standard_normal((n, 3, 3))
    return Mesh(
        p_site=corners.reshape(-1, 3),
        triangles=np.arange(3 * n).reshape(n, 3),
        reflectivities=rng.uniform(0.3, 0.6, n),  # leaves are bright at 905 nm
    )
