"""The study again, in simulation: its tables and figures by its own method and by ours.

``plan`` lists the scans; ``reproduce`` simulates each, finds its markers and fits them; the rest
puts the errors against truth into the shape of the study: ``table_2`` (centres by distance),
``table_4`` (mean error per stop of a lane), ``findings`` (what keeps the tolerance, and the model
behind it). Four series of scans:

- ``centre``: the centre stop of the study's field, several worlds: Table 2, Figures 8 and 3;
- ``lane 2``: its seven stops: Table 4 and Figure 11;
- ``turns``: the centre stop with other times of a turn: other counts at the same distances;
- ``distances``: eight markers at each of eleven distances to 30 m, on level ground where the
  study's cut takes nothing, with four times of a turn: distance and count told apart.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from pipelines.accuracy import (
    UNMATCHED,
    Demand,
    ErrorModel,
    ErrorSample,
    ErrorSummary,
    Limits,
    Statistic,
    fit_error_model,
    limits,
    marker_errors,
    mean_incidence,
    summarise,
)
from pipelines.config import SurveyConfig
from pipelines.extraction import extract
from pipelines.fitting import fit_markers
from pipelines.geometry import inverse, levelling_rotation, transform
from pipelines.rigs import FIRING_CYCLE
from pipelines.simulation import Field, SimulatedStop, SimulationConfig, scenario, simulate_stop
from pipelines.stitching import beams, choose_rig, stitch
from pipelines.study import GREATEST_DISTANCE, TABLE_2
from pipelines.values import (
    Array,
    Index,
    MarkerCandidates,
    MarkerFits,
    Mask,
    Rings,
    StitchedCloud,
    _same_length,
    _seal,
)

Progress = Callable[[float, str], None]

OURS, PAPER, FULL_SPHERE = "along_beam", "paper", "paper_sphere"
"""Methods of fitting; the last is the study's with a full sphere as its model (Figure 3)."""

CENTRE, LANE_2, TURNS, DISTANCES = "centre", "lane 2", "turns", "distances"
"""Series of scans."""

FIELD, LEVEL = "field", "level ground"
"""Places of findings: the study's field with its cut, and ground where the cut takes nothing."""

REFLECTIVITY_BINS = (1.0, 5.0, 15.0, 40.0, 100.0, 256.0)
"""Edges within which the noise of ranges is given."""

_FIELD, _CENTRE_STOP, _LANE = "paper-field", "lane3-stop4", "range-lane"
_STOPS_OF_LANE_2 = tuple(f"lane2-stop{i + 1}" for i in range(7))
_TURN = 13.2  # [s]; the default
_OTHER_TURNS = (4.2, 6.6, 26.4)  # [s]; none commensurate with the pitch of the channels
_N_THREADS = 2  # a scan in simulation and one in the pipeline
_RUN = 12  # shots of one laser in a row
_N_RUNS_MIN = 30  # that tell a noise
_STEP_MAX = 0.10  # [m] off the parabola: more is an edge
_SIMILAR = 0.2  # relative difference of reflectivity within one surface


