"""How likely each shape is at a place: the evidence of the beams about it.

Hides the search for the best parameters of a shape, and how much of its prior they leave.
"""

from __future__ import annotations

from math import erfc, nan

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.detection.beams import Beams
from spheremark.pipelines.detection.shapes import (
    BALL,
    BOULDER,
    CYLINDER,
    FORM,
    HEAD,
    N_PARAMETERS,
    NOISE,
    POLE,
    SHIFT,
    SOLID,
    SPHERE,
    STRETCH,
    align,
    log_likelihood,
    trust,
)
from spheremark.pipelines.estimation.linear_algebra import factorise, invert, solve
from spheremark.pipelines.model import Array, Index, Mask

_HOPELESS = 15.0  # logarithm of odds behind the best from which a hypothesis is given up
_GIVEN_UP = 12.0  # the same of the sphere, from which no other hypothesis is compared
_ORDER = (0, 4, 8, 7, 1, 6, 5, 3, 2)  # the sphere, then what refutes it at the least cost
_N_BEGINS, _N_ROUNDS, _N_CLIMBS = 2, 4, 20  # of a search; of its walks; and of its climbs
_CLOSE = 0.05  # logarithm of odds: a round of a walk that gains less is followed by finer steps
_ARRIVED, _MOST_DAMPED = 0.02, 1e3  # the same, which ends a climb; and damping that ends it
_JUMPS = (-1.5, -0.75, 0.75, 1.5)  # standard deviations of a prior, for parameters with two maxima
_STEP = 0.1  # of the standard deviations of a prior, between which scores are taken
_SAME = 0.15  # relative deviation of a radius, or of three axes, within which it may be a marker
_AS_LARGE = 0.002  # share of balls as large as markers that are known to be none
_AS_ROUND = 0.3  # of the stones that would be as round as markers by their prior: fewer are
_STARTS = (0.0, -0.3, 0.3)  # of the logarithm of the radius of a ball


@compiled
def _evidence(kind: int, shape: Array, prior: Array, beams: Beams, least: float) -> float:
    """Return the logarithm of the evidence of a hypothesis; its best shape replaces the start.

    By Laplace's approximation. Minus infinity where it falls hopelessly below the least.
    """
    steps = 0.4 * prior[1]
    if kind in (SPHERE, BALL):  # the centre is fitted already
        steps[:NOISE] = np.minimum(steps[:NOISE], 2.0 * np.exp(prior[0, NOISE]))
    found = _search(kind, shape, steps, prior, beams, least)
    if found == -np.inf:
        return -np.inf
    return float(found + _log_volume(kind, shape, prior, beams))


@compiled
def _evidence_nearby(kind: int, shape: Array, prior: Array, beams: Beams) -> float:
    """Return the logarithm of the evidence of a hypothesis; its best shape nearby replaces it."""
    found = log_likelihood(kind, shape, prior, beams, np.empty(len(beams.x)))
    found = _climbed(kind, shape, prior[1] > 0.0, prior, beams, found)
    return float(found + _log_volume(kind, shape, prior, beams))


