"""Coverage of error ellipses: whole simulated surveys against their own covariances.

Each survey has a field, a rig and sensors of its own: noise of ranges, biases of lasers, optics,
encoder, misalignment, axis offset, levelling and tilt are all drawn anew. What a fit takes for
unknown has to be unknown here too: optics and what all ranges have in common are drawn from its
priors. Stops of a survey share the rig, so they are not independent: intervals come from resampling
whole surveys.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.errors import ConfigError, SolveError, TooFewObservationsError
from spheremark.pipelines.evaluation.experiment import Column, Experiment, Plain, Table
from spheremark.pipelines.geometry import inverse, levelling_rotation, log_motion, rigid
from spheremark.pipelines.model import (
    Array,
    ControlMarks,
    Index,
    Levelling,
    MarkerFits,
    Mask,
    StopTruth,
    seal,
)
from spheremark.pipelines.network import adjust_network, assemble
from spheremark.pipelines.positioning.resection import resect
from spheremark.pipelines.scan.rigs import BEAM_WINDOW
from spheremark.pipelines.simulation import SimulationConfig, scenario, simulate_stop
from spheremark.pipelines.simulation.options import Optics, Profile
from spheremark.pipelines.survey import process

QUANTITIES = {"horizontal": 2, "position": 3, "pose": 6}
"""Compared quantities with their dimensions: position in the plane, in space, with rotation too."""

METHODS = ("free_station", "network")
"""Each station alone on control marks, and all of a survey together."""

LEVELS = (0.50, 0.68, 0.95)
"""Confidence levels of the table."""

_N_RESAMPLES = 2000
_CONFIDENCE = (0.025, 0.975)
_SURVEYS_MIN = 2
_CURVE = tuple(np.round(np.arange(0.05, 1.0, 0.05), 2).tolist())
_BINS = np.arange(0.0, 20.5, 0.5)
_CONFIG = SurveyConfig.from_mapping(
    {
        "fitting": {"methods": ["along_beam"]},
        "stitching": {"sigma_clock": 0.0},  # simulated sensors share a clock
    }
)
_SIMULATION = SimulationConfig(only_near_spheres=True)
_LIDAR = 102  # random stream
_NARROWEST = 0.2  # of the nominal divergence

_Scan = tuple[str, MarkerFits]
_Pose = tuple[Array, Array] | None  # T_site_station and its covariance


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Draws:
    """Errors of stations, one row for each of n stations.

    ``squares`` are in units of the covariance, by method and quantity, NaN where there is no
    station; ``errors`` (n, 3) and ``sigmas`` of the positions are by method [m].
    """

    surveys: Index
    squares: dict[tuple[str, str], Array]
    errors: dict[str, Array]
    sigmas: dict[str, Array]

    def __post_init__(self) -> None:
        seal(self, surveys=(None,))


class Coverage(NamedTuple):
    """Share of n stations within an ellipse of one level, with its 95 % interval."""

    method: str
    quantity: str
    level: float
    share: float
    low: float
    high: float
    n: int


def ellipse_coverage(n_surveys: int, n_stops: int, seed: int) -> Experiment[int, Draws, Plain]:
    """Return the experiment that compares stations of whole surveys with their covariances.

    Parameters
    ----------
    n_surveys : int
        Number of surveys; two or more.
    n_stops : int
        Stops of each.
    seed : int
        Seed of the first survey; the others follow.

    Returns
    -------
    Experiment
        Its report has shares, curves and histograms of squared errors, by method and quantity.
    """
    return Experiment(
        worlds=range(seed, seed + n_surveys),
        run_world=partial(survey_draws, n_stops=n_stops),
        pool=lambda parts: {"seed": seed, **_report(joined(parts))},
        tables=_tables,
    )


def _report(draws: Draws) -> Plain:
    """Return shares, curves and histograms of squared errors as plain values."""
    return {
        "n_surveys": len(np.unique(draws.surveys)),
        "n_stations": len(draws.surveys),
        "config": SurveyConfig().to_mapping()["resection"],
        "simulation": _SIMULATION.to_mapping(),
        "levels": [one._asdict() for one in coverage(draws, LEVELS)],
        "curve": [one._asdict() for one in coverage(draws, _CURVE)],
        "methods": [
            {
                "method": method,
                "n": int(np.isfinite(draws.sigmas[method]).sum()),
                "error_3d_rms_m": _rms(np.linalg.norm(draws.errors[method], axis=1)),
                "sigma_3d_rms_m": _rms(draws.sigmas[method]),
            }
            for method in METHODS
        ],
        "nees": [
            {
                "method": method,
                "quantity": quantity,
                "dimensions": QUANTITIES[quantity],
                "per_dimension": value,
                "counts": _counts(draws.squares[method, quantity]),
            }
            for (method, quantity), value in nees(draws).items()
        ],
        "bins": _BINS.tolist(),
    }


def _tables(report: Plain) -> list[Table]:
    """Return the shares within ellipses as a table."""
    title = (
        f"Share of {report['n_stations']} stations of {report['n_surveys']} simulated surveys "
        "within their ellipses (95 % interval from resampled surveys)"
    )
    shares = (
        Column(partial(_share, report, level), f"{100 * level:.0f} %", "", ">") for level in LEVELS
    )
    columns = (
        Column("method", "stations by"),
        Column("quantity", "of"),
        *shares,
        Column("per_dimension", "mean square", "", ".2f"),
    )
    notes = [
        f"{one['method']}: error {1000 * one['error_3d_rms_m']:.2f} mm, predicted "
        f"{1000 * one['sigma_3d_rms_m']:.2f} mm (3-D, RMS)"
        for one in report["methods"]
    ]
    return [Table(title=title, columns=columns, rows=report["nees"], notes=notes)]


def _share(report: Plain, level: float, row: Plain) -> str:
    """Return the share at one level with its interval [%]."""
    (one,) = (
        one
        for one in report["levels"]
        if (one["method"], one["quantity"], one["level"]) == (row["method"], row["quantity"], level)
    )
    return f"{100 * one['share']:.1f} ({100 * one['low']:.0f}-{100 * one['high']:.0f})"


def _rms(values: Array) -> float:
    """Return the root mean square of the values that are known."""
    return float(np.sqrt(np.nanmean(values**2)))


def _counts(squares: Array) -> list[int]:
    """Return the histogram of squares; those beyond the last bin are in the last."""
    known = np.minimum(squares[np.isfinite(squares)], _BINS[-1] - 1e-9)
    return [int(n) for n in np.histogram(known, _BINS)[0]]


def survey_draws(seed: int, *, n_stops: int) -> Draws:
    """Simulate one survey, position its stations by both methods, and compare with the truth."""
    field = scenario("paper-field", seed)
    if not 1 <= n_stops <= len(field.stops):
        raise ConfigError(f"{n_stops} stops are wanted; a survey has 1 to {len(field.stops)}.")
    places = np.round((np.arange(n_stops) + 0.5) * len(field.stops) / n_stops - 0.5).astype(int)
    scans, truths = [], []
    simulation = replace(_SIMULATION, optics=drawn_optics(np.random.default_rng([seed, _LIDAR])))
    for name in (field.stops[place].name for place in places):
        stop = simulate_stop(field, name, simulation)
        (result,) = process(stop.log, config=_CONFIG)
        scans.append((name, result.fits[_CONFIG.fitting.methods[0]]))
        truths.append(stop.truth)
    poses = {
        "free_station": _free_stations(scans, field.marks),
        "network": _network(scans, field.marks),
    }
    return _compared(seed, scans, truths, poses)


def drawn_optics(rng: np.random.Generator) -> Optics:
    """Return the optics of a LiDAR of the kind that the priors of a fit describe."""
    prior, profiles = _CONFIG.fitting, list(Profile)
    across, along = (abs(rng.normal(0.0, prior.sigma_beam_window)) * BEAM_WINDOW).tolist()
    return Optics(
        profile=profiles[rng.integers(len(profiles))],
        divergence_scale=max(rng.normal(1.0, prior.sigma_beam_width), _NARROWEST),
        window=(across, along),
        incidence=float(rng.integers(2)),
        range_bias=rng.normal(0.0, prior.sigma_range_common),
        range_scale=rng.normal(0.0, prior.sigma_range_scale),
    )


def _free_stations(scans: Sequence[_Scan], marks: ControlMarks) -> list[_Pose]:
    """Return the pose of each station by itself."""
    poses: list[_Pose] = []
    for _, fits in scans:
        try:
            fix = resect("free_station", fits, marks, _CONFIG.resection)
        except SolveError:
            poses.append(None)
        else:
            poses.append((fix.T_site_station, fix.cov_T_site_station))
    return poses


def _network(scans: list[_Scan], marks: ControlMarks) -> list[_Pose]:
    """Return the pose of each station of a network on the same control marks."""
    try:
        result = adjust_network(assemble(scans, marks, _CONFIG.resection), _CONFIG.resection)
    except SolveError:
        return [None] * len(scans)
    found = zip(result.T_site_station, result.cov_T_site_station, strict=True)
    poses = dict(zip(result.network.stations, found, strict=True))
    return [poses.get(name) for name, _ in scans]


def _compared(
    seed: int, scans: list[_Scan], truths: list[StopTruth], found: dict[str, list[_Pose]]
) -> Draws:
    """Compare poses with the truth, in units of their covariances."""
    n = len(scans)
    squares = {(m, q): np.full(n, np.nan) for m in METHODS for q in QUANTITIES}
    errors = {method: np.full((n, 3), np.nan) for method in METHODS}
    sigmas = {method: np.full(n, np.nan) for method in METHODS}
    for method, poses in found.items():
        for i, pose in enumerate(poses):
            if pose is None:
                continue
            errors[method][i], sigmas[method][i], own = pose_errors(
                pose, truths[i], scans[i][1].levelling
            )
            for quantity, square in own.items():
                squares[method, quantity][i] = square
    return Draws(
        surveys=np.full(n, seed, dtype=np.intp), squares=squares, errors=errors, sigmas=sigmas
    )


def pose_errors(
    pose: tuple[Array, Array], stop: StopTruth, levelling: Levelling
) -> tuple[Array, float, dict[str, float]]:
    """Return error and 3-D sigma of a station's position [m], and squares by quantity."""
    T, cov = pose
    truth = stop.T_site_base @ inverse(rigid(levelling_rotation(levelling), np.zeros(3)))
    error, cov_p = T[:3, 3] - truth[:3, 3], _cov_of_position(T, cov)
    squares = {
        "horizontal": _square(error[:2], cov_p[:2, :2]),
        "position": _square(error, cov_p),
        "pose": _square(log_motion(truth @ inverse(T)), cov),
    }
    return error, float(np.sqrt(np.trace(cov_p))), squares


