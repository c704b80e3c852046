"""The returns of a scan from a sphere: hides the pulse pattern, its gaps, and their information.

A turn of the gimbal draws upright lines of pulses round the horizon. How many cross a sphere, and
where, depends on distance, and on the sphere's position between the lines.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.config import FittingConfig, StitchingConfig
from spheremark.pipelines.errors import ConfigError
from spheremark.pipelines.model import Array, Beams, seal
from spheremark.pipelines.scan.rigs import FIRING_CYCLE, N_LASERS, VLP16_ELEVATIONS
from spheremark.pipelines.simulation import (
    SimulationConfig,
    commensurability,
    face_lines,
    recorded_time,
)
from spheremark.pipelines.sphere.footprint import Prediction, predict
from spheremark.pipelines.sphere.returns import BENT

N_ROWS = 16
"""Rows that each strip of a disc is cut into."""

_N_PER_ROW = 4  # beams along a row's height
_N_PER_STRIP = 4  # and across a strip
_N_PHASES = 400  # places between the lines that a sphere is tried at
_GOLDEN = 0.6180339887498949  # of a turn from place to place: no pitch of lines repeats it
_REFLECTIVITIES = (3.0, 9.0, 24.5, 63.0, 130.0)  # calibrated, at which real packets show ...
_SIGMAS = (0.0137, 0.0107, 0.0089, 0.0067, 0.0064)  # ... this noise of ranges [m]
_TOGETHER = 5  # centres that share a position
_SHARE_MIN = 0.02  # of a footprint that makes a return
_SOFTNESS = 0.15  # of the threshold, in the logarithm of the energy: noise at six sigma below it
_CLOSED = 1e-6  # [rad] by which a sweep may fall short of a full turn
_SAMPLES_MIN = 3.0  # of the angle, of a pulse between two of them on each of two faces
_N_CORNERS = 100  # places between two joint samples where a gimbal may start
_N_ROUNDS = 4  # in which precision and worth of the returns settle
_DISTANCES = np.geomspace(0.5, 45.0, 55)  # [m]
_LOST = 1e-4  # [m^2] a centre worse than this, and than six times the usual, counts as lost


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensor:
    """A tilted VLP-16 on a turning gimbal, and how it is driven.

    Attributes
    ----------
    turn : float
        Time in which the gimbal turns through 360 degrees [s].
    spin_rpm : float
        Revolutions of the LiDAR per minute.
    sweep : float
        Angle that the gimbal turns through. Less than a full turn shows one face of most spheres,
        whose mounting errors then do not cancel [rad].
    step : float
        Angle between the rests of a gimbal that steps instead of turning evenly; 0 turns evenly
        [rad]. ``turn`` then means nothing.
    rest_revolutions : int
        Revolutions of the LiDAR during each rest.
    move : float
        Time of the movement from one rest to the next; the LiDAR runs on [s].
    reflectivity : float
        Calibrated reflectivity of the spheres, 0 to 255. 42: red paint that sends half of the light
        back, the mean over a sphere.
    noise : float or None
        Noise of a range to a sphere near by [m]; by default that of a real VLP-16 at the
        reflectivity.
    sigma_weak : float
        Noise that an echo at the threshold of detection has besides, which falls with its energy
        [m].
    reach : float
        Distance at which a sphere's echoes are at that threshold [m]. Infinite: all are strong.
    drop_out : float
        Share of the returns that are lost for other reasons.
    sigma_direction : float
        Standard deviation of a beam's direction per axis [rad].
    sigma_range_bias : float
        Standard deviation of the range bias of a laser [m].
    sigma_range_common : float
        Standard deviation of what all lasers measure too long together [m]; as of the fits.
    sigma_mounting : float
        Standard deviation of the directions in which LiDAR and gimbal sit, per axis; it parts the
        two faces of the scan [rad]. As of the fits.
    sigma_offset : float
        Standard deviation of where the LiDAR sits on the gimbal, per axis; it counts where the
        gimbal turns by less than 360 degrees [m]. As of the fits.
    sigma_encoder : float
        Standard deviation of one sample of the gimbal's angle [rad]. 9e-5: steps of 16 bits, and
        0.005 deg of jitter.
    ripples : tuple of (float, float)
        Amplitude [rad] and periods in a turn of errors of the gimbal's angle, as samples that are
        few and clocks that differ make of an uneven speed.
    joint_rate : float
        Samples of the gimbal's angle in a second [Hz].
    sigma_aim : float or None
        Standard deviation of each direction after both faces, by mounting and encoder [rad]; by
        default that of ``Returns.aim``, which grows with the distance.
    divergence : tuple of float
        Full width of the footprint along the sweep and square to it [rad].
    elevations : tuple of float
        Least and greatest elevation at which spheres are looked for [rad]. 75 degrees either way:
        beyond it the outer lasers do not reach.
    """

    turn: float = 13.2
    spin_rpm: float = 600.0
    sweep: float = 2.0 * np.pi
    step: float = 0.0
    rest_revolutions: int = 3
    move: float = 0.1
    reflectivity: float = 42.0
    noise: float | None = None
    sigma_weak: float = 0.0
    reach: float = np.inf
    drop_out: float = 0.0
    sigma_direction: float = 1e-4
    sigma_range_bias: float = 0.003
    sigma_range_common: float = FittingConfig().sigma_range_common
    sigma_mounting: float = FittingConfig().sigma_mounting
    sigma_offset: float = FittingConfig().sigma_offset
    sigma_encoder: float = 9e-5
    ripples: tuple[tuple[float, float], ...] = ()
    joint_rate: float = 100.0
    sigma_aim: float | None = None
    divergence: tuple[float, float] = (3.0e-3, 1.5e-3)
    elevations: tuple[float, float] = (float(np.radians(-75.0)), float(np.radians(75.0)))

    def __post_init__(self) -> None:
        self.scan  # noqa: B018  its own checks of turn, speed and footprint
        if not 1e-5 <= self.sigma_range <= 0.5:
            raise ConfigError(
                f"sigma_range is {self.sigma_range!r}; 0.00001 to 0.5 m are possible."
            )

    @property
    def sigma_range(self) -> float:
        """Noise of a range to a sphere [m]."""
        if self.noise is not None:
            return self.noise
        return float(np.interp(np.log(self.reflectivity), np.log(_REFLECTIVITIES), _SIGMAS))

    def sigma_at(self, distance: float, lit: Array | float = 1.0) -> Array:
        """Return the noise of ranges to a sphere at a distance, by lit shares of footprints [m]."""
        return np.hypot(self.sigma_range, self.sigma_weak / self._strength(distance, lit))

    def heard_at(self, distance: float, lit: Array | float = 1.0) -> Array:
        """Return the probability that echoes of a sphere are detected, by lit shares."""
        return 1.0 / (1.0 + self._strength(distance, lit) ** (-1.0 / _SOFTNESS))

    def _strength(self, distance: float, lit: Array | float) -> Array:
        """Return the energy of echoes over that at the threshold of detection."""
        return np.maximum(lit, _SHARE_MIN) * (self.reach / distance) ** 2

    @property
    def scan(self) -> SimulationConfig:
        """The same speeds as options of the simulation."""
        return SimulationConfig(
            turn=self.turn,
            spin_rpm=self.spin_rpm,
            sweep=self.sweep,
            step=self.step,
            rest_revolutions=self.rest_revolutions,
            move=self.move,
            divergence=self.divergence,
        )

    @property
    def warning(self) -> str:
        """Problem of the two speeds, for people; empty when the lines spread well."""
        return commensurability(self.scan)

    @property
    def line_spacing(self) -> float:
        """Mean angle between lines at the horizon, those that fall on each other too [rad]."""
        if self.step:
            return 2.0 * np.pi / sum(map(len, face_lines(self.scan)))
        of_full_turn = 2.0 * np.pi / (2.0 * N_LASERS * self.turn * self.spin_rpm / 60.0)
        return of_full_turn * (2.0 * np.pi / self.sweep)

    @property
    def kept(self) -> float:
        """Share of the pulses on a surface that count for a centre.

        Some have no return. Others come where a gimbal that steps starts or stops between two joint
        samples, and the line between these misses the angle (``errors_of_interpolation``).
        """
        if not self.step:
            return 1.0 - self.drop_out
        after = (np.arange(_N_CORNERS) + 0.5) / _N_CORNERS  # where between two samples it starts
        reach = BENT * self.sigma_direction * self.move / self.step
        left_out = np.maximum(1.0 / self.joint_rate - reach / after - reach / (1.0 - after), 0.0)
        rest = self.rest_revolutions * 60.0 / self.spin_rpm
        return (1.0 - self.drop_out) * (1.0 - 2.0 * float(left_out.mean()) / (rest + self.move))

    @property
    def density(self) -> float:
        """Returns that a steradian at the horizon makes [1]."""
        return self.kept / (self.line_spacing * self.pulse_spacing)

    @property
    def is_full_turn(self) -> bool:
        """Whether every direction is swept on both faces."""
        return self.sweep >= 2.0 * np.pi - _CLOSED

    @property
    def pulse_spacing(self) -> float:
        """Angle from one pulse of a line to the next [rad]."""
        return 2.0 * np.pi * self.spin_rpm / 60.0 * FIRING_CYCLE


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Returns:
    """Information of a sphere's returns, by distance, strip and rows from the top."""

    distances: Array  # (d,) distances that are tabulated, ascending, even in the logarithm [m]
    # (d, c, k) area that returns come from, of the upper k rows of each strip, k from 0 [m^2]
    areas: Array
    # (d, c, k, 6) Fisher information of the same area for one return per square metre, upper
    # triangle row by row, axes towards, left and up [1]
    information: Array
    # (d, 3) factor of a centre's variances by the positions of the lines, against evenly spread
    # returns: towards, left, up; of one among some that share a position, over places where they
    # are found
    spread: Array
    lost: Array  # (d,) share of places at which a centre cannot be found
    parted: Array  # (d,) share of rigs that part its two faces too far for it to be found
    aim: Array  # (d,) standard deviation of directions by mounting and encoder [rad]
    # (360,) lines of the upward face less those of the other over all lines, by whole degrees from
    # where the sweep begins; nothing where the gimbal turns fully: ``aim`` holds what differs there
    imbalance: Array

    def __post_init__(self) -> None:
        d = len(self.distances)
        seal(self, distances=(d,), areas=(d, None, None), information=(d, None, None, 6))
        seal(self, spread=(d, 3), lost=(d,), parted=(d,), aim=(d,), imbalance=(None,))


