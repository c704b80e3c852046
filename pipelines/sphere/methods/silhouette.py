"""Centres from ranges and from the outline: which shots hit the sphere and which passed it by.

Hides how far the outline bounds a centre: how shots come to answer as their footprints enter it,
and what that says of where it is.
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
from spheremark.pipelines.sphere.description import Fits
from spheremark.pipelines.sphere.methods import along_beam
from spheremark.pipelines.sphere.pulses import Firings, Passing, firings_of, passing_of, pattern_of

NAME = "silhouette"
RETURNS_ONLY = "returns only: "

_LUCK = 0.01  # share of shots that hit and are lost, or pass by and answer
_AT = 10.0  # [m] where the least share of a footprint that answers is told
_LEAST = np.geomspace(1e-3, 0.3, 24)  # of a footprint: shares that may be the least there
_SHARE, _SPREAD_SHARE = 0.02, 1.5  # prior of that share, and its deviation in the logarithm
_SOFTNESSES = (0.015, 0.03, 0.06, 0.12, 0.24)  # half widths over which the answer turns to yes
_OWN_EDGES = 0.05 * np.linspace(-2.0, 2.0, 5)  # half widths by which a marker's edge may be off,
_OWN_LOGS = -0.5 * np.linspace(-2.0, 2.0, 5) ** 2  # and the logarithms of their chances
_N_PRODUCT = 100  # chances that are multiplied before the logarithm is taken
_N_PLACES = 64  # where a centre may be, when the link is sought
_N_LINKS = 3  # times that it is sought, ever nearer to the centres
_WIDER = 1.2  # of the standard deviations: places that are asked lie so much wider
_GRID, _GRID_END = 17, 2.6  # places to a side, and standard deviations to its ends
_N_ROUNDS = 3  # of the first time that a centre is asked about; later the last answer is near
_CAVITY_MIN = 0.05  # of a centre's precision: the least that is not its outline's own
_REACH_SIGMAS, _REACH_WIDTHS = 4.0, 2.0  # of a centre, of a footprint: shots within are in doubt
_THIN = 1e-6  # [m]
_FLOOR = 0.003  # of the covariance before: keeps that of the places invertible
_WORTH = 0.15  # of the samples that must speak: one alone would have no spread
_FLATTER = 0.8  # a step in the power of the likelihood


def _lit(inside: Array) -> Array:
    """Return what share of a footprint is lit that reaches so far inside [half widths]."""
    return np.asarray((np.arccos(-inside) + inside * np.sqrt(1.0 - inside**2)) / np.pi)


_INSIDE = np.linspace(-1.0, 1.0, 401)
_LIT = _lit(_INSIDE)


class _Link(NamedTuple):
    """How shots come to answer: the least lit share at _AT that does, and how softly [half widths].

    Attributes
    ----------
    least : float
        Share of a footprint, where half of the shots answer.
    softness : float
        Over what distance the answer turns to yes [half widths].
    """

    least: float
    softness: float


class _Site(NamedTuple):
    """What an outline tells of its centre across the line of sight, as a normal distribution.

    Attributes
    ----------
    precision : (2, 2)
        Inverse covariance [1/m^2].
    pull : (2,)
        That times the mean [1/m].
    """

    precision: Array
    pull: Array


class _Beside(NamedTuple):
    """Where a centre is across its line of sight, and what is known of that beside the outline.

    Attributes
    ----------
    place : (2,)
        The present estimate by both [m].
    cov : (2, 2)
        Its covariance [m^2].
    mean : (2,)
        Where the rest puts it [m].
    precision : (2, 2)
        Inverse covariance of the rest [1/m^2].
    """

    place: Array
    cov: Array
    mean: Array
    precision: Array


def fit(
    cloud: StitchedCloud, found: MarkerCandidates, config: FittingConfig, radius: float
) -> Fits:
    """Fit all candidates of a stop by their ranges and by their outline.

    Notes
    -----
    Every shot that passes closely adds the probability that it hit, or did not, which rises from 0
    to 1 as its footprint enters the outline. Where on the way it is one half depends on distance:
    an echo is as strong as the share of the footprint that is lit, over the square of the distance,
    and the weakest that is heard is the same for all markers of a stop and estimated with them.
    Expectation propagation (Minka, 2001) with two factors to a centre: ranges, linearised over what
    both leave open, and its outline, whose moments are summed over places across the line of sight.
    """
    pattern, why_not = pattern_of(cloud) if found.candidates else (None, "there is nothing to fit")
    if pattern is None:
        fits, rejected = along_beam.fit(cloud, found, config, radius)
        return tuple(_without_outline(fit, why_not) for fit in fits), rejected
    outline = _Outline(cloud, firings_of(cloud, pattern), radius)
    fits, rejected = along_beam.fit_ranges(cloud, found, config, radius, outline.told)
    return tuple(_named(fit) for fit in fits), rejected


def _without_outline(fit: MarkerFit, why_not: str) -> MarkerFit:
    """Return the fit by returns alone, weak, with the reason."""
    said = f"{fit.reason} " if fit.reason else ""
    return replace(
        fit,
        method=NAME,
        status=Status.WEAK,
        reason=f"{said}The outline is not used: {why_not}.",
        variant=RETURNS_ONLY + why_not,
    )


@compiled
def _entered(places: Array, half_widths: Array, radius: float, shifts: Array) -> Array:
    """Return how far footprints are inside the outline, in their half widths, (k, n).

    ``shifts`` are the centres in the plane, (k, 2).
    """
    entered = np.empty((len(shifts), len(places)))
    for k in range(len(shifts)):
        for i in range(len(places)):
            x, y = places[i, 0] - shifts[k, 0], places[i, 1] - shifts[k, 1]
            away = np.hypot(x, y)
            first = half_widths[i, 0, 0] * x + half_widths[i, 0, 1] * y
            second = half_widths[i, 1, 0] * x + half_widths[i, 1, 1] * y
            width = np.hypot(first, second) / max(away, 1e-9)
            entered[k, i] = (radius - away) / max(width, _THIN)
    return entered


@compiled
def _logarithms(entered: Array, has_hit: Mask, edges: Array, softness: float) -> Array:
    """Return the log-likelihood of what hit and what did not, (k, e), for edges and a softness.

    ``edges`` are where half of the shots answer, (e,), and ``softness`` over what distance that
    changes, in half widths of the footprint.
    """
    k, n = entered.shape
    shift = np.exp(edges / softness)
    total, product = np.zeros((k, len(edges))), np.ones(len(edges))
    for s in range(k):
        product[:] = 1.0
        for i in range(n):
            odds = np.exp(min(-entered[s, i] / softness, 300.0))  # against a hit, at edge zero
            for e in range(len(edges)):
                chance = _LUCK + (1.0 - 2.0 * _LUCK) / (1.0 + odds * shift[e])
                product[e] *= chance if has_hit[i] else 1.0 - chance
            if i % _N_PRODUCT == _N_PRODUCT - 1 or i == n - 1:  # a hundredth to this is above zero
                for e in range(len(edges)):
                    total[s, e] += np.log(product[e])
                    product[e] = 1.0
    return total


class _Outline:
    """What the shots about the centres of a stop tell, as far as it is known after each step.

    Parameters
    ----------
    cloud : StitchedCloud
        The stop.
    firings : Firings
        All its shots.
    radius : float
        Radius of the spheres [m].
    """

    def __init__(self, cloud: StitchedCloud, firings: Firings, radius: float) -> None:
        self._cloud, self._firings, self._radius = cloud, firings, radius
        self._n_asked = 0
        self._link = _Link(_SHARE, _SOFTNESSES[-1])
        self._passing: list[Passing] = []
        self._sites: list[_Site] = []

    def told(self, centres: Array, covs: Array) -> tuple[Array, Array]:
        """Return what the outlines add to the normal equations of centres, as ``Told``."""
        if not self._n_asked:
            near = passing_of(self._cloud, self._firings, centres, self._radius)
            self._passing = [
                _doubtful(*both, self._radius) for both in zip(near, covs, strict=True)
            ]
            self._sites = [_Site(np.zeros((2, 2)), np.zeros(2)) for _ in near]
        self._n_asked += 1
        beside = [
            _beside(p, cov, shots, site)
            for p, cov, shots, site in zip(centres, covs, self._passing, self._sites, strict=True)
        ]
        if self._n_asked <= _N_LINKS:
            self._link = _link(self._passing, beside, self._radius)
        n_rounds = _N_ROUNDS if self._n_asked == 1 else 1
        self._sites = [
            _site(shots, known, self._link, (self._radius, n_rounds))
            for shots, known in zip(self._passing, beside, strict=True)
        ]
        added = [
            (
                shots.axes.T @ site.precision @ shots.axes,
                shots.axes.T @ (site.pull - site.precision @ known.place),
            )
            for shots, site, known in zip(self._passing, self._sites, beside, strict=True)
        ]
        return np.array([precision for precision, _ in added]), np.array(
            [pull for _, pull in added]
        )


def _doubtful(shots: Passing, cov: Array, radius: float) -> Passing:
    """Return the shots that may hit or not as the centre is here or there; others say nothing."""
    widths = np.sqrt(np.sum(shots.half_widths**2, axis=(1, 2)))
    reach = _REACH_SIGMAS * np.sqrt(np.linalg.eigvalsh(cov)[-1])
    gaps = np.abs(np.linalg.norm(shots.places, axis=1) - radius)
    near = gaps < reach + _REACH_WIDTHS * widths
    return shots._replace(
        places=shots.places[near],
        half_widths=shots.half_widths[near],
        has_hit=shots.has_hit[near],
    )


def _beside(p: Array, cov: Array, shots: Passing, site: _Site) -> _Beside:
    """Return where a centre is across the line of sight, and what is known beside its outline."""
    place, cov_place = shots.axes @ (p - shots.centre), shots.axes @ cov @ shots.axes.T
    precision = np.linalg.inv(cov_place)
    least = _CAVITY_MIN * np.linalg.eigvalsh(precision)[0]
    values, vectors = np.linalg.eigh(precision - site.precision)
    others = (vectors * np.maximum(values, least)) @ vectors.T
    mean = np.linalg.solve(others, precision @ place - site.pull)
    return _Beside(place, cov_place, mean, others)


def _edges(least: Array, distance: float) -> Array:
    """Return where shots begin to answer [half widths], from the least share that does at _AT."""
    return np.interp(least * (distance / _AT) ** 2, _LIT, _INSIDE)


def _link(passing: list[Passing], beside: list[_Beside], radius: float) -> _Link:
    """Return how shots come to answer, by the markers of a stop together.

    Each marker's centre is only known so well, so that its likelihood is the mean over places where
    it may be.
    """
    prior = -0.5 * (np.log(_LEAST / _SHARE) / _SPREAD_SHARE) ** 2
    total, z = np.tile(prior, (len(_SOFTNESSES), 1)), _WIDER * _normal(_N_PLACES)
    for shots, known in zip(passing, beside, strict=True):
        places = known.place + z @ np.linalg.cholesky(known.cov).T
        weights = _log_normal(places, known) + 0.5 * np.sum((z / _WIDER) ** 2, axis=1)
        entered = _entered(shots.places, shots.half_widths, radius, places)
        edges = _edges(_LEAST, shots.distance)
        for i, softness in enumerate(_SOFTNESSES):
            logs = _logarithms(entered, shots.has_hit, edges, softness) + weights[:, None]
            total[i] += logs.max(axis=0) + np.log(np.mean(np.exp(logs - logs.max(axis=0)), axis=0))
    softest, least = np.unravel_index(int(np.argmax(total)), total.shape)
    return _Link(float(_LEAST[least]), _SOFTNESSES[int(softest)])


def _log_normal(places: Array, known: _Beside) -> Array:
    """Return the logarithm of the density of places beside the outline, up to a constant."""
    off = places - known.mean
    return np.asarray(-0.5 * np.einsum("ij,jk,ik->i", off, known.precision, off))


def _normal(n: int) -> Array:
    """Return standard normal places, (n, 2), the same every time and without a mean."""
    half = np.random.default_rng(0).standard_normal((n // 2, 2))
    return np.concatenate([half, -half])


def _grid() -> Array:
    """Return places over a square, (n, 2)."""
    side = np.linspace(-_GRID_END, _GRID_END, _GRID)
    return np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)


_PLACES = _grid()


def _spread(logs: Array) -> Array:
    """Return the weights of samples, (k,), of a flatter likelihood where too few would speak."""
    logs = logs - logs.max()
    while True:
        weights = np.exp(logs)
        weights /= weights.sum()
        if weights @ weights < 1.0 / (_WORTH * len(logs)):
            return np.asarray(weights)
        logs = _FLATTER * logs


def _site(shots: Passing, known: _Beside, link: _Link, asked: tuple[float, int]) -> _Site:
    """Return what an outline tells of its centre, as a normal distribution across the sight.

    ``asked`` is the radius, and how often the places that are asked draw nearer. The edge of each
    marker may be a little off that of all: a normal mean over that.
    """
    (radius, n_rounds), mean, cov = asked, known.place, known.cov
    edges = _edges(np.array([link.least]), shots.distance) + _OWN_EDGES
    for _ in range(n_rounds):
        places = mean + _WIDER * _PLACES @ np.linalg.cholesky(cov).T
        entered = _entered(shots.places, shots.half_widths, radius, places)
        logs = _logarithms(entered, shots.has_hit, edges, link.softness) + _OWN_LOGS
        most = logs.max(axis=1)
        logs = most + np.log(np.exp(logs - most[:, None]).sum(axis=1))
        weights = _spread(logs + _log_normal(places, known))
        mean = weights @ places
        cov = (weights[:, None] * (places - mean)).T @ (places - mean) + _FLOOR * known.cov
    values, vectors = np.linalg.eigh(np.linalg.inv(cov) - known.precision)
    precision = (vectors * np.maximum(values, 0.0)) @ vectors.T
    both = known.precision + precision
    return _Site(precision, both @ mean - known.precision @ known.mean)


def _named(fit: MarkerFit) -> MarkerFit:
    """Return the fit under this name, and its covariance without what few returns add.

    That comes from the bend of ranges over a place that only they tell.
    """
    cov = fit.cov_p_base / along_beam.inflation(fit.n_points)
    return replace(fit, method=NAME, cov_p_base=cov)
