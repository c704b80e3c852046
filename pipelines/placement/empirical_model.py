"""The model of centres from the fits of one's own surveys: hides the regression.

Variances of fits are compared with those of the sensor model, axis by axis at a reference, and by
distance, count, incidence and reflectivity. What few fits do not determine stays with the sensor
model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.estimation.linear_algebra import inverse
from spheremark.pipelines.estimation.robust import (
    huber_weights,
    robust_sigma,
    sandwich_covariance,
)
from spheremark.pipelines.model import Array, Index, Mask, same_length, seal
from spheremark.pipelines.placement.centre_model import (
    AXES,
    REFERENCE_DISTANCE,
    TERMS,
    CentreModel,
    Provenance,
    centres_ahead,
    sensor_model,
)
from spheremark.pipelines.placement.sensor import Sensor
from spheremark.pipelines.placement.station_covariance import claimed_bias_variance

ROWS_LEAST, STOPS_LEAST = 24, 3
"""Fits and stops below which the sensor model is kept."""

_SIGMA_CONSTANT, _SIGMA_POWER = 1.0, 0.5  # priors of factors' logarithms and of powers about none
_LEFT_LEAST = 0.1  # of a variance that must remain when known parts of it are taken off
_DOF_PRIOR = 30.0  # degrees of freedom that a variance factor of one is worth
_COLUMNS = ("ranges", "n_points", "incidences", "intensities", "turns", "stops", "dof", "sigma0")
_N_STEPS = 12


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class FitRows:
    """Fits of surveys, one row per centre."""

    ranges: Array  # (n,) distances [m]
    n_points: Array  # (n,) returns that carry each
    incidences: Array  # (n,) mean angles of incidence; NaN where not known [rad]
    intensities: Array  # (n,) mean reflectivity, 0 to 255; NaN where not known
    # (n, 3) stated variances towards, left and up, without that of the heading [m^2]
    variances: Array
    turns: Array  # (n,) times of the turns that saw them [s]
    stops: Index  # (n,) number of the stop that each is from
    # (n,) degrees of freedom and square root of the variance factor of that stop's position; NaN
    # where there is none
    dof: Array
    sigma0: Array
    surveys: tuple[str, ...]  # names of the surveys
    fit_method: str  # fitting method of all of them
    newest: str  # time of the newest, ISO 8601

    def __post_init__(self) -> None:
        columns = dict.fromkeys(_COLUMNS, (None,))
        seal(self, **columns, variances=(None, 3))
        same_length(self, *_COLUMNS, "variances")


class _Data(NamedTuple):
    """Logarithms of variances over the sensor model's, with their causes."""

    y: Array
    design: Array
    stops: Index


def fitted_model(sensor: Sensor, marker_radius: float, rows: FitRows) -> CentreModel:
    """Fit the model of centres to surveys; keep the sensor model where there are too few.

    Parameters
    ----------
    sensor : Sensor
        How the next survey will be driven.
    marker_radius : float
        Radius of the spheres [m].
    rows : FitRows
        Fits of one method.

    Returns
    -------
    CentreModel
        With powers, their covariance, and where they come from.

    Notes
    -----
    Bayesian robust regression (Huber's psi) with priors of no difference from the sensor model, 1
    on each factor's logarithm and 0.5 on each power; covariances are of the sandwich form,
    clustered by stop. The variance factors of the stops' positions, pooled with a prior of 30
    degrees of freedom, scale the variances. The expected count is that of the surveys for a turn of
    the same time.
    """
    model = sensor_model(sensor, marker_radius)
    usable = _usable(rows, model)
    n, n_stops = int(usable.sum()), len(np.unique(rows.stops[usable]))
    if n < ROWS_LEAST or n_stops < STOPS_LEAST:
        note = (
            f"{n} fits at {n_stops} stops are too few for a model of their own ({ROWS_LEAST} at "
            f"{STOPS_LEAST} are needed): the bound of the sensor's returns is used."
        )
        return replace(model, provenance=Provenance(source="sensor", note=note))
    expected, bound = centres_ahead(model, rows.ranges[usable])
    counts = np.log(rows.n_points[usable] / expected * sensor.turn / rows.turns[usable])
    log_count, sigma_count = _middle(counts, rows.stops[usable])
    data = _data(
        rows,
        usable,
        bound * (expected / rows.n_points[usable])[:, None],
        counts - log_count,
        claimed_bias_variance(sensor.sigma_range_bias),
    )
    beta, cov, scatter = _regressed(data)
    factor2, n_dof = _variance_factor(rows, usable)
    beta[: len(AXES)] += np.log(factor2)
    spread = 100.0 * float(np.sqrt(np.diag(cov)[: len(AXES)].mean())) / 2.0
    return CentreModel(
        sensor=sensor,
        marker_radius=marker_radius,
        log_factors=beta,
        cov_log_factors=cov,
        log_count=np.array([log_count, sigma_count]),
        at=np.zeros(len(TERMS)),
        provenance=Provenance(
            source="fitted",
            n_rows=n,
            n_stops=n_stops,
            surveys=rows.surveys,
            fit_method=rows.fit_method,
            newest=rows.newest,
            note=(
                f"Sigmas of centres are known to {spread:.1f} %; single fits scatter by "
                f"{50.0 * scatter:.0f} % about them. Variance factor {factor2:.2f} from "
                f"{n_dof:.0f} degrees of freedom."
            ),
        ),
    )


