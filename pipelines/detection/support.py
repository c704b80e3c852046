"""What holds an object up, by the beams that pass below it and beside a pole's place.

A pole lets most of them pass, and the legs of a tripod do. Shoulders, a larger stone or the ground
stop all from some height downwards.
"""

from __future__ import annotations

from math import exp, lgamma, log

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.detection.beams import BELOW
from spheremark.pipelines.detection.evidence import N_ROWS, ROW, Evidence, beside_pole
from spheremark.pipelines.detection.pulses import REACH
from spheremark.pipelines.detection.shapes import BOULDER, HEAD, NAMES
from spheremark.pipelines.detection.target import ASIDE
from spheremark.pipelines.model import Array

# Beta distributions of the share of beams that end near, where nothing is, something, anything
_OPEN, _CLOSED, _ANY = (0.3, 5.0), (5.0, 0.3), (0.5, 0.5)

_NEIGHBOUR = 0.05  # probability that something else is on one side; a boulder has ground on both
_DOUBT = 0.1  # probability of anything below what stands on a pole or on something wide
_RAREST = 1e-9  # nothing is less probable before a beam is seen
_ROWS = np.array([0.0, *(0.2,) * 3, *(0.08,) * 5])
"""Probabilities of the row from which something wide stops the beams below what stands on it: it
begins there, or widens farther down, as a cone does or a tripod."""

# Probabilities that nothing is below, that anything is, and that something is from each row down:
# what is tall, as a vehicle or a wall, begins where the sphere ends, unlike those that widen;
# shoulders begin within three radii below a head; a stone of two radii, round on top, is wider than
# a pole's place 0.4 radii below a boulder, which is a quarter lower or higher than a sphere
_ON_POLE = np.array([1.0 - _DOUBT, _DOUBT, *(0.0,) * 9])
_ON_WIDE = np.array([0.001, _DOUBT, *((0.999 - _DOUBT) * _ROWS)])
_ON_TALL = np.array([0.001, _DOUBT, 0.0, *((0.999 - _DOUBT) / 3.0,) * 3, *(0.0,) * 5])
_WIDE = _ON_WIDE, _ON_TALL
_ON_GROUND = np.array([0.005, 0.005, *(0.2475,) * 4, *(0.0,) * 5])
_ON_ANOTHER = np.array([0.005, 0.005, 0.0, *(0.33,) * 3, *(0.0,) * 5])
_SHOULDERS = np.array([0.001, 0.001, 0.0, 0.0, *(0.1996,) * 5, 0.0, 0.0])


def log_supports(
    evidence: Evidence,
    level: float,
    radius: float,
    held: tuple[float, float],
    perched: float,
) -> tuple[Array, Array]:
    """Return the log probabilities of the beams below a place by all hypotheses, (k,).

    And how probably something wide holds it that has begun at each row, as those beams show, (9,).

    Parameters
    ----------
    evidence : Evidence
        The beams towards and about it.
    level : float
        Height above the sensor [m].
    radius : float
        Of the sphere that is searched for [m].
    held : float, float
        Probabilities that what has this height is held by something wide, and not by a pole: by
        anything low, and by what is tall.
    perched : float
        Probability that a boulder of this height lies on another, and not on the ground.

    Notes
    -----
    Shares of beams are Beta distributed, their counts Beta-binomial; the row from which something
    stops them is marginalised. Both sides show what holds it up, or one does and the other shows a
    neighbour; the ground is on both. What is neither a boulder nor a head is held as a sphere is.
    """
    return _log_supports(*_beams_below(evidence, level, radius), held, perched)


def _log_supports(
    near: Array, past: Array, held: tuple[float, float], perched: float
) -> tuple[Array, Array]:
    """Return the same, from beams to the left and to the right by rows, (2, 9)."""
    pole, wide, tall, shoulders = (
        _log_supported(near, past, own, _NEIGHBOUR)
        for own in (_ON_POLE, _ON_WIDE, _ON_TALL, _SHOULDERS)
    )
    wide, by_tall = _either(wide, tall, held[1] / max(sum(held), _RAREST))
    ground, another = (_log_supported(near, past, own, 0.0) for own in (_ON_GROUND, _ON_ANOTHER))
    stands, by_wide = _either(pole, wide, sum(held))
    boulder, _ = _either(ground, another, perched)
    logs = np.full(len(NAMES), stands)
    logs[BOULDER], logs[HEAD] = boulder, shoulders
    low, high = (_shares_begun(near.sum(axis=0), past.sum(axis=0), own) for own in _WIDE)
    return logs, by_wide * ((1.0 - by_tall) * low + by_tall * high)


