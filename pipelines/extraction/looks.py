"""What a group of returns looks like when it is taken for a ball of the known radius.

Hides how a ball is brought to rest on a group and its shape measured: mean shift of a disc, then
robust fits along the beams with known radius, with free radius, and with missing curvature.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from pipelines.extraction.ball import Ball, View, passing, seen_from, view_of
from pipelines.extraction.ground import Grid
from pipelines.extraction.patches import Patches, patches_about, points_near
from pipelines.extraction.seeds import thinned
from pipelines.threads import side_by_side
from pipelines.values import Array, StitchedCloud

NOISE_MIN = 0.006
"""Scatter of any VLP-16: what scatters less is not known better [m]."""

RESOLUTION = 0.055
"""Scatter, in radii, below which a shape is seen more closely than nature makes balls."""

N_RESOLVED = 60
"""Returns that such a shape needs at least."""

_CLOSE, _LOOSE = 0.04, 0.3  # radii: least and most that returns may scatter about a ball
_N_LOOK = 4  # returns without which there is nothing to look at
_N_WORTH = 50  # seeds that are worth a thread
_N_STEPS = 6  # of a fit that only has to tell what a group is


class Look(NamedTuple):
    """What a group looks like when it is taken for a ball of the known radius.

    Attributes
    ----------
    x, y, z : float
        Centre in the base frame [m].
    n_points : int
        Returns that the ball explains.
    n_strange : int
        Returns inside its outline, about as far away, that it does not explain.
    n_beside : int
        Returns beside and above its outline, about as far away.
    n_below : int
        Returns below and beside the pole, about as far away or somewhat nearer.
    scatter : float
        Robust standard deviation along the beams [m].
    width, height : float
        Extent of the explained returns across and along the vertical [m].
    radius_free, sigma_radius : float
        Radius when it is estimated too [m].
    scatter_free : float
        Robust standard deviation along the beams about that ball [m].
    flat_across, sigma_across : float
        How much of the ball's curvature across is missing: 0 a ball, 1 a plane.
    flat_along, sigma_along : float
        The same along the vertical: 0 a ball, 1 a post.
    """

    x: float
    y: float
    z: float
    n_points: int
    n_strange: int
    n_beside: int
    n_below: int
    scatter: float
    width: float
    height: float
    radius_free: float
    sigma_radius: float
    scatter_free: float
    flat_across: float
    sigma_across: float
    flat_along: float
    sigma_along: float

    @property
    def p_base(self) -> Array:
        """Return the centre in the base frame.

        Returns
        -------
        (3,)
            Coordinates [m].
        """
        return np.array([self.x, self.y, self.z])


_N_FIELDS = len(Look._fields)


def look_at(cloud: StitchedCloud, grid: Grid, seeds: Array, ball: Ball) -> list[Look]:
    """Return what is seen where the seeds' discs came to rest with little around them.

    Parameters
    ----------
    cloud : StitchedCloud
        One stop.
    grid : Grid
        Cells of its returns.
    seeds : (k, 3)
        Where to look [m].
    ball : Ball
        What is looked for.

    Returns
    -------
    list of Look
        What is there; places at which hardly a return lies on a ball are left out.
    """
    patches = patches_about(cloud.p_base, grid, seeds, ball.radius)
    found = np.concatenate(_shared(_approached, patches, seeds, ball))
    found = found[(found[:, 3] >= _N_LOOK) & (found[:, 4] > 0.0)]
    found = found[np.lexsort((found[:, 2], found[:, 1], found[:, 0], -found[:, 3]))]
    places = thinned(found[:, :4].copy(), 0.5 * ball.radius)[:, :3]
    rows = np.concatenate(_shared(_looked, patches, places, ball))
    return [
        Look(*row[:3], *(int(count) for count in row[3:7]), *row[7:])
        for row in rows.tolist()
        if row[3]
    ]


def _shared(
    work: Callable[[Patches, Array, Ball], NDArray[Any]],
    patches: Patches,
    places: Array,
    ball: Ball,
) -> list[NDArray[Any]]:
    """Do something at all places, shared among threads."""
    return side_by_side(
        lambda first, end: work(patches, places[first:end], ball), len(places), worth=_N_WORTH
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _approached(patches: Patches, seeds: Array, ball: Ball) -> Array:
    """Return where seeds' discs came to rest, the returns in them, and 1 if worth a look, (k, 5).

    Little lies about a free ball; one that is seen closely needs no free space to be believed.
    """
    out = np.zeros((len(seeds), 5))
    for k in range(len(seeds)):
        points = points_near(patches, seeds[k])
        c, n = _shifted(points, seeds[k], ball.up, ball.radius)
        n_beside, n_below = _surroundings(points, c, ball)
        is_free = n_beside + n_below <= 2.0 + 0.6 * n
        out[k, :3], out[k, 3] = c, n
        out[k, 4] = is_free or (n >= N_RESOLVED and _is_resolved(points, c, ball))
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _shifted(points: Array, c: Array, up: Array, radius: float) -> tuple[Array, int]:
    """Return where a disc of the ball's size comes to rest, and how many returns it holds."""
    c, n = c.copy(), 0
    for _ in range(4):
        view = view_of(c, up)
        across, along, depth, n = 0.0, 0.0, 0.0, 0
        for i in range(len(points)):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            gap2 = (x - view.x) ** 2 + (y - view.y) ** 2 + (z - view.z) ** 2
            if gap2 >= (2.31 * radius) ** 2:  # outside of the disc or its depth
                continue
            a, b, d = passing(view, x, y, z)
            if a * a + b * b < (1.15 * radius) ** 2 and -2.0 * radius < d < 0.8 * radius:
                across, along, depth, n = across + a, along + b, depth + d, n + 1
        if n == 0:
            break
        across, along, depth = across / n, along / n, depth / n + 2.0 / 3.0 * radius
        depth /= np.sqrt(c[0] ** 2 + c[1] ** 2 + c[2] ** 2)
        for axis in range(3):
            c[axis] += across * view.across[axis] + along * view.up[axis] + depth * c[axis]
    return c, n


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _within(points: Array, c: Array, reach: float) -> Array:
    """Return the points within reach of a place."""
    kept = np.empty_like(points)
    n_kept = 0
    for i in range(len(points)):
        dx, dy, dz = points[i, 0] - c[0], points[i, 1] - c[1], points[i, 2] - c[2]
        if dx * dx + dy * dy + dz * dz < reach * reach:
            kept[n_kept, 0], kept[n_kept, 1], kept[n_kept, 2] = points[i]
            n_kept += 1
    return kept[:n_kept]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _surroundings(points: Array, c: Array, ball: Ball) -> tuple[int, int]:
    """Count the returns beside and below the outline that a free ball on a pole would not have."""
    n_beside, n_below, radius = 0, 0, ball.radius
    blur = 0.5 * ball.divergence * np.sqrt(c[0] ** 2 + c[1] ** 2 + c[2] ** 2)
    inner2 = (1.1 * radius + blur) ** 2  # no footprint that touches the ball is farther out
    view = view_of(c, ball.up)
    for i in range(len(points)):
        across, along, depth = passing(view, points[i, 0], points[i, 1], points[i, 2])
        gap2 = across * across + along * along
        is_pole = along < 0.0 and abs(across) < 0.6 * radius + blur
        if gap2 < inner2 or is_pole:
            continue
        if along > -0.5 * radius:
            n_beside += gap2 < (2.2 * radius + blur) ** 2 and abs(depth) < 1.5 * radius
        else:
            is_under = abs(across) < 1.9 * radius + blur  # what is farther out stands on its own
            is_under &= gap2 < (2.8 * radius + blur) ** 2
            n_below += is_under and -3.0 * radius < depth < 1.5 * radius
    return n_beside, n_below


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _is_resolved(points: Array, c: Array, ball: Ball) -> bool:
    """Tell whether a ball fits so closely that it needs no free space about it to be believed."""
    points = _within(points, c, 2.0 * ball.radius)
    scatter = np.inf
    for step_no in range(_N_STEPS):
        N, pull, axes, scatter = _equations(points, c, ball, ball.radius)
        if step_no > 0 and scatter > 4.0 * RESOLUTION * ball.radius:
            break  # it will not come to that any more
        step = np.linalg.solve(N[:3, :3] + 1e-3 * np.eye(3), pull[:3])
        step *= min(1.0, 0.5 * ball.radius / (np.sqrt(np.sum(step**2)) + 1e-12))
        c = c + step[0] * axes[0] + step[1] * axes[1] + step[2] * axes[2]
    return scatter < 1.5 * RESOLUTION * ball.radius


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _looked(patches: Patches, places: Array, ball: Ball) -> Array:
    """Return what is seen near places, (k, 17), as ``Look`` names it; zeros if no ball is there."""
    out = np.zeros((len(places), _N_FIELDS))
    for k in range(len(places)):
        _look(points_near(patches, places[k]), places[k], ball, out[k])
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _look(points: Array, start: Array, ball: Ball, out: Array) -> None:
    """Write what is seen near a place; nothing if hardly a return lies on a ball there."""
    radius = ball.radius
    c, _, _ = _settled(points, start, ball, 3)
    blur = 0.5 * ball.divergence * np.sqrt(np.sum(c**2))
    seen = seen_from(points, view_of(c, ball.up))
    residuals, J = _shape(seen, radius)
    scatter = max(_scatter(seen, residuals, radius), NOISE_MIN)
    weights = _weights(seen, residuals, radius, blur, scatter)
    if np.sum(weights > 0.0) < _N_LOOK:
        return
    rms = np.sqrt(np.sum(weights * residuals**2) / np.sum(weights))
    noise = max(rms, NOISE_MIN)
    flat, cov_flat = _flatness(J, residuals, weights)
    c_free, radius_free, cov_free = _settled(points, c, ball, 4)
    seen_free = seen_from(points, view_of(c_free, ball.up))
    residuals_free, _ = _shape(seen_free, radius_free)
    out[:3] = c
    out[3], out[4] = np.sum(weights > 0.0), _n_strange(seen, weights, radius)
    out[5], out[6] = _surroundings(points, c, ball)
    out[7], out[8], out[9] = rms, _extent(seen[:, 0], weights), _extent(seen[:, 1], weights)
    out[10], out[11] = radius_free, noise * np.sqrt(cov_free[3, 3])
    out[12] = _scatter(seen_free, residuals_free, radius_free)
    out[13], out[14] = flat[3], noise * np.sqrt(cov_flat[3, 3])
    out[15], out[16] = flat[4], noise * np.sqrt(cov_flat[4, 4])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _n_strange(seen: Array, weights: Array, radius: float) -> int:
    """Count the returns inside the outline, about as far away, that the ball does not explain."""
    n = 0
    for i in range(len(seen)):
        is_inside = np.hypot(seen[i, 0], seen[i, 1]) < 0.9 * radius and seen[i, 1] > -0.8 * radius
        n += is_inside and abs(seen[i, 2]) < 2.0 * radius and not weights[i] > 0.0
    return n


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _extent(places: Array, weights: Array) -> float:
    """Return how far apart the places are that have a weight [m]."""
    low, high = np.inf, -np.inf
    for i in range(len(places)):
        if weights[i] > 0.0:
            low, high = min(low, places[i]), max(high, places[i])
    return high - low


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _settled(
    points: Array, start: Array, ball: Ball, n_unknowns: int
) -> tuple[Array, float, Array]:
    """Return the centre of the ball near a place, its radius, and the covariance for unit noise.

    With three unknowns the radius stays as it is, with four it is estimated too. The prior, a third
    of the radius on a start good to that, keeps a handful of returns from running away.
    """
    c, radius, inverse = start.copy(), ball.radius, np.eye(n_unknowns)
    for _ in range(_N_STEPS):
        N, pull, axes, scatter = _equations(points, c, ball, radius)
        prior = (scatter / (_LOOSE * ball.radius)) ** 2 * np.eye(n_unknowns)
        inverse = np.linalg.inv(N[:n_unknowns, :n_unknowns] + prior)
        step = np.dot(inverse, pull[:n_unknowns])
        step *= min(1.0, 0.5 * ball.radius / (np.sqrt(np.sum(step**2)) + 1e-12))
        c += step[0] * axes[0] + step[1] * axes[1] + step[2] * axes[2]
        if n_unknowns > 3:
            radius = min(max(radius + step[3], 0.3 * ball.radius), 3.0 * ball.radius)
    return c, radius, inverse


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _equations(
    points: Array, c: Array, ball: Ball, radius: float
) -> tuple[Array, Array, Array, float]:
    """Return normal matrix and right-hand side of centre and radius, in axes that come with them.

    The last is the scatter about the ball as it is [m].
    """
    view = view_of(c, ball.up)
    distance = np.sqrt(c[0] ** 2 + c[1] ** 2 + c[2] ** 2)
    axes = np.empty((3, 3))
    axes[0], axes[1], axes[2] = view.across, view.up, c / distance
    blur = 0.5 * ball.divergence * distance
    seen = _about(points, view, radius + blur)
    residuals, J = _shape(seen, radius)
    scatter = _scatter(seen, residuals, radius)
    weights = _weights(seen, residuals, radius, blur, scatter)
    N, pull = np.zeros((4, 4)), np.zeros(4)
    for i in range(len(seen)):
        if weights[i] > 0.0:
            for j in range(4):
                pull[j] += weights[i] * residuals[i] * J[i, j]
                for k in range(4):
                    N[j, k] += weights[i] * J[i, j] * J[i, k]
    return N, pull, axes, scatter


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _about(points: Array, view: View, reach: float) -> Array:
    """Return how those beams pass a centre that do so within reach."""
    seen = np.empty((len(points), 3))
    n = 0
    for i in range(len(points)):
        across, along, depth = passing(view, points[i, 0], points[i, 1], points[i, 2])
        seen[n, 0], seen[n, 1], seen[n, 2] = across, along, depth
        n += across * across + along * along < reach * reach
    return seen[:n]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _shape(seen: Array, radius: float) -> tuple[Array, Array]:
    """Return along-beam residuals and their derivatives by ball and shape.

    Derivatives, (n, 6): centre across, up and along the beam, radius, and the missing shares of the
    curvature across and along the vertical. A beam that misses is expected at the outline.
    """
    residuals: Array = np.empty(len(seen))
    J: Array = np.zeros((len(seen), 6))
    for i in range(len(seen)):
        x, y, depth = seen[i, 0], seen[i, 1], seen[i, 2]
        h2 = radius * radius - x * x - y * y
        half = np.sqrt(max(h2, 0.0))
        residuals[i] = depth + half
        J[i, 2] = 1.0
        if h2 <= 0.0:
            continue
        steep = max(half, 0.25 * radius)  # a beam's footprint keeps the outline from being a cliff
        J[i, 0], J[i, 1], J[i, 3] = -x / steep, -y / steep, -radius / steep
        J[i, 4] = half - np.sqrt(radius * radius - y * y)
        J[i, 5] = half - np.sqrt(radius * radius - x * x)
    return residuals, J


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _flatness(J: Array, residuals: Array, weights: Array) -> tuple[Array, Array]:
    """Return centre and missing curvatures, and their covariance for unit noise."""
    N, pull = 1e-6 * np.eye(5), np.zeros(5)
    for i in range(len(J)):
        if weights[i] > 0.0:
            for j in range(5):
                slope = weights[i] * J[i, j + (j > 2)]  # all but the radius
                pull[j] += slope * residuals[i]
                for k in range(5):
                    N[j, k] += slope * J[i, k + (k > 2)]
    inverse = np.linalg.inv(N)
    flat: Array = np.dot(inverse, pull)
    return flat, np.asarray(inverse, dtype=np.float64)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _weights(seen: Array, residuals: Array, radius: float, blur: float, scatter: float) -> Array:
    """Return Tukey's weights of the returns that may belong to the ball."""
    weights = np.zeros(len(seen))
    limit = 4.7 * scatter
    for i in range(len(seen)):
        is_on = np.hypot(seen[i, 0], seen[i, 1]) < radius + blur and seen[i, 1] > -0.9 * radius
        if is_on and abs(residuals[i]) < limit:
            weights[i] = (1.0 - (residuals[i] / limit) ** 2) ** 2
    return weights


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _scatter(seen: Array, residuals: Array, radius: float) -> float:
    """Return the robust standard deviation of the residuals inside the outline [m]."""
    inside = np.empty(len(seen))
    n_inside = 0
    for i in range(len(seen)):
        is_inside = np.hypot(seen[i, 0], seen[i, 1]) < 0.9 * radius
        if is_inside and abs(residuals[i]) < 1.5 * radius:
            inside[n_inside] = abs(residuals[i])
            n_inside += 1
    if n_inside < 3:
        return _LOOSE * radius
    return min(max(1.4826 * np.median(inside[:n_inside]), _CLOSE * radius), _LOOSE * radius)
