"""Centres of spheres that all scan lines cross at one place, as with lines that fall on each other.

Hides a search along the line that such a strip of returns leaves open. Ranges and limb show there
how far beside the strip a centre lies, but neither well nor on which side: the likelihood has
several maxima, of which steps of least squares find the nearest.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from spheremark.pipelines.model import Array, Index, Mask
from spheremark.pipelines.sphere.limb import OUTLIERS, Edge, is_upper
from spheremark.pipelines.sphere.linearisation import Linear, linearise
from spheremark.pipelines.sphere.returns import Returns, distances_and_halves, of_markers

_STRIP = 0.1  # radii: standard deviation across a strip of returns
_N_MIN = 4  # returns that show one
_GRID = np.arange(-1.5, 1.51, 0.1)  # radii beside the strip
_N_STEPS, _STEP_MAX = 3, 0.3  # along the line of sight and along the strip; and radii
_LOOSE = 0.5  # radii: sigma of a step where returns do not determine it
_SQUARE_MAX = 9.0  # of a residual over its variance: more is an outlier


class _Measured(NamedTuple):
    """Ranges [m], their sigmas [m], and whether they are the sphere's."""

    ranges: Array
    sigmas: Array
    is_used: Mask


def on_strips(
    returns: Returns,
    linear: Linear,
    measured: tuple[Array, Array, Array],
    centres: Array,
    edge: Edge,
) -> tuple[Array, Array]:
    """Return where the centres of spheres lie that are seen on a strip, and how surely.

    Parameters
    ----------
    returns : Returns
        As mounting, clock and optics say they are.
    linear : Linear
        Of the centres.
    measured : (n,), (n,), (n,)
        Ranges without what echoes add [m], their sigmas [m] and weights.
    centres : (m, 3)
        Centres that were found [m].
    edge : Edge
        How returns end at the limb, and the radius.

    Returns
    -------
    (m, 3), (m, 3, 3)
        Moves to the likeliest places [m], and mean squares of the others about these [m^2]: zero
        for spheres that are seen on more than a strip.
    """
    moves, covs = np.zeros(centres.shape), np.zeros((len(centres), 3, 3))
    strips, middles, axes = _strips(returns, linear, measured[2], centres, edge.radius)
    if not len(strips):
        return moves, covs
    part, rows = of_markers(returns, strips)
    ranges, sigmas, weights = (column[rows] for column in measured)
    own = _Measured(ranges, sigmas, weights > 0.0)
    found = [
        _likeliest(
            part, own, centres[strips] + (middles + place * edge.radius) * axes[:, 2], axes, edge
        )
        for place in _GRID
    ]
    places, squares = (np.array(one) for one in zip(*found, strict=True))
    for k, strip in enumerate(strips):
        shares = np.exp(-0.5 * (squares[:, k] - squares[:, k].min()))
        best = places[squares[:, k].argmin(), k]
        off = places[:, k] - best
        moves[strip] = best - centres[strip]
        covs[strip] = (shares / shares.sum() * off.T) @ off
    return moves, covs


def _strips(
    returns: Returns, linear: Linear, weights: Array, centres: Array, radius: float
) -> tuple[Index, Array, Array]:
    """Return the spheres that are seen on a strip, how far beside it they are, and three axes.

    These are, (k, 3, 3), the line of sight, along the strip, and across it.
    """
    x, y = linear.offsets
    passing = x * returns.first_axes + y * returns.second_axes
    strips, middles, axes = [], [], []
    for m, (a, b) in enumerate(pairwise(returns.starts)):
        places = passing[:, a:b][:, weights[a:b] > 0.0]
        if places.shape[1] < _N_MIN:
            continue
        sight = centres[m] / np.linalg.norm(centres[m])
        places = places - np.outer(sight, sight @ places)
        middle = places.mean(axis=1)
        squares, vectors = np.linalg.eigh(np.cov(places))
        if squares[1] < (_STRIP * radius) ** 2:  # the least is along the line of sight
            across = np.cross(sight, vectors[:, 2])
            strips.append(m)
            middles.append([across @ middle])
            axes.append([sight, vectors[:, 2], across])
    n = len(strips)
    return (
        np.array(strips, np.intp),
        np.array(middles).reshape(n, 1),
        np.array(axes).reshape(n, 3, 3),
    )


def _likeliest(
    returns: Returns, measured: _Measured, begun: Array, axes: Array, edge: Edge
) -> tuple[Array, Array]:
    """Return the likeliest centres along sight and strip, and minus twice their log-likelihoods."""
    ranges, sigmas, is_used = measured
    spheres = np.column_stack([begun, np.full(len(begun), edge.radius)])
    covs, radius = np.zeros((len(begun), 4, 4)), edge.radius
    for _ in range(_N_STEPS):
        there = linearise(returns, spheres, covs, is_used)
        residuals = (ranges - there.ranges) / sigmas
        capped = is_used * np.clip(residuals, -(_SQUARE_MAX**0.5), _SQUARE_MAX**0.5)
        for m, (a, b) in enumerate(pairwise(returns.starts)):
            J = axes[m, :2] @ there.J[:3, a:b] / sigmas[a:b]
            N = is_used[a:b] * J @ J.T + np.eye(2) / (_LOOSE * radius) ** 2
            step = np.linalg.solve(N, J @ capped[a:b])
            spheres[m, :3] += np.clip(step, -_STEP_MAX * radius, _STEP_MAX * radius) @ axes[m, :2]
    there = linearise(returns, spheres, covs, is_used)
    distances, halves = distances_and_halves(returns, there.offsets)
    upper = is_upper(returns, there.offsets)
    inside = radius + halves - distances - edge.inside[upper] * halves
    blurs = np.hypot(edge.softness[upper] * halves, returns.sigmas_lateral)
    met = OUTLIERS + (1.0 - OUTLIERS) * ndtr(inside / blurs)
    squares = np.minimum(((ranges - there.ranges) / sigmas) ** 2, _SQUARE_MAX)
    each = is_used * (squares - 2.0 * returns.shares * np.log(met))
    return spheres[:, :3], np.asarray(np.bincount(returns.markers, each, len(begun)), np.float64)
