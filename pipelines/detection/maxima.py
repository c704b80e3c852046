"""The greatest likelihood of a shape, by jumps, walks and climbs, and the information there."""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.detection.beams import Beams
from spheremark.pipelines.detection.shapes import (
    N_PARAMETERS,
    NOISE,
    POLE,
    SHIFT,
    log_likelihood,
    trust,
)
from spheremark.pipelines.estimation.linear_algebra import solve
from spheremark.pipelines.model import Array, Index, Mask

_HOPELESS = 15.0  # logarithm of odds behind the best from which a search is given up
_N_BEGINS, _N_ROUNDS, _N_CLIMBS = 2, 4, 20  # of a search; of its walks; and of its climbs
_CLOSE = 0.05  # logarithm of odds: a round of a walk that gains less is followed by finer steps
_ARRIVED, _MOST_DAMPED = 0.02, 1e3  # the same, which ends a climb; and damping that ends it
_JUMPS = (-1.5, -0.75, 0.75, 1.5)  # standard deviations of a prior, for parameters with two maxima
_STEP = 0.1  # of the standard deviations of a prior, between which scores are taken


@compiled
def searched(
    kind: int, shape: Array, steps: Array, prior: Array, beams: Beams, least: float
) -> float:
    """Move a shape to the greatest likelihood times prior; return its logarithm.

    The likelihood has several maxima: far jumps and walks seek the greatest, and a climb goes up.
    """
    is_free = steps != 0.0
    found = log_likelihood(kind, shape, prior, beams, np.empty(len(beams.x)))
    for begin in range(_N_BEGINS):
        before = found
        found = _jumped(kind, shape, is_free, prior, beams, found)
        if begin and found < before + _CLOSE:
            break
        found = walked(kind, shape, steps.copy(), prior, beams, (found, least))
        if found == -np.inf:
            break
        found = climbed(kind, shape, is_free, prior, beams, found)
    return float(found)


@compiled
def walked(
    kind: int, shape: Array, steps: Array, prior: Array, beams: Beams, begun: tuple[float, float]
) -> float:
    """Move a shape by a pattern search (Hooke and Jeeves, 1961).

    Return the logarithm of likelihood times prior; minus infinity where it is hopelessly below the
    least. ``begun`` holds that of the start, and the least.
    """
    found, least = begun
    densities = np.empty(len(beams.x))
    for round_no in range(_N_ROUNDS):
        if found < least - _HOPELESS * (1.0 + 4.0 / (1.0 + round_no)):
            return -np.inf
        before, last = found, shape.copy()
        for j in range(N_PARAMETERS):
            if steps[j] == 0.0:
                continue
            for _ in range(2):
                kept = shape[j]
                shape[j] = kept + steps[j]
                trial = log_likelihood(kind, shape, prior, beams, densities)
                if trial > found:
                    found = trial
                    break
                shape[j], steps[j] = kept, -steps[j]
        moved = 2.0 * shape - last
        while found > before:  # as far again, where the parameters only gain together
            trial = log_likelihood(kind, moved, prior, beams, densities)
            if trial <= found:
                break
            found, last = trial, shape.copy()
            shape[:] = moved
            moved = 2.0 * shape - last
        if found < before + _CLOSE:
            steps *= 0.4
    return float(found)


@compiled
def _jumped(
    kind: int, shape: Array, is_free: Mask, prior: Array, beams: Beams, found: float
) -> float:
    """Move a shape far along one parameter after the other, where that is better."""
    densities = np.empty(len(beams.x))
    for j in range(NOISE, N_PARAMETERS):
        if not is_free[j] or SHIFT <= j < POLE:
            continue
        begun = best = shape[j]
        for jump in _JUMPS:
            shape[j] = begun + jump * prior[1, j]
            trial = log_likelihood(kind, shape, prior, beams, densities)
            if trial > found:
                found, best = trial, shape[j]
        shape[j] = best
    return float(found)


@compiled
def climbed(
    kind: int, shape: Array, is_free: Mask, prior: Array, beams: Beams, found: float
) -> float:
    """Move a shape to the greatest likelihood times prior nearby; return its logarithm.

    By damped scoring (Berndt, Hall, Hall and Hausman, 1974).
    """
    free, share = np.flatnonzero(is_free), trust(beams)
    damping, densities = 0.1, np.empty(len(beams.x))
    for _ in range(_N_CLIMBS):
        scores = scores_of(kind, shape, free, prior, beams)
        pull = (prior[0] - shape)[free] / prior[1][free]
        gradient, squares = pull + share * scores.sum(axis=1), share * (scores @ scores.T)
        gained = 0.0
        while damping < _MOST_DAMPED:
            N, step = squares.copy(), gradient.copy()
            for j in range(len(free)):
                N[j, j] += 1.0 + damping * (1.0 + squares[j, j])
            solve(N, step)
            trial = shape.copy()
            for j in range(len(free)):
                trial[free[j]] += step[j] * prior[1, free[j]]
            gained = log_likelihood(kind, trial, prior, beams, densities) - found
            if gained > 0.0:
                shape[:], found, damping = trial, found + gained, 0.2 * damping
                break
            damping *= 6.0
        if gained < _ARRIVED:
            break
    return float(found)


@compiled
def scores_of(kind: int, shape: Array, free: Index, prior: Array, beams: Beams) -> Array:
    """Return the scores of the beams in some parameters, per their standard deviations."""
    scores = np.zeros((len(free), len(beams.x)))
    above, below = np.empty(len(beams.x)), np.empty(len(beams.x))
    for j in range(len(free)):
        kept, h = shape[free[j]], _STEP * prior[1, free[j]]
        shape[free[j]] = kept + h
        log_likelihood(kind, shape, prior, beams, above)
        shape[free[j]] = kept - h
        log_likelihood(kind, shape, prior, beams, below)
        shape[free[j]] = kept
        scores[j] = np.log(above / below) / (2.0 * _STEP)
    return scores


@compiled
def information(kind: int, shape: Array, prior: Array, beams: Beams) -> tuple[Index, Array]:
    """Return the free parameters, and their information with the prior, per its variances.

    By the sum of outer products of the scores (Berndt, Hall, Hall and Hausman, 1974): it is
    positive, and takes errors of the parameters together. Those that are a property of the scan,
    the same for all hypotheses, have the prior's alone.
    """
    free = np.flatnonzero(prior[1] > 0.0)
    scores = scores_of(kind, shape, free, prior, beams)
    for j in range(len(free)):
        if SHIFT <= free[j] < POLE:
            scores[j] = 0.0
    N = trust(beams) * (scores @ scores.T)
    for j in range(len(free)):
        N[j, j] += 1.0
    return free, N