@dataclass(frozen=True, slots=True, kw_only=True)
class Scan:
    """One simulated scan of the reproduction.

    Attributes
    ----------
    series : str
        What it is for.
    scenario : str
        World to simulate.
    stop : str
        Stop in it.
    seed : int
        Source of chance of world, rig and sensor.
    turn : float
        Time of the gimbal's turn [s].
    """

    series: str
    scenario: str
    stop: str
    seed: int
    turn: float


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Centres:
    """Fitted centres with their errors, one row for each scan, marker and method.

    Attributes
    ----------
    scans : (n,)
        Place of the scan among those of the plan.
    methods, marks : tuple of str
        Fitting method and true mark of each row.
    ranges : (n,)
        True distances from the origin of the base to the marks [m].
    n_points : (n,)
        Numbers of returns that carry the estimates.
    incidences : (n,)
        Mean angles between beam and normal of the sphere [rad].
    error_station : (n, 3)
        Estimate minus truth towards the mark, to its left and upward [m].
    sigma_3d : (n,)
        Predicted: square roots of the traces of the covariances [m].
    rms : (n,)
        Root mean squares of the residuals along the beam [m].
    """

    scans: Index
    methods: tuple[str, ...]
    marks: tuple[str, ...]
    ranges: Array
    n_points: Array
    incidences: Array
    error_station: Array
    sigma_3d: Array
    rms: Array

    def __post_init__(self) -> None:
        n = len(self.methods)
        columns = ("scans", "ranges", "n_points", "incidences", "sigma_3d", "rms")
        _seal(self, **dict.fromkeys(columns, (n,)), error_station=(n, 3))
        _same_length(self, "methods", "marks", *columns)

    @property
    def error_3d(self) -> Array:
        """Lengths of the errors, (n,) [m]."""
        return np.asarray(np.linalg.norm(self.error_station, axis=1))

    def of(self, method: str, scans: ArrayLike) -> Mask:
        """Tell which rows are of a method and of some scans, (n,)."""
        return np.asarray((np.array(self.methods) == method) & np.isin(self.scans, scans))

    def sample(self, keep: Mask) -> ErrorSample:
        """Return some rows as the errors that a model is fitted to."""
        return ErrorSample(
            ranges=self.ranges[keep],
            n_points=self.n_points[keep],
            incidences=self.incidences[keep],
            errors_3d=self.error_3d[keep],
            scans=self.scans[keep],
        )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Example:
    """One marker as it was simulated, seen along its line of sight (Figures 3 and 9).

    Attributes
    ----------
    mark : str
        Its name.
    distance : float
        How far away it is [m].
    points_station : (n, 3)
        Returns about it: beyond the true centre, to its left, above it [m].
    is_left : (n,)
        Whether the study's method uses the return: it lies above the cut and near the ball.
    cut : float
        Height of the cut above the true centre [m].
    radius : float
        Radius of the sphere [m].
    centres_station : mapping of str to (3,)
        Fitted centre by method, in the same coordinates [m].
    """

    mark: str
    distance: float
    points_station: Array
    is_left: Mask
    cut: float
    radius: float
    centres_station: dict[str, Array]

    def __post_init__(self) -> None:
        _seal(self, points_station=(None, 3), is_left=(None,))
        _same_length(self, "points_station", "is_left")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RangeNoise:
    """Noise of single ranges by reflectivity.

    Attributes
    ----------
    sigmas : (k,)
        Standard deviation in each of ``REFLECTIVITY_BINS``; NaN where too little was seen [m].
    n : (k,)
        Number of runs of shots behind each.
    """

    sigmas: Array
    n: Index

    def __post_init__(self) -> None:
        k = len(REFLECTIVITY_BINS) - 1
        _seal(self, sigmas=(k,), n=(k,))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Reproduction:
    """All that was simulated and fitted.

    Attributes
    ----------
    scans : tuple of Scan
        The plan.
    n_marks : (n,)
        Marks of each scan's world, to tell how many were found.
    centres : Centres
        Centres with errors.
    example : Example
        A marker of the first scan that the study's cut reaches.
    noise : RangeNoise
        Noise of the simulated ranges of the first scan.
    config : SurveyConfig
        What they were fitted with.
    """

    scans: tuple[Scan, ...]
    n_marks: Index
    centres: Centres
    example: Example
    noise: RangeNoise
    config: SurveyConfig

    def series(self, *names: str) -> Index:
        """Return the places of the scans of some series."""
        return np.flatnonzero([scan.series in names for scan in self.scans])


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Table2Row:
    """Accuracy of centres at one of the study's distances.

    Attributes
    ----------
    distance : float
        Distance of the marker in the study [m].
    published_n_points : int
        Its number of returns there.
    published_error : float
        Its error there, 3-D [m].
    n_points : mapping of str to float
        Mean number of returns by method; NaN where the marker was never found.
    errors : mapping of str to ErrorSummary
        Errors over the worlds by method.
    """

    distance: float
    published_n_points: int
    published_error: float
    n_points: dict[str, float]
    errors: dict[str, ErrorSummary]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Table4Row:
    """Mean error of the centres at one stop of the lane.

    Attributes
    ----------
    stop : str
        Its name.
    n_marks : int
        Marks that might have been found, over all worlds.
    errors : mapping of str to ErrorSummary
        Errors over markers and worlds by method.
    mean_range : float
        Mean distance of the markers found by our method [m].
    """

    stop: str
    n_marks: int
    errors: dict[str, ErrorSummary]
    mean_range: float


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Finding:
    """What one method keeps in one place.

    Attributes
    ----------
    place : str
        ``FIELD`` or ``LEVEL``.
    method : str
        Fitting method.
    model : ErrorModel
        How its errors depend on distance, count and incidence.
    limits : mapping of str to Limits
        What keeps the tolerance, by statistic: ``p95`` and the study's ``mean``.
    errors : ErrorSummary
        The errors themselves.
    """

    place: str
    method: str
    model: ErrorModel
    limits: dict[Statistic, Limits]
    errors: ErrorSummary


