"""Centres from ranges and from the limb: which pulses hit the sphere and which passed it.

The probability that a pulse returns rises as its footprint enters the limb; this module estimates
how it rises, and what returned and missing pulses say of each centre.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.config import FittingConfig
from spheremark.pipelines.model import (
    Array,
    MarkerCandidates,
    MarkerFit,
    Mask,
    Status,
    StitchedCloud,
)
from spheremark.pipelines.scan.firings import Clock, clock_of
from spheremark.pipelines.sphere.description import Fits
from spheremark.pipelines.sphere.methods import along_beam
from spheremark.pipelines.sphere.pulses import Passing, passing_of

NAME = "silhouette"

_OUTLIERS = 0.01  # share of pulses that hit without a return, or pass by with one
_AT = 10.0  # [m] distance of the least share of a footprint that returns
_LEAST = np.geomspace(1e-3, 0.3, 24)  # grid of that share
_SHARE, _SPREAD_SHARE = 0.02, 1.5  # prior of that share, and its sigma in the logarithm
_SOFTNESSES = (0.015, 0.03, 0.06, 0.12, 0.24)  # half widths over which the probability rises
_OWN_EDGES = 0.05 * np.linspace(-2.0, 2.0, 5)  # half widths: deviations of one marker's edge,
_OWN_LOGS = -0.5 * np.linspace(-2.0, 2.0, 5) ** 2  # and the logarithms of their densities
_N_PRODUCT = 100  # probabilities that are multiplied before the logarithm is taken
_N_PLACES = 64  # places of a centre over which the likelihood of a link is averaged
_N_LINKS = 3  # steps in which the link is estimated
_WIDER = 1.2  # of the standard deviations: the places are spread by so much more
_GRID, _GRID_END = 17, 2.6  # places to a side, and standard deviations to its ends
_N_ROUNDS = 3  # in the first step of a centre; later ones start from the last result
_CAVITY_MIN = 0.05  # least share of a centre's precision that is not its limb's own
_REACH_SIGMAS, _REACH_WIDTHS = 4.0, 2.0  # of a centre, of a footprint: pulses within may hit
_THIN = 1e-6  # [m]
_FLOOR = 0.003  # of the covariance before: keeps that of the places invertible
_EFFECTIVE_MIN = 0.15  # least effective share of the places: few would have no spread
_FLATTER = 0.8  # a step in the power of the likelihood

_INSIDE = np.linspace(-1.0, 1.0, 401)  # half widths by which a footprint reaches inside the limb
_LIT = (np.arccos(-_INSIDE) + _INSIDE * np.sqrt(1.0 - _INSIDE**2)) / np.pi  # its share inside


class _Link(NamedTuple):
    """Probability of a return by the lit share of the footprint.

    ``least`` is the share at _AT for which half of the pulses return, ``softness`` the distance
    over which the probability rises [half widths].
    """

    least: float
    softness: float


class _Factor(NamedTuple):
    """Likelihood of a limb across the line of sight, approximated by a normal distribution.

    ``precision``, (2, 2), is its inverse covariance [1/m^2], ``rhs``, (2,), that times its mean.
    """

    precision: Array
    rhs: Array


class _Cavity(NamedTuple):
    """A centre across its line of sight, with and without the observations of its limb.

    ``place`` and ``cov`` are by all observations; ``mean`` and ``precision`` without the limb.
    """

    place: Array
    cov: Array
    mean: Array
    precision: Array


def fit(
    cloud: StitchedCloud, found: MarkerCandidates, config: FittingConfig, radius: float
) -> Fits:
    """Fit all candidates of a stop by their ranges and by their limb.

    Notes
    -----
    Every pulse that passes closely contributes the probability that it returned, or did not, which
    rises from 0 to 1 as its footprint enters the limb. Where on the way it is one half depends on
    distance: an echo is as strong as the share of the footprint that is lit, over the square of the
    distance, and the weakest echo that is detected is the same for all markers of a stop and
    estimated with them. Expectation propagation (Minka, 2001) with two factors to a centre: ranges,
    linearised over the uncertainty that both leave, and its limb, whose moments are summed over
    places across the line of sight.
    """
    if not found.candidates:
        return Fits((), ())
    clock, why_not = clock_of(cloud)
    if clock is None:
        result = along_beam.fit(cloud, found, config, radius)
        return result._replace(fits=tuple(_without_limb(fit, why_not) for fit in result.fits))
    limb = _Limb(cloud, clock, radius)
    result = along_beam.fit_ranges(cloud, found, config, radius, limb.observe)
    return result._replace(fits=tuple(_named(fit) for fit in result.fits))


def _without_limb(fit: MarkerFit, why_not: str) -> MarkerFit:
    """Return the fit by returns alone, which is weak, with the reason."""
    before = f"{fit.reason} " if fit.reason else ""
    return replace(
        fit,
        method=NAME,
        status=Status.WEAK,
        reason=f"{before}The limb is not used: {why_not}.",
        variant=f"returns only: {why_not}",
    )


def _entered(pulses: Passing, radius: float, places: Array) -> Array:
    """Return how far footprints are inside the limb [half widths], (k, n), for centres, (k, 2)."""
    x, y = (pulses.places[:, axis] - places[:, axis, None] for axis in range(2))
    (a, b), (c, d) = np.moveaxis(pulses.half_widths, 0, -1)
    away = np.sqrt(x * x + y * y)
    widths = np.sqrt((a * x + b * y) ** 2 + (c * x + d * y) ** 2)
    return np.asarray((radius - away) / np.maximum(widths / np.maximum(away, 1e-9), _THIN))


@compiled
def _logarithms(entered: Array, has_hit: Mask, edges: Array, softness: float) -> Array:
    """Return the log-likelihood of hits and misses, (k, e), for edges, (e,), and a softness.

    At an edge half of the pulses return; both are in half widths of the footprint.
    """
    k, n = entered.shape
    shift = np.exp(edges / softness)
    total, product = np.zeros((k, len(edges))), np.ones(len(edges))
    for s in range(k):
        product[:] = 1.0
        for i in range(n):
            odds = np.exp(min(-entered[s, i] / softness, 300.0))  # against a hit, at edge zero
            for e in range(len(edges)):
                chance = _OUTLIERS + (1.0 - 2.0 * _OUTLIERS) / (1.0 + odds * shift[e])
                product[e] *= chance if has_hit[i] else 1.0 - chance
            if i % _N_PRODUCT == _N_PRODUCT - 1 or i == n - 1:  # a hundredth to this is above zero
                for e in range(len(edges)):
                    total[s, e] += np.log(product[e])
                    product[e] = 1.0
    return total


class _Limb:
    """The limbs of a stop's spheres as observations of the centres, with their state."""

    def __init__(self, cloud: StitchedCloud, clock: Clock, radius: float) -> None:
        self._cloud, self._clock, self._radius = cloud, clock, radius
        self._step = 0
        self._link = _Link(_SHARE, _SOFTNESSES[-1])
        self._passing: list[Passing] = []
        self._factors: list[_Factor] = []

    def observe(self, centres: Array, covs: Array) -> tuple[Array, Array]:
        """Return what the limbs add to the normal equations of centres, as ``Observe``."""
        if not self._step:
            near = passing_of(self._cloud, self._clock, centres, self._radius)
            self._passing = [
                _doubtful(*both, self._radius) for both in zip(near, covs, strict=True)
            ]
            self._factors = [_Factor(np.zeros((2, 2)), np.zeros(2)) for _ in near]
        self._step += 1
        cavities = [
            _cavity(*one) for one in zip(centres, covs, self._passing, self._factors, strict=True)
        ]
        if self._step <= _N_LINKS:
            self._link = _link(self._passing, cavities, self._radius)
        n_rounds = _N_ROUNDS if self._step == 1 else 1
        normals, rhs = np.empty((len(centres), 3, 3)), np.empty((len(centres), 3))
        for k, (pulses, cavity) in enumerate(zip(self._passing, cavities, strict=True)):
            factor = _factor(pulses, cavity, self._link, self._radius, n_rounds)
            normals[k] = pulses.axes.T @ factor.precision @ pulses.axes
            rhs[k] = pulses.axes.T @ (factor.rhs - factor.precision @ cavity.place)
            self._factors[k] = factor
        return normals, rhs


