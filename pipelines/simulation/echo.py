"""The echo of a beam of finite width.

One ray is cast along the centre of every beam. Beams that touch a sphere or a pole, or that lie at
a step in range, are cast again as a bundle that fills the footprint; the bundle's returns merge
and split like those of one pulse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import Array, Column, Mask, seal
from spheremark.pipelines.scan.rigs import N_LASERS
from spheremark.pipelines.simulation.scene import Caster, Scene, caster

_N_RAYS = 61  # in a bundle
_MERGE = 0.8  # [m] nearer returns of one pulse are one echo: half a pulse of some 5 ns
_STEP = 0.10  # [m] departure of a range from the plane through its neighbours
NEAR = 0.35
"""Distance within which a beam passes near a sphere's centre [m]."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Aims:
    """Origins and directions of beams.

    Attributes
    ----------
    origins_site : (n, 3)
        Where each beam leaves the spin axis [m].
    directions_site : (n, 3)
        Unit vectors along the beams.
    spin_axes_site : (n, 3)
        Unit vectors along the spin axis at each pulse.
    """

    origins_site: Array
    directions_site: Array
    spin_axes_site: Array

    def __post_init__(self) -> None:
        n = len(self.origins_site)
        seal(self, origins_site=(n, 3), directions_site=(n, 3), spin_axes_site=(n, 3))

    def rows(self, chosen: Mask) -> Aims:
        """Return some of the beams."""
        return Aims(
            origins_site=self.origins_site[chosen],
            directions_site=self.directions_site[chosen],
            spin_axes_site=self.spin_axes_site[chosen],
        )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Echoes:
    """The strongest echo of each beam.

    Attributes
    ----------
    ranges : (n,)
        Energy-weighted mean distance along the beam; infinite without an echo [m].
    reflectivities : (n,)
        Reflectivity of the surface times its share of the footprint, 0 to 1.
    """

    ranges: Array
    reflectivities: Array

    def __post_init__(self) -> None:
        seal(self, ranges=(None,), reflectivities=(len(self.ranges),))

    def among(self, chosen: Mask) -> Echoes:
        """Return the echoes of all beams; those not chosen have none."""
        ranges, reflectivities = np.full(len(chosen), np.inf), np.zeros(len(chosen))
        ranges[chosen], reflectivities[chosen] = self.ranges, self.reflectivities
        return Echoes(ranges=ranges, reflectivities=reflectivities)


def trace(scene: Scene, aims: Aims, divergence: Array, anyway: Mask | None = None) -> Echoes:
    """Return the strongest echo of each beam.

    With ``anyway``, only these beams and those near spheres are traced.
    """
    cast = caster(scene.mesh)
    ranges = np.full(len(aims.origins_site), np.inf)
    reflectivities = np.zeros(len(ranges))
    is_cast = np.ones(len(ranges), dtype=np.bool_) if anyway is None else anyway
    chosen = aims.rows(is_cast)
    rays = np.hstack([chosen.origins_site, chosen.directions_site]).astype(np.float32)
    ranges[is_cast], reflectivities[is_cast] = cast(rays)
    if anyway is None:
        is_wide = _passes(scene, aims, float(divergence.max()) / 2, 0.0)
        is_wide |= _sees_step(ranges, N_LASERS)
    else:
        is_wide = _passes(scene, aims, 0.0, NEAR)
    wide = aims.rows(is_wide)
    ranges[is_wide], reflectivities[is_wide] = _trace_bundles(scene, cast, wide, divergence)
    return Echoes(ranges=ranges, reflectivities=reflectivities)


def _trace_bundles(
    scene: Scene, cast: Caster, aims: Aims, divergence: Array
) -> tuple[Array, Array]:
    """Return range and reflectivity of beams, each cast as a bundle of rays."""
    n = len(aims.origins_site)
    across = np.cross(aims.directions_site, aims.spin_axes_site)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(across, aims.directions_site)
    directions = _bundles(aims.directions_site, across, along, disc(_N_RAYS) * divergence / 2)
    rays = np.empty((n * _N_RAYS, 6), dtype=np.float32)
    rays[:, :3] = np.repeat(aims.origins_site, _N_RAYS, axis=0)
    rays[:, 3:] = directions.reshape(-1, 3)
    distances, shades = cast(rays)
    spheres = scene.spheres
    found: tuple[Array, Array] = _echoes(
        aims.origins_site,
        directions,
        distances.reshape(n, _N_RAYS),
        shades.reshape(n, _N_RAYS),
        np.column_stack([spheres.p_site, spheres.radii, spheres.reflectivities]),
    )
    return found


def _passes(scene: Scene, aims: Aims, half_width: float, clearance: float) -> Mask:
    """Return which beams pass spheres (or poles, without a clearance) closely enough."""
    spheres, poles = scene.spheres, scene.poles
    reach = np.maximum(spheres.radii, clearance)
    feet = np.concatenate([spheres.p_site, poles.feet_site[: 0 if clearance else None]])
    tops = np.concatenate([spheres.p_site, poles.tops_site[: 0 if clearance else None]])
    radii = np.concatenate([reach, poles.radii[: 0 if clearance else None]])
    found: Mask = _passes_axes(
        aims.origins_site, aims.directions_site, feet, tops - feet, radii, half_width
    )
    return found