class _Row(NamedTuple):
    """One row of ``Centres`` but for its scan."""

    method: str
    mark: str
    range: float
    n_points: int
    incidence: float
    error_station: Array
    sigma_3d: float
    rms: float


class _Measured(NamedTuple):
    """What one scan gave."""

    rows: list[_Row]
    n_marks: int
    example: Example | None
    noise: RangeNoise | None


def plan(seed: int, *, is_quick: bool = False) -> tuple[Scan, ...]:
    """Return the scans to simulate.

    Parameters
    ----------
    seed : int
        First of the seeds.
    is_quick : bool
        Fewer worlds and times of a turn: seconds for minutes, with wider intervals.

    Returns
    -------
    tuple of Scan
        The first is of the centre stop.
    """
    n_worlds, n_lanes, n_turned, n_distances = (2, 1, 1, 1) if is_quick else (10, 3, 2, 4)
    turns = _OTHER_TURNS[1:2] if is_quick else _OTHER_TURNS
    found = [Scan(series=CENTRE, scenario=_FIELD, stop=_CENTRE_STOP, seed=seed, turn=_TURN)]
    found += [dataclasses.replace(found[0], seed=seed + i) for i in range(1, n_worlds)]
    found += [
        Scan(series=LANE_2, scenario=_FIELD, stop=stop, seed=seed + i, turn=_TURN)
        for i in range(n_lanes)
        for stop in _STOPS_OF_LANE_2
    ]
    found += [
        dataclasses.replace(found[0], series=TURNS, seed=seed + i, turn=turn)
        for i in range(n_turned)
        for turn in turns
    ]
    found += [
        Scan(series=DISTANCES, scenario=_LANE, stop="centre", seed=seed + i, turn=turn)
        for i in range(n_distances)
        for turn in sorted((*(_OTHER_TURNS[:2] if is_quick else _OTHER_TURNS), _TURN))
    ]
    return tuple(found)


def reproduce(
    scans: Sequence[Scan],
    config: SurveyConfig,
    *,
    progress: Progress = lambda _share, _what: None,
) -> Reproduction:
    """Simulate and fit all scans of a plan.

    Parameters
    ----------
    scans : sequence of Scan
        The plan; the first is of the study's field.
    config : SurveyConfig
        How markers are found and fitted.
    progress : callable
        Told the share of the work that is done, 0 to 1, and what comes next; may raise to cancel.

    Returns
    -------
    Reproduction
        Errors of all centres.

    Notes
    -----
    The scans are independent: two are worked at side by side. Each is simulated whole, because the
    study's cut needs the ground. Cost grows linearly with the time of all turns.
    """
    worlds = {key: scenario(*key) for key in dict.fromkeys((s.scenario, s.seed) for s in scans)}
    found: list[_Measured] = []

    def measured(i: int) -> _Measured:
        scan = scans[i]
        return _measure(worlds[scan.scenario, scan.seed], scan, config, is_first=i == 0)

    with ThreadPoolExecutor(_N_THREADS) as pool:
        for scan, result in zip(scans, pool.map(measured, range(len(scans))), strict=True):
            found.append(result)
            progress(len(found) / len(scans), f"{scan.stop}, world {scan.seed}, {scan.turn:g} s")
    first = found[0]
    assert first.example is not None
    assert first.noise is not None
    return Reproduction(
        scans=tuple(scans),
        n_marks=np.array([one.n_marks for one in found], dtype=np.intp),
        centres=_joined([one.rows for one in found]),
        example=first.example,
        noise=first.noise,
        config=config,
    )


