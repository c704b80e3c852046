"""Centres from ranges and from the outline: which shots hit the sphere and which passed it by.

Hides the shots that nobody recorded. A driver drops what did not return, but lasers fire by the
clock: ring, time and azimuth of the returns about a marker tell every shot between them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pipelines.config import FittingConfig
from pipelines.fitting import along_beam
from pipelines.fitting.description import Fits
from pipelines.fitting.footprint import predict
from pipelines.geometry import levelling_rotation
from pipelines.rigs import FIRING_CYCLE, FIRING_ORDER, LASER_CYCLE, N_LASERS
from pipelines.stitching import beams
from pipelines.values import (
    RING_UNKNOWN,
    Array,
    Index,
    MarkerCandidates,
    MarkerFit,
    Mask,
    Status,
    StitchedCloud,
)

NAME = "silhouette"
RANGES_ONLY = "ranges only: "

_DELAYS = np.argsort(FIRING_ORDER) * LASER_CYCLE  # [s] of each laser within its firing
_PHASE_MAX = 3e-6  # [s] scatter of the firing clock: one laser's share of a firing
_N_TIMED = 20_000  # returns that tell the clock and the spin
_SPIN_MAX = np.radians(0.2)  # scatter of azimuths about a steady spin
_REACH = 1.5  # radii: shots that pass a centre closer are asked
_DEPTH = 2.0  # radii before and behind the centre within which a return is the sphere's own
_POLE_FROM, _POLE = 0.6, 0.35  # radii below the centre, and from the vertical: may be the pole
_LUCK = 0.01  # share of shots that hit and are lost, or pass by and answer
_EDGES = np.linspace(-1.2, 0.2, 15)  # half widths inside the outline where half answer
_SOFTNESSES = (0.03, 0.06, 0.12, 0.24)  # half widths over which the answer turns to yes
_EDGE, _SIGMA_EDGE = -0.6, 0.4  # prior of the edge
_N_PLACES = 24  # where a centre may be, when the link is sought
_REACH_SIGMAS, _REACH_WIDTHS = 4.0, 2.0  # of a centre, of a footprint: shots within are in doubt
_DRIFT = 0.05  # [s] over which the spin is steady
_CLOSE = 0.02  # [s] between returns of the same part of a revolution
_N_RATES = 10
_SEARCHES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)  # of the rate: ever finer about the best
_MARGIN = np.radians(1.0)  # what the LiDAR's place off the axis does to directions
_THIN = 1e-6  # [m]
_WIDER = 1.5  # of the variance: samples beyond the first round are drawn so much wider
_FLOOR = 0.01  # of the prior covariance: keeps a sample's covariance invertible
_SCALE, _SCALE_FEW, _FEW = 0.75, 0.35, 25.0  # of the covariance by returns, by Monte Carlo
_N_SAMPLES = 400
_N_ROUNDS = 3


class _Pattern(NamedTuple):
    """When and whither the lasers fire.

    Attributes
    ----------
    phase : float
        Instant of the first laser of firing 0 [s].
    spin : float
        Rate of the azimuth [rad/s].
    times, azimuths : (k,)
        By how much a steady spin is off at some instants [s, rad].
    """

    phase: float
    spin: float
    times: Array
    azimuths: Array


class _Firings(NamedTuple):
    """All firings of a stop, and which of their shots returned.

    Attributes
    ----------
    times, azimuths, angles : (m,)
        Instant of the first laser [s], azimuth then, gimbal angle then [rad].
    spin, turn : float
        Rates of the two [rad/s].
    v_base : (m, 3)
        Direction of a laser without elevation.
    row_of : (m, 16)
        Row of the cloud that each shot returned as; -1 where it did not.
    """

    times: Array
    azimuths: Array
    angles: Array
    spin: float
    turn: float
    v_base: Array
    row_of: Index


class _Passing(NamedTuple):
    """Shots that pass one sphere closely, in the plane square to the line of sight.

    Attributes
    ----------
    places : (n, 2)
        Where they pass [m].
    half_widths : (n, 2, 2)
        Square roots of their footprints there: half widths times their axes [m].
    has_hit : (n,)
        Whether they returned from the sphere.
    axes : (2, 3)
        Unit vectors of the plane.
    """

    places: Array
    half_widths: Array
    has_hit: Mask
    axes: Array


def fit(
    cloud: StitchedCloud, found: MarkerCandidates, config: FittingConfig, radius: float
) -> Fits:
    """Fit all candidates of a stop by their ranges and by their outline.

    Parameters
    ----------
    cloud : StitchedCloud
        The stop, with rings and times.
    found : MarkerCandidates
        Groups of returns.
    config : FittingConfig
        Prior noise of direction and laser bias.
    radius : float
        Radius of the spheres [m].

    Returns
    -------
    fits : tuple of MarkerFit
        Centres with covariances. Where the firing pattern cannot be told they are those of
        ``along_beam``, weak, with the reason in ``variant``.
    rejected : tuple of Rejection
        Candidates that no sphere explains.

    Notes
    -----
    The posterior of ``along_beam`` is the prior; every shot that passes closely adds the
    probability that it hit, or did not, which rises from 0 to 1 as its footprint enters the
    outline. Where on the way it is one half is the same for all markers of a stop and estimated
    with them. Mean and covariance are those of a weighted sample.
    """
    fits, rejected = along_beam.fit(cloud, found, config, radius)
    if not fits:
        return fits, rejected
    pattern, why_not = _pattern(cloud)
    if pattern is None:
        return tuple(_without_outline(fit, why_not) for fit in fits), rejected
    firings = _firings(cloud, pattern)
    passing = [_doubtful(_passing(cloud, firings, fit), fit) for fit in fits]
    link = _link(fits, passing)
    updated = tuple(
        _updated(cloud, fit, shots, link) for fit, shots in zip(fits, passing, strict=True)
    )
    return updated, rejected


def _without_outline(fit: MarkerFit, why_not: str) -> MarkerFit:
    """Return the fit by ranges alone, weak, with the reason."""
    said = f"{fit.reason} " if fit.reason else ""
    return replace(
        fit,
        method=NAME,
        status=Status.WEAK,
        reason=f"{said}The outline is not used: {why_not}.",
        variant=RANGES_ONLY + why_not,
    )


def _pattern(cloud: StitchedCloud) -> tuple[_Pattern | None, str]:
    """Return the firing pattern, or why it cannot be told."""
    if len(cloud.rig.laser_elevations) != N_LASERS:
        return None, f"the rig has {len(cloud.rig.laser_elevations)} lasers, not a VLP-16's 16"
    if not len(cloud.rings) or np.any(cloud.rings == RING_UNKNOWN):
        return None, "the rings of the returns are not known"
    rows = np.unique(np.linspace(0, len(cloud.times) - 1, _N_TIMED).astype(np.intp))
    rows = rows[np.isfinite(cloud.p_base[rows]).all(axis=1)]
    times = cloud.times[rows].astype(np.float64)
    firings = times - _DELAYS[cloud.rings[rows]]
    turn = np.exp(2j * np.pi * firings / FIRING_CYCLE)
    phase = float(np.angle(turn.mean())) / (2 * np.pi) * FIRING_CYCLE
    off = np.angle(turn * np.exp(-2j * np.pi * phase / FIRING_CYCLE)) / (2 * np.pi) * FIRING_CYCLE
    if not np.sqrt(np.mean(off**2)) < _PHASE_MAX:
        return None, "the times of the returns do not follow the VLP-16's firing cycle"
    order = np.argsort(times)
    azimuths = _azimuths(cloud, rows)[order]
    spin, off = _steady(times[order], azimuths)
    bins = np.round((times[order] - times.min()) / _DRIFT).astype(np.intp)
    counts = np.bincount(bins)
    seen = np.flatnonzero(counts)
    drift = np.bincount(bins, off)[seen] / counts[seen]
    scatter = np.sqrt(np.mean((off - np.bincount(bins, off)[bins] / counts[bins]) ** 2))
    if not scatter < _SPIN_MAX:
        return None, "the azimuths of the returns do not follow a steady spin"
    return _Pattern(phase, spin, times.min() + seen * _DRIFT, drift), ""


def _azimuths(cloud: StitchedCloud, rows: Index) -> Array:
    """Return the azimuths of returns in the frame of the LiDAR [rad]."""
    table = beams(cloud, rows)
    angles = cloud.gimbal_angles[rows].astype(np.float64)
    c, s, d = np.cos(angles), np.sin(angles), table.directions_base
    v_head = np.column_stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], d[:, 2]])
    v = v_head @ cloud.rig.T_head_lidar[:3, :3]
    return np.asarray(np.arctan2(-v[:, 1], v[:, 0]))


def _steady(times: Array, azimuths: Array) -> tuple[float, Array]:
    """Return the rate of the steadiest spin [rad/s], and each azimuth less its rate times time."""
    gaps, steps = np.diff(times), np.diff(azimuths)
    is_close = (gaps > 0.0) & (gaps < _CLOSE)
    rates = (steps[is_close] % (2 * np.pi)) / gaps[is_close]
    if len(rates) < _N_RATES:
        return 0.0, np.where(np.arange(len(times)) % 2, np.pi, -np.pi)
    spin = float(np.median(rates))
    turns = np.exp(1j * azimuths)
    for width in _SEARCHES:
        trial = spin * (1.0 + width * np.linspace(-2.0, 2.0, 81))
        power = [abs(np.mean(turns * np.exp(-1j * rate * times))) for rate in trial]
        spin = float(trial[int(np.argmax(power))])
    mean = float(np.angle(np.mean(turns * np.exp(-1j * spin * times))))
    return spin, mean + np.angle(turns * np.exp(-1j * (spin * times + mean)))


def _firings(cloud: StitchedCloud, pattern: _Pattern) -> _Firings:
    """Return every firing between the first return and the last."""
    delays = _DELAYS[cloud.rings]
    numbers = np.rint((cloud.times - delays - pattern.phase) / FIRING_CYCLE).astype(np.intp)
    first = int(numbers.min())
    numbered = np.arange(first, int(numbers.max()) + 1, dtype=np.float64)
    times: Array = pattern.phase + FIRING_CYCLE * numbered
    row_of = np.full((len(times), N_LASERS), -1, dtype=np.intp)
    row_of[numbers - first, cloud.rings] = np.arange(len(numbers))
    stamps, places = np.unique(cloud.times[:: max(len(numbers) // _N_TIMED, 1)], return_index=True)
    angles = np.unwrap(cloud.gimbal_angles[:: max(len(numbers) // _N_TIMED, 1)][places])
    gimbal = np.interp(times, stamps, angles.astype(np.float64))
    azimuths = pattern.spin * times + np.interp(times, pattern.times, pattern.azimuths)
    return _Firings(
        times=times,
        azimuths=azimuths,
        angles=gimbal,
        spin=pattern.spin,
        turn=float(np.median(np.gradient(gimbal, FIRING_CYCLE))),
        v_base=_directions(cloud, azimuths, gimbal, np.zeros(len(times))),
        row_of=row_of,
    )


def _directions(cloud: StitchedCloud, azimuths: Array, angles: Array, elevations: Array) -> Array:
    """Return the directions of shots in the base frame, (n, 3)."""
    v_lidar = np.column_stack(
        [
            np.cos(elevations) * np.cos(azimuths),
            -np.cos(elevations) * np.sin(azimuths),
            np.sin(elevations),
        ]
    )
    return _turned(v_lidar @ cloud.rig.T_head_lidar[:3, :3].T, angles)


def _turned(v_head: Array, angles: Array) -> Array:
    """Return vectors of the turning head, (n, 3), in the base frame."""
    c, s = np.cos(angles), np.sin(angles)
    x, y, z = v_head.T
    return np.column_stack([c * x - s * y, s * x + c * y, z])


def _passing(cloud: StitchedCloud, firings: _Firings, fit: MarkerFit) -> _Passing:
    """Return the shots that pass one sphere closely, save those that its pole may have answered."""
    rig, p, radius = cloud.rig, fit.p_base, fit.radius
    sight = p / np.linalg.norm(p)
    reach = float(np.abs(rig.laser_elevations).max()) + _REACH * radius / fit.mean_range + _MARGIN
    near = np.flatnonzero(firings.v_base @ sight > np.cos(reach))
    m, ring = np.repeat(near, N_LASERS), np.tile(np.arange(N_LASERS), len(near))
    angles = firings.angles[m] + firings.turn * _DELAYS[ring]
    azimuths = firings.azimuths[m] + firings.spin * _DELAYS[ring]
    u = _directions(cloud, azimuths, angles, rig.laser_elevations[ring])
    spin_axis = rig.T_head_lidar[:3, 2]
    origins = _turned(rig.T_head_lidar[:3, 3] + rig.laser_heights[ring, None] * spin_axis, angles)
    along = np.einsum("ij,ij->i", p - origins, u)
    passed = origins + along[:, None] * u - p
    keep = (along > 0.0) & (np.einsum("ij,ij->i", passed, passed) < (_REACH * radius) ** 2)
    rows = firings.row_of[m[keep], ring[keep]]
    seen = np.where(rows < 0, np.inf, np.linalg.norm(cloud.p_base[rows] - origins[keep], axis=1))
    depth = (seen - along[keep]) / radius
    axes = _plane(sight, levelling_rotation(cloud.levelling)[2])
    places = passed[keep] @ axes.T
    across = np.cross(_turned(np.tile(spin_axis, (int(keep.sum()), 1)), angles[keep]), u[keep])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    both = np.stack([across, np.cross(u[keep], across)], axis=1) @ axes.T
    half_widths = 0.5 * along[keep, None, None] * rig.divergence[:, None] * both
    is_pole = (places[:, 1] < -_POLE_FROM * radius) & (np.abs(places[:, 0]) < _POLE * radius)
    asked = (depth > -_DEPTH) & ~is_pole
    return _Passing(places[asked], half_widths[asked], (depth < _DEPTH)[asked], axes)


def _plane(sight: Array, up: Array) -> Array:
    """Return two unit vectors square to a line of sight, the second one upward, (2, 3)."""
    side = np.cross(sight, up)
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(side, sight)])


def _logarithms(shots: _Passing, radius: float, shifts: Array, links: Array) -> Array:
    """Return the log-likelihood of what hit and what did not, for some centres and links, (k,).

    ``shifts`` are the centres in the plane, (k, 2); ``links`` has where half of the shots answer
    and over what distance that changes, (k, 2), in half widths of the footprint.
    """
    offsets = shots.places - shifts[:, None, :]
    away = np.linalg.norm(offsets, axis=-1)
    outward = offsets / np.maximum(away, 1e-9)[..., None]
    widths = np.linalg.norm(np.einsum("nij,knj->kni", shots.half_widths, outward), axis=-1)
    entered = (radius - away) / np.maximum(widths, _THIN)
    x = np.clip((entered - links[:, :1]) / links[:, 1:], -40.0, 40.0)
    chance = _LUCK + (1.0 - 2.0 * _LUCK) / (1.0 + np.exp(-x))
    return np.asarray(np.log(np.where(shots.has_hit, chance, 1.0 - chance)).sum(axis=1))


def _doubtful(shots: _Passing, fit: MarkerFit) -> _Passing:
    """Return the shots that may hit or not as the centre is here or there; others say nothing."""
    widths = np.sqrt(np.sum(shots.half_widths**2, axis=(1, 2)))
    reach = _REACH_SIGMAS * np.sqrt(np.linalg.eigvalsh(fit.cov_p_base)[-1])
    gaps = np.abs(np.linalg.norm(shots.places, axis=1) - fit.radius)
    near = gaps < reach + _REACH_WIDTHS * widths
    return shots._replace(
        places=shots.places[near],
        half_widths=shots.half_widths[near],
        has_hit=shots.has_hit[near],
    )


def _link(fits: tuple[MarkerFit, ...], passing: list[_Passing]) -> Array:
    """Return where on its way in half of the shots answer, and how softly, (2,).

    Each marker's centre is only known so well, so that its likelihood is the mean over places where
    it may be.
    """
    links = np.array([[edge, soft] for edge in _EDGES for soft in _SOFTNESSES])
    total = -0.5 * ((links[:, 0] - _EDGE) / _SIGMA_EDGE) ** 2
    z = _normal(_N_PLACES)
    for fit, shots in zip(fits, passing, strict=True):
        shifts = z @ np.linalg.cholesky(fit.cov_p_base).T @ shots.axes.T
        for i, link in enumerate(links):
            logs = _logarithms(shots, fit.radius, shifts, np.tile(link, (len(z), 1)))
            total[i] += logs.max() + np.log(np.mean(np.exp(logs - logs.max())))
    return np.asarray(links[int(np.argmax(total))])


def _normal(n: int) -> Array:
    """Return standard normal places, (n, 3), the same every time and without a mean."""
    half = np.random.default_rng(0).standard_normal((n // 2, 3))
    return np.concatenate([half, -half])


def _updated(cloud: StitchedCloud, fit: MarkerFit, shots: _Passing, link: Array) -> MarkerFit:
    """Return the fit with what its outline says."""
    z = _normal(_N_SAMPLES)
    precision = np.linalg.inv(fit.cov_p_base)
    mean, cov, wide = np.zeros(3), fit.cov_p_base, 1.0
    links = np.tile(link, (len(z), 1))
    for _ in range(_N_ROUNDS):
        d = mean + z @ np.linalg.cholesky(wide * cov).T
        logs = _logarithms(shots, fit.radius, d @ shots.axes.T, links)
        logs += 0.5 * np.sum(z**2, axis=1) - 0.5 * np.einsum("ij,jk,ik->i", d, precision, d)
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        mean = weights @ d
        cov = (weights[:, None] * (d - mean)).T @ (d - mean) + _FLOOR * fit.cov_p_base
        wide = _WIDER
    p = fit.p_base + mean
    table = beams(cloud, fit.used)
    which = np.zeros(len(fit.used), dtype=np.intp)
    found = predict(table, p[None], np.array([fit.radius]), which)
    return replace(
        fit,
        method=NAME,
        p_base=p,
        cov_p_base=(_SCALE + _SCALE_FEW * np.exp(-fit.n_points / _FEW)) * cov,
        mean_range=float(np.linalg.norm(table.origins_base.mean(axis=0) - p)),
        residuals=table.ranges - found.ranges,
    )
