"""Features of a group of returns, measured against a sphere of the known radius.

Mean shift of a disc finds the place; a robust fit along the beams measures the shape.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import REASSOCIATED, compiled, compiled_with
from spheremark.pipelines.detection.cells import Cells
from spheremark.pipelines.detection.neighbourhoods import SortedReturns, rays_near, returns_about
from spheremark.pipelines.detection.seeds import thinned
from spheremark.pipelines.detection.target import Target, View, blur_at, passing, seen_from, view_of
from spheremark.pipelines.estimation.linear_algebra import solve
from spheremark.pipelines.model import Array, StitchedCloud
from spheremark.pipelines.threads import by_turns

NOISE_MIN = 0.006
"""Scatter of any VLP-16: a smaller sample scatter is chance [m]."""

RESOLUTION = 0.08
"""Scatter, in radii, below which a shape is rounder than stones are, whose relief is as high."""

N_RESOLVED = 60
"""Least number of returns of such a shape."""

_CLOSE, _LOOSE = 0.04, 0.3  # radii: least and most that returns may scatter about a ball
_N_FIT_MIN = 4  # returns: more than the unknowns of the fit
_BACK = 1.0  # radii: what lies deeper than the back of a sphere is not what it is part of
_N_TURN = 10  # places that a thread measures at a time
_NORMAL = 1.4826  # standard deviations of the normal distribution in a median deviation
_N_STEPS = 6  # of a fit that only has to classify


class Features(NamedTuple):
    """Features of a group, measured against a sphere of the known radius.

    Attributes
    ----------
    x, y, z : float
        Centre in the base frame [m].
    n_points : int
        Returns on the sphere.
    n_unexplained : int
        Returns inside its limb, at about its distance, that are off the sphere.
    n_beside : int
        Returns beside and above its limb, at about its distance.
    scatter : float
        Robust standard deviation along the beams [m].
    width, height : float
        Extent of the returns on the sphere, across and along the vertical [m].
    blur : float
        Half the width of a beam there [m].
    """

    x: float
    y: float
    z: float
    n_points: int
    n_unexplained: int
    n_beside: int
    scatter: float
    width: float
    height: float
    blur: float

    @property
    def p_base(self) -> Array:
        """Return the centre in the base frame."""
        return np.array([self.x, self.y, self.z])


_N_FIELDS = len(Features._fields)


def measure_features(
    cloud: StitchedCloud, cells: Cells, seeds: Array, target: Target
) -> list[Features]:
    """Return the features of the groups where the discs of plausible seeds came to rest."""
    nearby = returns_about(cloud.p_base, cells, seeds, target.radius)

    def of_all(work: Callable[..., Array], places: Array) -> Array:
        parts = by_turns(
            lambda first, end: work(nearby, places[first:end], target),
            len(places),
            size=_N_TURN,
            threaded_from=2 * _N_TURN,
        )
        return np.concatenate(parts)

    found = of_all(_rest_discs, seeds)
    found = found[(found[:, 3] >= _N_FIT_MIN) & (found[:, 4] > 0.0)]
    found = found[np.lexsort((found[:, 2], found[:, 1], found[:, 0], -found[:, 3]))]
    places = found[thinned(found[:, :3], 0.5 * target.radius), :3]
    rows = of_all(_measured, places)
    return [
        Features(*row[:3], *(int(count) for count in row[3:6]), *row[6:])
        for row in rows.tolist()
        if row[3]
    ]


@compiled
def _rest_discs(nearby: SortedReturns, seeds: Array, target: Target) -> Array:
    """Return where the seeds' discs came to rest, their returns, and 1 if plausible, (k, 5)."""
    out = np.zeros((len(seeds), 5))
    for k in range(len(seeds)):
        c, n, is_plausible = _rest_disc(rays_near(nearby, seeds[k]), seeds[k], target)
        out[k, 0], out[k, 1], out[k, 2], out[k, 3], out[k, 4] = c[0], c[1], c[2], n, is_plausible
    return out