def table_2(made: Reproduction) -> tuple[Table2Row, ...]:
    """Return the study's Table 2 again: errors by distance at the centre stop.

    Parameters
    ----------
    made : Reproduction
        The scans.

    Returns
    -------
    tuple of Table2Row
        In the order of the distances.
    """
    centres, scans = made.centres, made.series(CENTRE)
    nearest = np.argmin(np.abs(centres.ranges[:, None] - TABLE_2.ranges), axis=1)
    rows = []
    for i, distance in enumerate(TABLE_2.ranges):
        keep = {m: centres.of(m, scans) & (nearest == i) for m in (OURS, PAPER)}
        rows.append(
            Table2Row(
                distance=float(distance),
                published_n_points=int(TABLE_2.n_points[i]),
                published_error=float(TABLE_2.errors_3d[i]),
                n_points={
                    m: float(centres.n_points[k].mean()) if k.any() else np.nan
                    for m, k in keep.items()
                },
                errors={
                    m: summarise(centres.error_3d[k], made.config.tolerance)
                    for m, k in keep.items()
                },
            )
        )
    return tuple(rows)


def table_4(made: Reproduction) -> tuple[Table4Row, ...]:
    """Return the study's Table 4 again: mean error per stop of lane 2.

    Parameters
    ----------
    made : Reproduction
        The scans.

    Returns
    -------
    tuple of Table4Row
        In the order of the stops, those that were scanned.
    """
    centres, rows = made.centres, []
    for stop in _STOPS_OF_LANE_2:
        scans = np.array([i for i in made.series(LANE_2) if made.scans[i].stop == stop], np.intp)
        if not len(scans):
            continue
        keep = {method: centres.of(method, scans) for method in (OURS, PAPER)}
        rows.append(
            Table4Row(
                stop=stop,
                n_marks=int(made.n_marks[scans].sum()),
                errors={
                    m: summarise(centres.error_3d[k], made.config.tolerance)
                    for m, k in keep.items()
                },
                mean_range=float(centres.ranges[keep[OURS]].mean()) if keep[OURS].any() else np.nan,
            )
        )
    return tuple(rows)


def findings(made: Reproduction, rng: np.random.Generator) -> tuple[Finding, ...]:
    """Say what each method keeps, in the study's field and on level ground.

    Parameters
    ----------
    made : Reproduction
        The scans.
    rng : numpy.random.Generator
        Draws the resamples of the confidence intervals.

    Returns
    -------
    tuple of Finding
        Field first, ours first.

    Notes
    -----
    Greatest distances are for the default time of a turn, smallest counts for 7.5 m, the distance
    of the study's own claim.
    """
    places = {
        FIELD: made.series(CENTRE, LANE_2, TURNS),
        LEVEL: made.series(DISTANCES),
    }
    return tuple(
        _finding(made, place, method, scans, rng)
        for place, scans in places.items()
        for method in (OURS, PAPER)
    )


def models_of_icp(made: Reproduction) -> dict[str, ErrorSummary]:
    """Compare the hemisphere and the full sphere as models of the study's ICP (Figure 3).

    Parameters
    ----------
    made : Reproduction
        The scans.

    Returns
    -------
    dict
        Errors at the centre stop by method: ``paper`` (hemisphere) and ``paper_sphere``.
    """
    scans = made.series(CENTRE)
    return {
        method: summarise(
            made.centres.error_3d[made.centres.of(method, scans)], made.config.tolerance
        )
        for method in (PAPER, FULL_SPHERE)
    }


