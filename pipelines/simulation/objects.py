"""Objects that are no markers, each an ``Item``: surfaces, and where it might be mistaken for one.

Builders take random numbers, the foot of the object, and the site: its ground and the radius of its
markers, which what is made to resemble a marker scales with.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from spheremark.pipelines.geometry import rot_z
from spheremark.pipelines.model import Array
from spheremark.pipelines.simulation.bodies import box, cylinder, ellipsoid, leaves
from spheremark.pipelines.simulation.field import MARKER_RADIUS
from spheremark.pipelines.simulation.rocks import round_rock
from spheremark.pipelines.simulation.scene import Mesh, Stick, pole_mesh
from spheremark.pipelines.simulation.stands import draw_stand
from spheremark.pipelines.simulation.terrain import Terrain

_HEAD_RADII = (0.10, 0.12)  # [m]
_ROCK_RADII = (0.85, 1.2)  # of rocks that are as large as a marker, in its radii
WRONG_RADII = ((0.7, 0.9), (1.1, 1.5))
"""Sizes of decoys in radii of the markers: nearer ones would be markers."""

# Diffuse reflectivities at 905 nm.
WALL_SHADE = 0.40
_CLOTH_SHADE, _SKIN_SHADE = 0.30, 0.50
_BARK_SHADE, _BALL_SHADE, _PIPE_SHADE, _PAINT_SHADE = 0.25, 0.50, 0.35, 0.45


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
    sticks: Sequence[Stick] = ()

    @property
    def reach(self) -> float:
        """Distance from its place to its farthest corner [m]."""
        corners = [np.linalg.norm(mesh.p_site - self.p_site, axis=1) for mesh in self.meshes]
        balls = [[np.linalg.norm(p - self.p_site) + radius] for p, radius, _ in self.balls]
        return float(np.concatenate([*corners, *balls]).max())


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Site:
    """Ground, and radius of the markers [m]."""

    terrain: Terrain
    radius: float = MARKER_RADIUS


Builder = Callable[[np.random.Generator, Array, Site], Item]


def above(place: Array, height: float) -> Array:
    """Return a place raised by a height."""
    return np.asarray(place + np.array([0.0, 0.0, height]))


def wall(rng: np.random.Generator, foot: Array, _site: Site) -> Item:
    """Return a straight wall."""
    height = rng.uniform(1.6, 2.6)
    place = above(foot, height / 2 - 0.1)
    sides = (rng.uniform(3.0, 4.0), 0.15, height)
    mesh = box(place, sides, rng.uniform(0.0, np.pi), WALL_SHADE)
    return Item(kind="wall", p_site=place, meshes=[mesh])


def corner(rng: np.random.Generator, foot: Array, _site: Site) -> Item:
    """Return two walls that meet at a right angle; the corner points at the middle of the field."""
    length, height = 1.8, rng.uniform(1.6, 2.6)
    inwards = np.arctan2(-foot[1], -foot[0])
    meshes = []
    for turn in (0.75 * np.pi, -0.75 * np.pi):
        away = rot_z(inwards + turn) @ [length / 2, 0.0, 0.0]
        place = above(foot + away, height / 2 - 0.1)
        meshes.append(box(place, (length, 0.15, height), inwards + turn, WALL_SHADE))
    return Item(kind="corner", p_site=above(foot, height / 2), meshes=meshes)


def person(rng: np.random.Generator, foot: Array, _site: Site) -> Item:
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


def tree(rng: np.random.Generator, foot: Array, _site: Site) -> Item:
    """Return a trunk with a crown of leaves."""
    trunk, half = rng.uniform(1.2, 2.0), rng.uniform(0.7, 1.0)
    top = above(foot, trunk)
    crown = above(top, 0.6 * half)
    meshes = [
        cylinder(above(foot, -0.1), crown, rng.uniform(0.06, 0.13), _BARK_SHADE),
        leaves(rng, crown, (half, half, 0.8 * half), int(rng.integers(700, 1400)), 0.09),
    ]
    return Item(kind="tree", p_site=crown, meshes=meshes)


def barrel(rng: np.random.Generator, foot: Array, _site: Site) -> Item:
    """Return a barrel."""
    top = above(foot, 0.88)
    mesh = cylinder(above(foot, -0.1), top, rng.uniform(0.24, 0.30), _PIPE_SHADE)
    return Item(kind="barrel", p_site=top, meshes=[mesh])


def upright_pipe(rng: np.random.Generator, foot: Array, site: Site) -> Item:
    """Return an upright pipe as wide as a marker."""
    top = above(foot, rng.uniform(0.7, 1.5))
    mesh = cylinder(above(foot, -0.1), top, site.radius, _PIPE_SHADE)
    return Item(kind="pipe", p_site=top, meshes=[mesh])


def lying_pipe(rng: np.random.Generator, foot: Array, site: Site) -> Item:
    """Return a level pipe as wide as a marker, on the ground or held above it."""
    middle = above(foot, rng.uniform(0.10, 0.6))
    half = rot_z(rng.uniform(0.0, np.pi)) @ [0.7, 0.0, 0.0]
    mesh = cylinder(middle - half, middle + half, site.radius, _PIPE_SHADE)
    return Item(kind="pipe", p_site=middle, meshes=[mesh])


def _pole(terrain: Terrain, top: Array, radius: float) -> tuple[Mesh, Stick]:
    """Return a thin pole from the ground up to a place, and its axis."""
    return _rod(float(terrain.height_at(top)), top, radius)


def _rod(z: float, top: Array, radius: float) -> tuple[Mesh, Stick]:
    """Return a thin pole from a height up to a place, and its axis."""
    foot = np.append(top[:2], z)
    return pole_mesh(foot, top, radius, _PIPE_SHADE), (foot, top, radius)


def bare_pole(rng: np.random.Generator, foot: Array, site: Site) -> Item:
    """Return a pole without a ball."""
    top = above(foot, rng.uniform(0.6, 2.0))
    mesh, stick = _pole(site.terrain, top, rng.uniform(0.012, 0.045))
    return Item(kind="pole", p_site=top, meshes=[mesh], sticks=[stick])


def ball_on_pole(radius: float) -> Builder:
    """Return the builder of balls of the wrong size on poles."""

    def build(rng: np.random.Generator, foot: Array, site: Site) -> Item:
        centre = above(foot, rng.uniform(0.7, 1.4))
        mesh, stick = _pole(site.terrain, above(centre, -0.98 * radius), 0.015)
        balls = [(centre, radius, _BALL_SHADE)]
        return Item(kind="wrong ball", p_site=centre, meshes=[mesh], balls=balls, sticks=[stick])

    return build


def ball_on_ground(radius: float) -> Builder:
    """Return the builder of balls of the wrong size on the ground."""

    def build(_rng: np.random.Generator, foot: Array, _site: Site) -> Item:
        centre = above(foot, 0.95 * radius)
        return Item(
            kind="wrong ball", p_site=centre, meshes=[], balls=[(centre, radius, _BALL_SHADE)]
        )

    return build


def a_round_rock(rng: np.random.Generator, foot: Array, site: Site) -> Item:
    """Return a nearly round rock of marker size, sunk in by less than half."""
    radius = site.radius * rng.uniform(*_ROCK_RADII)
    centre = above(foot, radius * rng.uniform(0.3, 0.9))
    return Item(kind="rock", p_site=centre, meshes=[round_rock(rng, centre, radius)])


def perched_rock(rng: np.random.Generator, foot: Array, site: Site) -> Item:
    """Return a nearly round rock of marker size on top of a larger one."""
    below, radius = site.radius * rng.uniform(1.8, 3.0), site.radius * rng.uniform(*_ROCK_RADII)
    base = above(foot, 0.6 * below)
    centre = above(base, 0.92 * below + 0.95 * radius)
    meshes = [round_rock(rng, base, below), round_rock(rng, centre, radius)]
    return Item(kind="perched rock", p_site=centre, meshes=meshes)


def bush(rng: np.random.Generator, foot: Array, _site: Site) -> Item:
    """Return a bush of leaves down to the ground."""
    axes = np.array([*rng.uniform(0.3, 0.8, 2), rng.uniform(0.3, 0.9)])
    middle = above(foot, 0.8 * axes[2])
    n, size = int(rng.integers(200, 1200)), rng.uniform(0.02, 0.08)
    return Item(kind="bush", p_site=middle, meshes=[leaves(rng, middle, axes, n, size)])


def vehicle(rng: np.random.Generator, foot: Array, _site: Site) -> Item:
    """Return a car or van: body, cabin and wheels."""
    long, wide, high = rng.uniform(3.2, 5.0), rng.uniform(1.5, 1.9), rng.uniform(0.5, 0.8)
    heading = float(rng.uniform(-np.pi, np.pi))
    turn, shade = rot_z(heading), rng.uniform(0.05, 0.7)
    cabin = above(foot, 0.35 + 1.5 * high)
    meshes = [
        box(above(foot, 0.35 + high / 2), (long, wide, high), heading, shade),
        box(cabin, (0.55 * long, 0.9 * wide, high), heading, shade),
    ]
    for x in (-0.32, 0.32):
        for side in (-0.5, 0.5):
            hub = above(foot, 0.31) + turn @ [x * long, side * wide, 0.0]
            width = turn @ [0.0, 0.1, 0.0]
            meshes.append(cylinder(hub - width, hub + width, 0.31, 0.05))
    return Item(kind="vehicle", p_site=cabin, meshes=meshes)


def fence(rng: np.random.Generator, foot: Array, site: Site) -> Item:
    """Return posts with rails or wires between."""
    half, n_posts, tall = rng.uniform(1.0, 2.0), int(rng.integers(2, 5)), rng.uniform(0.8, 1.6)
    along = rot_z(rng.uniform(-np.pi, np.pi)) @ [half, 0.0, 0.0]
    meshes, sticks = [], []
    for s in np.linspace(-1.0, 1.0, n_posts):
        top = above(_on_ground(foot + s * along, site), tall)
        mesh, stick = _pole(site.terrain, top, rng.uniform(0.03, 0.06))
        meshes.append(mesh)
        sticks.append(stick)
    radius = rng.choice([0.003, 0.03])
    for height in np.linspace(0.3, 0.95, int(rng.integers(2, 5))) * tall:
        start, end = (above(_on_ground(foot + s * along, site), height) for s in (-1.0, 1.0))
        meshes.append(cylinder(start, end, radius, _BARK_SHADE))
        sticks.append((start, end, radius))
    return Item(kind="fence", p_site=above(foot, tall), meshes=meshes, sticks=sticks)


def cable(rng: np.random.Generator, foot: Array, site: Site) -> Item:
    """Return a sagging cable between two masts."""
    half, tall, sag = rng.uniform(1.5, 4.0), rng.uniform(1.5, 4.0), rng.uniform(0.1, 0.6)
    along = rot_z(rng.uniform(-np.pi, np.pi)) @ [half, 0.0, 0.0]
    radius, s = rng.uniform(0.005, 0.02), np.linspace(-1.0, 1.0, 9)
    p = foot + s[:, None] * along + np.array([0.0, 0.0, 1.0]) * (tall - sag * (1 - s**2))[:, None]
    meshes, sticks = [], []
    for start, end in pairwise(p):
        meshes.append(cylinder(start, end, radius, 0.1))
        sticks.append((start, end, radius))
    for end in (p[0], p[-1]):
        mesh, stick = _pole(site.terrain, end, 0.05)
        meshes.append(mesh)
        sticks.append(stick)
    return Item(kind="cable", p_site=p[4], meshes=meshes, sticks=sticks)


def sign(rng: np.random.Generator, foot: Array, site: Site) -> Item:
    """Return a panel on a post."""
    side = site.radius * rng.uniform(1.0, 4.0, 2)
    middle = above(foot, rng.uniform(0.7, 1.8) + side[1] / 2)
    mesh, stick = _pole(site.terrain, middle, rng.uniform(0.015, 0.04))
    panel = box(middle, (0.01, *side), rng.uniform(-np.pi, np.pi), rng.uniform(0.2, 0.9))
    return Item(kind="sign", p_site=middle, meshes=[mesh, panel], sticks=[stick])


def _wrong_size(rng: np.random.Generator, site: Site) -> float:
    """Return the radius of a decoy: 0.7 to 1.5 radii of the markers, but not theirs [m]."""
    return float(site.radius * rng.uniform(*WRONG_RADII[rng.integers(2)]))


def _raised(rng: np.random.Generator, foot: Array, half: float) -> Array:
    """Return the middle of a decoy of a half height that is not on the ground."""
    return above(foot, half + rng.uniform(0.5, 1.6))


def wrong_ball(rng: np.random.Generator, foot: Array, site: Site) -> Item:
    """Return a ball of the wrong size, raised or on the ground."""
    radius = _wrong_size(rng, site)
    if rng.random() < 0.3:
        return ball_on_ground(radius)(rng, foot, site)
    centre = _raised(rng, foot, radius)
    meshes, sticks = _holding(rng, centre, radius, site)
    balls = [(centre, radius, _BALL_SHADE)]
    return Item(kind="wrong ball", p_site=centre, meshes=meshes, balls=balls, sticks=sticks)


def cube(rng: np.random.Generator, foot: Array, site: Site) -> Item:
    """Return a cuboid about as large as a marker, raised or on the ground."""
    sides = 2.0 * site.radius * rng.uniform(0.7, 1.5) * rng.uniform(0.8, 1.2, 3)
    on_ground = rng.random() < 0.3
    middle = above(foot, sides[2] / 2) if on_ground else _raised(rng, foot, sides[2] / 2)
    meshes = [box(middle, sides, rng.uniform(-np.pi, np.pi), _PAINT_SHADE)]
    if on_ground:
        return Item(kind="cube", p_site=middle, meshes=meshes)
    more, sticks = _holding(rng, middle, sides[2] / 2, site)
    return Item(kind="cube", p_site=middle, meshes=meshes + more, sticks=sticks)


def drum(rng: np.random.Generator, foot: Array, site: Site) -> Item:
    """Return an upright or lying cylinder about as large as a marker, raised or on the ground."""
    radius, half = site.radius * rng.uniform(0.7, 1.5, 2)
    on_ground, lies = rng.random() < 0.3, rng.random() < 0.3
    up = radius if lies else half
    middle = above(foot, up) if on_ground else _raised(rng, foot, up)
    turn = rot_z(rng.uniform(-np.pi, np.pi))
    axis = half * (turn @ [1.0, 0.0, 0.0] if lies else np.array([0.0, 0.0, 1.0]))
    meshes = [cylinder(middle - axis, middle + axis, radius, _PAINT_SHADE)]
    if on_ground:
        return Item(kind="cylinder", p_site=middle, meshes=meshes)
    more, sticks = _holding(rng, middle, up, site)
    return Item(kind="cylinder", p_site=middle, meshes=meshes + more, sticks=sticks)


def _holding(
    rng: np.random.Generator, middle: Array, below: float, site: Site
) -> tuple[list[Mesh], list[Stick]]:
    """Return what holds a decoy that reaches down to a depth below its middle [m]."""
    stem, (own,) = _stem(rng, below), rng.spawn(1)
    stand = draw_stand(own, site.terrain, above(middle, -below), below, stem)
    mesh, stick = _rod(stand.z, above(middle, -0.98 * below), stem)
    return [mesh, *stand.meshes], [stick, *stand.sticks]


def _stem(rng: np.random.Generator, radius: float) -> float:
    """Return the radius of a pole that carries a body of some radius [m]."""
    return float(np.clip(radius * rng.uniform(0.1, 0.35), 0.004, 0.15))


def _on_ground(p_site: Array, site: Site) -> Array:
    """Return a place on the ground below or above another."""
    return np.append(p_site[:2], site.terrain.height_at(p_site))
