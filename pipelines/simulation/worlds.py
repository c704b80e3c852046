"""Random worlds: scene, optics, rig and motion are drawn from wide priors by one seed.

A world belongs to a family, which says what is particular about it: that quantity has its wide
prior, and the others have their usual ones. Families take turns with the seeds, so that even seeds
hold all of them, and odd seeds too. All priors are in ``PRIORS``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np

from spheremark.pipelines.errors import ConfigError
from spheremark.pipelines.model import Array, ControlMarks, ScanLog, Truth
from spheremark.pipelines.scan.rigs import BEAM_WINDOW, RANGE_STEP
from spheremark.pipelines.simulation import objects
from spheremark.pipelines.simulation.bodies import box, cylinder
from spheremark.pipelines.simulation.clutter import Ground, panel, placed, screen, with_items
from spheremark.pipelines.simulation.field import Field, Stop, checked_seed, marker_surfaces
from spheremark.pipelines.simulation.objects import Item
from spheremark.pipelines.simulation.options import Optics, Pick, Profile, SimulationConfig
from spheremark.pipelines.simulation.rig import commensurability
from spheremark.pipelines.simulation.rocks import draw_rocks, rock_mesh
from spheremark.pipelines.simulation.scene import Mesh, Scene, terrain_mesh
from spheremark.pipelines.simulation.stands import Stand, between, draw_stand
from spheremark.pipelines.simulation.stop import SimulatedStop, simulate_stop, survey_truth
from spheremark.pipelines.simulation.terrain import Terrain, rough_terrain

FAMILIES = (
    "plain", "lattice", "optics", "rig", "clutter", "panels", "decoys", "rocks", "empty",
    "step-and-shoot", "one face", "radius", "bare", "clock", "dust", "all at once",
)  # fmt: skip
"""What is particular about a world."""

_ALL = "all at once"


class Prior(NamedTuple):
    """Bounds of a quantity in usual worlds and in those of some families, and what it is."""

    usual: tuple[float, float]
    wide: tuple[float, float]
    is_log: bool
    families: tuple[str, ...]
    what: str

    def bounds(self, family: str) -> tuple[float, float]:
        """Return the bounds in worlds of a family."""
        return self.wide if family in self.families else self.usual

    def draw(self, rng: np.random.Generator, family: str) -> float:
        """Return a value between the bounds, evenly or evenly in its logarithm."""
        low, high = self.bounds(family)
        if self.is_log:
            return between(rng, (low, high))
        return float(rng.uniform(low, high))

    def rms(self, family: str) -> float:
        """Return the root of the mean square of such values."""
        low, high = self.bounds(family)
        if self.is_log:
            return float(np.sqrt((high**2 - low**2) / (2.0 * np.log(high / low))))
        return float(np.sqrt((low**2 + low * high + high**2) / 3.0))


_OPTICS, _RIG = ("optics", _ALL), ("rig", _ALL)
_MOTION, _GROUND = ("rig", "lattice", _ALL), ("rocks", _ALL)

PRIORS: Mapping[str, Prior] = {
    "sigma_range": Prior((0.004, 0.025), (0.003, 0.04), True, _OPTICS, "noise, strong echoes [m]"),
    "sigma_weak": Prior((0.001, 0.03), (0.001, 0.06), True, _OPTICS, "more at the threshold [m]"),
    "range_half": Prior((30, 100), (18, 100), True, _OPTICS, "reach with reflectivity 0.1 [m]"),
    "softness": Prior((0.05, 0.3), (0.05, 0.5), False, _OPTICS, "of the threshold, ln(energy)"),
    "drop_out": Prior((0.001, 0.02), (0.001, 0.2), True, _OPTICS, "share of returns lost"),
    "divergence_scale": Prior((0.85, 1.15), (0.7, 1.3), False, _OPTICS, "true over nominal; or 0"),
    "roundness": Prior(
        (0.85, 1.18), (0.7, 2.0), True, _OPTICS, "as much wider along the spin axis"
    ),
    "window": Prior((0.0, 0.5), (0.0, 1.0), False, _OPTICS, "beam there, of 12.7 x 9.5 mm"),
    "gate": Prior((0.1, 1.0), (0.05, 1.2), True, _OPTICS, "surfaces in one echo [m]"),
    # usual: in the mean of squares what the data sheet leaves, ``fitting.sigma_range_common``
    "range_bias": Prior((0.002, 0.005), (0.002, 0.015), True, _OPTICS, "its sigma, in common [m]"),
    "range_scale": Prior((1e-6, 5e-5), (1e-5, 3e-4), True, _OPTICS, "its sigma"),
    "shade": Prior((0.3, 0.8), (0.1, 0.9), False, _OPTICS, "reflectivity of the markers"),
    "sigma_laser_bias": Prior((0.001, 0.004), (0.002, 0.012), True, _RIG, "between lasers [m]"),
    "sigma_misalignment": Prior((1e-4, 5e-4), (5e-4, 4.4e-3), True, _RIG, "to 0.25 deg [rad]"),
    "sigma_axis_offset": Prior((1e-4, 1e-3), (1e-3, 1e-2), True, _RIG, "place in the head [m]"),
    "sigma_eccentricity": Prior((2e-5, 3e-4), (2e-4, 2e-3), True, _RIG, "of the encoder [rad]"),
    "encoder_bits": Prior((14, 19), (12, 19), False, _RIG, "steps of the encoder in a turn"),
    "sigma_encoder": Prior((2e-5, 1e-4), (5e-5, 5e-4), True, _RIG, "jitter of the angle [rad]"),
    "sigma_joint_stamp": Prior((1e-6, 2e-4), (1e-4, 2e-3), True, _RIG, "of its instant [s]"),
    "gimbal_clock_offset": Prior((1e-6, 3e-4), (1e-4, 0.01), True, _RIG, "latency, +- [s]"),
    "joint_rate": Prior((50, 200), (20, 200), True, _RIG, "of encoder and AHRS [Hz]"),
    "sigma_ahrs_bias": Prior((1e-3, 5e-3), (2e-3, 1.5e-2), True, _RIG, "roll and pitch [rad]"),
    "sigma_ahrs_drift": Prior((1e-6, 5e-5), (1e-5, 5e-4), True, _RIG, "[rad/s]"),
    "sigma_ahrs": Prior((2e-4, 2e-3), (5e-4, 5e-3), True, _RIG, "white noise [rad]"),
    "sigma_tilt": Prior((5e-3, 0.04), (0.01, 0.08), True, _RIG, "of the rover [rad]"),
    "turn": Prior((9, 18), (9, 18), False, (), "time of a turn [s]"),
    "ripple": Prior((1e-5, 3e-4), (1e-4, 5e-3), True, _MOTION, "1 to 12 in a turn [rad]"),
    "cogging": Prior((0.001, 0.1), (0.01, 0.9), True, _MOTION, "of the speed, 50 to 400 in a turn"),
    "radius": Prior((0.06, 0.25), (0.03, 2.5), True, ("radius",), "of markers, half 0.1 [m]"),
    "ground": Prior((0.3, 2.0), (0.0, 4.0), False, _GROUND, "roughness over the study's"),
    "slope": Prior((0.0, 0.03), (0.0, 0.1), False, _GROUND, "of the whole ground"),
    "cover": Prior((0.0, 0.01), (0.0, 0.03), False, _GROUND, "share of it under rocks"),
    "mast": Prior((0.8, 1.8), (0.5, 2.5), False, (_ALL,), "height of the LiDAR [m]"),
}
"""Every physical quantity that is drawn as a number; the wide bounds hold in its families."""

_IN_CONFIG = sorted(
    set(PRIORS)
    & {one.name for one in fields(SimulationConfig)}
    - {"sigma_range", "gimbal_clock_offset", "turn"}
)
_LATTICES = ((12.0, 600.0), (9.0, 600.0), (18.0, 600.0), (6.0, 1200.0), (12.0, 300.0), (7.2, 600.0))
_RPM, _RPM_OFF = (300.0, 600.0, 600.0, 600.0, 900.0, 1200.0), 0.003
_STEPS = (1.3, 1.7, 2.3, 3.1, 5.0)  # [deg] of a gimbal that rests
_SLOWER = 1.7  # the turn of a scan of one face
_CLOCK = Prior((0.005, 0.1), (0.005, 0.1), True, (), "latency in the family of that name [s]")
_DUST = (1e-4, 5e-3)  # [1/m]
_BY_TABLE, _WEAKER, _PENCILS = 0.25, 0.7, 0.15  # noise by the VLP-16's table; grows; no divergence
_PICKS = (0.7, 0.15, 0.15)  # shares of worlds by the echo that is recorded
_STRAYS = 1e-4  # of the pulses
_N_MARKS, _N_STOPS = (4, 16), 12
_RETURNS = 7500.0  # of a sphere of 0.1 m at 1 m, by a turn of 13.2 s
_FEWEST = 6.0  # returns at the greatest distance
_NEAREST, _FARTHEST = 1.8, 75.0  # [m]
_REACH = (12.0, 33.0)  # [m] within which objects stand, as far as markers do
_MAST, _MAST_AWAY = (0.008, 0.04), (0.35, 1.2)  # [m] radius of a rover's mast, and from the LiDAR
_STOP_CLEAR = 0.9  # [m] from a stop to the nearest object
_SPREAD = 4.8  # [m] of the stops about the first one
_N_TRIES = 300
_SKIRT = 150.0  # [m] half side of the ground
_CONFIG, _LAYOUT, _ITEMS, _LAND, _BEAM = range(30, 35)  # random streams
_Values = Mapping[str, float]
# Builders with the room that they need: metres, and radii of the markers.
_ROUND = ((objects.a_round_rock, 0.0, 2.5), (objects.perched_rock, 0.0, 4.5))
_GROWN = ((objects.tree, 1.1, 0.0), (objects.bush, 0.8, 0.0), (objects.person, 0.35, 0.0))
_BUILT = (
    (objects.vehicle, 2.6, 0.0),
    (objects.fence, 2.1, 0.0),
    (objects.cable, 1.0, 0.0),
    (objects.wall, 2.0, 0.0),
    (objects.corner, 2.0, 0.0),
    (objects.barrel, 0.35, 0.0),
    (objects.bare_pole, 0.1, 0.0),
    (objects.upright_pipe, 0.1, 1.0),
    (objects.lying_pipe, 0.7, 1.0),
    (objects.sign, 0.1, 3.0),
)
_LIKE = ((objects.wrong_ball, 0.05, 2.0), (objects.cube, 0.05, 2.6), (objects.drum, 0.05, 2.2))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RandomWorld:
    """A random world and its physics, before anything is simulated.

    Attributes
    ----------
    field : Field
        Scene, markers and stops; its family too.
    config : SimulationConfig
        Optics, rig and motion.
    """

    field: Field
    config: SimulationConfig


class Scan(NamedTuple):
    """One stop of a random world: its log, its truth apart, and what is known in memory only."""

    log: ScanLog
    truth: Truth
    world: RandomWorld
    stop: SimulatedStop


def random_world(seed: int) -> Scan:
    """Simulate one stop of a random world.

    Parameters
    ----------
    seed : int
        Seed of ``draw_world`` and of the scan.

    Returns
    -------
    Scan
        Log, truth, world and stop. The truth holds family, decoys by kind and place, and visible
        share, returns and scan lines of each marker.
    """
    world = draw_world(seed)
    stop = simulate_stop(world.field, world.field.stops[0].name, world.config)
    return Scan(stop.log, survey_truth(world.field, [stop], world.config, seed), world, stop)


def family_of(seed: int) -> str:
    """Return the family of a seed: they take turns with the even ones, and with the odd ones."""
    return FAMILIES[seed // 2 % len(FAMILIES)]


def draw_world(seed: int, family: str = "") -> RandomWorld:
    """Draw a random world.

    Parameters
    ----------
    seed : int
        Seed of everything, 0 or more.
    family : str
        One of ``FAMILIES``; by default families take turns with the seeds.

    Returns
    -------
    RandomWorld
        Field and configuration.

    Raises
    ------
    ConfigError
        If there is no such family, or the seed is negative.
    """
    values, config, family = _drawn(seed, family)
    field = _field(values, seed, family, config)
    return RandomWorld(field=field, config=config)


def draw_config(seed: int, family: str = "") -> SimulationConfig:
    """Draw optics, rig and motion of a random world, without its scene.

    Parameters
    ----------
    seed, family
        As in ``draw_world``.

    Returns
    -------
    SimulationConfig
        That of ``draw_world``.

    Raises
    ------
    ConfigError
        If there is no such family, or the seed is negative.
    """
    return _drawn(seed, family)[1]


def latency_rms(family: str) -> float:
    """Return the root of the mean square of a gimbal's latency in worlds of a family [s].

    Parameters
    ----------
    family : str
        One of ``FAMILIES``.

    Returns
    -------
    float
        What a data sheet gives as its sigma.
    """
    prior = _CLOCK if family == "clock" else PRIORS["gimbal_clock_offset"]
    return prior.rms(family)


def random_field(seed: int) -> Field:
    """Return the field of a random world, to be scanned with other physics than its own."""
    return draw_world(seed).field


def _drawn(seed: int, family: str) -> tuple[_Values, SimulationConfig, str]:
    """Draw the values of the priors and the configuration; return the family too."""
    family = family or family_of(checked_seed(seed))
    if family not in FAMILIES:
        raise ConfigError(f"There is no family {family!r}; there are: {', '.join(FAMILIES)}.")
    rng = np.random.default_rng([seed, _CONFIG])
    streams = {"roundness": np.random.default_rng([seed, _BEAM])}  # all else is as without it
    values = {name: one.draw(streams.get(name, rng), family) for name, one in PRIORS.items()}
    return values, _config(rng, values, family), family


def _config(rng: np.random.Generator, values: _Values, family: str) -> SimulationConfig:
    """Draw optics, rig and motion."""
    latency, step = values["gimbal_clock_offset"], RANGE_STEP
    if family == "clock":
        latency = _CLOCK.draw(rng, family)
    if family in _OPTICS:
        step *= float(rng.choice([0.5, 1.0, 2.0, 5.0]))
    drawn: dict[str, Any] = {name: values[name] for name in _IN_CONFIG}
    config = SimulationConfig(
        **drawn,
        sigma_range=None if rng.random() < _BY_TABLE else values["sigma_range"],
        gimbal_clock_offset=latency * rng.choice([-1.0, 1.0]),
        encoder_step=2 * np.pi / 2 ** round(values["encoder_bits"]),
        range_step=step,
        axis_offset=(float(rng.uniform(-0.1, 0.1)), float(rng.uniform(-0.1, 0.1))),
        optics=_optics(rng, values, family),
        has_rings=family != "bare",
    )
    return replace(config, **_motion(rng, values, family))


def _optics(rng: np.random.Generator, values: _Values, family: str) -> Optics:
    """Draw footprint and echoes."""
    is_pencil = family in _OPTICS and rng.random() < _PENCILS
    profiles, picks = list(Profile), list(Pick)
    across, along = (values["window"] * BEAM_WINDOW).tolist()
    return Optics(
        profile=Profile.EVEN if family == "plain" else profiles[rng.integers(len(profiles))],
        divergence_scale=0.0 if is_pencil else values["divergence_scale"],
        window=(across, along),
        incidence=float(rng.integers(2)),
        pick=picks[rng.choice(len(picks), p=_PICKS)],
        sigma_weak=values["sigma_weak"] * float(rng.random() < _WEAKER),
        range_scale=rng.normal(0.0, values["range_scale"]),
        range_bias=rng.normal(0.0, values["range_bias"]),
        dust=between(rng, _DUST) if family == "dust" else 0.0,
        strays=_STRAYS if family in ("dust", _ALL) else 0.0,
        **{name: values[name] for name in ("roundness", "gate", "range_half", "softness")},
    )


def _motion(rng: np.random.Generator, values: _Values, family: str) -> dict[str, Any]:
    """Draw how LiDAR and gimbal turn."""
    periods, teeth = float(rng.integers(1, 13)), float(rng.integers(50, 401))
    ripples = ((values["ripple"], periods), (values["cogging"] / teeth, teeth))
    if family == "lattice":
        turn, rpm = _LATTICES[rng.integers(len(_LATTICES))]
        return {"turn": turn, "spin_rpm": rpm, "ripples": ripples if rng.random() < 0.3 else ()}
    is_bare = family == "bare" and rng.random() < 0.5
    if family == "step-and-shoot" or is_bare:  # without times, a message must lie within a rest
        step = float(np.radians(rng.choice(_STEPS)))
        rests = int(rng.integers(1, 3)) + 2 * is_bare
        return {"step": step, "rest_revolutions": rests, "move": 0.05, "shot_times": not is_bare}
    sweep = float(np.radians(rng.uniform(180.0, 200.0))) if family == "one face" else 2 * np.pi
    rpm, turn = _speeds(rng, family)
    if family == "one face":
        turn *= _SLOWER
    return {"turn": turn, "spin_rpm": rpm, "ripples": ripples, "sweep": sweep}


def _speeds(rng: np.random.Generator, family: str) -> tuple[float, float]:
    """Draw speeds of LiDAR [1/min] and turn [s]; those that spread scan lines, if some do."""
    rpm, turn = 600.0, SimulationConfig().turn
    for _ in range(_N_TRIES):
        rpm = float(rng.choice(_RPM)) * (1.0 + _RPM_OFF * rng.standard_normal())
        rpm, turn = float(np.clip(rpm, 300.0, 1200.0)), PRIORS["turn"].draw(rng, family)
        if not commensurability(SimulationConfig(turn=turn, spin_rpm=rpm)):
            break
    return rpm, turn


def _field(values: _Values, seed: int, family: str, config: SimulationConfig) -> Field:
    """Draw ground, markers, stops and objects."""
    rng = np.random.default_rng([seed, _LAYOUT])
    is_usual = family != "radius" and rng.random() < 0.5
    radius = 0.1 if is_usual else values["radius"]
    terrain = _terrain(values, np.random.default_rng([seed, _LAND]))
    farthest = _farthest(radius, config)
    marks = _marks(rng, 0 if family == "empty" else int(rng.integers(*_N_MARKS)), radius, farthest)
    stops = _stops(rng, terrain, values["mast"], _clearances(marks, radius))
    marks[:, 2] = _heights(rng, marks, terrain, radius)
    shade = values["shade"]
    stem = float(np.clip(radius * rng.uniform(0.08, 0.3), 0.004, 0.15))
    stands = _stands(np.random.default_rng([seed, _ITEMS, 2]), marks, terrain, (radius, stem))
    feet = np.array([stand.z for stand in stands])
    posts, spheres, poles = marker_surfaces(marks, feet, radius, stem, shade)
    clear = [(s.p_site[0], s.p_site[1], _STOP_CLEAR) for s in stops]
    clear += [(x, y, radius + 0.4) for x, y, _ in marks]
    lies = np.random.default_rng([seed, _LAND, 1])
    rocks = rock_mesh(lies, draw_rocks(lies, np.array(clear), values["cover"]), terrain)
    wide = [mesh for stand in stands for mesh in stand.meshes]
    sticks = [stick for stand in stands for stick in stand.sticks]
    mesh = Mesh.merged([terrain_mesh(lies, terrain), _skirt(terrain), rocks, posts, *wide])
    names = tuple(f"P{i + 1:02d}" for i in range(len(marks)))
    world = Field(
        scenario="random",
        seed=seed,
        terrain=terrain,
        scene=Scene(mesh=mesh, spheres=spheres, poles=poles.joined(sticks)),
        marks=ControlMarks(names=names, p_site=marks, cov_p_site=np.zeros((len(marks), 3, 3))),
        marker_radius=radius,
        stops=stops,
        family=family,
        stands=tuple(stand.kind for stand in stands),
    )
    items = _items(np.random.default_rng([seed, _ITEMS]), world, family, farthest)
    if family in ("clutter", _ALL):
        items += _masts(np.random.default_rng([seed, _ITEMS, 1]), world)
    return with_items(world, "random", items)


def _farthest(radius: float, config: SimulationConfig) -> float:
    """Return the distance at which a marker has the fewest returns [m]."""
    rate = config.turn / SimulationConfig().turn if not config.step else 1.0
    per_metre = _RETURNS * rate * config.sweep / (2 * np.pi) * (radius / 0.1) ** 2
    return float(min(np.sqrt(per_metre / _FEWEST), _FARTHEST))


def _terrain(values: _Values, rng: np.random.Generator) -> Terrain:
    """Draw the ground: regolith of some roughness on a slope."""
    rough, slope, bearing = rough_terrain(rng), values["slope"], rng.uniform(-np.pi, np.pi)
    plane = slope * (np.cos(bearing) * rough.xs[None, :] + np.sin(bearing) * rough.ys[:, None])
    return replace(rough, heights=values["ground"] * rough.heights + plane)


def _skirt(terrain: Terrain) -> Mesh:
    """Return level ground around a terrain."""
    rings = []
    edge, z = float(terrain.xs[-1]), float(np.median(terrain.heights))
    for half in (edge, _SKIRT):
        corners = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        rings.append(np.column_stack([corners, np.full(4, z)]))
    i, j = np.arange(4), (np.arange(4) + 1) % 4
    triangles = np.concatenate([np.column_stack([i, j, i + 4]), np.column_stack([j, j + 4, i + 4])])
    return Mesh.even(np.concatenate(rings), triangles, 0.15)


def _marks(rng: np.random.Generator, n: int, radius: float, farthest: float) -> Array:
    """Draw places of markers about the origin so that none hides another, (n, 3) [m]."""
    nearest = max(_NEAREST + radius, 6.0 * radius)
    found: list[Array] = []
    for _ in range(_N_TRIES):
        if len(found) == n:
            break
        distance = np.exp(rng.uniform(np.log(nearest), np.log(farthest)))
        bearing = rng.uniform(-np.pi, np.pi)
        place = distance * np.array([np.cos(bearing), np.sin(bearing), 0.0])
        apart = [abs(np.angle(np.exp(1j * (bearing - np.arctan2(p[1], p[0]))))) for p in found]
        widths = [radius / np.hypot(*p[:2]) + radius / distance + 0.05 for p in found]
        if all(a > w for a, w in zip(apart, widths, strict=True)):
            found.append(place)
    return np.array(found).reshape(-1, 3)


def _heights(rng: np.random.Generator, marks: Array, terrain: Terrain, radius: float) -> Array:
    """Draw heights of markers: most are raised, some lie on the ground [m]."""
    n = len(marks)
    above = radius + np.where(rng.random(n) < 0.1, 0.02, rng.uniform(0.3, 1.6, n))
    return np.asarray(terrain.height_at(marks) + above)


def _stands(
    rng: np.random.Generator, marks: Array, terrain: Terrain, radii: tuple[float, float]
) -> list[Stand]:
    """Draw what markers stand on; ``radii`` are those of a marker and of its pole [m]."""
    lowest = marks - np.array([0.0, 0.0, radii[0]])
    return [draw_stand(rng, terrain, place, *radii) for place in lowest]


def _clearances(marks: Array, radius: float) -> Array:
    """Return places of markers, and how far a stop keeps away from each, (n, 3) [m]."""
    return np.column_stack([marks[:, :2], np.full(len(marks), _NEAREST + radius)])


def _stops(
    rng: np.random.Generator, terrain: Terrain, mast: float, clear: Array
) -> tuple[Stop, ...]:
    """Draw stops: the first at the origin, the others about it, clear of some places."""
    places = [np.zeros(3)]
    for _ in range(_N_TRIES):
        if len(places) == _N_STOPS:
            break
        distance, bearing = _SPREAD * np.sqrt(rng.random()), rng.uniform(-np.pi, np.pi)
        place = distance * np.array([np.cos(bearing), np.sin(bearing), 0.0])
        if (np.hypot(*(clear[:, :2] - place[:2]).T) > clear[:, 2]).all():
            places.append(place)
    stops = []
    for i, place in enumerate(places):
        place[2] = terrain.height_at(place) + mast
        heading = float(rng.uniform(-np.pi, np.pi))
        stops.append(Stop(name=f"stop{i + 1}", p_site=place, heading=heading))
    return tuple(stops)


def _items(rng: np.random.Generator, world: Field, family: str, farthest: float) -> list[Item]:
    """Draw the objects of a world."""
    ground = Ground(world, world.stops[0], hides=family in ("clutter", _ALL) and rng.random() < 0.5)
    items, reach = list[Item](), float(np.clip(farthest, *_REACH))
    if family in ("panels", _ALL):
        items += _beside(rng, ground)
    rates = {
        "plain": (0.5, 0.0, 0.0, 0.0),
        "clutter": (3.0, 4.0, 1.2, 1.0),
        "decoys": (2.0, 0.3, 0.5, 6.0),
        "rocks": (40.0, 0.3, 0.3, 0.5),
        "empty": (12.0, 3.0, 1.0, 4.0),
        _ALL: (10.0, 2.0, 0.8, 2.0),
    }.get(family, (2.0, 0.4, 0.3, 0.7))
    for rate, kinds in zip(rates, (_ROUND, _GROWN, _BUILT, _LIKE), strict=True):
        for builder, metres, radii in kinds:
            room = metres + radii * world.marker_radius
            ring = (2.0 + room, max(reach, 4.0 + 2.0 * room))
            items += placed(rng, ground, (int(rng.poisson(rate)), ring, room), builder)
    return items


def _beside(rng: np.random.Generator, ground: Ground) -> list[Item]:
    """Draw panels 5 cm to 1 m behind markers, bodies as near beside them, and screens before."""
    radius, items = ground.world.marker_radius, list[Item]()
    scale = max(1.0, radius / 0.1)
    for mark in ground.world.marks.p_site:
        gap = radius + float(np.exp(rng.uniform(np.log(0.05), 0.0)))
        kind = rng.choice(4)
        if kind == 0:
            items.append(panel(rng, ground.centre, mark, (gap, gap), scale))
        elif kind == 1:
            items.append(_neighbour(rng, ground, mark, gap))
        elif kind == 2 and rng.random() < 0.5:
            items.append(screen(rng, ground, mark))
    stops = np.array([stop.p_site for stop in ground.world.stops])
    return [
        item
        for item in items
        if np.linalg.norm(stops - item.p_site, axis=1).min() > item.reach + _STOP_CLEAR
    ]


def _masts(rng: np.random.Generator, world: Field) -> list[Item]:
    """Draw masts and antennas of the rover about its first stop, some nearer than is measured."""
    items, eye = list[Item](), world.stops[0].p_site
    for _ in range(int(rng.integers(4))):
        away, bearing = rng.uniform(*_MAST_AWAY), rng.uniform(-np.pi, np.pi)
        radius = rng.uniform(*_MAST)
        place = eye + away * np.array([np.cos(bearing), np.sin(bearing), 0.0])
        foot = np.append(place[:2], world.terrain.height_at(place))
        top = objects.above(place, rng.uniform(-0.3, 1.0))
        mesh, axis = cylinder(foot, top, radius, objects.WALL_SHADE), (foot, top, radius)
        items.append(Item(kind="mast", p_site=top, meshes=[mesh], sticks=[axis]))
    return items


def _neighbour(rng: np.random.Generator, ground: Ground, mark: Array, gap: float) -> Item:
    """Return a post or a wall's end beside a marker, its surface a gap from the centre."""
    sight = mark[:2] - ground.centre
    sight /= np.linalg.norm(sight)
    side = rng.choice([-1.0, 1.0]) * np.array([-sight[1], sight[0]])
    foot = np.append(mark[:2], ground.world.terrain.height_at(mark) - 0.1)
    top, depth = (
        mark[2] + rng.uniform(-1.0, 3.0) * ground.world.marker_radius,
        rng.uniform(-0.3, 0.3),
    )
    if rng.random() < 0.5:
        radius = rng.uniform(0.02, 0.15)
        foot[:2] += (gap + radius) * side + depth * sight
        high = np.append(foot[:2], max(top, foot[2] + 0.3))
        mesh, axis = cylinder(foot, high, radius, objects.WALL_SHADE), (foot, high, radius)
        return Item(kind="post beside", p_site=high, meshes=[mesh], sticks=[axis])
    wide, tall = rng.uniform(0.3, 2.0), max(float(top - foot[2]), 0.3)
    foot[:2] += (gap + wide / 2) * side + depth * sight
    middle = foot + np.array([0.0, 0.0, tall / 2])
    heading = float(np.arctan2(sight[1], sight[0]))
    mesh = box(middle, (rng.uniform(0.02, 0.2), wide, tall), heading, objects.WALL_SHADE)
    return Item(kind="wall beside", p_site=middle, meshes=[mesh])