def _doubtful(pulses: Passing, cov: Array, radius: float) -> Passing:
    """Return the pulses that may hit or miss within the uncertainty of the centre."""
    widths = np.sqrt(np.sum(pulses.half_widths**2, axis=(1, 2)))
    reach = _REACH_SIGMAS * np.sqrt(np.linalg.eigvalsh(cov)[-1])
    gaps = np.abs(np.linalg.norm(pulses.places, axis=1) - radius)
    near = gaps < reach + _REACH_WIDTHS * widths
    return pulses._replace(
        places=pulses.places[near],
        half_widths=pulses.half_widths[near],
        has_hit=pulses.has_hit[near],
    )


def _cavity(p: Array, cov: Array, pulses: Passing, factor: _Factor) -> _Cavity:
    """Return a centre across the line of sight, with and without the factor of its limb."""
    place, cov_place = pulses.axes @ (p - pulses.centre), pulses.axes @ cov @ pulses.axes.T
    precision = np.linalg.inv(cov_place)
    least = _CAVITY_MIN * np.linalg.eigvalsh(precision)[0]
    values, vectors = np.linalg.eigh(precision - factor.precision)
    others = (vectors * np.maximum(values, least)) @ vectors.T
    mean = np.linalg.solve(others, precision @ place - factor.rhs)
    return _Cavity(place, cov_place, mean, others)


