"""Sites: from a simulated world, or from heights on a grid."""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.errors import InputError
from spheremark.pipelines.model import Array
from spheremark.pipelines.placement.plan import Arrangement, Site, Stops
from spheremark.pipelines.simulation import Field
from spheremark.pipelines.simulation.rocks import ball
from spheremark.pipelines.simulation.scene import Mesh, caster

CELLS_MAX = 16_000_000
"""Nodes of a terrain at most; a tenth of a metre over 400 m square."""

_CELL = 0.1  # [m] of a simulated world's map
_CELL_WIDEST = 10.0  # [m] of a terrain
_HALF = 30.0  # [m] half side of that map
_ABOVE = 60.0  # [m] from where its surface is probed
_STEEP = 0.35  # share of a face that is seen from above below which it is sampled besides
_PARTS_MAX = 400  # that an edge is cut into at most: 20 m
_BALL_LEVEL = 3  # of its subdivision: flats lie within half a hundredth of the radius
_POLE_HEIGHTS = (0.62, 1.50)  # [m] the study's


def site_of_field(world: Field) -> Site:
    """Return the site of a simulated world: its ground and everything on it except its markers.

    Parameters
    ----------
    world : Field
        The world.

    Returns
    -------
    Site
        On a grid of 0.1 m, 60 m square.

    Notes
    -----
    The surface is probed from above, so that what overhangs reaches down to the ground; upright
    faces, which a probe from above may miss, are sampled besides and raise the nodes around. It
    hides too much rather than too little; rays at the triangles decide what it hides.
    """
    lines = np.arange(-_HALF, _HALF + _CELL / 2, _CELL)
    x, y = np.meshgrid(lines, lines)
    ground = world.terrain.height_at(np.stack([x, y], axis=-1))
    mesh = _without_markers(world)
    surface = np.maximum(ground, _probed(mesh, x, y).reshape(x.shape))
    _burn(surface, lines, _on_steep(mesh))
    surface = np.maximum(surface, _balls(world, x, y))
    return Site(
        name=f"{world.scenario}, seed {world.seed}",
        xs=lines,
        ys=lines.copy(),
        ground=np.asarray(ground),
        surface=surface,
        pole_heights=_POLE_HEIGHTS,
        marker_radius=world.marker_radius,
        bodies=Mesh.merged([mesh, *_ball_meshes(world)]),
    )


def stops_of_field(world: Field) -> Stops:
    """Return the stops of a simulated world, in the order of driving.

    Parameters
    ----------
    world : Field
        The world.

    Returns
    -------
    Stops
        Positions of the LiDAR, and its headings.
    """
    return Stops(
        names=tuple(stop.name for stop in world.stops),
        p_site=np.array([stop.p_site for stop in world.stops]),
        headings=np.array([stop.heading for stop in world.stops]),
    )


def marks_of_field(world: Field) -> Arrangement:
    """Return the marks of a simulated world as an arrangement.

    Parameters
    ----------
    world : Field
        The world.

    Returns
    -------
    Arrangement
        Its marks.
    """
    return Arrangement(names=world.marks.names, p_site=np.array(world.marks.p_site))


def _without_markers(world: Field) -> Mesh:
    """Return the mesh of a world without the poles of its markers."""
    poles, mesh = world.scene.poles, world.scene.mesh
    middles = mesh.p_site[mesh.triangles].mean(axis=1)
    away = np.full(len(middles), np.inf)
    for foot, top in zip(poles.feet_site, poles.tops_site, strict=True):
        is_near = (middles[:, 2] > foot[2] - 0.01) & (middles[:, 2] < top[2] + 0.01)
        gap = np.hypot(middles[:, 0] - foot[0], middles[:, 1] - foot[1])
        away = np.where(is_near, np.minimum(away, gap), away)
    keep = away > 1.5 * (poles.radii.max() if len(poles.radii) else 0.0)
    return Mesh(
        p_site=mesh.p_site.copy(),
        triangles=mesh.triangles[keep],
        reflectivities=mesh.reflectivities[keep],
    )


def _on_steep(mesh: Mesh) -> Array:
    """Return points on the steep triangles of a mesh, half a cell apart, (n, 3) [m]."""
    a, b, c = np.moveaxis(mesh.p_site[mesh.triangles], 1, 0)
    normals = np.cross(b - a, c - a)
    areas = np.linalg.norm(normals, axis=1)
    is_steep = np.abs(normals[:, 2]) < _STEEP * areas
    a, b, c = a[is_steep], b[is_steep], c[is_steep]
    edges = np.maximum(np.linalg.norm(b - a, axis=1), np.linalg.norm(c - a, axis=1))
    n_parts = np.minimum(np.ceil(2.0 * edges / _CELL).astype(np.intp), _PARTS_MAX)
    points = [np.zeros((0, 3))]
    for n in np.unique(n_parts):
        u, v = np.meshgrid(np.arange(n + 1) / max(n, 1), np.arange(n + 1) / max(n, 1))
        u, v = u[u + v <= 1.0 + 1e-9], v[u + v <= 1.0 + 1e-9]
        some = n_parts == n
        along = (
            u[None, :, None] * (b - a)[some][:, None] + v[None, :, None] * (c - a)[some][:, None]
        )
        points.append((a[some][:, None] + along).reshape(-1, 3))
    return np.concatenate(points)


