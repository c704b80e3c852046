"""The preflight report: what a recording holds and lacks, and whether it can be processed.

The report runs the real stitching on a thinned log, so that its verdict is that of processing. A
bad recording gets a report; only one that does not exist raises.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from spheremark.pipelines.config import StitchingConfig
from spheremark.pipelines.errors import InputError, MissingRigError, NotFoundError
from spheremark.pipelines.model import Array, Index, Nanos, Origin, Rig, ScanLog
from spheremark.pipelines.scan.rigs import tilted_vlp16
from spheremark.storage.recordings import timeline
from spheremark.storage.recordings.container import Batch, Channel
from spheremark.storage.recordings.decoding import Decoders
from spheremark.storage.recordings.options import LogOptions
from spheremark.storage.recordings.reading import assemble, diagnosis, read_log, stem
from spheremark.storage.recordings.sources import opened

OK, WEAK, REFUSED = "ok", "weak", "refused"

_SAMPLE = 40_000  # returns of the trial stitching
_PROBES = 4_000  # pairs of returns that give the LiDAR's speed
_PROBE_APART = 1_000_000  # [ns] between those of a pair: far less than a turn, many azimuth steps
_GAP_WEAK = 0.2 / 15.0  # [rad]: a sphere of 0.2 m at 15 m is as wide
_SKEW_WEAK = 1.0  # [s]; recorders are late by some tenths
_TURN_WEAK = np.pi  # half a turn shows the whole scene to a tilted LiDAR
_MOVES = np.radians(0.1)  # per second; a gimbal at rest turns less
_SPIN_MIN, _SPIN_MAX = 1.0, 1e3  # [rad/s] a VLP-16 turns at 31 to 126
_STOP_MAX = 3600.0  # [s]; scan lines of longer stops are not counted
_FAR_NS = 86_400_000_000_000  # [ns] a day: topics that begin so much later have no clock
_CROSSING_MIN = 1e-6  # a laser whose plane is nearer to the horizontal never crosses the horizon


@dataclass(frozen=True, slots=True, kw_only=True)
class TopicReport:
    """Type, number and rate of the messages of one topic.

    Attributes
    ----------
    topic, schema, encoding : str
        Its name, message type and encoding.
    n_messages : int
        Number of messages.
    rate_hz : float
        Messages per second; 0 for fewer than two.
    longest_gap_s : float
        Longest time between two messages, by the recorder's clock.
    counts : tuple of int
        Messages in each of 120 equal parts of the log.
    gaps_s : tuple of (float, float)
        Begin and end of its longest pauses, since the first message of the log.
    """

    topic: str
    schema: str
    encoding: str
    n_messages: int
    rate_hz: float
    longest_gap_s: float
    counts: tuple[int, ...] = ()
    gaps_s: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Preflight:
    """What a recording holds, and whether it can be processed.

    Attributes
    ----------
    verdict : str
        ``ok``, ``weak`` or ``refused``.
    code : str
        Stable code of the error for which it is refused; empty otherwise.
    reasons : tuple of str
        Why it is weak or refused, as sentences.
    notes : tuple of str
        What is missing without harm, as sentences.
    size_bytes : int
        Length of the file.
    topics : tuple of TopicReport
        All topics, by name.
    n_returns : int
        Returns of the LiDAR.
    has_shot_times : bool
        Whether the points carry a time of their own.
    has_orientation : bool
        Whether an AHRS was recorded.
    rig : str
        Name of the rig that the recording describes; empty when it does not.
    duration_s : float
        From the first return to the last.
    clock_skew_s : float or None
        Delay of the LiDAR's messages minus that of the gimbal's, each against its stamps.
    n_stops : int
        Stops found.
    gimbal_coverage_deg : float or None
        Smallest angle that the gimbal turned through at a stop, at most 360.
    gimbal_speed_deg_per_s : float or None
        Mean speed of the gimbal while it turns.
    lidar_speed_rpm : float or None
        Revolutions of the LiDAR per minute.
    coverage_gap_deg : float or None
        Largest angle along the horizon that no scan line crosses, at the worst stop.
    reading : dict
        Options with which the log was read, as far as they are no defaults.
    diagnosis : tuple of str
        What other signs, units and clocks make of the scan, if that was tried.
    log_duration_s : float
        From the first message of any topic to the last.
    gimbal_times_s, gimbal_angles_deg : tuple of float
        Samples of the gimbal's angle, since the first message of the log.
    stop_spans_s : tuple of (float, float)
        First and last return of each stop, likewise.
    """

    verdict: str
    code: str = ""
    reasons: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    size_bytes: int = 0
    topics: tuple[TopicReport, ...] = ()
    n_returns: int = 0
    has_shot_times: bool = False
    has_orientation: bool = False
    rig: str = ""
    duration_s: float = 0.0
    clock_skew_s: float | None = None
    n_stops: int = 0
    gimbal_coverage_deg: float | None = None
    gimbal_speed_deg_per_s: float | None = None
    lidar_speed_rpm: float | None = None
    coverage_gap_deg: float | None = None
    reading: dict[str, Any] = field(default_factory=dict)
    diagnosis: tuple[str, ...] = ()
    log_duration_s: float = 0.0
    gimbal_times_s: tuple[float, ...] = ()
    gimbal_angles_deg: tuple[float, ...] = ()
    stop_spans_s: tuple[tuple[float, float], ...] = ()

    def to_mapping(self) -> dict[str, Any]:
        """Return the report as plain values for JSON."""
        plain: dict[str, Any] = _plain(asdict(self))
        return plain


def _plain(value: Any) -> Any:
    """Return a value with lists in place of tuples."""
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    return [_plain(one) for one in value] if isinstance(value, tuple | list) else value


@dataclass(slots=True)
class _Times:
    """Log times of the messages of each topic."""

    channels: dict[str, Channel] = field(default_factory=dict)
    parts: dict[str, list[Nanos]] = field(default_factory=dict)

    def add(self, batch: Batch) -> None:
        """Take the times of a batch."""
        self.channels[batch.channel.topic] = batch.channel
        self.parts.setdefault(batch.channel.topic, []).append(batch.log_times_ns)

    def of(self, topic: str) -> Nanos:
        """Return the times of a topic in ascending order."""
        return np.asarray(np.sort(np.concatenate(self.parts[topic])))

    def span(self) -> tuple[int, int]:
        """Return the first and the last time of all topics, without implausible ones."""
        ends = [self.of(topic)[[0, -1]] for topic in self.parts]
        if not ends:
            return 0, 0
        middle = np.median([end[0] for end in ends])
        near = [end for end in ends if abs(end[0] - middle) < _FAR_NS] or ends
        return int(min(end[0] for end in near)), int(max(end[1] for end in near))

    def report(self, channel: Channel, span_ns: tuple[int, int]) -> TopicReport:
        """Return what a topic holds, in a log from its first time to its last."""
        times = self.of(channel.topic) if channel.topic in self.parts else np.empty(0, np.int64)
        steps = times[1:] - times[:-1]
        span = float(steps.sum()) * 1e-9
        return TopicReport(
            topic=channel.topic,
            schema=channel.schema,
            encoding=channel.encoding,
            n_messages=len(times),
            rate_hz=len(steps) / span if span else 0.0,
            longest_gap_s=float(steps.max()) * 1e-9 if len(steps) else 0.0,
            counts=timeline.counts(times, *span_ns) if len(times) else (),
            gaps_s=timeline.gaps(times, span_ns[0]),
        )


def inspect_log(
    url: str | Path,
    options: LogOptions | None = None,
    *,
    beside: Sequence[Path] = (),
    diagnosing: bool = False,
    name: str = "",
) -> Preflight:
    """Inspect a recording.

    Parameters
    ----------
    url : str or Path
        As for ``read_log``.
    options : LogOptions, optional
        Topics, joint and clocks, where they cannot be found.
    beside : sequence of Path
        Further files of the same log.
    diagnosing : bool
        Whether to try other signs, units and clocks, which takes seconds.
    name : str
        Its name in reasons; that of the file by default.

    Returns
    -------
    Preflight
        What it holds; for a bad recording as far as it can be read, with the reason.

    Raises
    ------
    NotFoundError
        If there is no such file.

    Notes
    -----
    Reads the whole file once, and stitches a sample of its returns.
    """
    options = options or LogOptions()
    start = Preflight(verdict=OK, reading=options.to_mapping())
    try:
        origin = Origin(name=name or stem(url), digest="")
        report, log = _inspect(url, beside, options, origin, start)
        if diagnosing and log is not None:
            found = diagnosis(
                log, options, lambda other: read_log(url, other, beside=beside, digest="-")
            )
            report = replace(report, diagnosis=found)
    except NotFoundError:
        raise
    except InputError as error:
        return _refused(start, error)
    return report


def _inspect(
    url: str | Path, beside: Sequence[Path], options: LogOptions, origin: Origin, start: Preflight
) -> tuple[Preflight, ScanLog | None]:
    """Walk the recording; return its report and its log. Only a file that is no log raises."""
    damage: InputError | None = None
    times = _Times()
    with opened(url, beside, recover=options.recover) as recording:
        decoders = Decoders(recording)
        try:
            for batch in recording.batches():
                times.add(batch)
                decoders.add(batch)
        except InputError as error:
            damage = error
        topics, span_ns = recording.channels, times.span()
        report = replace(
            start,
            size_bytes=recording.size,
            topics=tuple(times.report(topics[topic], span_ns) for topic in sorted(topics)),
            log_duration_s=(span_ns[1] - span_ns[0]) * 1e-9,
        )
    try:
        log = assemble(decoders, options, origin)
    except InputError as error:
        return _refused(report, damage or error), None
    report = _with_verdict(_described(report, log), log, _skew(decoders, times), span_ns)
    return (report if damage is None else _refused(report, damage)), log


def _refused(report: Preflight, error: InputError) -> Preflight:
    """Return the report with a refusal."""
    reasons = (str(error), *(reason for reason in report.reasons if reason != str(error)))
    return replace(report, verdict=REFUSED, code=error.code, reasons=reasons)


def _described(report: Preflight, log: ScanLog) -> Preflight:
    """Return the report with the contents of the log."""
    spin = _spin(log)
    return replace(
        report,
        notes=log.notes,
        n_returns=len(log.p_lidar),
        has_shot_times=log.has_pulse_times,
        has_orientation=len(log.quaternions_imu) > 0,
        rig=log.rig.name if log.rig else "",
        duration_s=_lasts(log),
        gimbal_speed_deg_per_s=_gimbal_speed_deg(log),
        lidar_speed_rpm=None if spin is None else abs(spin[0]) * 60.0 / (2.0 * np.pi),
    )


def _with_verdict(
    report: Preflight, log: ScanLog, skew: float | None, span_ns: tuple[int, int]
) -> Preflight:
    """Return the report with stops, coverage, reasons and verdict."""
    from spheremark.pipelines.scan.stitching import choose_rig, pause_notes, split_stops, stitch

    reasons: list[str] = []
    refusal: InputError | None = None
    try:
        rig = choose_rig(log, None)
    except MissingRigError as error:
        reasons.append(str(error))
        rig = tilted_vlp16("nominal", (0.0, 0.0))
    config = StitchingConfig()
    stops = split_stops(log, config)
    coverages: list[float] = []
    for stop in stops:
        try:
            coverages.append(stitch(_thinned(stop), rig, config).coverage)
        except InputError as error:
            refusal = refusal or error
    gaps = [gap for gap in (_horizon_gap(stop, rig) for stop in stops) if gap is not None]
    coverage, gap = min(coverages, default=None), max(gaps, default=None)
    reasons += [*log.weaknesses, *(note for stop in stops for note in pause_notes(stop))]
    reasons += _reasons(report, coverage, gap, skew)
    report = replace(
        report,
        verdict=WEAK if reasons else OK,
        reasons=tuple(reasons),
        clock_skew_s=skew,
        n_stops=len(stops),
        gimbal_coverage_deg=None if coverage is None else float(np.degrees(coverage)),
        coverage_gap_deg=None if gap is None else float(np.degrees(gap)),
        **timeline.of_log(log, stops, *span_ns),
    )
    return report if refusal is None else _refused(report, refusal)


def _reasons(
    report: Preflight, coverage: float | None, gap: float | None, skew: float | None
) -> list[str]:
    """Return the reasons that make a result weak."""
    reasons = []
    if coverage is not None and coverage < _TURN_WEAK:
        reasons.append(
            f"turn under 180 deg: the gimbal turned {np.degrees(coverage):.0f} deg, so that parts "
            "of the scene are not seen."
        )
    if gap is not None and gap > _GAP_WEAK and (coverage or 0.0) >= _TURN_WEAK:
        reasons.append(
            f"Scan lines leave gaps of {np.degrees(gap):.2f} deg at the horizon: spheres of 0.2 m "
            f"can hide beyond {0.2 / gap:.1f} m. Turn the gimbal slower, or so that its time for a "
            "turn is no multiple of the LiDAR's."
        )
    if skew is not None and abs(skew) > _SKEW_WEAK:
        reasons.append(
            f"The LiDAR's messages are {skew:.1f} s later than the gimbal's when compared with "
            "their stamps: their clocks may differ."
        )
    if not report.has_orientation:
        reasons.append("No orientation was recorded: the base can only be assumed to be level.")
    return reasons


def _thinned(log: ScanLog) -> ScanLog:
    """Return a log with at most ``_SAMPLE`` returns, first and last among them."""
    rows = _spread(len(log.stamps_lidar_ns), _SAMPLE)
    return replace(
        log,
        p_lidar=log.p_lidar[rows],
        intensities=log.intensities[rows],
        rings=log.rings[rows],
        stamps_lidar_ns=log.stamps_lidar_ns[rows],
    )


def _spread(n: int, most: int) -> Index:
    """Return at most so many of n places, evenly spread, the first and the last among them."""
    return np.rint(np.linspace(0, n - 1, min(n, most))).astype(np.intp)


def _skew(decoders: Decoders, times: _Times) -> float | None:
    """Return how much later the LiDAR's messages were recorded than the gimbal's [s].

    A message of the LiDAR is whole, and can be recorded, when its revolution is over.
    """
    lidars = [one.returns() for one in decoders.lidars.values()]
    joints = [s for one in decoders.joints.values() for s in one.series() if len(s.stamps_ns)]
    if not lidars or not joints or not len(lidars[0].message_stamps_ns):
        return None
    late = [
        float(np.median(times.of(topic) - np.int64(stamps[0])) - np.median(stamps - stamps[0]))
        for topic, stamps in (
            (lidars[0].topic, lidars[0].message_stamps_ns),
            (joints[0].topic, joints[0].stamps_ns),
        )
    ]
    stamps = lidars[0].message_stamps_ns
    revolution = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    return (late[0] - revolution - late[1]) * 1e-9


def _gimbal_speed_deg(log: ScanLog) -> float | None:
    """Return the mean speed of the gimbal while it turns [deg/s]."""
    stamps = log.stamps_gimbal_ns
    if len(stamps) < 2:
        return None
    steps, turned = (stamps[1:] - stamps[:-1]) * 1e-9, np.abs(np.diff(log.gimbal_angles))
    moves = turned > _MOVES * steps
    return float(np.degrees(turned[moves].sum() / steps[moves].sum())) if moves.any() else 0.0


def _azimuths(log: ScanLog, rows: Index) -> Array:
    """Return the sensor's azimuth of some returns, counter-clockwise [rad]."""
    p = log.p_lidar[rows].astype(np.float64)
    return np.asarray(np.arctan2(p[:, 1], p[:, 0]))