def _either(first: float, second: float, share: float) -> tuple[float, float]:
    """Return the log probability by either of two causes, and how probably it is the second.

    From the log probabilities by each, and the share of the second before.
    """
    share = min(max(share, _RAREST), 1.0 - _RAREST)
    first, second = first + log(1.0 - share), second + log(share)
    total = float(np.logaddexp(first, second))
    return total, exp(second - total)


def _beams_below(evidence: Evidence, level: float, radius: float) -> tuple[Array, Array]:
    """Return how many beams below a place end near, and how many are known to go past, (2, 9)."""
    near, past = evidence.below.astype(np.float64)
    n_past = past.sum()
    if evidence.silent is None:  # pulses are as dense below, and those without a return go past
        return near, past + max(evidence.n_on - near.sum() - n_past, 0.0) / past.size
    return near, np.maximum(past - _n_unknown(evidence, level, radius), 0.0)


def _n_unknown(evidence: Evidence, level: float, radius: float) -> Array:
    """Return how many pulses without a return below a place may have met unheard ground, (2, 9).

    The beams farther to the same side, past where a pole or shoulders would be, show how much of it
    is heard as far down. No ground is above the horizon, in the mean.
    """
    assert evidence.silent is not None
    silent = evidence.silent[:2, evidence.silent[1] < -level] / radius
    blur = evidence.blur.max() / radius
    n_heard, n_silent = (_n_aside(own, blur) for own in (evidence.seen[:2] / radius, silent))
    share = (n_silent.sum() + 0.5) / (n_heard.sum() + n_silent.sum() + 1.0)
    shares = (n_silent + share) / (n_heard + n_silent + 1.0)
    return np.asarray(beside_pole(silent, blur) * shares)


@compiled
def _n_aside(passing: Array, blur: float) -> Array:
    """Return how many beams pass to a side, below a place and past what may hold it, (2, 9)."""
    n = np.zeros((2, N_ROWS))
    for i in range(passing.shape[1]):
        across, up = passing[0, i], passing[1, i]
        if up < BELOW and abs(across) > ASIDE + blur and across * across + up * up < REACH * REACH:
            n[int(across > 0.0), min(int(-up / ROW), N_ROWS - 1)] += 1.0
    return n


@compiled
def _log_supported(near: Array, past: Array, support: Array, neighbour: float) -> float:
    """Return the log probability of all beams, by what holds a place up.

    ``neighbour`` is the probability that one side shows something else.
    """
    found = _log_support(near[0] + near[1], past[0] + past[1], support) + log(1.0 - neighbour)
    for side in range(2):
        if neighbour > 0.0:
            other = _log_share(near[1 - side].sum(), past[1 - side].sum(), _ANY)
            alone = _log_support(near[side], past[side], support) + log(0.5 * neighbour)
            found = np.logaddexp(found, alone + other)
    return float(found)


@compiled
def _log_support(near: Array, past: Array, support: Array) -> float:
    """Return the log probability of the beams of some rows, by what holds a place up."""
    logs = _logs_of(near, past, support)
    return float(logs.max() + np.log(np.exp(logs - logs.max()).sum()))


@compiled
def _shares_begun(near: Array, past: Array, support: Array) -> Array:
    """Return how probably something wide, if it holds a place, has begun at each row, (9,)."""
    logs = _logs_of(near, past, support)
    shares = np.exp(logs - logs.max())
    return np.asarray(np.cumsum(shares[2:]) / shares.sum())


@compiled
def _logs_of(near: Array, past: Array, support: Array) -> Array:
    """Return the log probabilities of the beams of some rows with each of a support, (2 + 9,)."""
    n_near, n_past, over, passed = near.sum(), past.sum(), 0.0, 0.0
    logs = np.full(len(support), -np.inf)
    logs[0] = log(support[0]) + _log_share(n_near, n_past, _OPEN)
    logs[1] = log(support[1]) + _log_share(n_near, n_past, _ANY)
    for row in range(len(near)):
        if support[2 + row] > 0.0:
            begun = log(support[2 + row]) + _log_share(over, passed, _OPEN)
            logs[2 + row] = begun + _log_share(n_near - over, n_past - passed, _CLOSED)
        over, passed = over + near[row], passed + past[row]
    return logs


@compiled
def _log_share(n_near: float, n_past: float, beta: tuple[float, float]) -> float:
    """Return the log probability that so many beams end near, and so many go past."""
    a, b = beta
    begun = lgamma(a + b) - lgamma(a) - lgamma(b)
    return begun + lgamma(a + n_near) + lgamma(b + n_past) - lgamma(a + b + n_near + n_past)
