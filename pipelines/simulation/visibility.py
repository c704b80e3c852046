"""Visible share of spheres from a place."""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.model import Array
from spheremark.pipelines.simulation.echo import disc
from spheremark.pipelines.simulation.scene import Scene, caster

_N_LINES = 400  # over the disc of a sphere: shares are good to a percent
_TOUCH = 1e-3  # [m]: a surface this near to the sphere is the sphere itself


def visible_shares(scene: Scene, p_site: Array, radius: float, eye_site: Array) -> Array:
    """Return the share of each sphere's disc that nothing hides.

    Parameters
    ----------
    scene : Scene
        All surfaces.
    p_site : (n, 3)
        Centres of the spheres, which are part of the scene [m].
    radius : float
        Their radius [m].
    eye_site : (3,)
        Point of view [m].

    Returns
    -------
    (n,)
        Shares, 0 to 1; the part that a pole below the sphere covers does not count as hidden.
    """
    return np.array([_visible_share(scene, centre, radius, eye_site) for centre in p_site])


def _visible_share(scene: Scene, centre: Array, radius: float, eye_site: Array) -> float:
    """Return the share of the lines of sight to a sphere on which nothing comes before it."""
    away = centre - eye_site
    distance = float(np.linalg.norm(away))
    ahead = away / distance
    aside = np.cross(ahead, [0.0, 0.0, 1.0])
    aside /= np.linalg.norm(aside)
    reach = radius * np.sqrt(1.0 - (radius / distance) ** 2)  # of the limb off the line of sight
    nearer = distance - radius**2 / distance  # of the limb's plane
    lines = nearer * ahead + reach * disc(_N_LINES) @ np.stack([aside, np.cross(aside, ahead)])
    lines /= np.linalg.norm(lines, axis=1, keepdims=True)
    rays = np.hstack([np.tile(eye_site, (len(lines), 1)), lines]).astype(np.float32)
    met, _ = caster(scene.mesh)(rays)
    hidden = met < distance - radius - _TOUCH
    is_other = np.linalg.norm(scene.spheres.p_site - centre, axis=1) > _TOUCH
    others, sizes = scene.spheres.p_site[is_other], scene.spheres.radii[is_other]
    for other, size in zip(others - eye_site, sizes, strict=True):
        along = lines @ other
        passes = other @ other - along**2 <= size**2
        hidden |= passes & (along > 0.0) & (along < distance)
    return float(np.mean(~hidden))
