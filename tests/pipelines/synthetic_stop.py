"""A small world of balls on poles, posts, boulders and a plane, seen shot by shot by a VLP-16.

Independent of the product's simulator: ranges come from the intersection of rays with solids, and
the footprint of a beam from many rays.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.geometry import levelling_rotation
from spheremark.pipelines.model import Levelling, StitchedCloud
from spheremark.pipelines.scan.rigs import FIRING_CYCLE, FIRING_ORDER, LASER_CYCLE, tilted_vlp16

RIG = tilted_vlp16("test", (0.05, 0.03))
LEVEL = Levelling(roll=0.0, pitch=0.0, sigma=1e-3, is_measured=True)
RADIUS = 0.100


class Shots(NamedTuple):
    origins: np.ndarray
    directions: np.ndarray
    across: np.ndarray
    rings: np.ndarray
    times: np.ndarray
    angles: np.ndarray

    def take(self, rows):
        return Shots(*(column[rows] for column in self))


@lru_cache(maxsize=2)
def fire(turn=13.2, revolutions_per_second=10.0):
    """All shots of one turn of the gimbal; the spin axis is horizontal and off the gimbal axis."""
    n = int(turn / FIRING_CYCLE)
    times = (np.arange(n)[:, None] * FIRING_CYCLE + np.argsort(FIRING_ORDER) * LASER_CYCLE).ravel()
    rings = np.tile(np.arange(16, dtype=np.uint8), n)
    azimuth = 2 * np.pi * revolutions_per_second * times
    angles = (2 * np.pi * times / turn + np.pi) % (2 * np.pi) - np.pi
    elevation, height = RIG.laser_elevations[rings], RIG.laser_heights[rings]
    R, t = RIG.T_head_lidar[:3, :3], RIG.T_head_lidar[:3, 3]
    v_lidar = np.column_stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            -np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    directions = turned(v_lidar @ R.T, angles)
    origins = turned(t + height[:, None] * R[:, 2], angles)
    spin = turned(np.tile(R[:, 2], (len(angles), 1)), angles)
    across = np.cross(spin, directions)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return Shots(origins, directions, across, rings, times, angles)


def turned(v, angles):
    c, s = np.cos(angles), np.sin(angles)
    return np.column_stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1], v[:, 2]])


def moved_to(shots, angles):
    """The same shots from a gimbal at other angles."""
    by = angles - shots.angles
    vectors = (turned(v, by) for v in (shots.origins, shots.directions, shots.across))
    return Shots(*vectors, shots.rings, shots.times, (angles + np.pi) % (2 * np.pi) - np.pi)


def towards(shots, p, reach):
    """The shots that pass a point by less than a distance."""
    away, off = np.linalg.norm(p), np.linalg.norm(shots.origins[0]) + 0.05
    if away > reach + 2 * off:  # most go elsewhere, which one product shows
        limit = np.arcsin(reach / (away - off)) + np.arcsin(off / away) + 1e-3
        shots = shots.take(np.flatnonzero(shots.directions @ (p / away) > np.cos(limit)))
    along, gap2 = passing(shots, p)
    return shots.take((along > 0) & (gap2 < reach**2))


def passing(shots, p):
    """How far along shots pass a point, and the squares of how far beside it."""
    v = p - shots.origins
    along = np.einsum("ij,ij->i", v, shots.directions)
    return along, np.einsum("ij,ij->i", v, v) - along**2


def sphere_ranges(origins, directions, centre, radius):
    v = centre - origins
    along = np.einsum("...i,...i->...", v, directions)
    h2 = radius**2 - np.einsum("...i,...i->...", v, v) + along**2
    return np.where((h2 > 0) & (along > 0), along - np.sqrt(np.maximum(h2, 0)), np.inf)


def post_ranges(origins, directions, foot, radius, height):
    """Ranges to a vertical cylinder that stands on a point."""
    v, d = (foot - origins)[..., :2], directions[..., :2]
    a = np.einsum("...i,...i->...", d, d)
    b = np.einsum("...i,...i->...", v, d)
    h2 = b**2 - a * (np.einsum("...i,...i->...", v, v) - radius**2)
    t = (b - np.sqrt(np.maximum(h2, 0))) / a
    z = origins[..., 2] + t * directions[..., 2] - foot[2]
    return np.where((h2 > 0) & (t > 0) & (z > 0) & (z < height), t, np.inf)


def ground_ranges(origins, directions, z):
    with np.errstate(divide="ignore"):
        t = (z - origins[..., 2]) / directions[..., 2]
    return np.where(t > 0, t, np.inf)


def footprint(shots, divergence, n=24):
    """Rays, n * n a shot and each with the same share of the light, that fill the footprint."""
    r = np.sqrt((np.arange(n) + 0.5) / n)
    phi = 2 * np.pi * (np.arange(n) + 0.5) / n
    x = (r[:, None] * np.cos(phi)).ravel() * divergence[0] / 2
    y = (r[:, None] * np.sin(phi)).ravel() * divergence[1] / 2
    along = np.cross(shots.directions, shots.across)
    v = shots.directions[:, None] + x[:, None] * shots.across[:, None] + y[:, None] * along[:, None]
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def lit_ranges(shots, centre, radius, divergence, n=24, power=0.0):
    """Mean range over the part of each footprint that hits a sphere, infinite where none does.

    Parts weigh by a power of the cosine of incidence.
    """
    ranges, lit = np.full(len(shots.rings), np.inf), np.zeros(len(shots.rings))
    along, gap2 = passing(shots, centre)
    met = gap2 < (radius + max(divergence) / 2 * (along + 2 * radius)) ** 2  # no ray of another
    shots = shots.take(met)
    rays = footprint(shots, divergence, n)
    t = sphere_ranges(shots.origins[:, None], rays, centre, radius)
    hits = np.isfinite(t)
    reached, weights = np.where(hits, t, 0), hits.astype(float)
    if power:
        out = shots.origins[:, None] + reached[..., None] * rays - centre
        cosines = -np.einsum("...i,...i->...", rays, out) / radius
        weights *= np.maximum(cosines, 0.05) ** power
    total, weight = (weights * reached).sum(axis=1), weights.sum(axis=1)
    ranges[met] = np.where(weight > 0, total / np.maximum(weight, 1e-12), np.inf)
    lit[met] = hits.mean(axis=1)
    return ranges, lit


def cloud_of(shots, ranges, intensity=30.0, rig=RIG, levelling=LEVEL, range_min=0.0):
    """The stitched cloud that shots with these ranges give; infinite ranges are no returns."""
    near = shots.take(ranges <= range_min)
    keep = (range_min < ranges) & (ranges < 60)
    shots, ranges = shots.take(keep), ranges[keep]
    p = shots.origins + ranges[:, None] * shots.directions
    return StitchedCloud(
        p_base=p.astype(np.float32),
        gimbal_angles=shots.angles.astype(np.float32),
        intensities=np.broadcast_to(np.float32(intensity), len(p)).copy(),
        rings=shots.rings.copy(),
        times=shots.times.astype(np.float32),
        levelling=levelling,
        rig=rig,
        coverage=2 * np.pi,
        duration=float(shots.times[-1] - shots.times[0]) if len(p) else 0.0,
        name="synthetic",
        near_times=near.times,
        near_rings=near.rings,
    )


def marker_shots(
    centre, rng, *, sigma=0.0, divergence=RIG.divergence, pole=0.0, step=0.002, power=0.0
):
    """Shots at one marker and their noisy ranges: footprint, pole below, mixed pixels with it."""
    near = towards(fire(), centre, 2.6 * RADIUS)
    ranges, lit = lit_ranges(near, centre, RADIUS, divergence, power=power)
    ranges = np.where(lit > 0.5, ranges, np.inf)
    if pole:
        foot = centre - [0, 0, 2.0]
        ranges = np.minimum(
            ranges, post_ranges(near.origins, near.directions, foot, pole, 2.0 - RADIUS)
        )
    ranges = ranges + sigma * rng.standard_normal(len(ranges))
    if step:
        ranges = np.round(ranges / step) * step
    return near, ranges


class World(NamedTuple):
    """Everything is given in the levelled frame."""

    balls: tuple = ()  # (centre, radius), on poles of 2 cm radius
    boulders: tuple = ()  # (centre, radius)
    posts: tuple = ()  # (foot, radius, height)
    ground: float = -0.8


def scan(world, rng, *, sigma=0.01, levelling=LEVEL, turn=13.2, angles_at=None):
    """One stop in a world, cast with one ray a shot; the gimbal turns evenly, or by a function."""
    shots = fire(turn)
    if angles_at is not None:
        shots = moved_to(shots, angles_at(shots.times))
    R = levelling_rotation(levelling)
    origins, directions = shots.origins @ R.T, shots.directions @ R.T
    ranges = ground_ranges(origins, directions, world.ground)
    azimuths = np.arctan2(directions[:, 1], directions[:, 0])

    def meet(cast, centre, reach):
        off = np.abs(azimuths - np.arctan2(centre[1], centre[0]))
        gap = np.minimum(off, 2 * np.pi - off) * np.hypot(centre[0], centre[1])
        rows = np.flatnonzero(gap < reach + 0.2)
        ranges[rows] = np.minimum(ranges[rows], cast(origins[rows], directions[rows]))

    for c, r in (*world.balls, *world.boulders):
        meet(lambda o, d, c=c, r=r: sphere_ranges(o, d, np.asarray(c), r), c, r)
    for c, r in world.balls:
        foot, height = np.array([c[0], c[1], world.ground]), c[2] - r - world.ground
        meet(lambda o, d, f=foot, h=height: post_ranges(o, d, f, 0.02, h), c, 0.1)
    for foot, r, h in world.posts:
        meet(lambda o, d, f=foot, r=r, h=h: post_ranges(o, d, np.asarray(f), r, h), foot, r)
    ranges = ranges + sigma * rng.standard_normal(len(ranges))
    return cloud_of(shots, ranges, levelling=levelling, range_min=0.9)


def ring_of_markers(n=14, height=0.4, low=6.84, high=9.34):
    """Centres like the study's: all around, at 7 to 9 m."""
    phi = 2 * np.pi * (np.arange(n) + 0.37) / n
    d = np.linspace(low, high, n)
    z = np.linspace(-height, height, n)
    return np.column_stack([d * np.cos(phi), d * np.sin(phi), z])
