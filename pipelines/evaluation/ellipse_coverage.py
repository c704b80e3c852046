"""Do stations lie where their ellipses say? Whole simulated surveys against their own promises.

Each survey has a field, a rig and sensors of its own: noise of ranges, biases of lasers, encoder,
misalignment, axis offset, levelling and tilt are all drawn anew. Its stops share the rig, so they
are not independent: intervals are made by drawing whole surveys again.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.stats import chi2

from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.errors import ConfigError, SolveError, TooFewObservationsError
from spheremark.pipelines.geometry import inverse, levelling_rotation, log_motion, rigid
from spheremark.pipelines.model import Array, ControlMarks, Index, MarkerFits, Mask, StopTruth, seal
from spheremark.pipelines.network import adjust_network, assemble
from spheremark.pipelines.positioning.resection import resect
from spheremark.pipelines.simulation import Field, SimulationConfig, scenario, simulate_stop
from spheremark.pipelines.survey import Progress, process
from spheremark.pipelines.threads import in_processes

QUANTITIES = {"horizontal": 2, "position": 3, "pose": 6}
"""What is compared, with its dimensions: position in the plane, in space, with rotation too."""

METHODS = ("free_station", "network")
"""Each station alone on control marks, and all of a survey together."""

LEVELS = (0.50, 0.68, 0.95)
"""Shares that are asked for first."""

_N_RESAMPLES = 2000
_CONFIDENCE = (0.025, 0.975)
_SURVEYS_MIN = 2


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Draws:
    """Errors of stations in units of their own covariance.

    Attributes
    ----------
    surveys : (n,)
        Survey of each station.
    squares : (n,) by (method, quantity)
        Square of the error, weighted by the inverse of its covariance; NaN where there is no
        station.
    errors : (n, 3) by method
        Errors of the positions in the site frame [m].
    sigmas : (n,) by method
        Square root of the trace of the covariance of each position [m].
    """

    surveys: Index
    squares: dict[tuple[str, str], Array]
    errors: dict[str, Array]
    sigmas: dict[str, Array]

    def __post_init__(self) -> None:
        seal(self, surveys=(None,))


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """How often something lies within what was promised.

    Attributes
    ----------
    method, quantity : str
        Of ``METHODS`` and ``QUANTITIES``.
    level : float
        Share that is promised.
    share : float
        Share that was found.
    low, high : float
        95 % interval of that share, by drawing whole surveys again.
    n : int
        Number of stations.
    """

    method: str
    quantity: str
    level: float
    share: float
    low: float
    high: float
    n: int


def survey_draws(
    seed: int,
    *,
    n_stops: int,
    config: SurveyConfig | None = None,
    simulation: SimulationConfig | None = None,
) -> Draws:
    """Simulate one survey, position its stations in both ways, and compare with the truth."""
    config = config or SurveyConfig.from_mapping({"fitting": {"methods": ["along_beam"]}})
    simulation = simulation or SimulationConfig(only_near_spheres=True)
    field = scenario("paper-field", seed)
    if not 1 <= n_stops <= len(field.stops):
        raise ConfigError(f"{n_stops} stops are wanted; a survey has 1 to {len(field.stops)}.")
    scans, truths = [], []
    for name in _spread(field, n_stops):
        stop = simulate_stop(field, name, simulation)
        (result,) = process(stop.log, config=config)
        scans.append((name, result.fits[config.fitting.methods[0]]))
        truths.append(stop.truth)
    found = {
        "free_station": _alone(scans, field.marks, config),
        "network": _together(scans, field.marks, config),
    }
    return _compared(seed, scans, truths, found)


def _spread(field: Field, n: int) -> list[str]:
    """Return the names of stops that are spread evenly over the order of driving."""
    places = np.round((np.arange(n) + 0.5) * len(field.stops) / n - 0.5).astype(int)
    return [field.stops[place].name for place in places]


Scan = tuple[str, MarkerFits]
Pose = tuple[Array, Array] | None  # T_site_station and its covariance


def _alone(scans: list[Scan], marks: ControlMarks, config: SurveyConfig) -> list[Pose]:
    """Return the pose of each station by itself."""
    poses: list[Pose] = []
    for _, fits in scans:
        try:
            fix = resect("free_station", fits, marks, config.resection)
        except SolveError:
            poses.append(None)
        else:
            poses.append((fix.T_site_station, fix.cov_T_site_station))
    return poses


def _together(scans: list[Scan], marks: ControlMarks, config: SurveyConfig) -> list[Pose]:
    """Return the pose of each station of a network on the same control marks."""
    try:
        result = adjust_network(assemble(scans, marks, config.resection), config.resection)
    except SolveError:
        return [None] * len(scans)
    places = {name: i for i, name in enumerate(result.network.stations)}
    return [
        (result.T_site_station[places[name]], result.cov_T_site_station[places[name]])
        if name in places
        else None
        for name, _ in scans
    ]


def _compared(
    seed: int, scans: list[Scan], truths: list[StopTruth], found: dict[str, list[Pose]]
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
            T, cov = pose
            R = levelling_rotation(scans[i][1].levelling)
            truth = truths[i].T_site_base @ inverse(rigid(R, np.zeros(3)))
            error, own = T[:3, 3] - truth[:3, 3], _cov_of_position(T, cov)
            errors[method][i], sigmas[method][i] = error, np.sqrt(np.trace(own))
            squares[method, "horizontal"][i] = _square(error[:2], own[:2, :2])
            squares[method, "position"][i] = _square(error, own)
            squares[method, "pose"][i] = _square(log_motion(truth @ inverse(T)), cov)
    return Draws(
        surveys=np.full(n, seed, dtype=np.intp), squares=squares, errors=errors, sigmas=sigmas
    )


def _cov_of_position(T: Array, cov: Array) -> Array:
    """Return the covariance of the position of a pose, (3, 3) [m^2]."""
    x, y, z = T[:3, 3]
    J = np.hstack([[[0, z, -y], [-z, 0, x], [y, -x, 0]], np.eye(3)])
    return np.asarray(J @ cov @ J.T)


def _square(error: Array, cov: Array) -> float:
    """Return the square of an error in units of its covariance."""
    return float(error @ np.linalg.solve(cov, error))


def joined(parts: Iterable[Draws]) -> Draws:
    """Return the draws of many surveys as one."""
    parts = tuple(parts)
    if len(parts) < _SURVEYS_MIN:
        raise TooFewObservationsError(
            f"{len(parts)} survey tells nothing about chance; simulate two or more."
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
    """Say how often stations lie within ellipses scaled to some shares.

    Parameters
    ----------
    draws : Draws
        Stations of many surveys.
    levels : iterable of float
        Shares that the ellipses are scaled to, by the chi-square distribution of their dimension.
    seed : int
        Source of chance of the intervals.

    Returns
    -------
    tuple of Coverage
        By method, quantity and level.

    Raises
    ------
    TooFewObservationsError
        If a method positioned no station.
    """
    weights = _resampled(draws.surveys, np.random.default_rng(seed))
    found = []
    for (method, quantity), squares in draws.squares.items():
        known = _known(draws, method, quantity)
        own = weights[:, known]
        own = own[own.any(axis=1)]  # surveys without a station may be all that is drawn
        for level in levels:
            inside = squares[known] <= chi2.ppf(level, QUANTITIES[quantity])
            low, high = np.quantile((own @ inside) / own.sum(axis=1), _CONFIDENCE)
            found.append(
                Coverage(
                    method=method,
                    quantity=quantity,
                    level=float(level),
                    share=float(inside.mean()),
                    low=float(low),
                    high=float(high),
                    n=int(known.sum()),
                )
            )
    return tuple(found)


def nees(draws: Draws) -> dict[tuple[str, str], float]:
    """Return the mean square of errors in units of their covariance, per dimension; 1 is honest.

    Parameters
    ----------
    draws : Draws
        Stations of many surveys.

    Returns
    -------
    dict
        By method and quantity.

    Raises
    ------
    TooFewObservationsError
        If a method positioned no station.
    """
    return {
        key: float(np.mean(squares[_known(draws, *key)])) / QUANTITIES[key[1]]
        for key, squares in draws.squares.items()
    }


def _known(draws: Draws, method: str, quantity: str) -> Mask:
    """Tell which stations a method positioned; at least one."""
    known: Mask = np.isfinite(draws.squares[method, quantity])
    if not known.any():
        raise TooFewObservationsError(
            f"None of {len(known)} stations was positioned by {method!r}: nothing is known of its "
            "errors. Simulate more surveys, or such that have marks enough."
        )
    return known


def simulate_surveys(
    n_surveys: int,
    n_stops: int,
    seed: int,
    *,
    simulation: SimulationConfig | None = None,
    n_processes: int | None = None,
    progress: Progress = lambda _share, _what: None,
) -> Draws:
    """Simulate many surveys, some at a time.

    Parameters
    ----------
    n_surveys : int
        How many; two or more.
    n_stops : int
        Stops of each.
    seed : int
        Source of chance of the first; the others follow.
    simulation : SimulationConfig, optional
        How the rig errs; the default one, with only the beams near spheres, if missing.
    n_processes : int, optional
        How many at a time; as many as there are processors by default.
    progress : callable
        Told the share of the work that is done, 0 to 1, and what comes next; may raise to cancel.

    Returns
    -------
    Draws
        One row for each station.
    """
    survey = partial(survey_draws, n_stops=n_stops, simulation=simulation)
    seeds = range(seed, seed + n_surveys)
    return joined(in_processes(survey, seeds, n_processes=n_processes, progress=progress))


def _resampled(surveys: Index, rng: np.random.Generator) -> Array:
    """Return how often each row is in each resample of whole surveys, (resamples, rows)."""
    _, clusters = np.unique(surveys, return_inverse=True)
    n = int(clusters.max()) + 1
    counts = rng.multinomial(n, np.full(n, 1.0 / n), _N_RESAMPLES)
    return np.asarray(counts[:, clusters], dtype=np.float64)
