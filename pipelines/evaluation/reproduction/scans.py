"""Scans simulated and fitted: errors of all centres against the truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from spheremark.pipelines.accuracy import UNMATCHED, marker_errors, mean_incidence
from spheremark.pipelines.config import FittingConfig, SurveyConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.error_model import ErrorSample
from spheremark.pipelines.evaluation.experiment import Experiment
from spheremark.pipelines.evaluation.reproduction.noise import RangeNoise, range_noise
from spheremark.pipelines.evaluation.reproduction.plan import (
    CENTRE,
    CENTRE_REAL,
    FULL_SPHERE,
    GROUND,
    OURS,
    PAPER,
    Scan,
)
from spheremark.pipelines.geometry import inverse, levelling_rotation, transform
from spheremark.pipelines.model import (
    Array,
    Index,
    MarkerCandidates,
    MarkerFits,
    Mask,
    StitchedCloud,
    same_length,
    seal,
)
from spheremark.pipelines.published import GREATEST_DISTANCE
from spheremark.pipelines.scan.stitching import beams, choose_rig, stitch
from spheremark.pipelines.simulation import (
    Field,
    SimulatedStop,
    SimulationConfig,
    scenario,
    simulate_stop,
)
from spheremark.pipelines.sphere import fit_markers


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Centres:
    """Fitted centres with their errors, one of n rows for each scan, marker and method.

    Attributes
    ----------
    scans : (n,)
        Place of the scan in the plan.
    methods, marks : tuple of str
        Fitting method and true mark of each row.
    ranges, n_points, incidences : (n,)
        True distance to the mark [m], number of returns, mean angle of incidence [rad].
    error_station : (n, 3)
        Estimate minus truth towards the mark, to its left and upward [m].
    sigma_3d, rms : (n,)
        Predicted sigma, that of the heading included, and RMS of the residuals along the beam [m].
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
        seal(self, **dict.fromkeys(columns, (n,)), error_station=(n, 3))
        same_length(self, "methods", "marks", *columns)

    @property
    def error_3d(self) -> Array:
        """Lengths of the errors, (n,) [m]."""
        return np.asarray(np.linalg.norm(self.error_station, axis=1))

    def of(self, method: str, scans: ArrayLike) -> Mask:
        """Return which rows are of a method and of some scans, (n,)."""
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
    """One marker as it was simulated, in its line of sight (Figures 3 and 9).

    Attributes
    ----------
    mark, distance, radius : str, float, float
        Name, distance [m] and radius [m] of the marker.
    points_station : (n, 3)
        Returns about it: beyond the true centre, to its left, above it [m].
    is_left : (n,)
        Whether the study's method uses the return: it lies above the cut and near the sphere.
    cut, ground : float
        Heights above the true centre of the cut, and of the highest ground point of the scan [m].
    centres_station : mapping of str to (3,)
        Fitted centre by method, in the same coordinates [m].
    """

    mark: str
    distance: float
    points_station: Array
    is_left: Mask
    cut: float
    ground: float
    radius: float
    centres_station: dict[str, Array]

    def __post_init__(self) -> None:
        seal(self, points_station=(None, 3), is_left=(None,))
        same_length(self, "points_station", "is_left")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Reproduction:
    """The scans of a plan, the marks of each, and the errors of all centres.

    ``example`` is a marker of the first scan, ``noise`` that of the ranges of the first scan that
    simulates a real sensor.
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


class _Row(NamedTuple):
    """One row of ``Centres`` without its scan."""

    method: str
    mark: str
    range: float
    n_points: int
    incidence: float
    error_station: Array
    sigma_3d: float
    rms: float


class _Measured(NamedTuple):
    """The results of one scan."""

    rows: list[_Row]
    n_marks: int
    example: Example | None
    noise: RangeNoise | None


def reproduction(
    scans: Sequence[Scan], config: SurveyConfig
) -> Experiment[int, _Measured, Reproduction]:
    """Return the experiment that simulates and fits all scans of a plan.

    Parameters
    ----------
    scans : sequence of Scan
        The plan; the first is of the study's field.
    config : SurveyConfig
        How markers are found and fitted.

    Returns
    -------
    Experiment
        Its result has the errors of all centres.

    Notes
    -----
    Scans of the study's field are simulated whole, because a cut may need the ground. Cost grows
    linearly with the time of all turns.
    """
    return Experiment(
        worlds=range(len(scans)),
        run_world=partial(_measure, scans=tuple(scans), config=config),
        pool=lambda found: Reproduction(
            scans=tuple(scans),
            n_marks=np.array([one.n_marks for one in found], dtype=np.intp),
            centres=_joined([one.rows for one in found]),
            example=next(one.example for one in found if one.example is not None),
            noise=next(one.noise for one in found if one.noise is not None),
            config=config,
        ),
    )


_field = lru_cache(maxsize=2)(scenario)  # scans of one world follow one another


def _measure(place: int, *, scans: Sequence[Scan], config: SurveyConfig) -> _Measured:
    """Simulate one scan and fit its markers by every method."""
    scan = scans[place]
    shows_noise = next((i for i, one in enumerate(scans) if one.sigma_range is None), 0)
    field = _field(scan.scenario, scan.seed)
    sensor = SimulationConfig(
        turn=scan.turn, sigma_range=scan.sigma_range, only_near_spheres=not scan.needs_ground
    )
    stop = simulate_stop(field, scan.stop, sensor, seed=scan.seed)
    cloud = stitch(stop.log, choose_rig(stop.log, None), config.stitching)
    found = extract(cloud, config.extraction, config.marker_radius)
    fits = _fits(cloud, found, scan, config)
    return _Measured(
        rows=[row for name, one in fits.items() for row in _rows(name, one, cloud, field, stop)],
        n_marks=len(field.marks.names),
        example=_example(fits, cloud, found, field, stop) if place == 0 else None,
        noise=_noise(stop) if place == shows_noise else None,
    )


def _fits(
    cloud: StitchedCloud, found: MarkerCandidates, scan: Scan, config: SurveyConfig
) -> dict[str, MarkerFits]:
    """Fit the markers of one scan by ours and the study's; at the centre by its variants too."""
    fitting = config.fitting
    methods: dict[str, tuple[str, FittingConfig]] = {m: (m, fitting) for m in (OURS, PAPER)}
    if scan.series in (CENTRE, CENTRE_REAL):
        methods[FULL_SPHERE] = (PAPER, dataclasses.replace(fitting, paper_model="sphere"))
        methods[GROUND] = (PAPER, dataclasses.replace(fitting, paper_cut="ground"))
    return {
        name: fit_markers(method, cloud, found, how, config.marker_radius)
        for name, (method, how) in methods.items()
    }


