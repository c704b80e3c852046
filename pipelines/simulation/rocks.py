"""Rocks of all sizes: rough convex bodies, some of them nearly round."""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.model import Array, Index
from spheremark.pipelines.simulation.scene import Mesh
from spheremark.pipelines.simulation.terrain import Terrain

_COVER = 0.01  # share of the ground that rocks cover
_DECAY = 4.0  # [1/m] of the exponential in size that the covered share falls with
_SIZES = (0.05, 1.0)  # [m] smallest and largest diameter
_HALF = 34.0  # [m] half side of the square they lie in
_FULL_HALF = 14.0  # [m] half side of the square where the small ones are kept too
_FAR_SIZE = 0.15  # [m] smaller rocks farther out are not resolved by any beam
_ROUND_SHARE = 0.15  # of the rocks are nearly round
_ROUND_LEVEL = 2  # of nearly round rocks: flats lie 1 mm inside a ball of 0.1 m
_N_FACETS = 9  # planes that a rock is cut by
_BURIED = 0.3  # share of a rock's half height that its centre lies above ground
_REFLECTIVITY = (0.10, 0.22)
_CROWN, _DEPTHS = 0.25, (0.0, 0.8)  # radii: about its top; depth of its ground below its middle
_WIDEST = 1.4  # [m] radius


def draw_rocks(rng: np.random.Generator, keep_clear: Array, cover: float = _COVER) -> Array:
    """Return places and sizes of rocks that cover a share of the ground.

    Notes
    -----
    The share of ground under rocks larger than D is ``k exp(-q D)``: the exponential tail of
    counted fields (Golombek and Rapp, 1997, eq. 4), here with q = 4 /m so that large rocks occur,
    and 1 % for all of them.
    """
    sizes = np.linspace(*_SIZES, 2000)
    shares = _DECAY * np.exp(-_DECAY * sizes)  # of the ground, per metre of diameter
    shares *= cover / np.ptp(np.exp(-_DECAY * sizes))
    density = shares / (np.pi / 4 * sizes**2)  # [1/m^3]
    cumulative = np.concatenate(
        [[0.0], np.cumsum(np.diff(sizes) * (density[1:] + density[:-1]) / 2)]
    )
    n = rng.poisson(cumulative[-1] * (2 * _HALF) ** 2)
    diameters = np.interp(rng.random(n) * cumulative[-1], cumulative, sizes)
    places = rng.uniform(-_HALF, _HALF, (n, 2))
    is_near = np.abs(places).max(axis=1) < _FULL_HALF
    gap = np.hypot(*(places[:, None, :] - keep_clear[None, :, :2]).transpose(2, 0, 1))
    is_clear = (gap > keep_clear[None, :, 2] + diameters[:, None] / 2).all(axis=1)
    keep = is_clear & (is_near | (diameters > _FAR_SIZE))
    return np.asarray(np.column_stack([places, diameters])[keep])


def rock_mesh(rng: np.random.Generator, rocks: Array, terrain: Terrain) -> Mesh:
    """Return the surfaces of rocks that lie on the ground."""
    levels = np.digitize(rocks[:, 2], [0.10, 0.20])  # small ones need few triangles
    balls = [ball(level) for level in range(3)]
    meshes = []
    for (x, y, diameter), level in zip(rocks, levels, strict=True):
        directions, triangles = balls[level]
        is_round = rng.random() < _ROUND_SHARE
        shape = _shape(rng, directions, is_round=is_round) * diameter / 2
        centre = np.array([x, y, 0.0])
        centre[2] = terrain.height_at(centre) + _BURIED * shape[:, 2].max()
        meshes.append(Mesh.even(shape + centre, triangles, rng.uniform(*_REFLECTIVITY)))
    return Mesh.merged(meshes)


def _shape(rng: np.random.Generator, directions: Array, *, is_round: bool) -> Array:
    """Return the surface of a rock of about unit radius in the given directions, (n, 3)."""
    axes = rng.uniform(0.92, 1.0, 3) if is_round else rng.uniform(0.6, 1.0, 3)
    normals = rng.standard_normal((_N_FACETS, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    depths = rng.uniform(0.97 if is_round else 0.65, 1.0, _N_FACETS)
    facing = np.maximum(directions @ normals.T, 1e-9)
    radii = np.minimum((depths / facing).min(axis=1), 1.0)  # a ball cut by planes stays convex
    heading = rng.uniform(0, 2 * np.pi)
    c, s = np.cos(heading), np.sin(heading)
    return np.asarray(
        (directions * radii[:, None] * axes) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    )


def round_rock(rng: np.random.Generator, centre: Array, radius: float) -> Mesh:
    """Return a nearly round rock: a ball with flats and axes that differ by a few percent."""
    directions, triangles = ball(_ROUND_LEVEL)
    shape = _shape(rng, directions, is_round=True) * radius
    return Mesh.even(shape + centre, triangles, rng.uniform(*_REFLECTIVITY))


def standing_rock(rng: np.random.Generator, top: Array, height: float) -> Mesh:
    """Return a rock that rises to a place from the ground, up to 1.7 m below."""
    directions, triangles = ball(_ROUND_LEVEL)
    shape = _shape(rng, directions, is_round=rng.random() < _ROUND_SHARE)
    highest = float(shape[np.hypot(*shape[:, :2].T) < _CROWN, 2].max())
    size = min(height / (highest + rng.uniform(*_DEPTHS)), _WIDEST)
    centre = top - np.array([0.0, 0.0, size * highest])
    return Mesh.even(size * shape + centre, triangles, rng.uniform(*_REFLECTIVITY))


def ball(level: int) -> tuple[Array, Index]:
    """Return the triangles of a unit ball: an icosahedron, each face split several times.

    Parameters
    ----------
    level : int
        How often each face is split into four.

    Returns
    -------
    directions : (n, 3)
        Unit vectors to the corners.
    triangles : (m, 3)
        Rows of ``directions``.
    """
    g = (1 + 5**0.5) / 2
    corners: list[tuple[float, float, float]]
    corners = [(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g)]
    corners += [(0, -1, -g), (0, 1, -g), (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)]
    faces = "0b5 051 017 07a 0ab 159 5b4 ba2 a76 718 394 342 326 368 389 495 24b 62a 867 981"
    vertices = np.array(corners, dtype=np.float64)
    triangles = np.array([[int(c, 16) for c in face] for face in faces.split()], dtype=np.intp)
    for _ in range(level):
        vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
        a, b, c = (vertices[triangles[:, i]] for i in range(3))
        n = len(triangles)
        ia, ib, ic, ab, bc, ca = (np.arange(n) + i * n for i in range(6))
        split = [(ia, ab, ca), (ib, bc, ab), (ic, ca, bc), (ab, bc, ca)]
        vertices = np.concatenate([a, b, c, a + b, b + c, c + a])
        triangles = np.concatenate([np.column_stack(t) for t in split])
    return vertices / np.linalg.norm(vertices, axis=1, keepdims=True), triangles
