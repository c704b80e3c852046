"""Scans simulated and fitted: errors of all centres against the truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.accuracy.truth import UNMATCHED, marker_errors, mean_incidence
from spheremark.pipelines.config import FittingConfig, SurveyConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.evaluation.experiment import Experiment, Plain
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

    Attributes
    ----------
    scans : tuple of Scan
        The plan.
    n_marks : (n,)
        Marks of each scan's world.
    centres : mapping of str to array
        Columns, named as the database names them, with one row for each scan, marker and method.
    example : Example
        A marker of the first scan.
    noise : RangeNoise
        Noise of the ranges of the first scan that simulates a real sensor.
    config : SurveyConfig
        Configuration of the fits.
    """

    scans: tuple[Scan, ...]
    n_marks: Index
    centres: Mapping[str, NDArray[Any]]
    example: Example
    noise: RangeNoise
    config: SurveyConfig

    def of(self, method: str, *series: str) -> Mask:
        """Return which centres are by a method and from some series of scans."""
        is_own = np.isin(self.centres["series"].astype(str), series)
        return np.asarray(is_own & (self.centres["fit_method"] == method))


class _Measured(NamedTuple):
    """The results of one scan."""

    rows: list[Plain]
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
            centres=columns_of([row for one in found for row in one.rows]),
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
    origin = {"stop": scan.stop, "series": scan.series, "world": scan.seed, "turn_s": scan.turn}
    return _Measured(
        rows=[
            {"scan": place, **origin, "fit_method": name, **row}
            for name, one in fits.items()
            for row in _rows(one, cloud, field, stop)
        ],
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


def _rows(fits: MarkerFits, cloud: StitchedCloud, field: Field, stop: SimulatedStop) -> list[Plain]:
    """Compare the fits of one method with the truth; fits of no mark are left out."""
    errors = marker_errors(fits, stop.truth, field.marks)
    true = transform(inverse(stop.truth.T_site_base), field.marks.p_site)
    rows = []
    for fit, mark, error in zip(fits.fits, errors.marks, errors.error_base, strict=True):
        if mark == UNMATCHED:
            continue
        name = field.marks.names[mark]
        towards, left, up = _line_of_sight(true[mark], cloud) @ error
        cov = fit.cov_with_heading(cloud.rig.sigma_heading)
        incidence = mean_incidence(beams(cloud, fit.used), fit.p_base, fit.radius)
        rows.append(
            {
                "marker": name,
                "mark": name,
                "status": "ok",
                "reason": "",
                "range_m": float(np.linalg.norm(true[mark])),
                "n_points": fit.n_points,
                "incidence_deg": float(np.degrees(incidence)),
                "sigma_3d_m": float(np.sqrt(np.trace(cov))),
                "rms_m": fit.rms,
                "error_towards_m": float(towards),
                "error_left_m": float(left),
                "error_up_m": float(up),
                "error_3d_m": float(np.linalg.norm(error)),
            }
        )
    return rows


def columns_of(rows: Sequence[Plain]) -> dict[str, NDArray[Any]]:
    """Return the columns of rows with the same keys; texts as objects."""
    return {
        key: np.array([row[key] for row in rows], dtype=object if isinstance(one, str) else None)
        for key, one in rows[0].items()
    }


def _line_of_sight(p_base: Array, cloud: StitchedCloud) -> Array:
    """Return the rotation from base to: towards a place, to its left, upward, (3, 3)."""
    up = levelling_rotation(cloud.levelling)[2]
    towards = p_base - (p_base @ up) * up
    towards = towards / np.linalg.norm(towards)
    return np.stack([towards, np.cross(up, towards), up])


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
    R = _line_of_sight(true[mark], cloud)
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
