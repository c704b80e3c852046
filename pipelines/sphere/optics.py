"""What is not known of a LiDAR's beams: unknowns that all returns of a scan share.

Neither the width and profile of a beam nor what its echo weighs are published. They change the mean
range of a footprint on a slope by millimetres, at all spheres alike: a scan determines some of it
from the returns near the limb, the rest belongs to the covariance.
"""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.config import FittingConfig
from spheremark.pipelines.model import OPTICS, Array, Rig
from spheremark.pipelines.model.network import RANGE_BIAS, RANGE_SCALE
from spheremark.pipelines.scan.rigs import BEAM_WINDOW
from spheremark.pipelines.sphere.linearisation import Linear
from spheremark.pipelines.sphere.returns import Returns

N_ESTIMATED = len(OPTICS)
"""Unknowns that a scan determines; it says nothing of the others."""

UNKNOWNS = (*OPTICS, RANGE_BIAS, RANGE_SCALE)
"""Unknowns of the optics: relative excess of the divergence; width at the window in units of the
VLP-16's; weight of an echo by this power of the cosine of incidence; bias [m] and scale of all
ranges."""

SIGMAS_PROFILE = np.array([0.1, 0.03, 0.3])
"""Standard deviations of what beams of other profiles than an even one leave open of these, from
simulated scans with Gaussian profiles and with two lobes."""

_NARROWEST = 0.02  # of the specified half widths: a ray


def prior_sigmas(config: FittingConfig, rig: Rig) -> Array:
    """Return the prior standard deviations of ``UNKNOWNS``.

    A calibration removes what lasers differ by, and leaves what they have in common.

    Parameters
    ----------
    config : FittingConfig
        The priors.
    rig : Rig
        Biases of lasers that differ widen the prior of what they have in common.

    Returns
    -------
    (5,)
        In the order of ``UNKNOWNS``.
    """
    spread = float(np.std(rig.laser_range_biases)) / config.sigma_range_bias
    return np.array(
        [
            config.sigma_beam_width,
            config.sigma_beam_window,
            config.sigma_echo_cosine,
            config.sigma_range_common * max(1.0, spread),
            config.sigma_range_scale,
        ]
    )


def with_widths(returns: Returns, optics: Array) -> Returns:
    """Return returns whose footprints have the widths of the optics.

    Parameters
    ----------
    returns : Returns
        With footprints as specified.
    optics : (2 or more,)
        Values of ``UNKNOWNS``.

    Returns
    -------
    ``Returns``
        With other half widths.
    """
    if not optics[:2].any():
        return returns
    width, window = optics[:2]
    specified = returns.half_widths
    widened = (1.0 + width) * specified + 0.5 * window * BEAM_WINDOW[:, None]
    factors = np.maximum(widened / specified, _NARROWEST)
    along, across = returns.vertical_half_widths
    mean = np.sqrt(factors[0] * factors[1])
    return returns._replace(
        half_widths=factors * specified,
        vertical_half_widths=np.stack([mean * along, mean * across]),
    )


def echo_shifts(linear: Linear, optics: Array) -> Array:
    """Return by how much ranges differ from those of echoes that weigh evenly.

    Parameters
    ----------
    linear : Linear
        Predicted ranges.
    optics : (3 or more,)
        Values of ``UNKNOWNS``.

    Returns
    -------
    (n,)
        What is measured longer [m].
    """
    return np.asarray(optics[N_ESTIMATED - 1] * linear.J_optics[1])


def derivatives(specified: Returns, widened: Returns, linear: Linear) -> Array:
    """Return the derivatives of predicted ranges by ``UNKNOWNS``.

    Parameters
    ----------
    specified, widened : Returns
        With footprints as specified, and as widened by the present optics.
    linear : Linear
        Predicted ranges for the latter.

    Returns
    -------
    (5, n)
        Derivatives.

    Notes
    -----
    What a footprint adds to a range grows with the sum of the squares of its half widths.
    """
    by_width, by_cosine = linear.J_optics
    halves = widened.half_widths
    by_square = by_width / np.sum(halves**2, axis=0)
    return np.stack(
        [
            by_square * np.sum(halves * specified.half_widths, axis=0),
            by_square * np.sum(halves * 0.5 * BEAM_WINDOW[:, None], axis=0),
            by_cosine,
            np.ones(len(specified.ranges)),
            specified.ranges,
        ]
    )
