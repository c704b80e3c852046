"""The echo of a beam of finite width.

One ray is cast along the centre of every beam. Beams that touch a sphere or a pole, or that lie at
a step in range, are cast again as a bundle that fills the footprint, each ray with the same energy;
the bundle's returns merge and split like those of one pulse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import Array, Column, Index, Mask, seal
from spheremark.pipelines.scan.rigs import N_LASERS
from spheremark.pipelines.simulation.options import Optics, Pick, Profile
from spheremark.pipelines.simulation.scene import Caster, Scene, caster

_N_RAYS = 61  # in a bundle
_STEP = 0.10  # [m] departure of a range from the plane through its neighbours
_LOBE = 0.45  # half width of one of two lobes, in half widths of the footprint
_PICKS = {Pick.STRONGEST: 0, Pick.FIRST: 1, Pick.LAST: 2}
NEAR = 0.25
"""Distance within which a beam passes near a sphere's surface [m]."""


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
    """The recorded echo of each beam.

    Attributes
    ----------
    ranges : (n,)
        Energy-weighted mean distance along the beam; infinite without an echo [m].
    reflectivities : (n,)
        Reflectivity of the surface times its share of the footprint, 0 to 1.
    spheres : (n,)
        Sphere of the scene that at least half of the energy is from, -1 for none.
    """

    ranges: Array
    reflectivities: Array
    spheres: Index

    def __post_init__(self) -> None:
        n = len(self.ranges)
        seal(self, ranges=(None,), reflectivities=(n,), spheres=(n,))

    def among(self, chosen: Mask) -> Echoes:
        """Return the echoes of all beams; those not chosen have none."""
        ranges, reflectivities = np.full(len(chosen), np.inf), np.zeros(len(chosen))
        spheres = np.full(len(chosen), -1)
        ranges[chosen], reflectivities[chosen] = self.ranges, self.reflectivities
        spheres[chosen] = self.spheres
        return Echoes(ranges=ranges, reflectivities=reflectivities, spheres=spheres)


def trace(
    scene: Scene,
    aims: Aims,
    divergence: Array,
    anyway: Mask | None = None,
    optics: Optics = Optics(),  # noqa: B008  frozen
) -> Echoes:
    """Return the recorded echo of each beam.

    With ``anyway``, only these beams and those near spheres are traced.
    """
    cast = caster(scene.mesh)
    ranges = np.full(len(aims.origins_site), np.inf)
    reflectivities, of = np.zeros(len(ranges)), np.full(len(ranges), -1)
    is_cast = np.ones(len(ranges), dtype=np.bool_) if anyway is None else anyway
    chosen = aims.rows(is_cast)
    rays = np.hstack([chosen.origins_site, chosen.directions_site]).astype(np.float32)
    ranges[is_cast], reflectivities[is_cast] = cast(rays, optics.incidence)
    if anyway is None:
        reach = max(1.0, float(np.abs(footprint(optics.profile, _N_RAYS)).max()))
        half_width = reach * float(divergence.max()) / 2
        is_wide = _passes(scene, aims, half_width, reach * max(optics.window) / 2)
        is_wide |= _sees_step(ranges, N_LASERS)
    else:
        is_wide = _passes(scene, aims, 0.0, NEAR)
    wide = aims.rows(is_wide)
    ranges[is_wide], reflectivities[is_wide], of[is_wide] = _trace_bundles(
        scene, cast, wide, divergence, optics
    )
    return Echoes(ranges=ranges, reflectivities=reflectivities, spheres=of)


def _trace_bundles(
    scene: Scene, cast: Caster, aims: Aims, divergence: Array, optics: Optics
) -> tuple[Array, Array, Index]:
    """Return range, reflectivity and sphere of beams, each cast as a bundle of rays."""
    n = len(aims.origins_site)
    across = np.cross(aims.directions_site, aims.spin_axes_site)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(across, aims.directions_site)
    offsets = footprint(optics.profile, _N_RAYS)
    k = len(offsets)
    starts = offsets * np.array(optics.window) / 2
    axes = (across, aims.directions_site, along)
    rays, directions = _bundles(aims.origins_site, axes, starts, offsets * divergence / 2)
    distances, shades = cast(rays.reshape(-1, 6), optics.incidence)
    spheres = scene.spheres
    found: tuple[Array, Array, Index] = _echoes(
        (aims.origins_site, across, along, starts),
        directions,
        distances.reshape(n, k),
        shades.reshape(n, k),
        np.column_stack([spheres.p_site, spheres.radii, spheres.reflectivities]),
        (optics.incidence, optics.gate, optics.energy_half * k, _PICKS[optics.pick]),
    )
    return found


def _passes(scene: Scene, aims: Aims, half_width: float, clearance: float) -> Mask:
    """Return which beams pass spheres (or poles, with a half width) closely enough."""
    spheres, poles = scene.spheres, scene.poles
    n_poles = len(poles.radii) if half_width else 0
    feet = np.concatenate([spheres.p_site, poles.feet_site[:n_poles]])
    tops = np.concatenate([spheres.p_site, poles.tops_site[:n_poles]])
    radii = np.concatenate([spheres.radii, poles.radii[:n_poles]]) + clearance
    found: Mask = _passes_axes(
        aims.origins_site, aims.directions_site, feet, tops - feet, radii, half_width
    )
    return found


def disc(n: int) -> Array:
    """Return points that fill the unit disc evenly, (n, 2) (Vogel, 1979)."""
    k = np.arange(n)
    radii, angles = np.sqrt((k + 0.5) / n), k * np.pi * (3 - np.sqrt(5))
    return np.column_stack([radii * np.cos(angles), radii * np.sin(angles)])