def _usable(rows: FitRows, model: CentreModel) -> Mask:
    """Return which rows can be compared with the sensor model."""
    distances = model.returns.distances
    is_known = np.isfinite(rows.variances).all(axis=1) & (rows.variances > 0).all(axis=1)
    is_near = (rows.ranges > distances[0]) & (rows.ranges < distances[-2])
    return np.asarray(is_known & is_near & (rows.n_points > 3) & (rows.turns > 0.1))


def _data(rows: FitRows, usable: Mask, expected: Array, counts: Array, known: float) -> _Data:
    """Return the regression: three rows for each fit."""
    variances = rows.variances[usable].copy()
    variances[:, 0] = np.maximum(variances[:, 0] - known, _LEFT_LEAST * variances[:, 0])
    causes = np.column_stack(
        [
            np.log(rows.ranges[usable] / REFERENCE_DISTANCE),
            counts,
            _centred(np.log(np.sin(rows.incidences[usable]))),
            _centred(np.log(np.maximum(rows.intensities[usable], 1.0))),
        ]
    )
    n = len(causes)
    design = np.zeros((n, 3, 3 + len(TERMS)))
    design[:, :, :3] = np.eye(3)
    design[:, :, 3:] = causes[:, None, :]
    y = np.log(variances / expected)
    return _Data(
        y=y.ravel(), design=design.reshape(3 * n, -1), stops=np.repeat(rows.stops[usable], 3)
    )


def _centred(values: Array) -> Array:
    """Return values less their median; zero for those that are not known."""
    is_known = np.isfinite(values)
    middle = float(np.median(values[is_known])) if is_known.any() else 0.0
    return np.where(is_known, values - middle, 0.0)


def _regressed(data: _Data) -> tuple[Array, Array, float]:
    """Return coefficients, their covariance, and the scatter of single logarithms."""
    k = data.design.shape[1]
    prior = np.diag([_SIGMA_CONSTANT**-2.0] * 3 + [_SIGMA_POWER**-2.0] * (k - 3))
    beta: Array = np.zeros(k)
    scatter, residuals, weights = 1.0, data.y, np.ones(len(data.y))
    for _ in range(_N_STEPS):
        weighted = data.design * (weights / scatter**2)[:, None]
        beta = inverse(weighted.T @ data.design + prior) @ (weighted.T @ data.y)
        residuals = data.y - data.design @ beta
        scatter = max(robust_sigma(residuals), 0.02)
        weights = huber_weights(residuals / scatter)
    bread = inverse((data.design * (weights / scatter**2)[:, None]).T @ data.design + prior)
    _, clusters = np.unique(data.stops, return_inverse=True)
    scores = data.design * (weights * residuals / scatter**2)[:, None]
    return beta, sandwich_covariance(bread, scores, clusters, prior), scatter


def _middle(values: Array, stops: Index) -> tuple[float, float]:
    """Return the median of values, and its standard deviation by the spread of stops' medians."""
    medians = np.array([np.median(values[stops == stop]) for stop in np.unique(stops)])
    return float(np.median(values)), float(medians.std(ddof=1) / np.sqrt(len(medians)))


def _variance_factor(rows: FitRows, usable: Mask) -> tuple[float, float]:
    """Return the pooled variance factor of the stops' positions, and its degrees of freedom."""
    _, first = np.unique(rows.stops[usable], return_index=True)
    dof, sigma0 = rows.dof[usable][first], rows.sigma0[usable][first]
    is_known = np.isfinite(dof) & np.isfinite(sigma0) & (dof > 0)
    total = float(dof[is_known].sum())
    squares = float((dof[is_known] * sigma0[is_known] ** 2).sum())
    return (squares + _DOF_PRIOR) / (total + _DOF_PRIOR), total
