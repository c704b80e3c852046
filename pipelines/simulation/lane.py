"""Markers at chosen distances about one stop, to measure errors against distance."""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.model import Array, ControlMarks
from spheremark.pipelines.simulation.field import MARKER_RADIUS, MAST, Field, Stop, marker_surfaces
from spheremark.pipelines.simulation.scene import Mesh, Scene, terrain_mesh
from spheremark.pipelines.simulation.terrain import Terrain

LANE_DISTANCES = np.arange(5.0, 30.1, 2.5)
"""Distances from the LiDAR to the markers of the range lane [m]."""

_PER_DISTANCE = 8
_HEIGHTS = (0.7, 1.5)  # [m] of the centres above the ground
_HALF = 40.0  # [m] half side of the ground
_LANE = 20  # random stream


def range_lane(
    seed: int, distances: Array = LANE_DISTANCES, per_distance: int = _PER_DISTANCE
) -> Field:
    """Return markers at chosen distances about one stop.

    Parameters
    ----------
    seed : int
        Seed of directions, heights and heading.
    distances : (k,)
        Distances; eleven from 5 to 30 m by default [m].
    per_distance : int
        Markers at each. With more than some 120 in all, near ones would hide others.

    Returns
    -------
    Field
        Level ground with nothing else on it. The 3-D distances from the base's origin are exact.

    Notes
    -----
    Neighbours in direction, 4 degrees apart by default, stand at different distances and hide
    nothing of each other. Simulated with ``only_near_spheres``, a stop gives 88 fits in some
    seconds.
    """
    rng = np.random.default_rng([seed, _LANE])
    lines = np.linspace(-_HALF, _HALF, 81)
    terrain = Terrain(xs=lines, ys=lines.copy(), heights=np.zeros((81, 81)))
    p_site = _ring(rng, distances, per_distance)
    posts, spheres, poles = marker_surfaces(p_site, terrain.height_at(p_site))
    names = tuple(f"D{d * 10:03.0f}-{i + 1}" for i in range(per_distance) for d in distances)
    heading = float(rng.uniform(-np.pi, np.pi))
    return Field(
        scenario="range-lane",
        seed=seed,
        terrain=terrain,
        scene=Scene(
            mesh=Mesh.merged([terrain_mesh(rng, terrain), posts]), spheres=spheres, poles=poles
        ),
        marks=ControlMarks(names=names, p_site=p_site, cov_p_site=np.zeros((len(p_site), 3, 3))),
        marker_radius=MARKER_RADIUS,
        stops=(Stop(name="centre", p_site=np.array([0.0, 0.0, MAST]), heading=heading),),
    )


def _ring(rng: np.random.Generator, distances: Array, per_distance: int) -> Array:
    """Return the centres, (n, 3): distances take turns going round [m]."""
    distances = np.tile(distances, per_distance)
    n = len(distances)
    bearings = (np.arange(n) + rng.uniform(-0.15, 0.15, n) + rng.random()) * 2 * np.pi / n
    heights = rng.uniform(*_HEIGHTS, n)
    reach = np.sqrt(distances**2 - (heights - MAST) ** 2)
    return np.column_stack([reach * np.cos(bearings), reach * np.sin(bearings), heights])
