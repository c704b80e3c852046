"""Ranges of beams to spheres, linearised over the uncertainty of the spheres.

The slope of the range to a sphere changes within less than a millimetre near the limb. At one place
it overstates what a beam says about a centre that is known to millimetres only, so that ranges are
linearised over the width of that uncertainty.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import Array, Index, Mask
from spheremark.pipelines.sphere.footprint import mean_depth_inside, mean_depths_at
from spheremark.pipelines.sphere.returns import Returns

_INNER = 0.9  # radii from the middle within which the range is nearly linear
_THIN2 = 1e-12  # [m^2] least variance: keeps the factor invertible
_N_POINTS = 8  # seven sigma points, and the middle one with a wider footprint
_WIDENED = 0.1  # by which that is wider
_THINNEST = 1e-9  # [m] of a depth
_WIDTH = math.sqrt(3.0)  # sigmas to either side: two such points have a normal's fourth moment

_Vector = tuple[float, float, float]
_Factor = tuple[float, float, float, float, float, float]


class Linear(NamedTuple):
    """Predicted ranges, linearised over the uncertainty of the spheres.

    Attributes
    ----------
    ranges : (n,)
        Predicted ranges, with the mean of their second-order term over the uncertainty [m].
    J : (4, n)
        Derivatives of the ranges by the centre and by the radius.
    sigmas_nonlinear : (n,)
        Standard deviation of the part of the range that is not linear [m].
    offsets : (2, n)
        Offset of the beam's axis from the centre, along the footprint's two axes [m].
    J_optics : (2, n)
        Derivatives of the ranges by the logarithm of the footprint's width, and by the power of the
        cosine of incidence with which an echo weighs [m].
    """

    ranges: Array
    J: Array
    sigmas_nonlinear: Array
    offsets: Array
    J_optics: Array


def linearise(returns: Returns, spheres: Array, covs: Array, is_used: Mask | None = None) -> Linear:
    """Predict ranges to spheres whose covariances are known.

    Parameters
    ----------
    returns : Returns
        Beams.
    spheres : (m, 4)
        Centres and radii [m].
    covs : (m, 4, 4)
        Their covariances [m^2].
    is_used : (n,), optional
        The other returns get the range and derivatives of the closest approach.

    Returns
    -------
    Linear
        Ranges with derivatives.

    Notes
    -----
    Near the limb the derivative is the slope between sigma points, for a normal distribution the
    mean derivative (statistical linearisation by cubature: Garcia-Fernandez, Svensson, Morelande,
    Sarkka, Posterior linearization filter, 2015). Along the beam a range is linear in the centre,
    so that sigma points differ only across the beam, and in the radius where it is free. Well
    inside the limb the exact derivative is taken, and the second-order term of a ray. Without that
    term least squares puts centres some millimetres too near where returns are
    few (Box, Bias in nonlinear estimation, 1971).
    """
    n = len(returns.ranges)
    if is_used is None:
        is_used = np.ones(n, dtype=np.bool_)
    out = Linear(np.empty(n), np.empty((4, n)), np.zeros(n), np.empty((2, n)), np.zeros((2, n)))
    axes = (returns.directions, returns.first_axes, returns.second_axes)
    beams = (returns.origins, axes, returns.half_widths)
    _linearise(beams, returns.starts, (spheres, covs), is_used, out)
    return out


@compiled
def _linearise(
    beams: tuple[Array, tuple[Array, Array, Array], Array],
    starts: Index,
    spheres: tuple[Array, Array],
    is_used: Mask,
    out: Linear,
) -> None:
    """Fill in ``Linear``."""
    (origins, (u, a, b), half_widths), (states, covs) = beams, spheres
    work = (np.empty((5, _N_POINTS)), np.empty((3, _N_POINTS)))
    for m in range(len(states)):
        cov, radius = covs[m], states[m, 3]
        for i in range(starts[m], starts[m + 1]):
            x, y, along = 0.0, 0.0, 0.0
            for j in range(3):
                v = states[m, j] - origins[j, i]
                x, y, along = x + v * a[j, i], y + v * b[j, i], along + v * u[j, i]
            shorter, by_x, by_y, by_radius, nonlinear = 0.0, 0.0, 0.0, 0.0, 0.0
            wider, squared = 0.0, 0.0
            if is_used[i]:
                c, s, away = _polar(x, y)
                radial = (
                    c * a[0, i] + s * b[0, i],
                    c * a[1, i] + s * b[1, i],
                    c * a[2, i] + s * b[2, i],
                )
                tangential = (
                    c * b[0, i] - s * a[0, i],
                    c * b[1, i] - s * a[1, i],
                    c * b[2, i] - s * a[2, i],
                )
                factor = _factor(cov, radial, tangential)
                half = (half_widths[0, i], half_widths[1, i])
                if _reach(away, max(half[0], half[1]), factor) < _INNER * radius:
                    shorter, by_x, by_y, by_radius, squared = mean_depth_inside(
                        x, y, radius, half[0], half[1]
                    )
                    # what the width adds grows with its square
                    wider = 2.0 * (shorter - math.sqrt(radius * radius - away * away))
                    squared = squared / shorter - shorter
                    shorter -= 0.5 * _curvature(away, radius, factor)
                else:
                    shorter, by_x, by_y, by_radius, nonlinear = _over_sigma_points(
                        (x, y, radius), half, (c, s), factor, work
                    )
                    found = work[1]
                    wider = (found[0, _N_POINTS - 1] - found[0, 0]) / _WIDENED
                    squared = found[2, 0] / max(found[0, 0], _THINNEST) - found[0, 0]
            for j in range(3):
                out.J[j, i] = u[j, i] - by_x * a[j, i] - by_y * b[j, i]
            out.J[3, i], out.sigmas_nonlinear[i] = -by_radius, nonlinear
            out.ranges[i] = along - shorter
            out.offsets[0, i], out.offsets[1, i] = -x, -y
            out.J_optics[0, i], out.J_optics[1, i] = -wider, -squared


@compiled
def _polar(x: float, y: float) -> _Vector:
    """Return cosine, sine and length of a vector."""
    away = max(np.sqrt(x * x + y * y), 1e-9)
    return x / away, y / away, away


@compiled
def _factor(cov: Array, radial: _Vector, tangential: _Vector) -> _Factor:
    """Return the Cholesky factor of a sphere's covariance (radial, tangential, radius), by rows."""
    aa, ab, bb, ar, br = 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(3):
        v = cov[j, 0] * radial[0] + cov[j, 1] * radial[1] + cov[j, 2] * radial[2]
        w = cov[j, 0] * tangential[0] + cov[j, 1] * tangential[1] + cov[j, 2] * tangential[2]
        aa, ab, bb = aa + radial[j] * v, ab + tangential[j] * v, bb + tangential[j] * w
        ar, br = ar + radial[j] * cov[j, 3], br + tangential[j] * cov[j, 3]
    aa = np.sqrt(max(aa, _THIN2))
    ab /= aa
    bb = np.sqrt(max(bb - ab * ab, _THIN2))
    ar /= aa
    br = (br - ab * ar) / bb
    rr = np.sqrt(max(cov[3, 3] - ar * ar - br * br, _THIN2)) if cov[3, 3] > 0.0 else 0.0
    return aa, ab, bb, ar, br, rr


