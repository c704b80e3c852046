"""The published field: ground, rocks, markers and stops."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spheremark.pipelines.errors import ConfigError, NotFoundError
from spheremark.pipelines.model import Array, ControlMarks, seal
from spheremark.pipelines.simulation.rocks import draw_rocks, rock_mesh
from spheremark.pipelines.simulation.scene import (
    Mesh,
    Poles,
    Scene,
    Spheres,
    pole_mesh,
    terrain_mesh,
)
from spheremark.pipelines.simulation.terrain import Terrain, rough_terrain, with_mounds

PAPER_DISTANCES = np.array(
    [6.84, 7.15, 7.19, 7.71, 7.76, 7.84, 7.90, 7.94, 7.99, 8.17, 8.27, 9.02, 9.13, 9.34]
)
"""Published distances from the LiDAR to the 14 markers, Table 2 [m]."""

MARKER_RADIUS = 0.100
"""Published radius of the spheres [m]."""

_MARKER_SHADE = 0.50  # red paint at 905 nm
_POLE_RADIUS = 0.015  # [m]
_POLE_SHADE = 0.30
_POLE_LENGTHS = (0.62, 1.50)  # [m] of a centre above the ground
_CENTRES_ABOVE_CUT = (-0.02, 0.13)  # [m] above the highest ground near a stop
_CUT_RADIUS = 10.0  # [m] within which the published method takes the highest ground
_LANES, _STOPS = 5, 7
_FIELD = (4.5, 4.0)  # [m] half sides of the rectangle of stops
MAST = 1.05
"""Height of the LiDAR above the ground [m]."""

_N_MOUNDS, _MOUND_DISTANCE, _MOUND_RADIUS, _MOUND_TOP = 5, 9.0, 2.0, 0.82  # the rest in [m]
_STOP_CLEAR, _MARK_CLEAR = 0.9, 0.5  # [m] around which there are no rocks
_TERRAIN, _LAYOUT, _ROCKS, _SHADES = range(4)  # random streams


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Stop:
    """A place where the rover stands still and scans.

    Attributes
    ----------
    name : str
        Name of the stop.
    p_site : (3,)
        Origin of the base: on the gimbal's axis at the height of the LiDAR [m].
    heading : float
        Heading of the rover, counter-clockwise from x [rad].
    """

    name: str
    p_site: Array
    heading: float

    def __post_init__(self) -> None:
        seal(self, p_site=(3,))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Decoy:
    """An object that is no marker and might be mistaken for one.

    Attributes
    ----------
    name : str
        Name of the object.
    kind : str
        Kind of object: ``person``, ``pole``, ``wrong ball`` and so on.
    p_site : (3,)
        The place where it might be mistaken: the middle of a ball, a head, a crown [m].
    reach : float
        Distance from there to its farthest corner [m].
    """

    name: str
    kind: str
    p_site: Array
    reach: float = 0.0

    def __post_init__(self) -> None:
        seal(self, p_site=(3,))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Field:
    """A world whose truth is known.

    Attributes
    ----------
    scenario : str
        Name of its scenario.
    seed : int
        Seed of its random numbers.
    terrain : Terrain
        The ground.
    scene : Scene
        All surfaces.
    marks : ControlMarks
        True centres of the markers, with zero covariance.
    marker_radius : float
        Radius of the markers [m].
    stops : tuple of Stop
        Where the rover stops, in the order of driving.
    decoys : tuple of Decoy
        Objects that might be mistaken for a marker; for comparison only.
    family : str
        What is particular about a random world; empty for the others.
    stands : tuple of str
        What each marker stands on, in a random world.
    """

    scenario: str
    seed: int
    terrain: Terrain
    scene: Scene
    marks: ControlMarks
    marker_radius: float
    stops: tuple[Stop, ...]
    decoys: tuple[Decoy, ...] = ()
    family: str = ""
    stands: tuple[str, ...] = ()

    def stop(self, name: str) -> Stop:
        """Return the stop of a name.

        Parameters
        ----------
        name : str
            Name of the stop.

        Returns
        -------
        Stop
            The stop.

        Raises
        ------
        NotFoundError
            If there is none of that name.
        """
        for stop in self.stops:
            if stop.name == name:
                return stop
        names = ", ".join(stop.name for stop in self.stops)
        raise NotFoundError(f"There is no stop {name!r} in {self.scenario}; there are: {names}.")


def checked_seed(seed: int) -> int:
    """Return the seed; raise ConfigError if it is negative."""
    if seed < 0:
        raise ConfigError(f"The seed is {seed}; it must be 0 or more.")
    return seed


def paper_field(seed: int) -> Field:
    """Return the published field: 14 markers around five lanes of seven stops.

    Notes
    -----
    The 3-D distances from the LiDAR at the centre stop to the markers are those of Table 2. A few
    mounds between the markers reach up to the spheres, so that the published cut at the highest
    ground removes the lower part of most spheres.
    """
    rng = np.random.default_rng([seed, _LAYOUT])
    bearings = _bearings(rng, len(PAPER_DISTANCES))
    terrain = rough_terrain(np.random.default_rng([seed, _TERRAIN]))
    mounds = _mounds(rng, bearings)
    terrain = with_mounds(terrain, mounds, _MOUND_RADIUS)
    stops = _lanes(rng, terrain)
    marks = _marks(rng, bearings, terrain, stops)
    return Field(
        scenario="paper-field",
        seed=seed,
        terrain=terrain,
        scene=_scene(seed, terrain, marks.p_site, _clearances(stops, marks, mounds)),
        marks=marks,
        marker_radius=MARKER_RADIUS,
        stops=stops,
    )


def marker_surfaces(
    p_site: Array,
    feet: Array,
    radius: float = MARKER_RADIUS,
    pole_radius: float = _POLE_RADIUS,
    shade: float = _MARKER_SHADE,
) -> tuple[Mesh, Spheres, Poles]:
    """Return markers on their poles, which begin at some heights [m]."""
    n = len(p_site)
    feet_site, tops = p_site.copy(), p_site.copy()
    feet_site[:, 2] = feet
    tops[:, 2] -= np.sqrt(radius**2 - pole_radius**2)
    meshes = [
        pole_mesh(foot, top, pole_radius, _POLE_SHADE)
        for foot, top in zip(feet_site, tops, strict=True)
    ]
    spheres = Spheres(
        p_site=p_site.copy(), radii=np.full(n, radius), reflectivities=np.full(n, shade)
    )
    poles = Poles(feet_site=feet_site, tops_site=tops, radii=np.full(n, pole_radius))
    return Mesh.merged(meshes), spheres, poles


def _bearings(rng: np.random.Generator, n: int) -> Array:
    """Return the bearings of the markers from the centre, about evenly spread [rad]."""
    jitter = rng.uniform(-0.25, 0.25, n)
    return np.asarray((np.arange(n) + jitter + rng.random()) * 2 * np.pi / n)


def _mounds(rng: np.random.Generator, bearings: Array) -> Array:
    """Return the tops of mounds half way between neighbouring markers, (n, 3) [m]."""
    places = np.round(np.arange(_N_MOUNDS) * len(bearings) / _N_MOUNDS).astype(int)
    following = np.append(bearings[1:], bearings[0] + 2 * np.pi)
    middle = (bearings + following)[places] / 2
    tops = _MOUND_TOP + rng.uniform(-0.02, 0.02, _N_MOUNDS)
    return np.column_stack(
        [_MOUND_DISTANCE * np.cos(middle), _MOUND_DISTANCE * np.sin(middle), tops]
    )


def _lanes(rng: np.random.Generator, terrain: Terrain) -> tuple[Stop, ...]:
    """Return five lanes of seven stops, driven to and fro; the centre stop is at the origin."""
    stops = []
    for lane, y in enumerate(np.linspace(-_FIELD[1], _FIELD[1], _LANES)):
        for place, x in enumerate(np.linspace(-_FIELD[0], _FIELD[0], _STOPS)):
            p_site = np.array([x, y, 0.0])
            p_site[2] = terrain.height_at(p_site) + MAST + rng.uniform(-0.03, 0.03)
            heading = np.pi * (lane % 2) + rng.normal(0.0, np.radians(5.0))
            name = f"lane{lane + 1}-stop{place + 1}"
            stops.append(Stop(name=name, p_site=p_site, heading=float(heading)))
    return tuple(stops)


def _marks(
    rng: np.random.Generator, bearings: Array, terrain: Terrain, stops: tuple[Stop, ...]
) -> ControlMarks:
    """Return the markers: far ones towards the corners of the field, near ones at its sides."""
    n = len(bearings)
    sides = np.abs(np.column_stack([np.cos(bearings) / _FIELD[0], np.sin(bearings) / _FIELD[1]]))
    extents = 1.0 / sides.max(axis=1)
    distances = np.empty(n)
    distances[np.argsort(extents)] = np.sort(PAPER_DISTANCES)
    p_site = np.column_stack(
        [distances * np.cos(bearings), distances * np.sin(bearings), np.zeros(n)]
    )
    cut = np.median([terrain.highest_near(stop.p_site, _CUT_RADIUS) for stop in stops])
    ground = terrain.height_at(p_site)
    shortest, longest = _POLE_LENGTHS
    p_site[:, 2] = np.clip(
        cut + rng.uniform(*_CENTRES_ABOVE_CUT, n), ground + shortest, ground + longest
    )
    centre = stops[len(stops) // 2].p_site
    drop = p_site[:, 2] - centre[2]
    p_site[:, :2] *= (np.sqrt(distances**2 - drop**2) / distances)[:, None]
    names = tuple(f"P{i + 1:02d}" for i in range(n))
    return ControlMarks(names=names, p_site=p_site, cov_p_site=np.zeros((n, 3, 3)))


def _clearances(stops: tuple[Stop, ...], marks: ControlMarks, mounds: Array) -> Array:
    """Return places and radii where no rock may lie, (n, 3) [m]."""
    places = [np.array([stop.p_site for stop in stops]), marks.p_site, mounds]
    radii = [_STOP_CLEAR, _MARK_CLEAR, _MOUND_RADIUS]
    return np.concatenate(
        [
            np.column_stack([p_site[:, :2], np.full(len(p_site), radius)])
            for p_site, radius in zip(places, radii, strict=True)
        ]
    )


def _scene(seed: int, terrain: Terrain, p_site: Array, keep_clear: Array) -> Scene:
    """Return ground, rocks and markers as one scene."""
    rng = np.random.default_rng([seed, _ROCKS])
    ground = terrain_mesh(np.random.default_rng([seed, _SHADES]), terrain)
    rocks = rock_mesh(rng, draw_rocks(rng, keep_clear), terrain)
    posts, spheres, poles = marker_surfaces(p_site, terrain.height_at(p_site))
    return Scene(mesh=Mesh.merged([ground, rocks, posts]), spheres=spheres, poles=poles)