def _cov_of_position(T: Array, cov: Array) -> Array:
    """Return the covariance of the position of a pose, (3, 3) [m^2]."""
    x, y, z = T[:3, 3]
    J = np.hstack([[[0, z, -y], [-z, 0, x], [y, -x, 0]], np.eye(3)])
    return np.asarray(J @ cov @ J.T)


def _square(error: Array, cov: Array) -> float:
    """Return the square of an error in units of its covariance."""
    return float(error @ np.linalg.solve(cov, error))


def joined(parts: Sequence[Draws]) -> Draws:
    """Return the draws of many surveys as one."""
    if len(parts) < _SURVEYS_MIN:
        raise TooFewObservationsError(
            f"{len(parts)} survey shows no spread; simulate two surveys or more."
        )
    first = parts[0]
    return Draws(
        surveys=np.concatenate([part.surveys for part in parts]),
        squares={key: np.concatenate([p.squares[key] for p in parts]) for key in first.squares},
        errors={key: np.concatenate([p.errors[key] for p in parts]) for key in first.errors},
        sigmas={key: np.concatenate([p.sigmas[key] for p in parts]) for key in first.sigmas},
    )


def coverage(
    draws: Draws, levels: Iterable[float] = LEVELS, *, seed: int = 0
) -> tuple[Coverage, ...]:
    """Return the shares of stations within ellipses scaled to some levels by chi-square."""
    weights = _resampled(draws.surveys, np.random.default_rng(seed))
    found = []
    for (method, quantity), squares in draws.squares.items():
        known = _known(draws, method, quantity)
        own = weights[:, known]
        own = own[own.any(axis=1)]  # surveys without a station may be all that is drawn
        for level in levels:
            inside = squares[known] <= chi2.ppf(level, QUANTITIES[quantity])
            low, high = np.quantile((own @ inside) / own.sum(axis=1), _CONFIDENCE).tolist()
            share, n = float(inside.mean()), int(known.sum())
            found.append(Coverage(method, quantity, float(level), share, low, high, n))
    return tuple(found)


def nees(draws: Draws) -> dict[tuple[str, str], float]:
    """Return the mean square of errors in units of their covariance, per dimension; 1 is honest."""
    return {
        key: float(np.mean(squares[_known(draws, *key)])) / QUANTITIES[key[1]]
        for key, squares in draws.squares.items()
    }


def _known(draws: Draws, method: str, quantity: str) -> Mask:
    """Return which stations a method positioned; at least one."""
    known: Mask = np.isfinite(draws.squares[method, quantity])
    if not known.any():
        raise TooFewObservationsError(
            f"None of {len(known)} stations was positioned by {method!r}, so its errors are not "
            "known. Simulate more surveys, or fields with more marks."
        )
    return known


def _resampled(surveys: Index, rng: np.random.Generator) -> Array:
    """Return how often each row is in each resample of whole surveys, (resamples, rows)."""
    _, clusters = np.unique(surveys, return_inverse=True)
    n = int(clusters.max()) + 1
    counts = rng.multinomial(n, np.full(n, 1.0 / n), _N_RESAMPLES)
    return np.asarray(counts[:, clusters], dtype=np.float64)