@compiled
def _reach(away: float, half: float, factor: _Factor) -> float:
    """Return how far from the centre a footprint may reach within the sigma points [m]."""
    aa, ab, bb, ar, _, rr = factor
    outward, sideways = away + _WIDTH * aa, _WIDTH * (abs(ab) + bb)
    return math.sqrt(outward**2 + sideways**2) + half + _WIDTH * (abs(ar) + rr)


@compiled
def _curvature(away: float, radius: float, factor: _Factor) -> float:
    """Return the trace of a ray's second derivatives times the covariance [m]."""
    aa, ab, bb, ar, br, rr = factor
    square = radius * radius - away * away
    outward = radius * aa - away * ar
    bent = outward * outward + away * away * (br * br + rr * rr)
    return -(bent / square + ab * ab + bb * bb) / math.sqrt(square)


@compiled
def _over_sigma_points(
    sphere: _Vector,
    half: tuple[float, float],
    direction: tuple[float, float],
    factor: _Factor,
    work: tuple[Array, Array],
) -> tuple[float, float, float, float, float]:
    """Return mean depth, slopes by x, y and radius, and the deviation that is not linear."""
    (x, y, radius), (c, s), (aa, ab, bb, ar, br, rr) = sphere, direction, factor
    # columns of the factor in the footprint's axes: x, y and radius
    columns = (
        (aa * c - ab * s, aa * s + ab * c, ar),
        (-bb * s, bb * c, br),
        (0.0, 0.0, rr),
    )
    points, found = work
    for p in range(_N_POINTS):
        points[0, p], points[1, p], points[2, p] = x, y, radius
        points[3, p], points[4, p] = half
    points[3, _N_POINTS - 1] *= 1.0 + _WIDENED
    points[4, _N_POINTS - 1] *= 1.0 + _WIDENED
    for k in range(3):
        for sign in range(-1, 2, 2):
            p = 1 + k if sign > 0 else 4 + k
            points[0, p] += sign * _WIDTH * columns[k][0]
            points[1, p] += sign * _WIDTH * columns[k][1]
            points[2, p] += sign * _WIDTH * columns[k][2]
    mean_depths_at(points, found)
    d, a, b, r = found[0, 0], found[0, 1], found[0, 2], found[0, 3]
    minus_a, minus_b, minus_r = found[0, 4], found[0, 5], found[0, 6]
    mean = (a + b + r + minus_a + minus_b + minus_r) / 6.0
    square = (a * a + b * b + r * r + minus_a**2 + minus_b**2 + minus_r**2) / 6.0
    by_a, by_b, by_radius = a - minus_a, b - minus_b, r - minus_r
    linear = (by_a * by_a + by_b * by_b + by_radius * by_radius) / (2.0 * _WIDTH) ** 2
    nonlinear = np.sqrt(max(square - mean * mean - linear, 0.0))
    by_radius = by_radius / (2.0 * _WIDTH * rr) if rr > 0.0 else 0.0
    by_b = (by_b / (2.0 * _WIDTH) - br * by_radius) / bb
    by_a = (by_a / (2.0 * _WIDTH) - ab * by_b - ar * by_radius) / aa
    return 2.0 * d - mean, by_a * c - by_b * s, by_a * s + by_b * c, by_radius, nonlinear
