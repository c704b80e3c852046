"""All surfaces of a world: triangles for ground, rocks and poles, and exact spheres."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from spheremark.pipelines.model import Array, Column, Index, seal
from spheremark.pipelines.simulation.terrain import Terrain, interpolated

_N_SIDES = 24  # of a pole: its flats lie 0.1 mm inside the circle
_REGOLITH = (0.10, 0.20)  # diffuse reflectivity at 905 nm
_PATCH = 0.5  # [m] regolith changes its reflectivity over about this length

Caster = Callable[..., tuple[Column, Column]]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Mesh:
    """Triangles, each with its reflectivity.

    Attributes
    ----------
    p_site : (n, 3)
        Corners [m].
    triangles : (m, 3)
        Rows of ``p_site``.
    reflectivities : (m,)
        Diffuse reflectivity of each triangle, 0 to 1.
    """

    p_site: Array
    triangles: Index
    reflectivities: Array

    def __post_init__(self) -> None:
        seal(self, p_site=(None, 3), triangles=(None, 3), reflectivities=(len(self.triangles),))

    @classmethod
    def even(cls, p_site: Array, triangles: Index, reflectivity: float) -> Self:
        """Return a mesh of one reflectivity.

        Parameters
        ----------
        p_site : (n, 3)
            Corners [m].
        triangles : (m, 3)
            Rows of ``p_site``.
        reflectivity : float
            Diffuse reflectivity of all triangles, 0 to 1.

        Returns
        -------
        Mesh
            The mesh.
        """
        shades = np.full(len(triangles), reflectivity)
        return cls(p_site=p_site, triangles=triangles, reflectivities=shades)

    @classmethod
    def merged(cls, meshes: Sequence[Mesh]) -> Self:
        """Return several meshes as one.

        Parameters
        ----------
        meshes : sequence of Mesh
            The meshes; may be none.

        Returns
        -------
        Mesh
            All their triangles.
        """
        firsts = np.cumsum([0, *(len(mesh.p_site) for mesh in meshes)])
        shifted = [mesh.triangles + first for mesh, first in zip(meshes, firsts, strict=False)]
        return cls(
            p_site=np.concatenate([np.zeros((0, 3)), *(mesh.p_site for mesh in meshes)]),
            triangles=np.concatenate([np.zeros((0, 3), np.intp), *shifted]),
            reflectivities=np.concatenate([[], *(mesh.reflectivities for mesh in meshes)]),
        )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Spheres:
    """Exact spheres.

    Attributes
    ----------
    p_site : (n, 3)
        Centres [m].
    radii : (n,)
        Radii [m].
    reflectivities : (n,)
        Diffuse reflectivities, 0 to 1.
    """

    p_site: Array
    radii: Array
    reflectivities: Array

    def __post_init__(self) -> None:
        n = len(self.p_site)
        seal(self, p_site=(n, 3), radii=(n,), reflectivities=(n,))


Stick = tuple[Array, Array, float]
"""Foot, top and radius of a thin pole."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Poles:
    """Axes of thin poles: beams that touch them are traced as bundles.

    Attributes
    ----------
    feet_site, tops_site : (n, 3)
        Ends of the axes [m].
    radii : (n,)
        Radii [m].
    """

    feet_site: Array
    tops_site: Array
    radii: Array

    def __post_init__(self) -> None:
        n = len(self.radii)
        seal(self, feet_site=(n, 3), tops_site=(n, 3), radii=(n,))

    def joined(self, sticks: Sequence[Stick]) -> Poles:
        """Return these poles and more.

        Parameters
        ----------
        sticks : sequence of (foot, top, radius)
            Axes and radii of the others [m].

        Returns
        -------
        Poles
            All of them, these first.
        """
        return Poles(
            feet_site=np.vstack([self.feet_site, *(foot for foot, _, _ in sticks)]),
            tops_site=np.vstack([self.tops_site, *(top for _, top, _ in sticks)]),
            radii=np.append(self.radii, [radius for _, _, radius in sticks]),
        )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Scene:
    """All surfaces that a beam can meet.

    Attributes
    ----------
    mesh : Mesh
        Ground, rocks, poles and all other triangles.
    spheres : Spheres
        Exact spheres, not part of the mesh.
    poles : Poles
        Axes of the poles that the mesh holds.
    """

    mesh: Mesh
    spheres: Spheres
    poles: Poles