class _Disc(NamedTuple):
    """Beams over a sphere's disc at one distance, and the information of each."""

    left: Array  # (n,) where they pass the centre, to the left [m]
    information: Array  # (n, 3, 3) of each; zero where it does not return
    returns: Array  # (n,) probability that each returns


@lru_cache(maxsize=16)
def returns_of(sensor: Sensor, radius: float, n_strips: int) -> Returns:
    """Return the information of a sensor's returns from a sphere.

    Notes
    -----
    A return is the mean range over its footprint, linearised over the uncertainty of the centre, as
    in the fit along the beam. The spread comes from the true lines of one turn at 400 places.
    An error of the mounting moves the two faces apart: the share by which the information of one
    exceeds that of the other is left of it. In less than a full turn most spheres are seen on one
    face, and the error is one that they share (``imbalance``). Errors of the encoder are averaged
    over the samples of its angle that are taken while the lines pass the sphere.
    """
    discs = [_disc(sensor, radius, n_strips, d) for d in _DISTANCES]
    shape = (len(_DISTANCES), n_strips, N_ROWS, _N_PER_ROW * _N_PER_STRIP)
    cell = (2.0 * _reaches(sensor, radius) / n_strips / _N_PER_STRIP)[:, None, None, None]
    cell = cell * cell * n_strips * _N_PER_STRIP / (N_ROWS * _N_PER_ROW)
    areas = np.stack([disc.returns for disc in discs]).reshape(shape) * cell
    worth = np.stack([disc.information for disc in discs]).reshape(*shape, 3, 3)
    upper = np.triu_indices(3)
    worth = worth[..., upper[0], upper[1]] * cell[..., None]
    spreads = [_spread(sensor, radius, disc, d) for disc, d in zip(discs, _DISTANCES, strict=True)]
    mean, lost, uneven = (np.array(column) for column in zip(*spreads, strict=True))
    return Returns(
        distances=_DISTANCES.copy(),
        areas=_from_top(areas.sum(axis=-1)),
        information=_from_top(worth.sum(axis=3)),
        spread=mean,
        lost=lost,
        parted=_parted(sensor, radius),
        aim=_aims(sensor, radius, uneven * sensor.is_full_turn),
        imbalance=np.zeros(0) if sensor.is_full_turn else _imbalance(sensor),
    )