def _edges(least: Array, distance: float) -> Array:
    """Return the edges [half widths] for least shares at _AT: echoes fade with distance squared."""
    return np.interp(least * (distance / _AT) ** 2, _LIT, _INSIDE)


def _link(passing: list[Passing], cavities: list[_Cavity], radius: float) -> _Link:
    """Return the most likely link for the markers of a stop together.

    The likelihood of a marker is the mean over the places of its uncertain centre.
    """
    prior = -0.5 * (np.log(_LEAST / _SHARE) / _SPREAD_SHARE) ** 2
    total, z = np.tile(prior, (len(_SOFTNESSES), 1)), _WIDER * _normal(_N_PLACES)
    for pulses, cavity in zip(passing, cavities, strict=True):
        places = cavity.place + z @ np.linalg.cholesky(cavity.cov).T
        weights = _log_normal(places, cavity) + 0.5 * np.sum((z / _WIDER) ** 2, axis=1)
        entered = _entered(pulses, radius, places)
        edges = _edges(_LEAST, pulses.distance)
        for i, softness in enumerate(_SOFTNESSES):
            logs = _logarithms(entered, pulses.has_hit, edges, softness) + weights[:, None]
            total[i] += logs.max(axis=0) + np.log(np.mean(np.exp(logs - logs.max(axis=0)), axis=0))
    softest, least = np.unravel_index(int(np.argmax(total)), total.shape)
    return _Link(float(_LEAST[least]), _SOFTNESSES[int(softest)])


def _log_normal(places: Array, cavity: _Cavity) -> Array:
    """Return the log-density of places without the limb, up to a constant."""
    off = places - cavity.mean
    return np.asarray(-0.5 * np.einsum("ij,jk,ik->i", off, cavity.precision, off))


def _normal(n: int) -> Array:
    """Return standard normal places, (n, 2), the same every time and with zero mean."""
    half = np.random.default_rng(0).standard_normal((n // 2, 2))
    return np.concatenate([half, -half])


def _grid() -> Array:
    """Return places over a square, (n, 2)."""
    side = np.linspace(-_GRID_END, _GRID_END, _GRID)
    return np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)


_PLACES = _grid()


def _weights(logs: Array) -> Array:
    """Return the weights of places, (k,), of a flatter likelihood where few would dominate."""
    logs = logs - logs.max()
    while True:
        weights = np.exp(logs)
        weights /= weights.sum()
        if weights @ weights < 1.0 / (_EFFECTIVE_MIN * len(logs)):
            return np.asarray(weights)
        logs = _FLATTER * logs


def _factor(pulses: Passing, cavity: _Cavity, link: _Link, radius: float, n_rounds: int) -> _Factor:
    """Return the normal approximation of the limb's likelihood across the line of sight.

    Each round spreads the places by the last one's moments. The edge of a marker may deviate from
    that of all: the likelihood is a mean over normal deviations.
    """
    mean, cov = cavity.place, cavity.cov
    edges = _edges(np.array([link.least]), pulses.distance) + _OWN_EDGES
    for _ in range(n_rounds):
        places = mean + _WIDER * _PLACES @ np.linalg.cholesky(cov).T
        entered = _entered(pulses, radius, places)
        logs = _logarithms(entered, pulses.has_hit, edges, link.softness) + _OWN_LOGS
        most = logs.max(axis=1)
        logs = most + np.log(np.exp(logs - most[:, None]).sum(axis=1))
        weights = _weights(logs + _log_normal(places, cavity))
        mean = weights @ places
        cov = (weights[:, None] * (places - mean)).T @ (places - mean) + _FLOOR * cavity.cov
    values, vectors = np.linalg.eigh(np.linalg.inv(cov) - cavity.precision)
    precision = (vectors * np.maximum(values, 0.0)) @ vectors.T
    both = cavity.precision + precision
    return _Factor(precision, both @ mean - cavity.precision @ cavity.mean)


def _named(fit: MarkerFit) -> MarkerFit:
    """Return the fit under this name, without the inflation of the covariance by few returns.

    That is due to the bend of ranges over a place that only they determine.
    """
    cov = fit.cov_p_base / along_beam.inflation(fit.n_points)
    return replace(fit, method=NAME, cov_p_base=cov)
