"""What a return says of a centre beside its range: that its beam has met the sphere.

The footprint of a beam that returned reaches inside the limb, so that the outermost returns bound
the limb from all sides. Missing returns are not used: they may be lost for other reasons. So each
side has a meaning only beside the opposite one (``occlusion``).
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from spheremark.pipelines.model import Array, Index, Mask
from spheremark.pipelines.sphere.linearisation import Linear
from spheremark.pipelines.sphere.normal_equations import sums_of_products
from spheremark.pipelines.sphere.returns import Returns, distances_and_halves, swept

_EDGES = np.arange(-0.5, 1.01, 0.05)  # half widths inside the limb
_SOFTNESSES = 0.05 * 2.0 ** np.arange(0.0, 4.6, 0.5)  # half widths of the footprint
_EDGE, _SIGMA_EDGE = 0.2, 0.4  # prior of the edge
_SOFTNESS, _SPREAD = 0.2, 0.7  # prior of the softness, and its sigma in the logarithm
_BLURS = np.append(0.0, 0.05 * 2.0 ** np.arange(0.0, 6.1, 0.5))  # half widths, of single returns
_FROM, _BIN, _N_BINS = -2.0, 0.05, 75  # half widths inside: bins of the histogram of returns
_POLE_BELOW, _POLE_HALF = 0.6, 0.25  # radii below the centre and to either side: beside the pole
# Half widths: scatter of the edges of single spheres about that of all, even and between halves
_SIGMAS_OWN = np.array([0.05, 0.1])
_POLE_BLUR = 0.3  # half widths by which returns beside the pole may be the pole's
SIGMA_HALVES = _SIGMA_EDGE / math.sqrt(2.0)
"""Prior of half the difference between the edges above and below [half widths]."""

OUTLIERS = 0.01
"""Share of returns with the range of a sphere whose beam did not meet it."""

_CERTAIN = 4.0  # standard deviations inside the limb beyond which a return carries no information
_DAMPING = 0.5  # part of the factors before that those of a step keep
_CAVITY_MIN = 0.05  # least share of a centre's precision that is not one return's own
_DENSITY = 1.0 / math.sqrt(2.0 * math.pi)


class Edge(NamedTuple):
    """How returns end at the limb of spheres.

    Attributes
    ----------
    radius : float
        Radius of the spheres [m].
    inside : (2,)
        How far inside the limb a footprint must reach to return, in its half widths: at the lower
        half of a sphere, where ground behind it may be the stronger echo, and at the upper.
    softness : (2,)
        Standard deviation of that, in the same unit.
    """

    radius: float
    inside: Array
    softness: Array

    @property
    def halves(self) -> float:
        """By how much half widths more the edge lies inside above than in the mean."""
        return float(self.inside[1] - self.inside[0]) / 2.0


class LimbNormals(NamedTuple):
    """What the limb adds to the normal equations of centres.

    Attributes
    ----------
    centres, rhs : (m, 3, 3), (m, 3)
        Normal matrices and right-hand sides.
    faces, rhs_faces : (m, 3, 3), (m, 3)
        The same with returns of the downward sweep counted negative.
    of_faces : (m, 3, 3)
        Normal matrices of moves of the two faces against each other.
    shared, shared_faces : (m, 3, 2), (m, 3, 2)
        Between the centres, all returns alike and by face, and what all spheres share: the
        difference of the two halves, and the offset of the gimbal's clock.
    of_shared : (2, 3)
        Normal equations of these two, last the right-hand sides.
    factors : (n, 2)
        Precision, and precision times mean, of the normal approximation of each return's
        likelihood.
    """

    centres: Array
    rhs: Array
    faces: Array
    rhs_faces: Array
    of_faces: Array
    shared: Array
    shared_faces: Array
    of_shared: Array
    factors: Array


def edge_of(returns: Returns, linear: Linear, weights: Array, covs: Array, radius: float) -> Edge:
    """Estimate how returns end at the limb of the spheres of a stop.

    Notes
    -----
    Returns lie evenly up to the edge: one that seems to reach inside of it by ``x``, with standard
    deviation ``s``, has a density proportional to ``Phi(x / s)``. Footprints that are wider or
    narrower than specified move the edge. What is not known of the direction of a return and of the
    centre of its sphere, by ``covs``, (m, 3, 3), is no softness of the edge: else spheres whose
    limb is badly seen would soften it for all. Posterior mean over a grid, with a weak prior for
    few spheres. Returns beside the pole are left out: there footprints that miss the sphere return
    too.
    """
    distances, halves = distances_and_halves(returns, linear.offsets)
    inside = (radius + halves - distances) / halves
    bins = np.clip((inside - _FROM) / _BIN, 0.0, _N_BINS).astype(np.intp)
    counted = (weights > 0.0) & (bins < _N_BINS) & ~_is_by_pole(returns, linear.offsets, radius)
    rows = _towards_beams(returns, linear.offsets)[:, counted]
    variances = np.einsum("in,nij,jn->n", rows, covs[returns.markers[counted]], rows)
    variances += returns.sigmas_lateral[counted] ** 2
    blurs = np.argmin(np.abs(np.sqrt(variances) / halves[counted] - _BLURS[:, None]), axis=0)
    cells = (is_upper(returns, linear.offsets)[counted] * len(_BLURS) + blurs) * _N_BINS
    counts = np.bincount(cells + bins[counted], minlength=2 * len(_BLURS) * _N_BINS)
    logs = np.tensordot(counts.reshape(2, len(_BLURS), _N_BINS), _log_densities()) + _log_prior()
    posterior = np.exp(logs - logs.max(axis=(1, 2), keepdims=True))
    posterior /= posterior.sum(axis=(1, 2), keepdims=True)
    softness = np.exp(posterior.sum(axis=1) @ np.log(_SOFTNESSES))
    return Edge(radius, posterior.sum(axis=2) @ _EDGES, softness)


def _towards_beams(returns: Returns, offsets: Array) -> Array:
    """Return unit vectors from centres to beams, square to the lines of sight to them, (3, n)."""
    distances = np.maximum(np.hypot(*offsets), 1e-9)
    x, y = offsets / distances
    tilt = distances / returns.ranges
    return np.asarray(x * returns.first_axes + y * returns.second_axes + tilt * returns.directions)


def is_upper(returns: Returns, offsets: Array) -> Index:
    """Return 1 for beams that pass above the centre, else 0."""
    return np.asarray(np.sum(offsets * returns.vertical, axis=0) > 0.0, dtype=np.intp)


@cache
def _log_densities() -> Array:
    """Return the log-density of returns in each bin for each blur, edge and softness."""
    inside = _FROM + _BIN * (np.arange(_N_BINS) + 0.5)
    sigmas = np.hypot(_BLURS[:, None, None, None], _SOFTNESSES)
    z = (inside[:, None, None] - _EDGES[:, None]) / sigmas
    t = (_FROM + _BIN * _N_BINS - _EDGES[:, None]) / sigmas
    length = t * ndtr(t) + _DENSITY * np.exp(-0.5 * t * t)
    return np.asarray(np.log(OUTLIERS + (1.0 - OUTLIERS) * ndtr(z)) - np.log(sigmas * length))


@cache
def _log_prior() -> Array:
    """Return the prior log-density of each edge and softness, (e, s)."""
    edges = ((_EDGES[:, None] - _EDGE) / _SIGMA_EDGE) ** 2
    return np.asarray(-0.5 * (edges + (np.log(_SOFTNESSES / _SOFTNESS) / _SPREAD) ** 2))


def limb_normals(
    returns: Returns, linear: Linear, weights: Array, covs: Array, edge: Edge, factors: Array
) -> LimbNormals:
    """Return what it adds to the normal equations that the beams of returns met their spheres.

    Notes
    -----
    Expectation propagation (Minka, Expectation propagation for approximate Bayesian inference,
    2001): each return is taken out of the present estimate, its probability of reaching inside is
    multiplied in, and a normal distribution of the same mean and variance replaces the product.
    Only the place across the line of sight is observed: the apparent size of the limb also depends
    on the distance, but less exactly than the footprint is known. Where returns lie on one side
    only, a deviation of the edge would shift the centre, and a deviation between the two halves
    would lift it: each sphere has both of its own, which are eliminated.
    """
    distances, halves = distances_and_halves(returns, linear.offsets)
    upper = is_upper(returns, linear.offsets)
    inside = edge.radius + halves - distances - edge.inside[upper] * halves
    blur2 = (edge.softness[upper] * halves) ** 2 + returns.sigmas_lateral**2
    widest = np.trace(covs, axis1=1, axis2=2)[returns.markers]
    used = np.flatnonzero((weights > 0.0) & (inside <= _CERTAIN * np.sqrt(widest + blur2)))
    by_pole = _is_by_pole(returns, linear.offsets, edge.radius)[used]
    inside, halves, blur2 = inside[used], halves[used], blur2[used]
    blur2 = blur2 + by_pole * (_POLE_BLUR * halves) ** 2

    # derivatives of the depth inside by the centre and the sphere's own edge
    columns = np.empty((6, len(used)))
    columns[:3] = _towards_beams(returns, linear.offsets)[:, used]
    x, y = linear.offsets[:, used] / distances[used]
    columns[3] = -halves
    columns[4] = -halves * np.sum(np.stack([x, y]) * returns.vertical[:, used], axis=0)
    rows = columns[:3]
    columns[5] = np.sum(rows * swept(returns)[:, used], axis=0)
    variances = np.einsum("in,nij,jn->n", rows, covs[returns.markers[used]], rows)
    found = np.zeros(factors.shape)
    found[used] = (weights * returns.shares)[used, None] * _approximated(
        inside, (variances, blur2), factors[used]
    )
    if factors.any():  # factors that change together would overshoot, and come back
        found[used] += _DAMPING * (factors[used] - found[used])

    precisions, rhs = found[used, 0], found[used, 1] - found[used, 0] * inside
    starts, right = np.searchsorted(used, returns.starts), np.vstack([precisions * columns, rhs])
    both = sums_of_products(starts, columns, right)
    faces = sums_of_products(starts, columns, returns.vertical[0, used] * right)
    inverse = np.linalg.inv(both[:, 3:5, 3:5] + np.diag(_SIGMAS_OWN**-2.0))
    # the fifth is the difference of all spheres, too
    N = both - both[:, :, 3:5] @ inverse @ both[:, 3:5]
    by_face = faces[:, :3] - faces[:, :3, 3:5] @ inverse @ both[:, 3:5]
    of_faces = both[:, :3, :3] - faces[:, :3, 3:5] @ inverse @ faces[:, 3:5, :3]
    return LimbNormals(
        centres=N[:, :3, :3],
        rhs=N[:, :3, 6],
        faces=by_face[:, :, :3],
        rhs_faces=by_face[:, :, 6],
        of_faces=of_faces,
        shared=N[:, :3, 4:6],
        shared_faces=by_face[:, :, 4:6],
        of_shared=N[:, 4:6, 4:].sum(axis=0),
        factors=found,
    )


def _approximated(inside: Array, variances: tuple[Array, Array], factors: Array) -> Array:
    """Return the normal approximations, (n, 2), of the likelihoods of reaching inside.

    ``variances`` are those of the centre along the row, and of the blur of the edge.
    """
    variance, blur2 = variances
    precision = np.maximum(1.0 / variance - factors[:, 0], _CAVITY_MIN / variance)
    rhs = inside / variance - factors[:, 1]
    spread = 1.0 / precision + blur2
    z = rhs / precision / np.sqrt(spread)
    chance = np.where(z > _CERTAIN, 1.0, OUTLIERS + (1.0 - OUTLIERS) * ndtr(z))
    ratio = (1.0 - OUTLIERS) * _DENSITY * np.exp(-0.5 * z * z) / chance
    curvature = ratio * (z + ratio) / spread  # minus the second derivative of the log-likelihood
    given = curvature / (1.0 - curvature / precision)
    mean = rhs / precision + ratio / np.sqrt(spread) / precision
    # not concave so far outside: the return is rather an outlier, and says nothing
    is_concave = curvature[:, None] > 0.0
    return np.where(is_concave, np.column_stack([given, (precision + given) * mean - rhs]), 0.0)


def _is_by_pole(returns: Returns, offsets: Array, radius: float) -> Mask:
    """Tell which footprints lie so low and so near the vertical that they may be on the pole."""
    (x, y), (up_x, up_y) = offsets, returns.vertical
    is_low = x * up_x + y * up_y < -_POLE_BELOW * radius
    near = np.abs(x * up_y - y * up_x) < _POLE_HALF * radius + returns.vertical_half_widths[1]
    return np.asarray(is_low & near)
