"""One stop of a simulated survey: the log that the rig records, and the truth beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.errors import InputError
from spheremark.pipelines.geometry import rigid, rot_x, rot_y, rot_z
from spheremark.pipelines.model import (
    RING_UNKNOWN,
    Array,
    Firings,
    Index,
    Nanos,
    Origin,
    Rig,
    ScanLog,
    StopTruth,
    Truth,
)
from spheremark.pipelines.scan.rigs import FIRING_CYCLE, N_LASERS, rig_digest
from spheremark.pipelines.simulation.echo import NEAR, Echoes, trace
from spheremark.pipelines.simulation.field import Field, checked_seed
from spheremark.pipelines.simulation.options import Optics, SimulationConfig
from spheremark.pipelines.simulation.rig import (
    Motion,
    ahrs_samples,
    joint_samples,
    nominal_rig,
    recorded_time,
    true_rig,
    turning,
)
from spheremark.pipelines.simulation.scene import Scene
from spheremark.pipelines.simulation.sensor import (
    FIRINGS_PER_PACKET,
    Pulses,
    Recorded,
    aim,
    fire,
    may_pass,
    record,
)
from spheremark.pipelines.simulation.visibility import visible_shares

Progress = Callable[[float, str], None]

_CHUNK = 683 * FIRINGS_PER_PACKET  # firings at a time: some 100 MB of work space
_FIRST_STOP = datetime(2026, 5, 11, 9, 0, tzinfo=UTC)
_BETWEEN_STOPS = timedelta(seconds=90)
_HOME = np.radians(1.0)  # the gimbal starts within this of zero
_THINNING = 128  # one firing in so many is traced in any case: every 7 ms
_LINE_NS = 10_000_000  # less than half a revolution at 20 in a second
_RIG, _STOP = 100, 101  # random streams


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SimulatedStop:
    """One stop: the log, and the truth.

    Attributes
    ----------
    log : ScanLog
        The recording, with the nominal rig; it holds nothing of the truth.
    truth : StopTruth
        True pose of the base.
    rig : Rig
        The true rig.
    firings : Firings
        All pulses of the LiDAR as its packets hold them; its returns are those of the log.
    marks : (n,)
        Mark of the field that each return of the log is from, -1 for none.
    sigmas : (n,)
        Standard deviation of each range [m].
    counts : tuple of (int, int)
        Returns and scan lines of each mark of the field.
    """

    log: ScanLog
    truth: StopTruth
    rig: Rig
    firings: Firings
    marks: Index
    sigmas: Array
    counts: tuple[tuple[int, int], ...]


class _Run(NamedTuple):
    """World, pose, motion and rig of the LiDAR at one stop."""

    scene: Scene
    T_site_base: Array
    motion: Motion
    rig: Rig


def _silent(fraction: float, message: str) -> None:
    """Ignore the progress."""


def simulate_stop(
    field: Field,
    name: str,
    config: SimulationConfig,
    *,
    seed: int | None = None,
    progress: Progress = _silent,
) -> SimulatedStop:
    """Simulate the recording of one stop.

    Parameters
    ----------
    field : Field
        The world.
    name : str
        Name of the stop.
    config : SimulationConfig
        Motion of the rig, and errors of its sensors.
    seed : int, optional
        Seed of rig and sensors; that of the field by default. All stops of a survey take the same:
        they share the rig, and differ in noise, tilt and start.
    progress : callable
        Receives the fraction done, 0 to 1, and the current step; may raise to cancel.

    Returns
    -------
    SimulatedStop
        Log and truth.

    Raises
    ------
    NotFoundError
        If the field has no such stop.
    ConfigError
        If the seed is negative.

    Notes
    -----
    Work grows linearly with the time of the scan, and takes about a fifth of it on two cores. The
    points of the log are those that a driver computes from the packets.
    """
    stop = field.stop(name)
    seed = checked_seed(field.seed if seed is None else seed)
    place = field.stops.index(stop)
    rng = np.random.default_rng([seed, _STOP, place])
    rig = true_rig(config, np.random.default_rng([seed, _RIG]))
    R_station_base = _lean(rng, config.sigma_tilt)
    T_site_base = rigid(rot_z(stop.heading) @ R_station_base, stop.p_site)
    motion = turning(config, rng.uniform(-_HOME, _HOME))
    start_ns = _start_ns(place, rng)
    of_lidar, of_encoder, of_ahrs = rng.spawn(3)
    returns = Recorded.joined(
        _scan(_Run(field.scene, T_site_base, motion, rig), config, of_lidar, progress), start_ns
    )
    joint = joint_samples(motion, rig, config, of_encoder)
    ahrs = ahrs_samples(motion, R_station_base, rig, config, of_ahrs)
    log = ScanLog(
        p_lidar=returns.p_lidar,
        intensities=returns.intensities,
        rings=returns.rings if config.has_rings else np.full_like(returns.rings, RING_UNKNOWN),
        stamps_lidar_ns=start_ns + _stamped(returns.offsets_ns, config),
        has_pulse_times=config.shot_times,
        gimbal_angles=joint[0],
        stamps_gimbal_ns=start_ns + joint[1],
        quaternions_imu=ahrs[0],
        stamps_imu_ns=start_ns + ahrs[1],
        rig=nominal_rig(config),
        origin=Origin(name=name, digest=""),
    )
    truth = StopTruth(name=name, T_site_base=T_site_base)
    is_mark = (returns.spheres >= 0) & (returns.spheres < len(field.marks.names))
    return SimulatedStop(
        log=log,
        truth=truth,
        rig=rig,
        firings=returns.firings,
        marks=np.where(is_mark, returns.spheres, -1),
        sigmas=returns.sigmas,
        counts=_counts(returns, len(field.marks.names)),
    )


def survey_truth(
    field: Field, stops: Sequence[SimulatedStop], config: SimulationConfig, seed: int
) -> Truth:
    """Return the truth of a simulated survey, to be kept beside its logs.

    Parameters
    ----------
    field : Field
        The world.
    stops : sequence of SimulatedStop
        Its stops, all simulated with the same seed and configuration.
    config : SimulationConfig
        The configuration.
    seed : int
        The seed.

    Returns
    -------
    Truth
        Marks, poses, the true rig, configuration and seeds, the decoys on the field, and the
        visible share, returns and scan lines of each marker from each stop.

    Raises
    ------
    InputError
        If there are no stops, or if they do not share one rig.
    """
    digests = {rig_digest(stop.rig) for stop in stops}
    if len(digests) != 1:
        raise InputError(
            f"The truth of a survey needs stops with one rig, and {len(stops)} stops with "
            f"{len(digests)} rigs were given; simulate all stops with the same seed and options."
        )
    return Truth(
        marks=field.marks,
        stops=tuple(stop.truth for stop in stops),
        rig=stops[0].rig,
        about={
            "scenario": field.scenario,
            "family": field.family,
            "scenario_seed": field.seed,
            "seed": seed,
            "marker_radius_m": field.marker_radius,
            "simulation": config.to_mapping(),
            "decoys": [
                {
                    "name": decoy.name,
                    "kind": decoy.kind,
                    "p_site_m": decoy.p_site.tolist(),
                    "reach_m": decoy.reach,
                }
                for decoy in field.decoys
            ],
            "stands": dict(zip(field.marks.names, field.stands, strict=False)),
            "visible_shares": {stop.truth.name: _shares(field, stop) for stop in stops},
            "returns": {
                stop.truth.name: {
                    name: {"n": n, "n_lines": n_lines}
                    for name, (n, n_lines) in zip(field.marks.names, stop.counts, strict=True)
                }
                for stop in stops
            },
        },
    )


def _shares(field: Field, stop: SimulatedStop) -> dict[str, float]:
    """Return the share of each marker that is not hidden from a stop."""
    shares = visible_shares(
        field.scene, field.marks.p_site, field.marker_radius, stop.truth.T_site_base[:3, 3]
    )
    return dict(zip(field.marks.names, np.round(shares, 3).tolist(), strict=True))


def _counts(returns: Recorded, n_marks: int) -> tuple[tuple[int, int], ...]:
    """Return how many returns each marker has, and on how many scan lines.

    A line is one crossing of a laser; the next one is half a revolution later or more.
    """
    counts = []
    for mark in range(n_marks):
        own = np.flatnonzero(returns.spheres == mark)
        own = own[np.argsort(returns.rings[own], kind="stable")]
        rings, offsets_ns = returns.rings[own].astype(int), returns.offsets_ns[own]
        is_next = (np.diff(rings) != 0) | (np.diff(offsets_ns) > _LINE_NS)
        counts.append((len(own), int(is_next.sum()) + min(len(own), 1)))
    return tuple(counts)


def _lean(rng: np.random.Generator, sigma: float) -> Array:
    """Return a small random ``R_station_base``, (3, 3)."""
    roll, pitch = np.clip(rng.normal(0.0, sigma, 2), -3 * sigma, 3 * sigma)
    return np.asarray(rot_y(pitch) @ rot_x(roll))


def _start_ns(place: int, rng: np.random.Generator) -> int:
    """Return the instant of the first pulse of a stop."""
    second = int((_FIRST_STOP + place * _BETWEEN_STOPS).timestamp())
    return second * 10**9 + int(rng.integers(10**9))


def _stamped(offsets_ns: Nanos, config: SimulationConfig) -> Nanos:
    """Return the recorded instants of points: their own, or that of their revolution."""
    revolution_ns = round(60e9 / config.spin_rpm)
    return offsets_ns if config.shot_times else offsets_ns // revolution_ns * revolution_ns


def _scan(
    run: _Run, config: SimulationConfig, rng: np.random.Generator, progress: Progress
) -> list[Recorded]:
    """Return the record of the LiDAR during one turn, in pieces."""
    n = int(recorded_time(config) / FIRING_CYCLE) // FIRINGS_PER_PACKET * FIRINGS_PER_PACKET
    start_azimuth, rig = rng.uniform(0.0, 2 * np.pi), run.rig
    pieces = []
    for first in range(0, n, _CHUNK):
        progress(first / n, "Casting beams")
        pulses = fire(first, min(_CHUNK, n - first), start_azimuth, run.motion, config.spin_rpm)
        if config.only_near_spheres:
            echoes = _near_spheres(run, pulses, config.optics)
        else:
            aims = aim(pulses, rig, run.T_site_base)
            echoes = trace(run.scene, aims, rig.divergence, optics=config.optics)
        pieces.append(record(pulses, echoes, rig, config, rng))
    progress(1.0, "All beams cast")
    return pieces


def _near_spheres(run: _Run, pulses: Pulses, optics: Optics) -> Echoes:
    """Return the echoes of pulses that pass spheres closely, and of one firing in 128.

    The latter show the turn and the ground.
    """
    anyway = np.repeat(np.arange(len(pulses.rings) // N_LASERS) % _THINNING == 0, N_LASERS)
    spheres = run.scene.spheres
    near = float(spheres.radii.max(initial=0.0)) + NEAR
    chosen = anyway | may_pass(pulses, run.rig, run.T_site_base, spheres.p_site, near)
    aims = aim(pulses.rows(chosen), run.rig, run.T_site_base)
    return trace(run.scene, aims, run.rig.divergence, anyway[chosen], optics).among(chosen)
