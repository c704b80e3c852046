"""Objects that are no markers: walls, panels, people, trees, poles, pipes, balls and round rocks.

Each one is an ``Item``: surfaces, and the place where it might be mistaken for a marker.
Items stand clear of stops, of markers and of each other, and none but the screens stands between
the centre stop and a marker; from other stops they may hide one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from spheremark.pipelines.geometry import rot_z
from spheremark.pipelines.model import Array
from spheremark.pipelines.simulation.bodies import box, cylinder, ellipsoid, leaves
from spheremark.pipelines.simulation.field import MARKER_RADIUS, Decoy, Field, paper_field
from spheremark.pipelines.simulation.rocks import round_rock
from spheremark.pipelines.simulation.scene import Mesh, Poles, Scene, Spheres, pole_mesh
from spheremark.pipelines.simulation.terrain import Terrain

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
_HEAD_RADII = (0.10, 0.12)  # [m]
_ROCK_RADII = (0.085, 0.12)  # [m] of rocks that are as large as a marker
_CLUTTER, _ROCKS = 10, 11  # random streams
# Diffuse reflectivities at 905 nm.
_WALL_SHADE, _CLOTH_SHADE, _SKIN_SHADE = 0.40, 0.30, 0.50
_BARK_SHADE, _BALL_SHADE, _PIPE_SHADE = 0.25, 0.50, 0.35


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Item:
    """One object that is no marker.

    Attributes
    ----------
    kind : str
        Kind of object.
    p_site : (3,)
        Where it might be mistaken for a marker [m].
    meshes : sequence of Mesh
        Its surfaces.
    balls : sequence of (p_site, radius, reflectivity)
        Exact spheres that belong to it.
    sticks : sequence of (foot, top, radius)
        Axes of thin poles among the meshes, on which beams are traced as bundles.
    """

    kind: str
    p_site: Array
    meshes: Sequence[Mesh]
    balls: Sequence[tuple[Array, float, float]] = ()
    sticks: Sequence[tuple[Array, Array, float]] = ()


Builder = Callable[[np.random.Generator, Array], Item]


@dataclass(slots=True, eq=False)
class _Ground:
    """The occupied places of a field: finds free ones."""

    world: Field
    taken: list[tuple[float, float, float]] = field(default_factory=list)  # x, y, radius [m]

    @property
    def centre(self) -> Array:
        """Return the centre stop, x and y [m]."""
        return self.world.stops[len(self.world.stops) // 2].p_site[:2]

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
        stops = np.array([stop.p_site[:2] for stop in self.world.stops])
        marks = self.world.marks.p_site[:, :2]
        taken = np.array(self.taken).reshape(-1, 3)
        sights = marks - self.centre
        along = np.clip((xy - self.centre) @ sights.T / (sights**2).sum(axis=1), 0.0, 1.0)
        beside = np.hypot(*(self.centre + along[:, None] * sights - xy).T)
        return bool(
            np.hypot(*(stops - xy).T).min() > radius + _STOP_CLEAR
            and np.hypot(*(marks - xy).T).min() > radius + _MARK_CLEAR
            and (beside[along < 1.0] > radius + _SIGHT_CLEAR).all()
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
    ground = _Ground(world)
    items = _beside_markers(rng, ground)
    kinds: list[tuple[int, tuple[float, float], float, Builder]] = [
        (2, _WALL_RING, 2.0, _wall),
        (1, _WALL_RING, 2.0, _corner),
        (3, _RING, 1.1, _tree),
        (4, _RING, 0.35, _person),
        (2, _RING, 0.35, _barrel),
        (2, _RING, 0.15, _upright_pipe),
        (2, _RING, 0.8, _lying_pipe),
        (6, _RING, 0.1, _bare_pole(world.terrain)),
        *((1, _RING, r + 0.1, _ball_on_pole(world.terrain, r)) for r in _WRONG_RADII),
        *((1, _RING, r + 0.1, _ball_on_ground(r)) for r in _WRONG_RADII),
        (15, _ROCK_RING, 0.2, _round_rock),
        (5, _ROCK_RING, 0.35, _perched_rock),
    ]
    for n, ring, radius, builder in kinds:
        items += _placed(rng, ground, (n, ring, radius), builder)
    return _with_items(world, "clutter-field", items)


def rock_field(seed: int) -> Field:
    """Return the published field among many nearly round rocks of marker size."""
    world = paper_field(seed)
    rng = np.random.default_rng([seed, _ROCKS])
    ground = _Ground(world)
    items = _placed(rng, ground, (40, _ROCK_RING, 0.35), _perched_rock)
    items += _placed(rng, ground, (200, _ROCK_RING, 0.15), _round_rock)
    return _with_items(world, "rock-field", items)


def _placed(
    rng: np.random.Generator,
    ground: _Ground,
    number_ring_radius: tuple[int, tuple[float, float], float],
    builder: Builder,
) -> list[Item]:
    """Return items of one kind, fewer than the number if their ring has no free place."""
    n, ring, radius = number_ring_radius
    places = [ground.place(rng, ring, radius) for _ in range(n)]
    return [builder(rng, place) for place in places if place is not None]


def _with_items(world: Field, scenario: str, items: Sequence[Item]) -> Field:
    """Return a field with more items on it."""
    scene = world.scene
    balls = [ball for item in items for ball in item.balls]
    sticks = [stick for item in items for stick in item.sticks]
    spheres = Spheres(
        p_site=np.vstack([scene.spheres.p_site, *(p for p, _, _ in balls)]),
        radii=np.append(scene.spheres.radii, [radius for _, radius, _ in balls]),
        reflectivities=np.append(scene.spheres.reflectivities, [shade for _, _, shade in balls]),
    )
    poles = Poles(
        feet_site=np.vstack([scene.poles.feet_site, *(foot for foot, _, _ in sticks)]),
        tops_site=np.vstack([scene.poles.tops_site, *(top for _, top, _ in sticks)]),
        radii=np.append(scene.poles.radii, [radius for _, _, radius in sticks]),
    )
    mesh = Mesh.merged([scene.mesh, *(mesh for item in items for mesh in item.meshes)])
    decoys = tuple(
        Decoy(name=f"X{i + 1:03d}", kind=item.kind, p_site=np.array(item.p_site))
        for i, item in enumerate(items)
    )
    return replace(
        world,
        scenario=scenario,
        scene=Scene(mesh=mesh, spheres=spheres, poles=poles),
        decoys=decoys,
    )


def _beside_markers(rng: np.random.Generator, ground: _Ground) -> list[Item]:
    """Return panels behind some markers and screens before the edges of some others."""
    marks = ground.world.marks.p_site
    chosen = rng.permutation(len(marks))[: _N_PANELS + _N_SCREENS]
    items = [_panel(rng, ground.centre, marks[i]) for i in chosen[:_N_PANELS]]
    items += [_screen(rng, ground.world, marks[i]) for i in chosen[_N_PANELS:]]
    ground.taken += [(float(item.p_site[0]), float(item.p_site[1]), 0.7) for item in items]
    return items


def _panel(rng: np.random.Generator, centre: Array, mark: Array) -> Item:
    """Return a panel close behind a marker, turned by up to 30 degrees."""
    sight = mark[:2] - centre
    heading = float(np.arctan2(sight[1], sight[0]))
    place = mark.copy()
    place[:2] += sight / np.linalg.norm(sight) * rng.uniform(*_PANEL_GAPS)
    sides = (0.02, rng.uniform(0.8, 1.4), rng.uniform(0.7, 1.2))
    turn = heading + np.radians(rng.uniform(-30.0, 30.0))
    return Item(kind="panel", p_site=place, meshes=[box(place, sides, turn, _WALL_SHADE)])


def _screen(rng: np.random.Generator, world: Field, mark: Array) -> Item:
    """Return a screen whose upright edge hides part of a marker from the centre stop.

    A share h of a disc of unit radius lies beyond a chord at c where pi h = acos c - c sqrt(1-c^2).
    """
    chords = np.linspace(-1.0, 1.0, 2001)
    shares = (np.arccos(chords) - chords * np.sqrt(1.0 - chords**2)) / np.pi
    edge = MARKER_RADIUS * float(np.interp(-rng.uniform(*_HIDDEN), -shares, chords))
    eye = world.stops[len(world.stops) // 2].p_site
    sight = mark - eye
    distance = float(np.linalg.norm(sight))
    share = 1.0 - rng.uniform(*_SCREEN_GAPS) / distance  # of the way from the stop to the marker
    width, height = rng.uniform(0.4, 0.7), rng.uniform(0.5, 0.9)
    left = np.array([-sight[1], sight[0], 0.0]) / np.hypot(sight[0], sight[1])
    side = rng.choice([-1.0, 1.0])
    place = eye + share * sight + side * left * (share * edge + width / 2)
    heading = float(np.arctan2(sight[1], sight[0]))
    mesh = box(place, (0.01, width, height), heading, _WALL_SHADE)
    return Item(kind="screen", p_site=place, meshes=[mesh])


def _above(place: Array, height: float) -> Array:
    """Return a place raised by a height."""
    return np.asarray(place + np.array([0.0, 0.0, height]))


def _wall(rng: np.random.Generator, foot: Array) -> Item:
    """Return a straight wall."""
    height = rng.uniform(1.6, 2.6)
    place = _above(foot, height / 2 - 0.1)
    sides = (rng.uniform(3.0, 4.0), 0.15, height)
    mesh = box(place, sides, rng.uniform(0.0, np.pi), _WALL_SHADE)
    return Item(kind="wall", p_site=place, meshes=[mesh])


def _corner(rng: np.random.Generator, foot: Array) -> Item:
    """Return two walls that meet at a right angle; the corner points at the middle of the field."""
    length, height = 1.8, rng.uniform(1.6, 2.6)
    inwards = np.arctan2(-foot[1], -foot[0])
    meshes = []
    for turn in (0.75 * np.pi, -0.75 * np.pi):
        away = rot_z(inwards + turn) @ [length / 2, 0.0, 0.0]
        place = _above(foot + away, height / 2 - 0.1)
        meshes.append(box(place, (length, 0.15, height), inwards + turn, _WALL_SHADE))
    return Item(kind="corner", p_site=_above(foot, height / 2), meshes=meshes)


def _person(rng: np.random.Generator, foot: Array) -> Item:
    """Return a standing person: legs, trunk, arms, neck and a head about as wide as a marker."""
    tall, turn = rng.uniform(0.92, 1.08), rot_z(rng.uniform(-np.pi, np.pi))

    def at(x: float, y: float, z: float) -> Array:
        return np.asarray(foot + turn @ (tall * np.array([x, y, z])))

    limbs = [(at(0.0, y, 0.0), at(0.0, y, 0.85), 0.075) for y in (-0.1, 0.1)]
    limbs += [(at(0.0, y, 1.38), at(0.12, 1.25 * y, 0.85), 0.045) for y in (-0.22, 0.22)]
    limbs.append((at(0.0, 0.0, 1.35), at(0.0, 0.0, 1.55), 0.055))
    meshes = [cylinder(start, end, radius, _CLOTH_SHADE) for start, end, radius in limbs]
    heading = float(np.arctan2(turn[1, 0], turn[0, 0]))
    meshes.append(ellipsoid(at(0.0, 0.0, 1.12), (0.13, 0.21, 0.34), heading, _CLOTH_SHADE))
    head = at(0.02, 0.0, 1.62)
    radius = rng.uniform(*_HEAD_RADII)
    return Item(kind="person", p_site=head, meshes=meshes, balls=[(head, radius, _SKIN_SHADE)])


def _tree(rng: np.random.Generator, foot: Array) -> Item:
    """Return a trunk with a crown of leaves."""
    trunk, half = rng.uniform(1.2, 2.0), rng.uniform(0.7, 1.0)
    top = _above(foot, trunk)
    crown = _above(top, 0.6 * half)
    meshes = [
        cylinder(_above(foot, -0.1), crown, rng.uniform(0.06, 0.13), _BARK_SHADE),
        leaves(rng, crown, (half, half, 0.8 * half), int(rng.integers(700, 1400)), 0.09),
    ]
    return Item(kind="tree", p_site=crown, meshes=meshes)


def _barrel(rng: np.random.Generator, foot: Array) -> Item:
    """Return a barrel."""
    top = _above(foot, 0.88)
    mesh = cylinder(_above(foot, -0.1), top, rng.uniform(0.24, 0.30), _PIPE_SHADE)
    return Item(kind="barrel", p_site=top, meshes=[mesh])


def _upright_pipe(rng: np.random.Generator, foot: Array) -> Item:
    """Return an upright pipe as wide as a marker."""
    top = _above(foot, rng.uniform(0.7, 1.5))
    mesh = cylinder(_above(foot, -0.1), top, MARKER_RADIUS, _PIPE_SHADE)
    return Item(kind="pipe", p_site=top, meshes=[mesh])


def _lying_pipe(rng: np.random.Generator, foot: Array) -> Item:
    """Return a level pipe as wide as a marker, on the ground or held above it."""
    middle = _above(foot, rng.uniform(0.10, 0.6))
    half = rot_z(rng.uniform(0.0, np.pi)) @ [0.7, 0.0, 0.0]
    mesh = cylinder(middle - half, middle + half, MARKER_RADIUS, _PIPE_SHADE)
    return Item(kind="pipe", p_site=middle, meshes=[mesh])


def _pole(terrain: Terrain, top: Array, radius: float) -> tuple[Mesh, tuple[Array, Array, float]]:
    """Return a thin pole up to a place, and its axis."""
    foot = np.array([top[0], top[1], terrain.height_at(top)])
    return pole_mesh(foot, top, radius, _PIPE_SHADE), (foot, top, radius)


def _bare_pole(terrain: Terrain) -> Builder:
    """Return the builder of poles without a ball."""

    def build(rng: np.random.Generator, foot: Array) -> Item:
        top = _above(foot, rng.uniform(0.6, 2.0))
        mesh, stick = _pole(terrain, top, rng.uniform(0.012, 0.045))
        return Item(kind="pole", p_site=top, meshes=[mesh], sticks=[stick])

    return build


def _ball_on_pole(terrain: Terrain, radius: float) -> Builder:
    """Return the builder of balls of the wrong size on poles."""

    def build(rng: np.random.Generator, foot: Array) -> Item:
        centre = _above(foot, rng.uniform(0.7, 1.4))
        mesh, stick = _pole(terrain, _above(centre, -0.98 * radius), 0.015)
        balls = [(centre, radius, _BALL_SHADE)]
        return Item(kind="wrong ball", p_site=centre, meshes=[mesh], balls=balls, sticks=[stick])

    return build


def _ball_on_ground(radius: float) -> Builder:
    """Return the builder of balls of the wrong size on the ground."""

    def build(_rng: np.random.Generator, foot: Array) -> Item:
        centre = _above(foot, 0.95 * radius)
        return Item(
            kind="wrong ball", p_site=centre, meshes=[], balls=[(centre, radius, _BALL_SHADE)]
        )

    return build


def _round_rock(rng: np.random.Generator, foot: Array) -> Item:
    """Return a nearly round rock of marker size, sunk in by less than half."""
    radius = rng.uniform(*_ROCK_RADII)
    centre = _above(foot, radius * rng.uniform(0.3, 0.9))
    return Item(kind="rock", p_site=centre, meshes=[round_rock(rng, centre, radius)])


def _perched_rock(rng: np.random.Generator, foot: Array) -> Item:
    """Return a nearly round rock of marker size on top of a larger one."""
    below, radius = rng.uniform(0.18, 0.30), rng.uniform(*_ROCK_RADII)
    base = _above(foot, 0.6 * below)
    centre = _above(base, 0.92 * below + 0.95 * radius)
    meshes = [round_rock(rng, base, below), round_rock(rng, centre, radius)]
    return Item(kind="perched rock", p_site=centre, meshes=meshes)
