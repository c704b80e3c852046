"""Fields with objects that are no markers; where these stand.

Items stand clear of stops, of markers and of each other, and none but the screens stands between
the centre stop and a marker; from other stops they may hide one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from spheremark.pipelines.model import Array
from spheremark.pipelines.simulation import objects
from spheremark.pipelines.simulation.bodies import box
from spheremark.pipelines.simulation.field import Decoy, Field, Stop, paper_field
from spheremark.pipelines.simulation.objects import WALL_SHADE, Builder, Item, Site
from spheremark.pipelines.simulation.scene import Mesh, Scene, Spheres

_STOP_CLEAR = 0.9  # [m] from a stop to the nearest item
_MARK_CLEAR = 0.45  # [m] from a marker to the nearest item that is placed by chance
_SIGHT_CLEAR = 0.25  # [m] from a line of sight of the centre stop to the nearest item before it
_RING = (4.0, 14.0)  # [m] from the centre stop to items
_WALL_RING = (11.5, 15.5)  # [m] the same for walls
_ROCK_RING = (2.5, 14.0)  # [m] the same for rocks
_N_TRIES = 400  # places that are tried for an item before it is left out
_N_PANELS, _N_SCREENS = 4, 3  # markers with a panel close behind them, and half before them
_PANEL_GAPS = (0.3, 1.0)  # [m] from a marker's centre to the panel behind it
_SCREEN_GAPS = (0.5, 1.2)  # [m] from a marker's centre to the screen before it
_HIDDEN = (0.2, 0.5)  # share of a marker that a screen hides from the centre stop
_WRONG_RADII = (0.06, 0.15, 0.25)  # [m] of balls that are no markers
_CLUTTER, _ROCKS = 10, 11  # random streams


@dataclass(slots=True, eq=False)
class Ground:
    """The occupied places of a field: finds free ones."""

    world: Field
    eye: Stop  # from which no item may hide a marker ...
    hides: bool = False  # ... unless it may
    taken: list[tuple[float, float, float]] = field(default_factory=list)  # x, y, radius [m]

    @property
    def centre(self) -> Array:
        """Return the place of that stop, x and y [m]."""
        return self.eye.p_site[:2]

    def place(
        self, rng: np.random.Generator, ring: tuple[float, float], radius: float
    ) -> Array | None:
        """Return a free place on the ground, (3,) [m], and occupy it; None if there is none."""
        for _ in range(_N_TRIES):
            distance = np.sqrt(rng.uniform(ring[0] ** 2, ring[1] ** 2))
            bearing = rng.uniform(-np.pi, np.pi)
            xy = self.centre + distance * np.array([np.cos(bearing), np.sin(bearing)])
            if self._is_free(xy, radius):
                self.taken.append((float(xy[0]), float(xy[1]), radius))
                return np.append(xy, self.world.terrain.height_at(xy))
        return None

    def _is_free(self, xy: Array, radius: float) -> bool:
        """Return whether a place is free and hides no marker from the centre stop."""
        stops, ball = np.array([s.p_site[:2] for s in self.world.stops]), self.world.marker_radius
        marks = self.world.marks.p_site[:, :2]
        taken = np.array(self.taken).reshape(-1, 3)
        sights = marks - self.centre
        along = np.clip((xy - self.centre) @ sights.T / (sights**2).sum(axis=1), 0.0, 1.0)
        beside = np.hypot(*(self.centre + along[:, None] * sights - xy).T)
        return bool(
            np.hypot(*(stops - xy).T).min() > radius + _STOP_CLEAR
            and (np.hypot(*(marks - xy).T) > radius + max(_MARK_CLEAR, ball + 0.35)).all()
            and (
                self.hides or (beside[along < 1.0] > radius + max(_SIGHT_CLEAR, ball + 0.15)).all()
            )
            and (np.hypot(*(taken[:, :2] - xy).T) > radius + taken[:, 2]).all()
        )


def clutter_field(seed: int) -> Field:
    """Return the published field among objects that might be mistaken for a marker.

    Notes
    -----
    Panels stand 0.3 to 1 m behind four markers, and the edge of a screen hides 20 to 50 % of three
    others from the centre stop. Beyond them: walls and a corner of walls, people with heads of
    0.10 to 0.12 m, trees of trunk and leaves, poles without a ball, barrels and pipes (one pipe as
    wide as a marker), balls of radius 0.06, 0.15 and 0.25 m on poles and on the ground, and nearly
    round rocks of marker size on the ground and on top of others.
    """
    world = paper_field(seed)
    rng = np.random.default_rng([seed, _CLUTTER])
    ground = Ground(world, world.stops[len(world.stops) // 2])
    items = _beside_markers(rng, ground)
    kinds: list[tuple[int, tuple[float, float], float, Builder]] = [
        (2, _WALL_RING, 2.0, objects.wall),
        (1, _WALL_RING, 2.0, objects.corner),
        (3, _RING, 1.1, objects.tree),
        (4, _RING, 0.35, objects.person),
        (2, _RING, 0.35, objects.barrel),
        (2, _RING, 0.15, objects.upright_pipe),
        (2, _RING, 0.8, objects.lying_pipe),
        (6, _RING, 0.1, objects.bare_pole),
        *((1, _RING, r + 0.1, objects.ball_on_pole(r)) for r in _WRONG_RADII),
        *((1, _RING, r + 0.1, objects.ball_on_ground(r)) for r in _WRONG_RADII),
        (15, _ROCK_RING, 0.2, objects.a_round_rock),
        (5, _ROCK_RING, 0.35, objects.perched_rock),
    ]
    for n, ring, radius, builder in kinds:
        items += placed(rng, ground, (n, ring, radius), builder)
    return with_items(world, "clutter-field", items)


def rock_field(seed: int) -> Field:
    """Return the published field among many nearly round rocks of marker size."""
    world = paper_field(seed)
    rng = np.random.default_rng([seed, _ROCKS])
    ground = Ground(world, world.stops[len(world.stops) // 2])
    items = placed(rng, ground, (40, _ROCK_RING, 0.35), objects.perched_rock)
    items += placed(rng, ground, (200, _ROCK_RING, 0.15), objects.a_round_rock)
    return with_items(world, "rock-field", items)


def placed(
    rng: np.random.Generator,
    ground: Ground,
    number_ring_radius: tuple[int, tuple[float, float], float],
    builder: Builder,
) -> list[Item]:
    """Return items of one kind, fewer than the number if their ring has no free place."""
    n, ring, radius = number_ring_radius
    places = [ground.place(rng, ring, radius) for _ in range(n)]
    site = Site(terrain=ground.world.terrain, radius=ground.world.marker_radius)
    return [builder(rng, place, site) for place in places if place is not None]


def with_items(world: Field, scenario: str, items: Sequence[Item]) -> Field:
    """Return a field with more items on it."""
    scene = world.scene
    balls = [ball for item in items for ball in item.balls]
    sticks = [stick for item in items for stick in item.sticks]
    spheres = Spheres(
        p_site=np.vstack([scene.spheres.p_site, *(p for p, _, _ in balls)]),
        radii=np.append(scene.spheres.radii, [radius for _, radius, _ in balls]),
        reflectivities=np.append(scene.spheres.reflectivities, [shade for _, _, shade in balls]),
    )
    mesh = Mesh.merged([scene.mesh, *(mesh for item in items for mesh in item.meshes)])
    decoys = tuple(
        Decoy(name=f"X{i + 1:03d}", kind=item.kind, p_site=np.array(item.p_site), reach=item.reach)
        for i, item in enumerate(items)
    )
    return replace(
        world,
        scenario=scenario,
        scene=Scene(mesh=mesh, spheres=spheres, poles=scene.poles.joined(sticks)),
        decoys=decoys,
    )


def _beside_markers(rng: np.random.Generator, ground: Ground) -> list[Item]:
    """Return panels behind some markers and screens before the edges of some others."""
    marks = ground.world.marks.p_site
    chosen = rng.permutation(len(marks))[: _N_PANELS + _N_SCREENS]
    items = [panel(rng, ground.centre, marks[i], _PANEL_GAPS) for i in chosen[:_N_PANELS]]
    items += [screen(rng, ground, marks[i]) for i in chosen[_N_PANELS:]]
    ground.taken += [(float(item.p_site[0]), float(item.p_site[1]), 0.7) for item in items]
    return items


def panel(
    rng: np.random.Generator,
    centre: Array,
    mark: Array,
    gaps: tuple[float, float],
    scale: float = 1.0,
) -> Item:
    """Return a panel close behind a marker's centre, turned by up to 30 degrees."""
    sight = mark[:2] - centre
    heading = float(np.arctan2(sight[1], sight[0]))
    place = mark.copy()
    place[:2] += sight / np.linalg.norm(sight) * rng.uniform(*gaps)
    sides = (0.02, scale * rng.uniform(0.8, 1.4), scale * rng.uniform(0.7, 1.2))
    turn = heading + np.radians(rng.uniform(-30.0, 30.0))
    return Item(kind="panel", p_site=place, meshes=[box(place, sides, turn, WALL_SHADE)])


