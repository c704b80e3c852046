"""What holds an object up, by the beams that pass below it and beside a pole's place.

A pole lets most of them pass, and the legs of a tripod do. Shoulders, a larger stone or the ground
stop all from some height downwards.
"""

from __future__ import annotations

from math import lgamma, log

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.detection.beams import BELOW
from spheremark.pipelines.detection.evidence import Evidence, beside_pole
from spheremark.pipelines.detection.shapes import BOULDER
from spheremark.pipelines.detection.target import ASIDE
from spheremark.pipelines.model import Array

OPEN, CLOSED, ANY = (0.3, 5.0), (5.0, 0.3), (0.5, 0.5)
"""Beta distributions of the share of beams that end near, where nothing is, something, anything."""

_NEIGHBOUR = 0.05  # probability that something else stands on one side, but for the ground
# Probabilities that nothing is below, that something is from some row downwards, and that anything
# is; then the first and the last such row: shoulders begin within three radii below a head
_POLE, _SHOULDERS = (0.85, 0.05, 0.1, 1, 8), (0.001, 0.998, 0.001, 2, 6)
_GROUND, _ANYTHING = (0.005, 0.99, 0.005, 0, 3), (0.05, 0.05, 0.9, 1, 8)
_SUPPORTS = np.array(  # by hypothesis
    [_POLE, _POLE, _GROUND, _SHOULDERS, _POLE, _ANYTHING, _POLE, _ANYTHING, _ANYTHING]
)


def log_supports(evidence: Evidence, level: float, radius: float, as_high: float) -> Array:
    """Return the log probabilities of the beams below a place by all hypotheses, (k,).

    Parameters
    ----------
    evidence : Evidence
        The beams towards and about it.
    level : float
        Height above the sensor [m].
    radius : float
        Of the sphere that is searched for [m].
    as_high : float
        How many times likelier such a height is on something wide than on a pole.

    Notes
    -----
    Shares of beams are Beta distributed, their counts Beta-binomial; the row from which something
    stops them is marginalised. Both sides show what holds it up, or one does and the other shows a
    neighbour; the ground is on both.
    """
    supports = _SUPPORTS.copy()
    supports[supports[:, 0] > 0.5, 1] *= as_high
    return np.asarray(_log_supports(*_beams_below(evidence, level, radius), supports))


def _beams_below(evidence: Evidence, level: float, radius: float) -> tuple[Array, Array]:
    """Return how many beams below a place end near, and how many are known to go past, (2, 9)."""
    near, past = evidence.below.astype(np.float64)
    n_past = past.sum()
    if evidence.silent is None:  # pulses are as dense below, and those without a return go past
        return near, past + max(evidence.n_on - near.sum() - n_past, 0.0) / past.size
    n_unknown = _n_unknown(evidence, level, radius)
    return near, past * max(1.0 - n_unknown / max(n_past, 1.0), 0.0)


def _n_unknown(evidence: Evidence, level: float, radius: float) -> float:
    """Return how many pulses without a return below a place may have met ground that is not heard.

    The beams to the sides, past where a pole or shoulders would be, show how much of it is heard.
    No ground is above the horizon, in the mean.
    """
    assert evidence.silent is not None
    silent = evidence.silent[:2, evidence.silent[1] < -level] / radius
    blur = evidence.blur.max() / radius
    n_heard, n_silent = (
        int(np.sum((up < BELOW) & (abs(across) > ASIDE + blur)))
        for across, up in (evidence.seen[:2] / radius, silent)
    )
    n_below = beside_pole(silent, blur).sum()
    return float(n_below * (n_silent + 0.5) / (n_heard + n_silent + 1.0))


@compiled
def _log_supports(near: Array, past: Array, supports: Array) -> Array:
    """Return the log probabilities of beams to the left and to the right, by rows, (2, 9)."""
    logs = np.empty(len(supports))
    for kind in range(len(supports)):
        support = supports[kind]
        logs[kind] = _log_support(near[0] + near[1], past[0] + past[1], support)
        if kind == BOULDER:
            continue
        logs[kind] += log(1.0 - _NEIGHBOUR)
        for side in range(2):
            neighbour = log_share(near[1 - side].sum(), past[1 - side].sum(), ANY)
            alone = _log_support(near[side], past[side], support) + neighbour
            logs[kind] = np.logaddexp(logs[kind], alone + log(0.5 * _NEIGHBOUR))
    return logs


@compiled
def _log_support(near: Array, past: Array, support: Array) -> float:
    """Return the log probability of the beams of some rows, by what holds a place up."""
    nothing, something, anything, first, last = support
    n_near, n_past = near.sum(), past.sum()
    found = log(nothing) + log_share(n_near, n_past, OPEN)
    found = np.logaddexp(found, log(anything) + log_share(n_near, n_past, ANY))
    over, passed = near[: int(first)].sum(), past[: int(first)].sum()
    for row in range(int(first), int(last) + 1):
        begun = log(something / (last + 1.0 - first)) + log_share(over, passed, OPEN)
        found = np.logaddexp(found, begun + log_share(n_near - over, n_past - passed, CLOSED))
        over, passed = over + near[row], passed + past[row]
    return float(found)


@compiled
def log_share(n_near: float, n_past: float, beta: tuple[float, float]) -> float:
    """Return the log probability that so many beams end near, and so many go past."""
    a, b = beta
    begun = lgamma(a + b) - lgamma(a) - lgamma(b)
    return begun + lgamma(a + n_near) + lgamma(b + n_past) - lgamma(a + b + n_near + n_past)