def _rows(
    method: str, fits: MarkerFits, cloud: StitchedCloud, field: Field, stop: SimulatedStop
) -> list[_Row]:
    """Compare the fits of one method with the truth; fits of no mark are left out."""
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
                sigma_3d=float(np.sqrt(np.trace(fit.cov_with_heading(cloud.rig.sigma_heading)))),
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
    """Choose a marker about as far as the study's limit, and turn it into the line of sight."""
    true = transform(inverse(stop.truth.T_site_base), field.marks.p_site)
    fits = {name: one for name, one in fits.items() if name != GROUND}
    marks = {name: marker_errors(one, stop.truth, field.marks).marks for name, one in fits.items()}
    up = levelling_rotation(cloud.levelling)[2]
    distances = np.linalg.norm(true, axis=1)
    chosen = [m for m in marks[PAPER] if m != UNMATCHED and all(m in own for own in marks.values())]
    mark = min(chosen, key=lambda m: abs(distances[m] - GREATEST_DISTANCE))
    fit = {n: one.fits[int(np.flatnonzero(marks[n] == mark)[0])] for n, one in fits.items()}
    members = np.union1d(fit[PAPER].used, fit[PAPER].rejected)
    is_left = np.isin(members, fit[PAPER].used)
    R = _sight(true[mark], cloud)
    points = (cloud.p_base[members] - true[mark]) @ R.T
    return Example(
        mark=field.marks.names[mark],
        distance=float(distances[mark]),
        points_station=points,
        is_left=is_left,
        cut=float(points[is_left, 2].min()),
        ground=float(found.ground_height_max - true[mark] @ up),
        radius=field.marker_radius,
        centres_station={n: R @ (one.p_base - true[mark]) for n, one in fit.items()},
    )


def _noise(stop: SimulatedStop) -> RangeNoise:
    """Return the noise of the ranges of a simulated log, estimated as in a real one."""
    log = stop.log
    offsets = log.stamps_lidar_ns - log.stamps_lidar_ns.min()
    return range_noise(np.linalg.norm(log.p_lidar, axis=1), log.rings, offsets, log.intensities)
