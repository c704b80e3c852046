"""How much of its prior a shape leaves: the evidence of the beams about it.

Hides Laplace's approximation, the integral where it is too rough, and how likely what differs from
a marker by a size or a form does not differ.
"""

from __future__ import annotations

from math import erfc

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.detection.beams import Beams
from spheremark.pipelines.detection.maxima import climbed, information
from spheremark.pipelines.detection.shapes import (
    BALL,
    BOULDER,
    FORM,
    POLE,
    SHIFT,
    align,
    log_likelihood,
)
from spheremark.pipelines.estimation.linear_algebra import factorise, invert
from spheremark.pipelines.model import Array, Index

_SAME = 0.15  # relative deviation of a radius, or of three axes, within which it may be a marker
_AS_LARGE = 0.002  # share of balls as large as markers that are known to be none
_AS_ROUND = 0.3  # of the stones that would be as round as markers by their prior: fewer are
_N_SHAPES, _N_STAGES, _N_MOVES = 16, 24, 3  # of an integral, and between two of its stages
_NORMAL = np.random.default_rng(2).normal(size=4093)  # draws, taken in turn; the numbers are prime
_LOG_UNIFORM = np.log(np.random.default_rng(3).uniform(size=4091))
_ACCEPTED = 0.25  # share of the moves: near the best of many dimensions (Roberts et al., 1997)


@compiled
def log_volume(kind: int, shape: Array, prior: Array, beams: Beams) -> float:
    """Return the logarithm of the share of the prior that the likelihood leaves about the best.

    By Laplace's approximation.
    """
    free, N = information(kind, shape, prior, beams)
    total, root = 0.0, np.zeros_like(N)
    for j in range(SHIFT, POLE):
        if prior[1, j] > 0.0:  # a property of the scan
            total += 0.5 * ((shape[j] - prior[0, j]) / prior[1, j]) ** 2
    factorise(N, root)
    for j in range(len(free)):
        total -= np.log(root[j, j])
    return float(total)


@compiled
def log_integral(kind: int, shape: Array, prior: Array, beams: Beams) -> float:
    """Return the logarithm of the integral of likelihood times prior about a best shape.

    By sequential Monte Carlo (Del Moral, Doucet and Jasra, 2006): shapes that are drawn from
    Laplace's normal distribution move in stages to that of the likelihood. An outline that beams
    either meet or miss is a cliff, which derivatives at the best shape do not show.
    """
    prior = prior.copy()
    prior[1, SHIFT:POLE] = 0.0  # a property of the scan
    free, N = information(kind, shape, prior, beams)
    total, root = 0.0, np.zeros_like(N)
    invert(N, N)
    factorise(N, root)
    for j in range(len(free)):
        total += np.log(root[j, j])
        root[j] *= prior[1, free[j]]
    about, found, weights = (shape, free, root), np.empty(_N_SHAPES), np.zeros(_N_SHAPES)
    drawn = _NORMAL[: _N_SHAPES * len(free)].reshape(_N_SHAPES, len(free)).copy()
    for i in range(_N_SHAPES):
        found[i] = _log_likelihood_of(kind, about, drawn[i], prior, beams)
    power, size = 0.0, 1.2 / np.sqrt(len(free))
    for stage in range(1, _N_STAGES + 1):
        step = (stage / _N_STAGES) ** 2 - power
        for i in range(_N_SHAPES):
            weights[i] += step * (found[i] + 0.5 * drawn[i] @ drawn[i])
        if stage < _N_STAGES:
            power += step
            total += _drawn_anew(drawn, found, weights)
            accepted = _moved(kind, about, prior, beams, (drawn, found), (power, size, stage))
            size *= np.exp(accepted - _ACCEPTED)
    return float(total + weights.max() + np.log(np.exp(weights - weights.max()).mean()))


@compiled
def _log_likelihood_of(
    kind: int, about: tuple[Array, Index, Array], drawn: Array, prior: Array, beams: Beams
) -> float:
    """Return the logarithm of the likelihood of a draw from about a shape."""
    shape, free, root = about
    at = shape.copy()
    at[free] += root @ drawn
    return float(log_likelihood(kind, at, prior, beams, np.empty(len(beams.x))))