def _from_top(rows: Array) -> Array:
    """Return cumulative sums over rows, axis 2, that begin with nothing."""
    sums = np.cumsum(rows, axis=2)
    return np.concatenate([np.zeros_like(sums[:, :, :1]), sums], axis=2)


def _reaches(sensor: Sensor, radius: float) -> Array:
    """Return how far from its centre a sphere's returns come, footprint included [m]."""
    return radius + 0.5 * max(sensor.divergence) * _DISTANCES


def _density(sensor: Sensor, distance: float) -> float:
    """Return the returns per square metre of a disc at the horizon [1/m^2]."""
    spacing = sensor.line_spacing * sensor.pulse_spacing
    return sensor.kept / (spacing * distance**2)


def _disc(sensor: Sensor, radius: float, n_strips: int, distance: float) -> _Disc:
    """Return beams over the disc, strip by strip, row by row from the top."""
    reach = radius + 0.5 * max(sensor.divergence) * distance
    n_left, n_up = n_strips * _N_PER_STRIP, N_ROWS * _N_PER_ROW
    left = reach * ((2.0 * np.arange(n_left) + 1.0) / n_left - 1.0)
    up = -reach * ((2.0 * np.arange(n_up) + 1.0) / n_up - 1.0)
    grid = np.stack(np.meshgrid(left, up, indexing="ij"), axis=-1)
    grid = grid.reshape(n_strips, _N_PER_STRIP, N_ROWS, _N_PER_ROW, 2)
    left, up = grid.transpose(4, 0, 2, 1, 3).reshape(2, -1)
    table = _beams(sensor, left, up, distance)
    cell = (2.0 * reach) ** 2 / (n_left * n_up)
    cov = np.eye(3) * (0.02 * radius) ** 2
    lateral2 = (sensor.sigma_direction * distance) ** 2
    middle = _ranges(table, np.array([distance, 0.0, 0.0]), radius)
    is_lit = middle.lit > _SHARE_MIN
    returns = (is_lit & (middle.ranges >= StitchingConfig().range_min)).astype(np.float64)
    returns *= 2.0 * returns.sum() >= is_lit.sum()  # else it is too near to be found
    returns *= sensor.heard_at(distance, middle.lit)
    noise2 = sensor.sigma_at(distance, middle.lit) ** 2
    information: Array = np.zeros((len(left), 3, 3))
    for _ in range(_N_ROUNDS):
        J, bend2 = _slopes(table, middle.ranges, distance, radius, cov)
        variance = noise2 + lateral2 * np.sum(J[:, 1:] ** 2, axis=1) + bend2
        information = (returns / variance)[:, None, None] * J[:, :, None] * J[:, None, :]
        N = information.sum(axis=0) * cell * _density(sensor, distance)
        cov = np.asarray(np.linalg.inv(N + np.eye(3) / (0.3 * radius) ** 2))
    return _Disc(left=left, information=information, returns=returns)


