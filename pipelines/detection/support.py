"""What holds an object up, by the beams that pass below it and beside a pole's place.

A pole lets most of them pass, and the legs of a tripod do, whose head is narrow. Shoulders, a
larger stone or the ground stop all from some height downwards, and a body does farther down.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import lgamma, log
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.detection.beams import BELOW
from spheremark.pipelines.detection.evidence import N_ROWS, ROW, Evidence, beside_pole
from spheremark.pipelines.detection.shapes import BOULDER, HEAD, NAMES
from spheremark.pipelines.detection.target import ASIDE, REACH
from spheremark.pipelines.model import Array

# Beta distributions of the share of beams that end near, where nothing is, something, anything,
# the legs of a tripod, and the body below a head
_OPEN, _CLOSED, _ANY = (0.3, 5.0), (5.0, 0.3), (0.5, 0.5)
_LEGS, _BODY = (3.0, 7.0), (8.0, 1.0)

_NEIGHBOUR = 0.05  # probability that something else is on one side; a boulder has ground on both
_DOUBT = 0.1  # probability of anything below what stands on a pole or on something wide
_RAREST = 1e-9  # nothing is less probable before a beam is seen
_SPREADS, _SLOPES = 3, 2  # rows that legs begin to spread below a head, and shoulders slope over
_FACING = np.array([0.4, 0.35, 0.25])  # probabilities of each of ``_SHOULDERS``
_ROWS = np.array([0.0, *(0.2,) * 3, *(0.08,) * 5])
"""Probabilities of the row from which something wide stops the beams below what stands on it: it
begins there, or widens farther down, as a cone does or a tripod. The last two rows are farther down
than pulses without a return are known: what begins there is not seen."""

# Probabilities that nothing is below, that anything is, and that something is from each row down
_ON_POLE = np.array([1.0 - _DOUBT, _DOUBT, *(0.0,) * 9])
_ON_WIDE = np.array([0.001, _DOUBT, *((0.999 - _DOUBT) * _ROWS)])
_ON_TALL = np.array([0.001, _DOUBT, 0.0, *((0.999 - _DOUBT) / 3.0,) * 3, *(0.0,) * 5])
_ON_GROUND = np.array([0.005, 0.005, *(0.2475,) * 4, *(0.0,) * 5])
_ON_ANOTHER = np.array([0.005, 0.005, 0.0, *(0.33,) * 3, *(0.0,) * 5])
_ON_BODY = np.array([0.001, 0.001, 0.0, 0.0, *(0.1996,) * 5, 0.0, 0.0])

_Beta = tuple[float, float]
_Below = tuple[Array, Array, Array]  # near and past, (2, 2, 9), and as ``Evidence.lower``


class _Support(NamedTuple):
    """What may hold an object, by the beams below that end near.

    Where it begins, and the share of beams that end there; how many rows farther down it may be
    broad, and the share of those farther to the side; and the share at the height of a body.
    """

    rows: Array
    share: _Beta = _CLOSED
    lag: int = 0
    farther: _Beta = _CLOSED
    lower: _Beta = _ANY


# The head of a tripod may be as narrow as a pole or nearly as wide as a sphere. What is tall, as a
# vehicle or a wall, begins where the sphere ends, unlike those that widen
_STANDING = (
    _Support(_ON_POLE, lower=_OPEN),
    _Support(_ON_WIDE, _ANY, _SPREADS, _LEGS, _LEGS),
    _Support(_ON_WIDE),
    _Support(_ON_TALL, lower=_CLOSED),
)
# A stone of two radii, round on top, is wider than a pole's place 0.4 radii below a boulder, which
# is a quarter lower or higher than a sphere; a smaller one is narrow there
_LYING = (
    _Support(_ON_GROUND),
    _Support(_ON_ANOTHER),
    _Support(_ON_ANOTHER, _CLOSED, _SPREADS, _ANY),
)
# Shoulders begin within three radii below a head, or slope; from the side, they are as narrow
_SHOULDERS = (
    _Support(_ON_BODY, lower=_BODY),
    _Support(_ON_BODY, lag=_SLOPES, lower=_BODY),
    _Support(_ON_BODY, _ANY, _SPREADS, _LEGS, _BODY),
)


def log_supports(
    evidence: Evidence, level: float, radius: float, standing: Array, lying: Array
) -> tuple[Array, Array]:
    """Return the log probabilities of the beams below a place by all hypotheses, (k,).

    And how probably something but a pole holds it that has begun at each row, as those beams show,
    (9,).

    Parameters
    ----------
    evidence : Evidence
        The beams towards and about it.
    level : float
        Height above the sensor [m].
    radius : float
        Of the sphere that is searched for [m].
    standing : (4,)
        Probabilities that what has this height is held by a pole, by something as high that is
        narrow, as a tripod, by something low and wide, and by something tall and wide.
    lying : (3,)
        Probabilities that a boulder of this height lies on the ground, on another that is wide, and
        on one that is narrow.

    Notes
    -----
    Shares of beams are Beta distributed, their counts Beta-binomial; the row from which something
    stops them is marginalised. Both sides show what holds it up, or one does and the other shows a
    neighbour; the ground is on both. What is neither a boulder nor a head is held as a sphere is.
    """
    beams = *_beams_below(evidence, level, radius), evidence.lower.astype(np.float64)
    return _log_supports(beams, standing, lying)


def _log_supports(beams: _Below, standing: Array, lying: Array) -> tuple[Array, Array]:
    """Return the same, from how many beams below end near and go past."""
    stands, held = _log_any(beams, _STANDING, standing, _NEIGHBOUR)
    logs = np.full(len(NAMES), stands)
    logs[BOULDER], _ = _log_any(beams, _LYING, lying, 0.0)
    logs[HEAD], _ = _log_any(beams, _SHOULDERS, _FACING, _NEIGHBOUR)
    return logs, held


def _log_any(
    beams: _Below, supports: Sequence[_Support], shares: Array, neighbour: float
) -> tuple[float, Array]:
    """Return the log probability of all beams by any of some supports, of probabilities before.

    And how probably something has begun at each row, (9,).
    """
    near, past, lower = beams
    logs = np.log(np.maximum(shares, _RAREST))
    logs += [_log_share(*lower, own.lower) for own in supports]
    logs += [_log_supported(near, past, own, neighbour) for own in supports]
    total = float(np.logaddexp.reduce(logs))
    begun = [_shares_begun(near, past, own) for own in supports]
    return total, np.asarray(np.exp(logs - total) @ begun)


def _beams_below(evidence: Evidence, level: float, radius: float) -> tuple[Array, Array]:
    """Return how many beams below a place end near, and how many are known to go past."""
    near, past = evidence.below.astype(np.float64)
    n_past = past.sum()
    if evidence.silent is None:  # pulses are as dense below, and those without a return go past
        return near, past + max(evidence.n_on - near.sum() - n_past, 0.0) / past.size
    return near, np.maximum(past - _n_unknown(evidence, level, radius), 0.0)


def _n_unknown(evidence: Evidence, level: float, radius: float) -> Array:
    """Return how many pulses without a return below a place may have met unheard ground.

    The beams farther to the same side, past where a pole or shoulders would be, show how much of it
    is heard as far down. No ground is above the horizon, in the mean.
    """
    assert evidence.silent is not None
    silent = evidence.silent[:2, evidence.silent[1] < -level] / radius
    blur = evidence.blur.max() / radius
    n_heard, n_silent = (_n_aside(own, blur) for own in (evidence.seen[:2] / radius, silent))
    share = (n_silent.sum() + 0.5) / (n_heard.sum() + n_silent.sum() + 1.0)
    shares = (n_silent + share) / (n_heard + n_silent + 1.0)
    return np.asarray(beside_pole(silent, blur) * shares[:, None])


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
def _log_supported(near: Array, past: Array, support: _Support, neighbour: float) -> float:
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
def _log_support(near: Array, past: Array, support: _Support) -> float:
    """Return the log probability of beams, nearer and farther, by what holds a place up."""
    logs = _logs_of(near, past, support)
    return float(logs.max() + np.log(np.exp(logs - logs.max()).sum()))


@compiled
def _shares_begun(near: Array, past: Array, support: _Support) -> Array:
    """Return how probably something, if it holds a place, has begun at each row, (9,)."""
    logs = _logs_of(near[0] + near[1], past[0] + past[1], support)
    shares = np.exp(logs - logs.max())
    return np.asarray(np.cumsum(shares[2:]) / shares.sum())


@compiled
def _logs_of(near: Array, past: Array, support: _Support) -> Array:
    """Return the log probabilities of beams, nearer and farther, with each of a support, (2 + 9,).

    Those nearer end there from its row on; those farther go past it until so many rows below.
    """
    rows, lag = support.rows, support.lag
    stopped, gone = near.copy(), past.copy()
    if lag == 0:  # those farther to the side do as those nearer
        stopped[0], gone[0] = near[0] + near[1], past[0] + past[1]
        stopped[1], gone[1] = 0.0, 0.0
    n_near, n_past, logs = stopped.sum(axis=1), gone.sum(axis=1), np.full(len(rows), -np.inf)
    logs[0] = log(rows[0]) + _log_share(n_near.sum(), n_past.sum(), _OPEN)
    logs[1] = log(rows[1]) + _log_share(n_near[0], n_past[0], _ANY)
    logs[1] += _log_share(n_near[1], n_past[1], _OPEN)
    for row in range(N_ROWS):
        if rows[2 + row] > 0.0:
            over, passed = stopped[0, :row].sum(), gone[0, :row].sum()
            beside, wide = stopped[1, : row + lag].sum(), gone[1, : row + lag].sum()
            begun = log(rows[2 + row]) + _log_share(over + beside, passed + wide, _OPEN)
            begun += _log_share(n_near[0] - over, n_past[0] - passed, support.share)
            logs[2 + row] = begun + _log_share(
                n_near[1] - beside, n_past[1] - wide, support.farther
            )
    return logs


@compiled
def _log_share(n_near: float, n_past: float, beta: _Beta) -> float:
    """Return the log probability that so many beams end near, and so many go past."""
    a, b = beta
    begun = lgamma(a + b) - lgamma(a) - lgamma(b)
    return begun + lgamma(a + n_near) + lgamma(b + n_past) - lgamma(a + b + n_near + n_past)