@compiled
def _rest_disc(rays: Array, seed: Array, target: Target) -> tuple[Array, int, bool]:
    """Return where a seed's disc comes to rest, the returns in it, and whether it is plausible.

    Plausible is a free sphere or a resolved one.
    """
    c, n = _mean_shift(rays, seed, target.up, target.radius)
    n_beside, n_below = _count_surroundings(rays, c, target)
    is_free = n_beside + n_below <= 2.0 + 0.6 * n
    return c, n, is_free or (n >= N_RESOLVED and _is_resolved(rays, c, target))


@compiled_with(fastmath=REASSOCIATED)
def _mean_shift(rays: Array, c: Array, up: Array, radius: float) -> tuple[Array, int]:
    """Return where a disc of the sphere's size comes to rest, and the number of its returns."""
    c, n = c.copy(), 0
    for _ in range(4):
        view = view_of(c, up)
        across, along, depth, n = 0.0, 0.0, 0.0, 0
        for i in range(rays.shape[1]):
            a, b, d = passing(view, rays, i)
            is_in = (
                (a * a + b * b < (1.15 * radius) ** 2) & (d > -2.0 * radius) & (d < 0.8 * radius)
            )
            across += a if is_in else 0.0
            along += b if is_in else 0.0
            depth += d if is_in else 0.0
            n += is_in
        if n == 0:
            break
        across, along, depth = across / n, along / n, depth / n + 2.0 / 3.0 * radius
        depth /= np.sqrt(c[0] ** 2 + c[1] ** 2 + c[2] ** 2)
        for axis in range(3):
            c[axis] += across * view.across[axis] + along * view.up[axis] + depth * c[axis]
    return c, n


@compiled
def _count_surroundings(rays: Array, c: Array, target: Target) -> tuple[int, int]:
    """Count the returns beside and below the limb that a free sphere on a pole does not have.

    Twice those of the emptier side: what stands beside a sphere or behind its edge is on one side.
    """
    beside, below, radius = [0, 0], [0, 0], target.radius
    blur = blur_at(c, target)
    inner2 = (1.1 * radius + blur) ** 2  # no footprint that touches the sphere is farther out
    beside2, below2 = (2.2 * radius + blur) ** 2, (2.8 * radius + blur) ** 2
    view = view_of(c, target.up)
    for i in range(rays.shape[1]):
        across, along, depth = passing(view, rays, i)
        gap2, aside = across * across + along * along, abs(across)
        is_out = (gap2 >= inner2) & ~((along < 0.0) & (aside < 0.6 * radius + blur))
        is_high, side = along > -0.5 * radius, int(across > 0.0)
        beside[side] += is_out & is_high & (gap2 < beside2) & (abs(depth) < _BACK * radius)
        # anything farther out may be another object
        is_under = is_out & ~is_high & (aside < 1.9 * radius + blur) & (gap2 < below2)
        below[side] += is_under & (depth > -3.0 * radius) & (depth < _BACK * radius)
    return 2 * min(beside[0], beside[1]), 2 * min(below[0], below[1])


@compiled
def _is_resolved(rays: Array, c: Array, target: Target) -> bool:
    """Return whether a sphere fits so closely that it need not stand free to be accepted."""
    near, limit = _within(rays, c, 2.0 * target.radius), RESOLUTION * target.radius
    _, scatter = _fit(near, c, target, 3.0 * limit)
    return bool(scatter < limit)


@compiled
def _measured(nearby: SortedReturns, places: Array, target: Target) -> Array:
    """Return the fields of ``Features`` near places, (k, 10); zeros without a sphere there."""
    out = np.zeros((len(places), _N_FIELDS))
    for k in range(len(places)):
        rays = rays_near(nearby, places[k])
        _measure(rays, places[k], target, out[k])
    return out