def _ranges(table: Beams, centre: Array, radius: float) -> Prediction:
    """Return the ranges of beams to one sphere."""
    which = np.zeros(len(table.ranges), dtype=np.intp)
    return predict(table, centre[None], np.array([radius]), which)


def _slopes(
    table: Beams, ranges: Array, distance: float, radius: float, cov: Array
) -> tuple[Array, Array]:
    """Return derivatives by the centre over its uncertainty, and the variance of second order.

    The slope between places the square root of three standard deviations to either side is the
    mean derivative of a normal distribution.
    """
    J, bend2 = np.ones((len(ranges), 3)), np.zeros(len(ranges))
    for axis in (1, 2):
        step = np.zeros(3)
        step[axis] = max(np.sqrt(3.0 * cov[axis, axis]), 1e-5)
        centre = np.array([distance, 0.0, 0.0])
        above = _ranges(table, centre + step, radius).ranges
        below = _ranges(table, centre - step, radius).ranges
        J[:, axis] = (above - below) / (2.0 * step[axis])
        bend2 += (above + below - 2.0 * ranges) ** 2 / 18.0
    return J, bend2


def _beams(sensor: Sensor, left: Array, up: Array, distance: float) -> Beams:
    """Return parallel beams along x that pass a centre at some distances, swept upwards."""
    n = len(left)
    return Beams(
        origins_base=np.column_stack([np.zeros(n), left, up]),
        directions_base=np.tile([1.0, 0.0, 0.0], (n, 1)),
        ranges=np.full(n, distance),
        across_base=np.tile([0.0, 0.0, 1.0], (n, 1)),
        rings=np.zeros(n, np.uint8),
        intensities=np.full(n, 50.0),
        times=np.zeros(n),
        divergence=np.array(sensor.divergence),
    )