def range_noise(
    ranges: ArrayLike, rings: Rings, offsets_ns: ArrayLike, intensities: ArrayLike
) -> RangeNoise:
    """Estimate the noise of single ranges from neighbouring shots of each laser.

    Parameters
    ----------
    ranges : (n,)
        Measured distances [m].
    rings : (n,)
        Laser of each shot.
    offsets_ns : (n,)
        Instants of the shots since any start [ns].
    intensities : (n,)
        Reflectivity, 0-255.

    Returns
    -------
    RangeNoise
        By reflectivity.

    Notes
    -----
    Runs of twelve shots in a row of one laser on one surface (equal reflectivity within a fifth)
    are freed of a parabola, which takes slope and curvature away; the median over runs of the
    standard deviation of the rest. Long enough to hold the slow part of noise that is not white:
    real VLP-16 oscillate over five or six shots.
    """
    seconds = np.asarray(offsets_ns, dtype=np.float64) * 1e-9
    order = np.lexsort((seconds, rings))
    firings, lasers = np.round(seconds[order] / FIRING_CYCLE), np.asarray(rings)[order]
    starts = np.arange(0, len(order) - _RUN, _RUN)
    ends = starts + _RUN - 1
    is_run = (firings[ends] - firings[starts] == _RUN - 1) & (lasers[ends] == lasers[starts])
    runs = order[starts[is_run][:, None] + np.arange(_RUN)]
    shades = np.asarray(intensities, dtype=np.float64)[runs]
    middle = np.median(shades, axis=1)
    rest = np.asarray(ranges, dtype=np.float64)[runs] @ _free_of_parabola()
    is_alike = (np.abs(shades - middle[:, None]) <= _SIMILAR * middle[:, None] + 1.0).all(axis=1)
    is_good = is_alike & (np.abs(rest).max(axis=1) < _STEP_MAX)
    places = np.digitize(middle[is_good], REFLECTIVITY_BINS) - 1
    sigmas = np.sqrt(np.sum(rest[is_good] ** 2, axis=1) / (_RUN - 3))
    samples = [sigmas[places == k] for k in range(len(REFLECTIVITY_BINS) - 1)]
    return RangeNoise(
        sigmas=np.array([np.median(s) if len(s) >= _N_RUNS_MIN else np.nan for s in samples]),
        n=np.array([len(s) for s in samples], dtype=np.intp),
    )


def _free_of_parabola() -> Array:
    """Return the projection that takes the best parabola from a run, (12, 12)."""
    powers = np.vander(np.linspace(-1.0, 1.0, _RUN), 3)
    return np.asarray(np.eye(_RUN) - powers @ np.linalg.pinv(powers))


def _measure(field: Field, scan: Scan, config: SurveyConfig, *, is_first: bool) -> _Measured:
    """Simulate one scan and fit its markers by every method."""
    stop = simulate_stop(field, scan.stop, SimulationConfig(turn=scan.turn), seed=scan.seed)
    cloud = stitch(stop.log, choose_rig(stop.log, None), config.stitching)
    found = extract(cloud, config.extraction, config.marker_radius)
    fits = _fits(cloud, found, scan, config)
    rows = [row for name, one in fits.items() for row in _rows(name, one, cloud, field, stop)]
    return _Measured(
        rows=rows,
        n_marks=len(field.marks.names),
        example=_example(fits, cloud, found, field, stop) if is_first else None,
        noise=_noise(stop) if is_first else None,
    )


def _fits(
    cloud: StitchedCloud, found: MarkerCandidates, scan: Scan, config: SurveyConfig
) -> dict[str, MarkerFits]:
    """Fit the markers of one scan by ours, the study's, and the study's with a full sphere."""
    radius, fitting = config.marker_radius, config.fitting
    fits = {m: fit_markers(m, cloud, found, fitting, radius) for m in (OURS, PAPER)}
    if scan.series == CENTRE:
        whole = dataclasses.replace(fitting, paper_model="sphere")
        fits[FULL_SPHERE] = fit_markers(PAPER, cloud, found, whole, radius)
    return fits


def _rows(
    method: str, fits: MarkerFits, cloud: StitchedCloud, field: Field, stop: SimulatedStop
) -> list[_Row]:
    """Compare the fits of one method with the truth; a fit that stands on no mark is left out."""
    errors = marker_errors(fits, stop.truth, field.marks)
    true = transform(inverse(stop.truth.T_site_base), field.marks.p_site)
    rows = []
    for fit, mark, error in zip(fits.fits, errors.marks, errors.error_base, strict=True):
        if mark == UNMATCHED:
            continue
        rows.append(
            _Row(
                method=method,
                mark=field.marks.names[mark],
                range=float(np.linalg.norm(true[mark])),
                n_points=fit.n_points,
                incidence=mean_incidence(beams(cloud, fit.used), fit.p_base, fit.radius),
                error_station=_sight(true[mark], cloud) @ error,
                sigma_3d=fit.sigma_3d,
                rms=fit.rms,
            )
        )
    return rows