@compiled
def _moved(
    kind: int,
    about: tuple[Array, Index, Array],
    prior: Array,
    beams: Beams,
    known: tuple[Array, Array],
    by: tuple[float, float, int],
) -> float:
    """Move draws by the rule of Metropolis; return the share of the moves that were accepted.

    ``known`` are the draws and the logarithms of their likelihoods; ``by`` is the power that the
    likelihood has at a stage, the size of a move, and the number of the stage.
    """
    (drawn, found), (power, size, stage) = known, by
    n_used, n_accepted = (1 + (stage - 1) * _N_MOVES) * drawn.size, 0
    for i in range(_N_SHAPES):
        for _ in range(_N_MOVES):
            moved = drawn[i].copy()
            for j in range(len(moved)):
                n_used += 1
                moved[j] += size * _NORMAL[n_used % len(_NORMAL)]
            likely = _log_likelihood_of(kind, about, moved, prior, beams)
            gained = power * (likely - found[i])
            gained -= 0.5 * (1.0 - power) * (moved @ moved - drawn[i] @ drawn[i])
            if _LOG_UNIFORM[n_used % len(_LOG_UNIFORM)] < gained:
                drawn[i], found[i], n_accepted = moved, likely, n_accepted + 1
    return n_accepted / (_N_SHAPES * _N_MOVES)


@compiled
def _drawn_anew(drawn: Array, found: Array, weights: Array) -> float:
    """Draw shapes by their weights where few count; return the logarithm of the mean weight."""
    n, most = len(weights), weights.max()
    shares = np.exp(weights - most)
    total = shares.sum()
    if total * total > 0.5 * n * (shares @ shares):
        return 0.0
    rows = np.searchsorted(np.cumsum(shares) / total, (np.arange(n) + 0.5) / n)
    drawn[:], found[:], weights[:] = drawn[rows], found[rows], 0.0
    return float(most + np.log(total / n))


@compiled
def log_another(kind: int, shape: Array, prior: Array, beams: Beams) -> float:
    """Return the logarithm of the probability that a ball or a boulder is not as a marker is."""
    if kind == BALL:
        return float(_log_other_size(shape, prior, beams))
    if kind != BOULDER:
        return 0.0
    free, cov = information(kind, shape, prior, beams)
    invert(cov, cov)
    same = 1.0
    for j in range(len(free)):
        if FORM <= free[j] < SHIFT:
            off = shape[free[j]]
            limit = _SAME if free[j] < FORM + 2 else 2.0 * _SAME
            scale = 1.0 / (np.sqrt(2.0 * cov[j, j]) * prior[1, free[j]])
            same *= 1.0 - 0.5 * (erfc((limit - off) * scale) + erfc((limit + off) * scale))
    return float(np.log(max(1.0 - same, _AS_ROUND)))


@compiled
def _log_other_size(shape: Array, prior: Array, beams: Beams) -> float:
    """Return the logarithm of the probability that a ball is larger or smaller than a marker.

    By how far the likelihood falls from the best radius to the nearest other ones.
    """
    densities, other = np.empty(len(beams.x)), 0.0
    best = log_likelihood(BALL, shape, prior, beams, densities)
    for limit in (-_SAME, _SAME):
        at_limit, is_free = shape.copy(), prior[1] > 0.0
        at_limit[FORM], is_free[FORM] = limit, False
        align(BALL, at_limit, beams)
        begun = log_likelihood(BALL, at_limit, prior, beams, densities)
        fallen = best - climbed(BALL, at_limit, is_free, prior, beams, begun)
        off = np.sqrt(max(fallen, 0.0))  # over the square root of two standard deviations
        is_beyond = (shape[FORM] - limit) * limit > 0.0
        other += 0.5 * erfc(-off if is_beyond else off)
    return float(np.log(max(other, _AS_LARGE)))