def _aims(sensor: Sensor, radius: float, uneven: Array) -> Array:
    """Return the standard deviation of directions by how unevenly two faces are sampled [rad]."""
    if sensor.sigma_aim is not None:
        return np.full(len(_DISTANCES), sensor.sigma_aim)
    share = 2.0 * radius / _DISTANCES / (2.0 * np.pi)  # of a turn, on each face
    n_samples = 2.0 * sensor.joint_rate * recorded_time(sensor.scan) * share
    encoder = sensor.sigma_encoder / np.sqrt(np.maximum(n_samples, _SAMPLES_MIN))
    aims = np.hypot(sensor.sigma_mounting * uneven, encoder)
    n_faces = sensor.sweep / np.pi
    n_lines = np.maximum(2.0 * np.pi * share / sensor.line_spacing, 1.0)
    for amplitude, periods in sensor.ripples:
        # the lines over a sphere come from all lasers, while the gimbal turns by what these span
        alike = np.sinc(periods * np.ptp(VLP16_ELEVATIONS) / (2.0 * np.pi)) ** 2
        variance = 0.5 * amplitude**2 * (alike / n_faces + (1.0 - alike) / n_lines)
        aims = np.sqrt(aims**2 + variance)
    return np.asarray(aims)


def _parted(sensor: Sensor, radius: float) -> Array:
    """Return the probability that the mounting parts the two faces of a sphere by its radius.

    Of two discs so far apart less than 40 % overlaps: they are no sphere. Each of two axes across
    the line of sight moves one face against the other by twice its error.
    """
    sigmas = 2.0 * np.hypot(sensor.sigma_mounting * _DISTANCES, sensor.sigma_offset)
    return np.asarray(np.exp(-0.5 * (radius / sigmas) ** 2) * sensor.is_full_turn)


def _imbalance(sensor: Sensor) -> Array:
    """Return by how much lines of the upward face outnumber the others, by azimuth in degrees."""
    degrees = np.radians(np.arange(361))
    up, down = (np.histogram(lines, degrees)[0] for lines in face_lines(sensor.scan))
    return np.asarray((up - down) / np.maximum(up + down, 1))


def _spread(
    sensor: Sensor, radius: float, disc: _Disc, distance: float
) -> tuple[Array, float, float]:
    """Return the mean spread, the share of lost centres, and by how much two faces differ."""
    columns, inverse = np.unique(np.round(disc.left, 9), return_inverse=True)
    worth = np.zeros((len(columns), 3, 3))
    np.add.at(worth, inverse, disc.information)
    height = 2.0 * (columns[1] - columns[0]) * len(columns) / 2.0 / (N_ROWS * _N_PER_ROW)
    per_line = sensor.kept * height / (distance * sensor.pulse_spacing)
    faces = np.array([_crossings(lines, columns, distance) for lines in face_lines(sensor.scan)])
    across = faces @ (worth[:, 1, 1] + worth[:, 2, 2])
    uneven = (across[0] - across[1]) / np.maximum(across.sum(axis=0), 1e-300)
    crossings = faces.sum(axis=0)
    information = np.einsum("pc,cij->pij", crossings, worth) * per_line
    even = information.mean(axis=0)
    floor = np.eye(3) / (0.3 * radius) ** 2
    variances = np.einsum("pii->pi", np.linalg.inv(information + floor))
    usual = np.diag(np.linalg.inv(even + floor))
    is_found = variances.sum(axis=1) < max(_LOST, 6.0 * float(usual.sum()))
    is_found &= bool(disc.returns.any())
    ratios = variances[is_found] / usual if is_found.any() else np.full((1, 3), 36.0)
    return _together(ratios), float(np.mean(~is_found)), float(np.sqrt(np.mean(uneven**2)))


def _together(ratios: Array) -> Array:
    """Return the spread of one centre among several that share a position, by mean information."""
    rng = np.random.default_rng(0)
    worth = np.mean([1.0 / ratios[rng.permutation(len(ratios))] for _ in range(_TOGETHER)], axis=0)
    return np.asarray((1.0 / worth).mean(axis=0))


def _crossings(lines: Array, columns: Array, distance: float) -> Array:
    """Return how many lines pass each column of a disc at each place it may stand, (p, c)."""
    lines = np.concatenate([lines - 2 * np.pi, lines, lines + 2 * np.pi])
    places = 2 * np.pi * (np.arange(_N_PHASES) * _GOLDEN % 1.0)
    half = 0.5 * (columns[1] - columns[0])
    edges = np.append(columns - half, columns[-1] + half) / distance
    below = np.searchsorted(lines, places[:, None] + edges[None, :])
    return np.asarray(np.diff(below, axis=1), dtype=np.float64)
