"""The chain with its defaults, for notebooks and scripts: one call a problem, arrays and values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from spheremark.pipelines.calibration import Calibration
from spheremark.pipelines.config import ResectionConfig, SurveyConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.errors import InputError
from spheremark.pipelines.model import (
    RING_UNKNOWN,
    Array,
    ControlMarks,
    Levelling,
    MarkerFits,
    Rings,
    StitchedCloud,
    StopResult,
)
from spheremark.pipelines.network import AdjustedNetwork, adjust_network, assemble
from spheremark.pipelines.placement import (
    Arrangement,
    Costs,
    Evaluation,
    Goal,
    Optimum,
    PlaceRules,
    Report,
    Requirement,
    Sensor,
    Site,
    Stops,
    evaluate,
    find_candidates,
    optimise,
    sensor_model,
    site_of_grid,
)
from spheremark.pipelines.scan.rigs import N_LASERS, vlp16
from spheremark.pipelines.sphere import fit_markers

_SIGMA_LEVELLING = 0.003  # [rad] of a scanner that stands upright as well as a bubble shows
_ORIGIN_SPREAD = 0.25  # [m] of beam origins that still count as one place of the sensor
_BORDER = 2.0  # [m] of flat ground beyond the reach of the marks
_CELL = 0.25  # [m] of flat ground
_MAST = 1.05  # [m] of the LiDAR above flat ground, as on the study's rover


def find_spheres(  # noqa: PLR0913  each is a column or a property of the scan
    xyz: ArrayLike,
    radius: float,
    *,
    rings: ArrayLike | None = None,
    times: ArrayLike | None = None,
    origins: ArrayLike = (0.0, 0.0, 0.0),
    divergence: float = 0.003,
    config: SurveyConfig | None = None,
) -> MarkerFits:
    """Find and fit the spheres of known radius in the cloud of one scan.

    Parameters
    ----------
    xyz : (n, 3) array_like
        Returns in a right-handed frame with z up [m]; rows that are not finite are left out.
    radius : float
        Radius of the spheres [m].
    rings : (n,) array_like, optional
        Laser of each return, 0 the lowest.
    times : (n,) array_like, optional
        Instant of each return since the first [s].
    origins : (3,) or (n, 3) array_like
        Position of the sensor, or of the origin of each beam, in the frame of ``xyz`` [m].
    divergence : float
        Full width of the beam [rad].
    config : SurveyConfig, optional
        Options of detection and fitting; the first fitting method is used.

    Returns
    -------
    MarkerFits
        Centres with covariances in the frame of ``xyz`` (``p_base``), and the groups that were
        refused, with reasons. Rows count the finite returns.

    Raises
    ------
    InputError
        If shapes disagree, nothing is finite, or beams start at several places.

    Notes
    -----
    The fit works along beams from one sensor position: a cloud joined from several positions has to
    be given one position at a time. Without a levelled frame tilt the cloud first: the pole of a
    marker is expected below it.
    """
    config = config or SurveyConfig()
    p, sensor, columns = _columns(xyz, origins, rings, times)
    cloud = _resting_cloud(p - sensor, *columns, divergence)
    found = extract(cloud, config.extraction, radius)
    fits = fit_markers(config.fitting.methods[0], cloud, found, config.fitting, radius)
    return replace(
        fits,
        fits=tuple(replace(fit, p_base=fit.p_base + sensor) for fit in fits.fits),
        rejected=tuple(replace(one, p_base=one.p_base + sensor) for one in fits.rejected),
        possible=tuple(replace(one, p_base=one.p_base + sensor) for one in fits.possible),
        possible_fits=tuple(replace(one, p_base=one.p_base + sensor) for one in fits.possible_fits),
    )


def adjust(
    stops: Sequence[StopResult],
    control: ControlMarks | None = None,
    *,
    config: ResectionConfig | None = None,
    calibration: Calibration | None = None,
) -> AdjustedNetwork:
    """Adjust all stations and marks of a survey together.

    Parameters
    ----------
    stops : sequence of StopResult
        Results of ``process``; the centres of their first fitting method are used.
    control : ControlMarks, optional
        Marks at known places; without any the network is free.
    config : ResectionConfig, optional
        Matching and levels of the tests.
    calibration : Calibration, optional
        The rig with covariance: its parameters become unknowns of the network.

    Returns
    -------
    AdjustedNetwork
        Poses, marks, covariances and tests.

    Raises
    ------
    InputError
        If two stops have the same name.
    SolveError
        If the stops share too few marks, or the adjustment does not settle.
    """
    config = config or ResectionConfig()
    scans = [(stop.name, next(iter(stop.fits.values()))) for stop in stops]
    return adjust_network(assemble(scans, control, config, calibration), config)


def evaluate_plan(
    marks: ArrayLike,
    stops: ArrayLike,
    *,
    site: Site | None = None,
    sensor: Sensor | None = None,
    requirement: Requirement | None = None,
) -> Evaluation:
    """Predict the accuracy of every stop from the places of the marks, without simulating a scan.

    Parameters
    ----------
    marks : (k, 3) array_like
        Centres of the spheres in the site frame [m].
    stops : (m, 3) array_like
        Positions of the LiDAR in the site frame [m].
    site : Site, optional
        Ground and what hides marks; by default flat ground below the lowest stop.
    sensor : Sensor, optional
        The scan; by default one turn of a VLP-16.
    requirement : Requirement, optional
        Tolerance and positioning method.

    Returns
    -------
    Evaluation
        Covariance, angles, reliability and probability for each stop, with a reason for each weak
        one.

    Raises
    ------
    InputError
        If shapes are wrong, or a place lies off the site.
    """
    where, places = _places("stops", stops), _places("marks", marks)
    site = site or _flat_site(where, places)
    model = sensor_model(sensor or Sensor(), site.marker_radius)
    return evaluate(
        site,
        _stops(where),
        Arrangement.numbered(places),
        model,
        requirement or Requirement(),
    )


def optimise_plan(  # noqa: PLR0913  all that a plan is made of
    stops: ArrayLike,
    n_marks: int | None = None,
    *,
    site: Site | None = None,
    sensor: Sensor | None = None,
    requirement: Requirement | None = None,
    rules: PlaceRules | None = None,
    goal: Goal | None = None,
    standing: ArrayLike | None = None,
    costs: Costs | None = None,
    report: Report | None = None,
    seed: int = 0,
) -> Optimum:
    """Find the best places for marks, or the fewest that keep the tolerance at every stop.

    Parameters
    ----------
    stops : (m, 3) array_like
        Positions of the LiDAR in the site frame [m].
    n_marks : int, optional
        Number of marks; by default the least number that keeps the tolerance.
    site : Site, optional
        Ground and what hides marks; by default flat ground below the lowest stop.
    sensor : Sensor, optional
        The scan; by default one turn of a VLP-16.
    requirement : Requirement, optional
        Tolerance and positioning method.
    rules : PlaceRules, optional
        Where marks may stand.
    goal : Goal, optional
        What is least: worst stop, after a loss or mean, the weight of the way past all marks, and
        how far stops may move. The number of marks is that of ``n_marks``, if given.
    standing : (n, 3) array_like, optional
        Centres of marks that stand already and stay; they count among the number [m].
    costs : Costs, optional
        What marks and the way past them cost: ``cost`` of the result.
    report : callable, optional
        Takes the state of the search: the best arrangement and the bound so far.
    seed : int
        Of the optimiser's later starts.

    Returns
    -------
    Optimum
        Marks, their evaluation, and the bound that no arrangement goes below.

    Raises
    ------
    InputError
        If shapes are wrong, or a stop lies off the site.
    DegenerateGeometryError
        If no number of marks keeps the tolerance.
    """
    where = _places("stops", stops)
    site, rules = site or _flat_site(where, where), rules or PlaceRules()
    goal = goal or Goal()
    found = optimise(
        site,
        _stops(where),
        find_candidates(site, _stops(where), rules),
        sensor_model(sensor or Sensor(), site.marker_radius),
        requirement or Requirement(),
        goal if n_marks is None else replace(goal, n_marks=n_marks),
        np.random.default_rng(seed),
        standing=None if standing is None else Arrangement.numbered(_places("marks", standing)),
        report=report,
    )
    return found if costs is None else replace(found, cost=costs.of(found))


def _columns(
    xyz: ArrayLike, origins: ArrayLike, rings: ArrayLike | None, times: ArrayLike | None
) -> tuple[Array, Array, tuple[Rings, Array]]:
    """Return the finite points, the position of the sensor, and rings and times, checked."""
    p, starts = np.asarray(xyz, np.float64), np.asarray(origins, np.float64)
    n = len(p)
    if p.ndim != 2 or p.shape[1] != 3:
        raise InputError(f"xyz has shape {p.shape}, not (n, 3).")
    if starts.shape not in ((3,), (n, 3)):
        raise InputError(f"origins has shape {starts.shape}, not (3,) or ({n}, 3).")
    laser = np.full(n, RING_UNKNOWN, np.uint8) if rings is None else np.asarray(rings)
    instants = np.zeros(n) if times is None else np.asarray(times, np.float64)
    for name, column in (("rings", laser), ("times", instants)):
        if column.shape != (n,):
            raise InputError(f"{name} has shape {column.shape}, not ({n},).")
    starts = np.broadcast_to(starts, (n, 3))
    keep = np.isfinite(p).all(axis=1) & np.isfinite(starts).all(axis=1)
    if not keep.any():
        raise InputError(f"None of the {n} rows of xyz is finite.")
    sensor = starts[keep].mean(axis=0)
    spread = np.linalg.norm(starts[keep] - sensor, axis=1).max()
    if spread > _ORIGIN_SPREAD:
        raise InputError(
            f"Beams start up to {spread:.2f} m from their mean; more than {_ORIGIN_SPREAD} m are "
            "several positions of the sensor. Give the cloud of one position at a time."
        )
    if laser[keep].min() < 0 or laser[keep].max() > RING_UNKNOWN:
        raise InputError(f"rings must lie between 0 and {RING_UNKNOWN}.")
    return p[keep], sensor, (laser[keep].astype(np.uint8), instants[keep])


def _resting_cloud(p: Array, rings: Rings, times: Array, divergence: float) -> StitchedCloud:
    """Return a cloud of a sensor that stands upright and still at the origin."""
    rig = vlp16("resting", np.eye(4))
    rig = replace(rig, laser_heights=np.zeros(N_LASERS), divergence=np.full(2, divergence))
    known = np.where(rings < N_LASERS, rings, RING_UNKNOWN).astype(np.uint8)
    return StitchedCloud(
        p_base=p.astype(np.float32),
        gimbal_angles=np.zeros(len(p), np.float32),
        intensities=np.zeros(len(p), np.float32),
        rings=known,
        times=(times - times.min()).astype(np.float32),
        levelling=Levelling(roll=0.0, pitch=0.0, sigma=_SIGMA_LEVELLING, is_measured=False),
        rig=rig,
        coverage=0.0,
        duration=max(float(np.ptp(times)), 0.1),
        name="cloud",
    )


def _places(what: str, places: ArrayLike) -> Array:
    """Return positions as (n, 3)."""
    p = np.asarray(places, np.float64)
    if p.ndim != 2 or p.shape[1] != 3 or not np.isfinite(p).all():
        raise InputError(f"{what} has shape {p.shape}; finite positions (n, 3) are expected.")
    return p


def _stops(p_site: Array) -> Stops:
    """Return stops by number."""
    return Stops(names=tuple(f"S{i + 1:02d}" for i in range(len(p_site))), p_site=p_site)


def _flat_site(stops: Array, marks: Array) -> Site:
    """Return flat ground under stops and marks, one mast below the lowest stop."""
    reach = PlaceRules().reach + _BORDER
    every = np.vstack([stops, marks])[:, :2]
    xs, ys = (
        np.arange(every[:, axis].min() - reach, every[:, axis].max() + reach + _CELL, _CELL)
        for axis in range(2)
    )
    level = stops[:, 2].min() - _MAST
    return site_of_grid("flat ground", xs, ys, np.full((len(ys), len(xs)), level))