def screen(rng: np.random.Generator, ground: Ground, mark: Array) -> Item:
    """Return a screen whose upright edge hides part of a marker from the stop.

    A share h of a disc of unit radius lies beyond a chord at c where pi h = acos c - c sqrt(1-c^2).
    """
    chords = np.linspace(-1.0, 1.0, 2001)
    shares = (np.arccos(chords) - chords * np.sqrt(1.0 - chords**2)) / np.pi
    eye, radius = ground.eye.p_site, ground.world.marker_radius
    edge = radius * float(np.interp(-rng.uniform(*_HIDDEN), -shares, chords))
    sight = mark - eye
    distance = float(np.linalg.norm(sight))
    share = 1.0 - rng.uniform(*_SCREEN_GAPS) / distance  # of the way from the stop to the marker
    wide = max(1.0, radius / 0.1)
    width, height = wide * rng.uniform(0.4, 0.7), wide * rng.uniform(0.5, 0.9)
    left = np.array([-sight[1], sight[0], 0.0]) / np.hypot(sight[0], sight[1])
    side = rng.choice([-1.0, 1.0])
    place = eye + share * sight + side * left * (share * edge + width / 2)
    heading = float(np.arctan2(sight[1], sight[0]))
    mesh = box(place, (0.01, width, height), heading, WALL_SHADE)
    return Item(kind="screen", p_site=place, meshes=[mesh])