@compiled
def _search(
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
        found = _walked(kind, shape, steps.copy(), prior, beams, (found, least))
        if found == -np.inf:
            break
        found = _climbed(kind, shape, is_free, prior, beams, found)
    return float(found)


@compiled
def _walked(
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
def _climbed(
    kind: int, shape: Array, is_free: Mask, prior: Array, beams: Beams, found: float
) -> float:
    """Move a shape to the greatest likelihood times prior nearby; return its logarithm.

    By damped scoring (Berndt, Hall, Hall and Hausman, 1974).
    """
    free, share = np.flatnonzero(is_free), trust(beams)
    damping, densities = 0.1, np.empty(len(beams.x))
    for _ in range(_N_CLIMBS):
        scores = _scores(kind, shape, free, prior, beams)
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
        fallen = best - _climbed(BALL, at_limit, is_free, prior, beams, begun)
        off = np.sqrt(max(fallen, 0.0))  # over the square root of two standard deviations
        is_beyond = (shape[FORM] - limit) * limit > 0.0
        other += 0.5 * erfc(-off if is_beyond else off)
    return float(np.log(max(other, _AS_LARGE)))


@compiled
def _scores(kind: int, shape: Array, free: Index, prior: Array, beams: Beams) -> Array:
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
def _information(kind: int, shape: Array, prior: Array, beams: Beams) -> tuple[Index, Array]:
    """Return the free parameters, and their information with the prior, per its variances.

    By the sum of outer products of the scores (Berndt, Hall, Hall and Hausman, 1974): it is
    positive, and takes errors of the parameters together. Those that are a property of the scan,
    the same for all hypotheses, have the prior's alone.
    """
    free = np.flatnonzero(prior[1] > 0.0)
    scores = _scores(kind, shape, free, prior, beams)
    for j in range(len(free)):
        if SHIFT <= free[j] < POLE:
            scores[j] = 0.0
    N = trust(beams) * (scores @ scores.T)
    for j in range(len(free)):
        N[j, j] += 1.0
    return free, N


@compiled
def _log_volume(kind: int, shape: Array, prior: Array, beams: Beams) -> float:
    """Return the logarithm of the share of the prior that the likelihood leaves about the best."""
    free, N = _information(kind, shape, prior, beams)
    total, same, root = 0.0, 1.0, np.zeros_like(N)
    for j in range(SHIFT, POLE):
        if prior[1, j] > 0.0:  # a property of the scan
            total += 0.5 * ((shape[j] - prior[0, j]) / prior[1, j]) ** 2
    factorise(N, root)
    for j in range(len(free)):
        total -= np.log(root[j, j])
    if kind == BOULDER:
        invert(N, N)
        for j in range(len(free)):
            if FORM <= free[j] < SHIFT:
                off = shape[free[j]]
                limit = _SAME if free[j] < FORM + 2 else 2.0 * _SAME
                scale = 1.0 / (np.sqrt(2.0 * N[j, j]) * prior[1, free[j]])
                same *= 1.0 - 0.5 * (erfc((limit - off) * scale) + erfc((limit + off) * scale))
        total += np.log(max(1.0 - same, _AS_ROUND))
    if kind == BALL:
        total += _log_other_size(shape, prior, beams)
    return total


@compiled
def cov_shared(shape: Array, prior: Array, beams: Beams) -> Array:
    """Return the covariance of what the best sphere shares with other markers."""
    free, N = _information(SPHERE, shape, prior, beams)
    invert(N, N)
    first, n = np.searchsorted(free, NOISE), FORM + 1 - NOISE
    cov = np.empty((n, n))
    for j in range(n):
        for k in range(n):
            cov[j, k] = N[first + j, first + k] * prior[1, NOISE + j] * prior[1, NOISE + k]
    return cov


@compiled
def compared(beams: Beams, priors: Array, log_priors: Array, begun: Array) -> tuple[Array, Array]:
    """Return the logarithms of prior times evidence of all hypotheses, and their best shapes.

    ``begun`` are the best shapes by other priors, from which these are climbed to, NaN where one
    was not sought; (0, p) if there are none. The sphere is sought anew beside that, and a solid is
    always one beside the best sphere.
    """
    found, shapes = np.full(len(log_priors), -np.inf), np.full((len(log_priors), N_PARAMETERS), nan)
    shapes[SPHERE] = priors[SPHERE, 0]
    for kind in _ORDER:
        is_named = kind != BALL or found[CYLINDER] < found.max()  # the two are easily confused
        if found.max() - found[SPHERE] > _GIVEN_UP and is_named:
            continue
        is_begun = kind != SOLID and len(begun) > 0 and not np.isnan(begun[kind, 0])
        if is_begun:
            shape = begun[kind].copy()
            own = _evidence_nearby(kind, shape, priors[kind], beams)
            _keep(kind, shape, own + log_priors[kind], found, shapes)
        if kind == SPHERE or not is_begun:
            _seek(kind, priors, log_priors, beams, (found, shapes))
    return found, shapes


@compiled
def _seek(
    kind: int, priors: Array, log_priors: Array, beams: Beams, known: tuple[Array, Array]
) -> None:
    """Search for the best shape of a kind, where the best sphere is; ``known`` as ``compared``."""
    found, shapes = known
    sphere = priors[SPHERE, 0] if kind == SPHERE else shapes[SPHERE]
    for start in _STARTS:
        shape = _start(kind, priors[kind], sphere, start, beams)
        if kind == SOLID:
            own = _evidence_nearby(kind, shape, priors[kind], beams)
        else:
            own = _evidence(kind, shape, priors[kind], beams, found.max() - log_priors[kind])
        _keep(kind, shape, own + log_priors[kind], found, shapes)
        if kind in (BALL, BOULDER):  # it may have found a better place for the sphere too
            again = _start(SPHERE, priors[SPHERE], shape, start, beams)
            own = _evidence_nearby(SPHERE, again, priors[SPHERE], beams)
            _keep(SPHERE, again, own + log_priors[SPHERE], found, shapes)
        if kind != BALL:
            break


@compiled
def _keep(kind: int, shape: Array, own: float, found: Array, shapes: Array) -> None:
    """Replace the shape of a kind by one with greater evidence."""
    if own > found[kind]:
        found[kind], shapes[kind] = own, shape


@compiled
def _start(kind: int, prior: Array, sphere: Array, start: float, beams: Beams) -> Array:
    """Return a start of the search for the best shape of a kind where the best sphere is."""
    shape: Array = prior[0].copy()
    shape[:STRETCH], shape[SHIFT:] = sphere[:STRETCH], sphere[SHIFT:]
    if kind in (BOULDER, HEAD):
        shape[NOISE] = prior[0, NOISE]
    if kind in (SPHERE, BALL):
        shape[STRETCH] = sphere[STRETCH]
    if kind == SOLID:
        shape[POLE] = prior[0, POLE]
    if kind in (BALL, BOULDER, SOLID):
        shape[FORM] = sphere[FORM]
    if kind == BALL:
        shape[FORM] += start
    if kind == BOULDER:
        shape[FORM + 2] = sphere[STRETCH]
    align(kind, shape, beams)
    return shape