def _spin(log: ScanLog) -> tuple[float, float] | None:
    """Return the LiDAR's angular speed [rad/s] and its azimuth at the first return [rad].

    The speed of pairs of returns is rough; the drift of the azimuth against it over the whole log
    makes it exact.
    """
    stamps = log.stamps_lidar_ns
    if not log.has_pulse_times or len(stamps) < 2:
        return None
    rows = _spread(len(stamps), _PROBES)
    later = np.searchsorted(stamps, stamps[rows] + _PROBE_APART)
    is_near = (later < len(stamps)) & (
        stamps[np.minimum(later, len(stamps) - 1)] - stamps[rows] < 4 * _PROBE_APART
    )
    if not is_near.any():
        return None
    first, second = rows[is_near], later[is_near]
    turned = _wrapped(_azimuths(log, second) - _azimuths(log, first))
    speed = float(np.median(turned / ((stamps[second] - stamps[first]) * 1e-9)))
    times = (stamps[rows] - stamps[0]) * 1e-9
    drift = np.unwrap(_wrapped(_azimuths(log, rows) - speed * times))
    slope, azimuth = np.polyfit(times, drift, 1) if len(rows) > 2 else (0.0, float(drift[0]))
    return speed + float(slope), float(azimuth)


def _wrapped(angles: Array) -> Array:
    """Reduce angles to [-pi, pi) [rad]."""
    return np.asarray((angles + np.pi) % (2.0 * np.pi) - np.pi)


