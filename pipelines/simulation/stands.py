"""What markers and other bodies stand on that is wider than a pole."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.geometry import rot_z
from spheremark.pipelines.model import Array
from spheremark.pipelines.simulation.bodies import box, cylinder
from spheremark.pipelines.simulation.rocks import standing_rock
from spheremark.pipelines.simulation.scene import Mesh, Stick
from spheremark.pipelines.simulation.terrain import Terrain

_Surfaces = tuple[list[Mesh], list[Stick]]

POLE, GROUND = "pole", "ground"
"""What holds a marker that stands on nothing wide."""

_WIDE = 0.3  # share of the bodies that are raised
_TOUCHING, _RODS = 0.5, (0.01, 0.15)  # share that lie on it; else lengths of the rod between [m]
_SUNK = 0.3  # [m] into uneven ground
_HALF_WIDTHS, _ROOMY = (0.12, 0.6), 0.5  # [m] wider for bodies of more than that radius
_OFF = 0.4  # half widths that a body is off the middle
_DRUMS = (0.3, 3.0)  # radii of the body
_PLATES, _LEGS = (0.02, 0.06), (0.015, 0.04)  # [m] thickness of a table, radius of its legs
_HUBS, _SPREADS = (0.03, 0.08), (0.25, 0.6)  # [m] of a tripod; heights that its feet are away
_LEAST = 0.15  # [m] that anything wide is high
_SHADES = (0.05, 0.7)


class Stand(NamedTuple):
    """What a body stands on.

    Attributes
    ----------
    kind : str
        ``pole``, ``ground``, ``crate``, ``drum``, ``rock``, ``table`` or ``tripod``.
    z : float
        Height at which a rod or pole to the body begins [m].
    meshes : sequence of Mesh
        Surfaces of what is wide.
    sticks : sequence of (foot, top, radius)
        Axes of thin poles among them.
    """

    kind: str
    z: float
    meshes: Sequence[Mesh] = ()
    sticks: Sequence[Stick] = ()


class _Body(NamedTuple):
    """The place right below a body [m], the ground below it, its radius, and that of its rod."""

    top: Array
    ground: float
    radius: float
    stem: float

    @property
    def height(self) -> float:
        """Return how high the place is [m]."""
        return float(self.top[2] - self.ground)


def draw_stand(
    rng: np.random.Generator, terrain: Terrain, lowest: Array, radius: float, stem: float
) -> Stand:
    """Draw what holds a body: mostly a pole, or something wide.

    Parameters
    ----------
    rng : Generator
        Random numbers.
    terrain : Terrain
        The ground.
    lowest : (3,)
        Lowest point of the body [m].
    radius, stem : float
        Its radius, and that of a rod below it [m].

    Returns
    -------
    Stand
        ``ground`` for what is too low to stand on anything.
    """
    ground = float(terrain.height_at(lowest))
    is_wide, touches = rng.random() < _WIDE, rng.random() < _TOUCHING
    rod = 0.0 if touches else between(rng, _RODS)
    height = float(lowest[2]) - ground
    if height < _LEAST:
        return Stand(GROUND, ground)
    if not is_wide:
        return Stand(POLE, ground)
    kind = list(_WIDE_ONES)[rng.integers(len(_WIDE_ONES))]
    top = lowest - np.array([0.0, 0.0, min(rod, height - _LEAST)])
    meshes, sticks = _WIDE_ONES[kind](rng, _Body(top, ground, radius, stem))
    return Stand(kind, float(top[2]) - stem, meshes, sticks)


def between(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    """Return a value between bounds, evenly in its logarithm."""
    return float(np.exp(rng.uniform(*np.log(bounds))))


def _plan(rng: np.random.Generator, body: _Body) -> tuple[Array, Array, float]:
    """Draw the middle of a rectangle below a body, its half sides [m], and its heading [rad]."""
    grown = max(1.0, body.radius / _ROOMY)
    half = np.array([grown * between(rng, _HALF_WIDTHS) for _ in range(2)])
    heading = float(rng.uniform(-np.pi, np.pi))
    off = np.append(half * rng.uniform(-_OFF, _OFF, 2), 0.0)
    return body.top + rot_z(heading) @ off, half, heading


def _crate(rng: np.random.Generator, body: _Body) -> _Surfaces:
    """Return a crate, a block or a low wall."""
    middle, half, heading = _plan(rng, body)
    tall = body.height + _SUNK
    middle[2] -= tall / 2
    return [box(middle, (*(2 * half), tall), heading, rng.uniform(*_SHADES))], []


def _drum(rng: np.random.Generator, body: _Body) -> _Surfaces:
    """Return a thick post, a pipe or a drum."""
    radius = min(body.radius * between(rng, _DRUMS), max(_ROOMY, body.radius))
    off = radius * rng.uniform(0.0, _OFF) * rot_z(rng.uniform(-np.pi, np.pi))[:, 0]
    high = body.top + off
    foot = np.append(high[:2], body.ground - _SUNK)
    return [cylinder(foot, high, radius, rng.uniform(*_SHADES))], []


def _rock(rng: np.random.Generator, body: _Body) -> _Surfaces:
    """Return a rock."""
    return [standing_rock(rng, body.top, body.height)], []


def _table(rng: np.random.Generator, body: _Body) -> _Surfaces:
    """Return a table: a plate on four legs."""
    middle, half, heading = _plan(rng, body)
    half = np.maximum(half, 2.0 * body.radius)
    thick, radius, shade = rng.uniform(*_PLATES), rng.uniform(*_LEGS), rng.uniform(*_SHADES)
    middle[2] -= thick / 2
    meshes, sticks = [box(middle, (*(2 * half), thick), heading, shade)], []
    for x in (-1.0, 1.0):
        for y in (-1.0, 1.0):
            high = middle + rot_z(heading) @ np.append(0.9 * half * [x, y], 0.0)
            foot = np.append(high[:2], body.ground - _SUNK)
            meshes.append(cylinder(foot, high, radius, shade))
            sticks.append((foot, high, radius))
    return meshes, sticks


def _tripod(rng: np.random.Generator, body: _Body) -> _Surfaces:
    """Return three legs below a hub."""
    hub, shade = max(rng.uniform(*_HUBS), 1.5 * body.stem), rng.uniform(*_SHADES)
    low = body.top - np.array([0.0, 0.0, min(2.0 * hub, 0.5 * body.height)])
    meshes, sticks = [cylinder(low, body.top, hub, shade)], []
    leg, away, turn = hub * rng.uniform(0.2, 0.5), rng.uniform(*_SPREADS), rng.uniform(0, np.pi)
    for bearing in turn + np.arange(3) * 2 * np.pi / 3:
        aside = rot_z(bearing)[:, 0]
        foot = body.top + away * body.height * aside
        foot[2] = body.ground
        high = low + 0.8 * hub * aside
        meshes.append(cylinder(foot, high, leg, shade))
        sticks.append((foot, high, leg))
    return meshes, sticks


_WIDE_ONES: Mapping[str, Callable[[np.random.Generator, _Body], _Surfaces]] = {
    "crate": _crate,
    "drum": _drum,
    "rock": _rock,
    "table": _table,
    "tripod": _tripod,
}