def footprint(profile: Profile, n: int) -> Array:
    """Return about n rays of equal energy: places across and along, in half widths, (k, 2)."""
    if profile is Profile.EVEN:
        return disc(n)
    half = disc(n // 2)
    if profile is Profile.GAUSSIAN:  # within rho lies the share 1 - exp(-2 rho^2)
        squares = (half**2).sum(axis=1, keepdims=True)
        half *= np.sqrt(-0.5 * np.log1p(-squares) / squares)
    else:
        half = half * (_LOBE, 1.0) + (1.0 - _LOBE, 0.0)
    return np.concatenate([half, -half])  # symmetric: a slope moves the mean by curvature alone


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
    origins: Array, axes: tuple[Array, Array, Array], starts: Array, offsets: Array
) -> tuple[Column, Array]:  # pragma: no cover
    """Return the rays of bundles, (n, k, 6), and their directions in full, (n, k, 3).

    ``axes`` are unit vectors across, ahead and along the spin axis; ``starts`` and ``offsets`` are
    places across and along it, at the window and at unit distance.
    """
    across, ahead, along = axes
    n, k = len(origins), len(offsets)
    rays, directions = np.empty((n, k, 6), dtype=np.float32), np.empty((n, k, 3))
    for i in range(n):
        for j in range(k):
            u, v = offsets[j, 0], offsets[j, 1]
            stretch = 1.0 / np.sqrt(1.0 + u * u + v * v)
            for m in range(3):
                one = stretch * (ahead[i, m] + u * across[i, m] + v * along[i, m])
                directions[i, j, m] = rays[i, j, 3 + m] = one
                rays[i, j, m] = (
                    origins[i, m] + starts[j, 0] * across[i, m] + starts[j, 1] * along[i, m]
                )
    return rays, directions


@compiled
def _echoes(
    beams: tuple[Array, Array, Array, Array],
    directions: Array,
    distances: Column,
    shades: Column,
    spheres: Array,
    law: tuple[float, float, float, int],
) -> tuple[Array, Array, Index]:  # pragma: no cover
    """Return the echo of each bundle: range, reflectivity times share, and sphere.

    ``beams`` are origins, axes across and along, and places of the rays on these at the window;
    ``law`` is exponent of the cosine of incidence, gate, least energy and which echo is taken.
    """
    origins, across, along_spin, starts = beams
    n, k = distances.shape
    ranges, reflectivities = np.empty(n), np.empty(n)
    of = np.empty(n, dtype=np.int64)
    t, shade, label = np.empty(k), np.empty(k), np.empty(k, dtype=np.int64)
    for i in range(n):
        for j in range(k):
            t[j], shade[j], label[j] = distances[i, j], shades[i, j], -1
        for m in range(len(spheres)):
            radius = spheres[m, 3]
            for j in range(k):
                u, v = starts[j, 0], starts[j, 1]
                wx = spheres[m, 0] - origins[i, 0] - u * across[i, 0] - v * along_spin[i, 0]
                wy = spheres[m, 1] - origins[i, 1] - u * across[i, 1] - v * along_spin[i, 1]
                wz = spheres[m, 2] - origins[i, 2] - u * across[i, 2] - v * along_spin[i, 2]
                distance2 = wx * wx + wy * wy + wz * wz
                dx, dy, dz = directions[i, j, 0], directions[i, j, 1], directions[i, j, 2]
                along = wx * dx + wy * dy + wz * dz
                if along < np.sqrt(distance2) - 2.0 * radius:
                    break  # well beside the bundle or behind it
                inside = radius**2 - (distance2 - along**2)
                if inside >= 0.0 and 0.0 < along - np.sqrt(inside) < t[j]:
                    t[j], shade[j], label[j] = along - np.sqrt(inside), spheres[m, 4], m
                    if law[0] > 0.0:
                        shade[j] *= (np.sqrt(inside) / radius) ** law[0]
        ranges[i], reflectivities[i], of[i] = _picked(t, shade, label, law)
    return ranges, reflectivities, of


@compiled
def _picked(
    t: Array, shade: Array, label: Index, law: tuple[float, float, float, int]
) -> tuple[float, float, int]:  # pragma: no cover
    """Return range, reflectivity and sphere of the echo of a pulse that is recorded."""
    _, gate, least, pick = law
    for i in range(1, len(t)):  # in place: sorted by range, the few rays of a bundle
        ti, shade_i, label_i, j = t[i], shade[i], label[i], i
        while j > 0 and t[j - 1] > ti:
            t[j], shade[j], label[j] = t[j - 1], shade[j - 1], label[j - 1]
            j -= 1
        t[j], shade[j], label[j] = ti, shade_i, label_i
    best_energy, best_range, best_shade, best_of, begin = 0.0, np.inf, 0.0, -1, 0
    while begin < len(t) and t[begin] < np.inf:
        energy, moment, share, own, of, end = 0.0, 0.0, 0.0, 0.0, -1, begin
        while end < len(t) and t[end] < np.inf and (end == begin or t[end] - t[end - 1] <= gate):
            weight = shade[end] / t[end] ** 2
            energy, moment, share = energy + weight, moment + weight * t[end], share + shade[end]
            if of < 0:
                of = label[end]
            if of >= 0 and label[end] == of:
                own += weight
            end += 1
        begin = end
        if pick == 0 or (energy < least and best_energy < least):
            takes = energy > best_energy
        elif pick == 1:
            takes = best_energy < least
        else:
            takes = energy >= least
        if takes:
            best_energy, best_range, best_shade = energy, moment / energy, share / len(t)
            best_of = of if 2.0 * own >= energy else -1
    return best_range, best_shade, best_of
