"""How noisy the returns of a stop are, and which of them are none of a sphere.

Hides the noise of a range by reflectivity, of which only the ratio is known beforehand, and the
robust weights. All spheres of a stop tell of the noise together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import Array, Index, Mask
from spheremark.pipelines.sphere.linearisation import Linear
from spheremark.pipelines.sphere.returns import Rows

# Range noise of a VLP-16 by reflectivity, from recorded packets [m]: a prior, for the ratio between
# dark and bright; its size is estimated from the stop.
_REFLECTIVITIES = np.array([5.0, 15.0, 40.0, 100.0])  # limits between the classes
_SIGMAS = np.array([0.0137, 0.0107, 0.0089, 0.0067, 0.0064])
_FACTOR_START = 3.0  # the largest noise that a VLP-16 shows, 25 mm

FACTOR_MIN = 0.08
"""Least noise in units of the prior: 2 mm quantisation alone gives as much."""

EXPECTED_SQUARE = 0.9099
"""Mean of weight times square of normal residuals in units of their sigma."""

_TUKEY = 8.0  # sigmas at which a return has no weight; 99 % efficient on clean data
_DOF_CLASS = 30.0  # returns that the common noise is worth when that of a class is estimated


class Noise(NamedTuple):
    """The noise of a stop in units of the prior.

    Attributes
    ----------
    factor : float
        Of all returns.
    factors : (c,)
        By class of reflectivity.
    """

    factor: float
    factors: Array


class Weighed(NamedTuple):
    """What returns leave after what they should measure.

    Attributes
    ----------
    residuals : (n,)
        Observed minus computed, the bias of each laser taken off [m].
    sigmas : (n,)
        Their standard deviations [m].
    weights : (n,)
        Robust weights, 0 to 1.
    noise : Noise
        As these residuals have it.
    """

    residuals: Array
    sigmas: Array
    weights: Array
    noise: Noise


START = Noise(_FACTOR_START, np.full(len(_SIGMAS), _FACTOR_START))
"""The noise before a residual is seen."""


def classes_of(intensities: Array) -> tuple[Index, Array]:
    """Return classes of reflectivity and prior noise of ranges."""
    classes = np.searchsorted(_REFLECTIVITIES, intensities, side="right")
    return classes, _SIGMAS[classes]


def weigh(rows: Rows, linear: Linear, biases: Array, noise: Noise, is_in: Mask) -> Weighed:
    """Weigh returns, and estimate the noise of their stop.

    Notes
    -----
    The noise of a range is its own, that of the direction on a slope, and the bend. A class is
    believed to have the factor of all until it has returns enough to speak for itself. Weights are
    Tukey's.
    """
    return Weighed(*_weigh(rows, linear, biases, noise, is_in))


@compiled
def _weigh(
    rows: Rows, linear: Linear, biases: Array, noise: Noise, is_in: Mask
) -> tuple[Array, Array, Array, Noise]:
    """Return the fields of ``Weighed``."""
    n = len(rows.ranges)
    residuals, beside, sigmas, weights = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for i in range(n):
        residuals[i] = rows.ranges[i] - linear.ranges[i] - biases[rows.lasers[i]]
    _beside(rows, linear, beside)
    _against(rows, residuals, beside, noise.factors, sigmas, weights)
    squares, counts = np.zeros(len(noise.factors)), np.zeros(len(noise.factors))
    for i in range(n):
        if is_in[i] and weights[i] > 0.0:
            c = rows.classes[i]
            squares[c] += weights[i] * (noise.factors[c] * residuals[i] / sigmas[i]) ** 2
            counts[c] += 1.0
    found = _pooled(squares / EXPECTED_SQUARE, counts, 3.0 * (len(rows.firsts) - 1.0))
    _against(rows, residuals, beside, found.factors, sigmas, weights)
    for i in range(n):
        weights[i] *= is_in[i]
    return residuals, sigmas, weights, found


@compiled
def _beside(rows: Rows, linear: Linear, variances: Array) -> None:
    """Fill in the variances of what is not noise of the range: directions on a slope, the bend."""
    J, u = linear.J, rows.directions
    for i in range(len(variances)):
        along = J[0, i] * u[0, i] + J[1, i] * u[1, i] + J[2, i] * u[2, i]
        square = J[0, i] * J[0, i] + J[1, i] * J[1, i] + J[2, i] * J[2, i]
        lateral, bend = rows.lateral[i], linear.bends[i]
        variances[i] = lateral * lateral * max(square - along * along, 0.0) + bend * bend


@compiled
def _against(
    rows: Rows, residuals: Array, beside: Array, factors: Array, sigmas: Array, weights: Array
) -> None:
    """Fill in sigmas, and Tukey's weights of residuals in units of them."""
    for i in range(len(sigmas)):
        own = factors[rows.classes[i]] * rows.sigmas[i]
        sigmas[i] = np.sqrt(own * own + beside[i])
    for i in range(len(sigmas)):
        scaled = residuals[i] / (_TUKEY * sigmas[i])
        rest = max(1.0 - scaled * scaled, 0.0)
        weights[i] = rest * rest


@compiled
def _pooled(squares: Array, counts: Array, n_unknowns: float) -> Noise:
    """Return the noise from sums of squares and numbers of returns by class."""
    n = max(np.sum(counts), 1.0)
    dof = max(n - n_unknowns, 0.0)
    factor2 = (np.sum(squares) + 1.0) / (dof + 1.0)
    own = (squares + _DOF_CLASS * factor2) / (counts * dof / n + _DOF_CLASS)
    return Noise(max(np.sqrt(factor2), FACTOR_MIN), np.maximum(np.sqrt(own), FACTOR_MIN))