def terrain_mesh(rng: np.random.Generator, terrain: Terrain) -> Mesh:
    """Return the ground as triangles, with a reflectivity that varies from patch to patch."""
    n_rows, n_columns = terrain.heights.shape
    x, y = np.meshgrid(terrain.xs, terrain.ys)
    p_site = np.column_stack([x.ravel(), y.ravel(), terrain.heights.ravel()])
    nodes = np.arange(n_rows * n_columns).reshape(n_rows, n_columns)
    a, b, c, d = (
        corner.ravel()
        for corner in (nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, 1:], nodes[1:, :-1])
    )
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    lines = np.arange(terrain.xs[0], terrain.xs[-1] + _PATCH, _PATCH)
    shades = rng.uniform(*_REGOLITH, (len(lines), len(lines)))
    middles = p_site[triangles].mean(axis=1)
    return Mesh(
        p_site=p_site,
        triangles=triangles,
        reflectivities=interpolated(lines, lines, shades, middles),
    )


def pole_mesh(foot: ArrayLike, top: ArrayLike, radius: float, reflectivity: float) -> Mesh:
    """Return an upright pole as a prism that is open at both ends."""
    angles = np.arange(_N_SIDES) * 2 * np.pi / _N_SIDES
    ring = radius * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(_N_SIDES)])
    low = np.arange(_N_SIDES)
    following = np.roll(low, -1)
    high = low + _N_SIDES
    triangles = np.concatenate(
        [
            np.column_stack([low, following, high]),
            np.column_stack([following, following + _N_SIDES, high]),
        ]
    )
    corners = np.concatenate([ring + np.asarray(foot), ring + np.asarray(top)])
    return Mesh.even(corners, triangles, reflectivity)


@lru_cache(maxsize=1)
def caster(mesh: Mesh) -> Caster:
    """Return the function that casts rays against a mesh.

    Parameters
    ----------
    mesh : Mesh
        Triangles; the search tree of the last mesh is cached, because it takes a second to build.

    Returns
    -------
    callable
        From rays, (n, 6) float32, origin and unit direction in the site frame [m], and an exponent
        of the cosine of incidence (0 by default) to distances, (n,), infinite where nothing is met
        [m], and reflectivities times that power, (n,), there zero.
    """
    if not len(mesh.triangles):
        return lambda rays, _incidence=0.0: (
            np.full(len(rays), np.inf, np.float32),
            np.zeros(len(rays), np.float32),
        )
    import open3d as o3d

    tree = o3d.t.geometry.RaycastingScene()
    tree.add_triangles(
        o3d.core.Tensor.from_numpy(mesh.p_site.astype(np.float32)),
        o3d.core.Tensor.from_numpy(mesh.triangles.astype(np.uint32)),
    )
    shades = np.append(mesh.reflectivities, 0.0).astype(np.float32)

    def cast(rays: Column, incidence: float = 0.0) -> tuple[Column, Column]:
        hits = tree.cast_rays(o3d.core.Tensor.from_numpy(rays))
        met = np.minimum(hits["primitive_ids"].numpy(), len(shades) - 1)
        dimmed = shades[met]
        if incidence:
            normals = hits["primitive_normals"].numpy()
            cosines = np.abs(np.einsum("ij,ij->i", normals, rays[:, 3:]))
            dimmed = dimmed * cosines**incidence
        return hits["t_hit"].numpy(), dimmed

    return cast