def _lasts(log: ScanLog) -> float:
    """Return the time from the first return to the last [s]."""
    return float(log.stamps_lidar_ns[-1] - log.stamps_lidar_ns[0]) * 1e-9


def _horizon_gap(log: ScanLog, rig: Rig) -> float | None:
    """Return the largest angle along the base's horizon that no scan line crosses [rad].

    A laser of elevation e and sensor azimuth a points along ``R (cos e cos a, cos e sin a, sin e)``
    in the head; it crosses the horizon where the last component is zero, twice a revolution.
    """
    spin = _spin(log)
    if spin is None or not _SPIN_MIN < abs(spin[0]) < _SPIN_MAX or _lasts(log) > _STOP_MAX:
        return None
    speed, azimuth = spin
    R = rig.T_head_lidar[:3, :3]
    stamps, joints = log.stamps_lidar_ns, log.stamps_gimbal_ns
    start, end = max(stamps[0], joints[0]), min(stamps[-1], joints[-1])
    crossings = []
    for elevation in rig.laser_elevations.tolist():
        for a in _horizon_azimuths(R[2], elevation):
            v = R @ [
                np.cos(elevation) * np.cos(a),
                np.cos(elevation) * np.sin(a),
                np.sin(elevation),
            ]
            period = 2.0 * np.pi / abs(speed)
            first = ((a - azimuth) / speed) % period - period
            times = np.arange(first, _lasts(log) + period, period)
            instants = stamps[0] + np.rint(times * 1e9).astype(np.int64)
            instants = instants[(instants >= start) & (instants <= end)]
            angles = np.interp(
                (instants - start) * 1e-9, (joints - start) * 1e-9, log.gimbal_angles
            )
            crossings.append(angles + np.arctan2(v[1], v[0]))
    azimuths = np.sort(np.concatenate(crossings) % (2.0 * np.pi)) if crossings else np.empty(0)
    if len(azimuths) < 2:
        return None
    return float(np.diff(azimuths, append=azimuths[0] + 2.0 * np.pi).max())


def _horizon_azimuths(row: Array, elevation: float) -> tuple[float, ...]:
    """Return the sensor azimuths at which a laser points along the horizon [rad]."""
    reach = float(np.hypot(row[0], row[1])) * np.cos(elevation)
    level = -float(row[2]) * np.sin(elevation)
    if reach < _CROSSING_MIN or abs(level) >= reach:
        return ()
    middle, half = float(np.arctan2(row[1], row[0])), float(np.arccos(level / reach))
    return middle - half, middle + half