@compiled
def _measure(rays: Array, start: Array, target: Target, out: Array) -> None:
    """Write the features near a place; nothing if too few returns lie on a sphere there."""
    radius = target.radius
    c, _ = _fit(rays, start, target, np.inf)
    blur = blur_at(c, target)
    seen = seen_from(rays, view_of(c, target.up))
    residuals = _residuals(seen, radius)
    scatter = max(_scatter(seen, residuals, radius), NOISE_MIN)
    weights = _weights(seen, residuals, radius, blur, scatter)
    n, rms = _weighted_rms(residuals, weights)
    if n < _N_FIT_MIN:
        return
    out[0], out[1], out[2] = c[0], c[1], c[2]
    out[3], out[4] = n, _count_unexplained(seen, weights, radius)
    out[5] = _count_surroundings(rays, c, target)[0]
    out[6], out[7], out[8] = rms, _extent(seen[0], weights), _extent(seen[1], weights)
    out[9] = blur


@compiled
def _weighted_rms(residuals: Array, weights: Array) -> tuple[int, float]:
    """Return the number of residuals with a weight, and their weighted root mean square."""
    n, total, squares = 0, 0.0, 0.0
    for i in range(len(weights)):
        n += weights[i] > 0.0
        total += weights[i]
        squares += weights[i] * (residuals[i] * residuals[i])
    return n, np.sqrt(squares / total)


@compiled
def _count_unexplained(seen: Array, weights: Array, radius: float) -> int:
    """Count the returns inside the limb, at about its distance, that are off the sphere."""
    n = 0
    for i in range(len(weights)):
        x, y = seen[0, i], seen[1, i]
        is_inside = (x * x + y * y < (0.9 * radius) ** 2) & (y > -0.8 * radius)
        n += is_inside & (abs(seen[2, i]) < 2.0 * radius) & (weights[i] <= 0.0)
    return n


@compiled
def _extent(places: Array, weights: Array) -> float:
    """Return the extent of the places that have a weight [m]."""
    low, high = np.inf, -np.inf
    for i in range(len(places)):
        if weights[i] > 0.0:
            low, high = min(low, places[i]), max(high, places[i])
    return high - low


@compiled
def _fit(rays: Array, start: Array, target: Target, worst: float) -> tuple[Array, float]:
    """Return the sphere's centre near a place, and the scatter about it.

    The prior, a third of the radius on a start good to that, bounds the step of a handful of
    returns. It gives up where the scatter stays above the worst.
    """
    c, scatter = start.copy(), np.inf
    for step_no in range(_N_STEPS):
        view = view_of(c, target.up)
        seen, residuals, scatter = _residuals_about(rays, view, c, target)
        if step_no > 1 and scatter > worst:
            break
        weights = _weights(seen, residuals, target.radius, blur_at(c, target), scatter)
        N, step = _normal_equations(seen, residuals, weights, target.radius)
        for j in range(3):
            N[j, j] += (scatter / (_LOOSE * target.radius)) ** 2
        solve(N, step)
        c = _moved(c, view, step, 0.5 * target.radius)
    return c, scatter


@compiled
def _residuals_about(
    rays: Array, view: View, c: Array, target: Target
) -> tuple[Array, Array, float]:
    """Return how beams pass a sphere within its limb, their residuals, and the scatter."""
    seen = _about(rays, view, target.radius + blur_at(c, target))
    residuals = _residuals(seen, target.radius)
    return seen, residuals, _scatter(seen, residuals, target.radius)


@compiled
def _moved(c: Array, view: View, step: Array, longest: float) -> Array:
    """Return a centre after a step across, up and away from the sensor, at most the longest."""
    moved = c.copy()
    share = min(1.0, longest / (np.sqrt(step @ step) + 1e-12))
    distance = np.sqrt(c[0] ** 2 + c[1] ** 2 + c[2] ** 2)
    for axis in range(3):
        aside = step[0] * view.across[axis] + step[1] * view.up[axis]
        moved[axis] += share * (aside + step[2] * c[axis] / distance)
    return moved


@compiled
def _within(rays: Array, c: Array, reach: float) -> Array:
    """Return the rays, (3, n), within reach of a place."""
    kept = np.empty(rays.shape)
    n = 0
    for i in range(rays.shape[1]):
        x, y, z, distance = rays[0, i], rays[1, i], rays[2, i], rays[3, i]
        kept[0, n], kept[1, n], kept[2, n], kept[3, n] = x, y, z, distance
        x, y, z = distance * x - c[0], distance * y - c[1], distance * z - c[2]
        n += x * x + y * y + z * z < reach * reach
    return kept[:, :n].copy()