def disc(n: int) -> Array:
    """Return points that fill the unit disc evenly, (n, 2) (Vogel, 1979)."""
    k = np.arange(n)
    radii, angles = np.sqrt((k + 0.5) / n), k * np.pi * (3 - np.sqrt(5))
    return np.column_stack([radii * np.cos(angles), radii * np.sin(angles)])


@compiled
def _passes_axes(
    origins: Array, directions: Array, feet: Array, axes: Array, radii: Array, half_width: float
) -> Mask:  # pragma: no cover
    """Return which beams pass one of the axes within its radius and their own half width."""
    found = np.zeros(len(origins), dtype=np.bool_)
    for i in range(len(origins)):
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        for j in range(len(feet)):
            wx, wy = feet[j, 0] - origins[i, 0], feet[j, 1] - origins[i, 1]
            wz = feet[j, 2] - origins[i, 2]
            ax, ay, az = axes[j, 0], axes[j, 1], axes[j, 2]
            wd, ad = wx * dx + wy * dy + wz * dz, ax * dx + ay * dy + az * dz
            # the place on the axis nearest to the line of the beam, clamped to its ends
            square = ax * ax + ay * ay + az * az - ad * ad
            s = 0.0
            if square > 0.0:
                s = min(max((wd * ad - ax * wx - ay * wy - az * wz) / square, 0.0), 1.0)
            along = wd + s * ad
            px, py, pz = wx + s * ax, wy + s * ay, wz + s * az
            away = px * px + py * py + pz * pz - along * along
            if along > 0.0 and away <= (radii[j] + half_width * along) ** 2:
                found[i] = True
                break
    return found


@compiled
def _sees_step(ranges: Array, stride: int) -> Mask:  # pragma: no cover
    """Return which beams differ from the plane through the beams before and after them.

    Along a sweep the inverse range of a plane is linear to first order, however it is tilted. The
    first and last firing have no neighbour on one side and count as steps.
    """
    n = len(ranges)
    found = np.ones(n, dtype=np.bool_)
    for i in range(stride, n - stride):
        before, after = 1.0 / ranges[i - stride], 1.0 / ranges[i + stride]
        if np.isinf(ranges[i]):
            found[i] = before + after > 0.0
        else:
            found[i] = abs(before + after - 2.0 / ranges[i]) * ranges[i] ** 2 > _STEP
    return found


@compiled
def _bundles(
    directions: Array, across: Array, along: Array, offsets: Array
) -> Array:  # pragma: no cover
    """Return the unit vectors of bundles, (n, k, 3), from offsets across and along the axis."""
    n, k = len(directions), len(offsets)
    out = np.empty((n, k, 3))
    for i in range(n):
        for j in range(k):
            u, v = offsets[j, 0], offsets[j, 1]
            stretch = 1.0 / np.sqrt(1.0 + u * u + v * v)
            for m in range(3):
                out[i, j, m] = stretch * (directions[i, m] + u * across[i, m] + v * along[i, m])
    return out


@compiled
def _echoes(
    origins: Array,
    directions: Array,
    distances: Column,
    shades: Column,
    spheres: Array,
) -> tuple[Array, Array]:  # pragma: no cover
    """Return the strongest echo of each bundle: range, and reflectivity times share."""
    n, k = distances.shape
    ranges, reflectivities = np.empty(n), np.empty(n)
    t, shade = np.empty(k), np.empty(k)
    for i in range(n):
        for j in range(k):
            t[j], shade[j] = distances[i, j], shades[i, j]
        for m in range(len(spheres)):
            wx, wy = spheres[m, 0] - origins[i, 0], spheres[m, 1] - origins[i, 1]
            wz, radius = spheres[m, 2] - origins[i, 2], spheres[m, 3]
            distance = np.sqrt(wx * wx + wy * wy + wz * wz)
            for j in range(k):
                dx, dy, dz = directions[i, j, 0], directions[i, j, 1], directions[i, j, 2]
                along = wx * dx + wy * dy + wz * dz
                if along < distance - 2.0 * radius:
                    break  # well beside the bundle or behind it
                inside = radius**2 - (distance**2 - along**2)
                if inside >= 0.0 and 0.0 < along - np.sqrt(inside) < t[j]:
                    t[j], shade[j] = along - np.sqrt(inside), spheres[m, 4]
        ranges[i], reflectivities[i] = _strongest(t, shade)
    return ranges, reflectivities


@compiled
def _strongest(t: Array, shade: Array) -> tuple[float, float]:  # pragma: no cover
    """Return range and reflectivity of the strongest group of returns of one pulse."""
    for i in range(1, len(t)):  # in place: sorted by range, the few rays of a bundle
        ti, shade_i, j = t[i], shade[i], i
        while j > 0 and t[j - 1] > ti:
            t[j], shade[j] = t[j - 1], shade[j - 1]
            j -= 1
        t[j], shade[j] = ti, shade_i
    best_energy, best_range, best_shade = 0.0, np.inf, 0.0
    energy, moment, share = 0.0, 0.0, 0.0
    for j in range(len(t)):
        if np.isinf(t[j]):
            break
        if j and t[j] - t[j - 1] > _MERGE:
            energy, moment, share = 0.0, 0.0, 0.0
        weight = shade[j] / t[j] ** 2
        energy, moment, share = energy + weight, moment + weight * t[j], share + shade[j]
        if energy > best_energy:
            best_energy, best_range, best_shade = energy, moment / energy, share / len(t)
    return best_range, best_shade