def _sight(p_base: Array, cloud: StitchedCloud) -> Array:
    """Return the rotation from base to: towards a place, to its left, upward, (3, 3)."""
    up = levelling_rotation(cloud.levelling)[2]
    towards = p_base - (p_base @ up) * up
    towards = towards / np.linalg.norm(towards)
    return np.stack([towards, np.cross(up, towards), up])


def _joined(rows_of_scans: Sequence[Sequence[_Row]]) -> Centres:
    """Put the rows of all scans into columns."""
    rows = [row for rows in rows_of_scans for row in rows]
    scans = np.repeat(np.arange(len(rows_of_scans)), [len(rows) for rows in rows_of_scans])
    return Centres(
        scans=scans.astype(np.intp),
        methods=tuple(row.method for row in rows),
        marks=tuple(row.mark for row in rows),
        ranges=np.array([row.range for row in rows]),
        n_points=np.array([float(row.n_points) for row in rows]),
        incidences=np.array([row.incidence for row in rows]),
        error_station=np.array([row.error_station for row in rows]).reshape(-1, 3),
        sigma_3d=np.array([row.sigma_3d for row in rows]),
        rms=np.array([row.rms for row in rows]),
    )


def _example(
    fits: dict[str, MarkerFits],
    cloud: StitchedCloud,
    found: MarkerCandidates,
    field: Field,
    stop: SimulatedStop,
) -> Example:
    """Choose a marker of which the cut takes about a third, and show it from aside."""
    true = transform(inverse(stop.truth.T_site_base), field.marks.p_site)
    marks = {name: marker_errors(one, stop.truth, field.marks).marks for name, one in fits.items()}
    up = levelling_rotation(cloud.levelling)[2]
    cuts = found.ground_height_max - true @ up
    chosen = [m for m in marks[PAPER] if m != UNMATCHED and all(m in own for own in marks.values())]
    mark = min(chosen, key=lambda m: abs(cuts[m] + field.marker_radius / 3))
    fit = {n: one.fits[int(np.flatnonzero(marks[n] == mark)[0])] for n, one in fits.items()}
    members = np.union1d(fit[PAPER].used, fit[PAPER].rejected)
    R = _sight(true[mark], cloud)
    return Example(
        mark=field.marks.names[mark],
        distance=float(np.linalg.norm(true[mark])),
        points_station=(cloud.p_base[members] - true[mark]) @ R.T,
        is_left=np.isin(members, fit[PAPER].used),
        cut=float(cuts[mark]),
        radius=field.marker_radius,
        centres_station={n: R @ (one.p_base - true[mark]) for n, one in fit.items()},
    )


def _noise(stop: SimulatedStop) -> RangeNoise:
    """Return the noise of the ranges of a simulated log, as it would be seen in a real one."""
    log = stop.log
    offsets = log.stamps_lidar_ns - log.stamps_lidar_ns.min()
    return range_noise(np.linalg.norm(log.p_lidar, axis=1), log.rings, offsets, log.intensities)


def _finding(
    made: Reproduction, place: str, method: str, scans: Index, rng: np.random.Generator
) -> Finding:
    """Say what one method keeps in one place."""
    centres, tolerance = made.centres, made.config.tolerance
    keep = centres.of(method, scans)
    usual = [i for i in scans if made.scans[i].turn == _TURN]
    default = centres.of(method, usual)
    density = float(np.median(centres.n_points[default] * centres.ranges[default] ** 2))
    sample = centres.sample(keep)
    asked = {
        statistic: Demand(
            tolerance=tolerance, statistic=statistic, at_range=GREATEST_DISTANCE, density=density
        )
        for statistic in _STATISTICS
    }
    return Finding(
        place=place,
        method=method,
        model=fit_error_model(sample),
        limits={statistic: limits(sample, demand, rng) for statistic, demand in asked.items()},
        errors=summarise(centres.error_3d[default], tolerance),
    )


_STATISTICS: tuple[Statistic, ...] = ("p95", "mean")