def _burn(surface: Array, lines: Array, points: Array) -> None:
    """Raise the nodes about points to their heights, in place."""
    cells = np.floor((points[:, :2] - lines[0]) / _CELL).astype(np.intp)
    inside = ((cells >= 0) & (cells < len(lines) - 1)).all(axis=1)
    i, j = cells[inside].T
    for right, up in ((0, 0), (0, 1), (1, 0), (1, 1)):
        np.maximum.at(surface, (j + up, i + right), points[inside, 2])


def _others(world: Field) -> list[tuple[Array, float]]:
    """Return centres and radii of the spheres that are no marker [m]."""
    balls = zip(world.scene.spheres.p_site, world.scene.spheres.radii, strict=True)
    marks = world.marks.p_site
    return [
        (centre, float(radius))
        for centre, radius in balls
        if np.linalg.norm(marks - centre, axis=1).min(initial=np.inf) > 1e-3
    ]


def _balls(world: Field, x: Array, y: Array) -> Array:
    """Return the height of the highest sphere that is no marker over places; minus infinity [m]."""
    tops = np.full(x.shape, -np.inf)
    for centre, radius in _others(world):
        rise2 = radius**2 - (x - centre[0]) ** 2 - (y - centre[1]) ** 2
        tops = np.where(rise2 > 0, np.maximum(tops, centre[2] + np.sqrt(np.abs(rise2))), tops)
    return np.asarray(tops)


def _ball_meshes(world: Field) -> list[Mesh]:
    """Return the spheres that are no marker as triangles."""
    directions, triangles = ball(_BALL_LEVEL)
    return [
        Mesh.even(centre + radius * directions, triangles.copy(), 0.5)
        for centre, radius in _others(world)
    ]


def _probed(mesh: Mesh, x: Array, y: Array) -> Array:
    """Return the height of the highest triangle over places; minus infinity over none [m]."""
    rays = np.zeros((x.size, 6), np.float32)
    rays[:, 0], rays[:, 1], rays[:, 2], rays[:, 5] = x.ravel(), y.ravel(), _ABOVE, -1.0
    met, _ = caster.__wrapped__(mesh)(rays)
    return np.where(np.isfinite(met), _ABOVE - met.astype(np.float64), -np.inf)


def site_of_grid(
    name: str, xs: Array, ys: Array, heights: Array, *, surface: Array | None = None
) -> Site:
    """Return the site of an elevation model.

    Parameters
    ----------
    name : str
        Where it comes from, for people.
    xs, ys : (n,), (m,)
        Lines of an even grid, ascending [m].
    heights : (m, n)
        Heights, rows along y; NaN where they are not known [m].
    surface : (m, n), optional
        Heights of what hides; the ground itself by default [m].

    Returns
    -------
    Site
        With the usual poles and markers.

    Raises
    ------
    InputError
        If the grid is too small, too large or too coarse, uneven, or knows no height at all.
    """
    if heights.size > CELLS_MAX:
        raise InputError(
            f"{name} has {heights.size:,} cells; {CELLS_MAX:,} are the most. Take a part of it or "
            "wider cells."
        )
    if min(heights.shape) < 2 or not np.isfinite(heights).any():
        raise InputError(f"{name} holds no terrain: none of {heights.size:,} cells has a height.")
    steps = np.concatenate([np.diff(xs), np.diff(ys)])
    if not (steps.min() > 0 and np.ptp(steps) <= 1e-3 * steps.mean()):
        raise InputError(
            f"The cells of {name} are {steps.min():g} to {steps.max():g} m wide; an even grid of "
            "square cells is needed. Resample it (gdalwarp -tr)."
        )
    if steps.mean() > _CELL_WIDEST:
        raise InputError(
            f"The cells of {name} are {steps.mean():g} m wide; marks stand some metres from stops, "
            f"and {_CELL_WIDEST:g} m is the most. If its unit is not the metre, reproject it "
            "(gdalwarp)."
        )
    ground = np.array(heights, dtype=np.float64)
    top = ground.copy() if surface is None else np.fmax(surface, ground)
    return Site(
        name=name,
        xs=np.array(xs, np.float64),
        ys=np.array(ys, np.float64),
        ground=ground,
        surface=top,
    )