@compiled
def _about(rays: Array, view: View, reach: float) -> Array:
    """Return how the beams within reach of a centre pass it, (3, n)."""
    seen: Array = seen_from(rays, view)
    n = 0
    for i in range(seen.shape[1]):
        across, along, depth = seen[0, i], seen[1, i], seen[2, i]
        seen[0, n], seen[1, n], seen[2, n] = across, along, depth
        n += across * across + along * along < reach * reach
    return seen[:, :n].copy()


@compiled
def _residuals(seen: Array, radius: float) -> Array:
    """Return residuals along the beams; a beam that misses is expected at the limb."""
    residuals = np.empty(seen.shape[1])
    for i in range(len(residuals)):
        h2 = radius * radius - seen[0, i] * seen[0, i] - seen[1, i] * seen[1, i]
        residuals[i] = seen[2, i] + np.sqrt(max(h2, 0.0))
    return residuals


@compiled_with(fastmath=REASSOCIATED)
def _normal_equations(
    seen: Array, residuals: Array, weights: Array, radius: float
) -> tuple[Array, Array]:
    """Return normal matrix and right-hand side of the centre across, up, and along the beam."""
    aa, ab, ac, bb, bc, cc, pa, pb, pc = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(weights)):
        w, r, x, y = weights[i], weights[i] * residuals[i], seen[0, i], seen[1, i]
        h2 = radius * radius - x * x - y * y
        # the footprint bounds the slope at the limb
        share = -1.0 / max(np.sqrt(max(h2, 0.0)), 0.25 * radius) if h2 > 0.0 else 0.0
        a, b = share * x, share * y
        aa, ab, ac = aa + w * a * a, ab + w * a * b, ac + w * a
        bb, bc, cc = bb + w * b * b, bc + w * b, cc + w
        pa, pb, pc = pa + r * a, pb + r * b, pc + r
    N, rhs = np.empty((3, 3)), np.empty(3)  # filled by element: rows take a second to compile
    N[0, 0], N[0, 1], N[0, 2], N[1, 1], N[1, 2], N[2, 2] = aa, ab, ac, bb, bc, cc
    N[1, 0], N[2, 0], N[2, 1] = ab, ac, bc
    rhs[0], rhs[1], rhs[2] = pa, pb, pc
    return N, rhs


@compiled
def _weights(seen: Array, residuals: Array, radius: float, blur: float, scatter: float) -> Array:
    """Return Tukey's weights of the returns that may belong to the sphere."""
    weights = np.empty(len(residuals))
    limit, reach2 = 4.7 * scatter, (radius + blur) ** 2
    for i in range(len(residuals)):
        x, y, off = seen[0, i], seen[1, i], abs(residuals[i]) / limit
        is_on = (x * x + y * y < reach2) & (y > -0.9 * radius) & (off < 1.0)
        weights[i] = (1.0 - off * off) ** 2 if is_on else 0.0
    return weights


@compiled
def _scatter(seen: Array, residuals: Array, radius: float) -> float:
    """Return the robust standard deviation of the residuals inside the limb [m]."""
    inside, n, n_close, n_loose = np.empty(len(residuals) + 1), 0, 0, 0
    close, loose = _CLOSE * radius / _NORMAL, _LOOSE * radius / _NORMAL
    for i in range(len(residuals)):
        x, y, off = seen[0, i], seen[1, i], abs(residuals[i])
        is_inside = (x * x + y * y < (0.9 * radius) ** 2) & (off < 1.5 * radius)
        inside[n] = off  # overwritten by the next one unless counted
        n += is_inside
        n_close += is_inside & (off < close)
        n_loose += is_inside & (off > loose)
    if n < 3 or 2 * n_loose > n:
        return _LOOSE * radius
    if 2 * n_close > n:
        return _CLOSE * radius
    return min(max(_NORMAL * np.median(inside[:n]), _CLOSE * radius), _LOOSE * radius)
