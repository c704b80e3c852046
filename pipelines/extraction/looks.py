"""What a group of returns looks like when it is taken for a ball of the known radius.

Hides how a ball is brought to rest on a group and its shape measured: mean shift of a disc, then
robust fits along the beams with known radius, with free radius, and with missing curvature.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from pipelines.extraction.ball import Ball, view
from pipelines.extraction.ground import Grid
from pipelines.extraction.patches import Patches, cells_of, gathered, near, patches_about
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
    cells = cells_of(seeds, grid)

    parts = side_by_side(
        lambda first, end: _approached(patches, seeds[first:end], cells[first:end], ball),
        len(seeds),
        worth=_N_WORTH,
    )
    found = np.concatenate(parts)
    is_free = found[:, 4] + found[:, 5] <= 2.0 + 0.6 * found[:, 3]
    is_crowded = ~is_free & (found[:, 3] >= N_RESOLVED)
    is_crowded[is_crowded] = _resolved(
        patches, found[is_crowded], cells_of(found[is_crowded, :3], grid), ball
    )
    found = found[(found[:, 3] >= _N_LOOK) & (is_free | is_crowded)]
    found = found[np.lexsort((found[:, 2], found[:, 1], found[:, 0], -found[:, 3]))]
    places = thinned(found[:, :4].copy(), 0.5 * ball.radius)[:, :3]
    looks = []
    for place, cell in zip(places, cells_of(places, grid), strict=True):
        points = gathered(patches, near(patches, cell, place))
        looks.append(_look(points, place, ball))
    return [look for look in looks if look is not None]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _approached(patches: Patches, seeds: Array, seed_cells: NDArray[np.int64], ball: Ball) -> Array:
    """Return where seeds' discs came to rest, the returns in, beside and below them, (k, 6)."""
    out = np.zeros((len(seeds), 6))
    for k in range(len(seeds)):
        points = gathered(patches, near(patches, seed_cells[k], seeds[k]))
        c, n = _shifted(points, seeds[k], ball.up, ball.radius)
        seen, _, _ = view(points, c, ball.up)
        blur = 0.5 * ball.divergence * np.sqrt(c[0] ** 2 + c[1] ** 2 + c[2] ** 2)
        n_beside, n_below = _surroundings(seen, ball.radius, blur)
        out[k, 0], out[k, 1], out[k, 2] = c[0], c[1], c[2]
        out[k, 3], out[k, 4], out[k, 5] = n, n_beside, n_below
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _shifted(points: Array, c: Array, up: Array, radius: float) -> tuple[Array, int]:
    """Return where a disc of the ball's size comes to rest, and how many returns it holds."""
    n = 0
    for _ in range(4):
        # what is farther off than this lies outside of the disc or its depth
        seen, v_across, v_up = view(_within(points, c, 2.31 * radius), c, up)
        across, along, depth, n = 0.0, 0.0, 0.0, 0
        for i in range(len(seen)):
            is_inside = seen[i, 0] ** 2 + seen[i, 1] ** 2 < (1.15 * radius) ** 2
            if is_inside and -2.0 * radius < seen[i, 2] < 0.8 * radius:
                across, along, depth = across + seen[i, 0], along + seen[i, 1], depth + seen[i, 2]
                n += 1
        if n == 0:
            break
        v_beam = c / np.linalg.norm(c)
        depth = depth / n + 2.0 / 3.0 * radius
        c = c + (across / n) * v_across + (along / n) * v_up + depth * v_beam
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
def _surroundings(seen: Array, radius: float, blur: float) -> tuple[int, int]:
    """Count the returns beside and below the outline that a free ball on a pole would not have."""
    n_beside, n_below = 0, 0
    inner = 1.1 * radius + blur  # no footprint that touches the ball is farther out
    for i in range(len(seen)):
        across, along, depth = seen[i, 0], seen[i, 1], seen[i, 2]
        gap = np.sqrt(across * across + along * along)
        is_pole = along < 0.0 and abs(across) < 0.6 * radius + blur
        if gap < inner or is_pole:
            continue
        if along > -0.5 * radius:
            n_beside += gap < 2.2 * radius + blur and abs(depth) < 1.5 * radius
        else:
            is_under = abs(across) < 1.9 * radius + blur  # what is farther out stands on its own
            is_under &= gap < 2.8 * radius + blur
            n_below += is_under and -3.0 * radius < depth < 1.5 * radius
    return n_beside, n_below


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _resolved(
    patches: Patches, found: Array, cells: NDArray[np.int64], ball: Ball
) -> NDArray[np.bool_]:
    """Tell where a ball fits so closely that it needs no free space about it to be believed."""
    out = np.zeros(len(found), np.bool_)
    for k in range(len(found)):
        c = found[k, :3].copy()
        points = _within(gathered(patches, near(patches, cells[k], c)), c, 2.0 * ball.radius)
        scatter = np.inf
        for step_no in range(_N_STEPS):
            N, pull, axes, scatter = _equations(points, c, ball, ball.radius)
            if step_no > 0 and scatter > 4.0 * RESOLUTION * ball.radius:
                break  # it will not come to that any more
            step = np.linalg.solve(N[:3, :3] + 1e-3 * np.eye(3), pull[:3])
            step *= min(1.0, 0.5 * ball.radius / (np.sqrt(np.sum(step**2)) + 1e-12))
            c = c + step[0] * axes[0] + step[1] * axes[1] + step[2] * axes[2]
        out[k] = scatter < 1.5 * RESOLUTION * ball.radius
    return out


def _look(points: Array, start: Array, ball: Ball) -> Look | None:
    """Return what is seen near a place; nothing if hardly a return lies on a ball there."""
    radius = ball.radius
    c, _, _ = _settled(points, start, ball, 3)
    blur = 0.5 * ball.divergence * float(np.linalg.norm(c))
    seen, _, _ = view(points, c, ball.up)
    residuals, J = _shape(seen, radius)
    scatter = _scatter(seen, residuals, radius)
    weights = _weights(seen, residuals, radius, blur, max(scatter, NOISE_MIN))
    is_in = weights > 0.0
    if is_in.sum() < _N_LOOK:
        return None
    is_strange = ~is_in & (np.hypot(seen[:, 0], seen[:, 1]) < 0.9 * radius)
    is_strange &= (np.abs(seen[:, 2]) < 2.0 * radius) & (seen[:, 1] > -0.8 * radius)
    rms = float(np.sqrt(np.sum(weights * residuals**2) / np.sum(weights)))
    noise = max(rms, NOISE_MIN)
    n_beside, n_below = _surroundings(seen, radius, blur)
    flat, cov_flat = _solve(J[:, [0, 1, 2, 4, 5]], residuals, weights, 1e-6)
    c_free, radius_free, cov_free = _settled(points, c, ball, 4)
    seen_free, _, _ = view(points, c_free, ball.up)
    residuals_free, _ = _shape(seen_free, radius_free)
    return Look(
        x=float(c[0]),
        y=float(c[1]),
        z=float(c[2]),
        n_points=int(is_in.sum()),
        n_strange=int(is_strange.sum()),
        n_beside=n_beside,
        n_below=n_below,
        scatter=rms,
        width=float(np.ptp(seen[is_in, 0])),
        height=float(np.ptp(seen[is_in, 1])),
        radius_free=radius_free,
        sigma_radius=noise * float(np.sqrt(cov_free[3, 3])),
        scatter_free=_scatter(seen_free, residuals_free, radius_free),
        flat_across=float(flat[3]),
        sigma_across=noise * float(np.sqrt(cov_flat[3, 3])),
        flat_along=float(flat[4]),
        sigma_along=noise * float(np.sqrt(cov_flat[4, 4])),
    )


def _settled(points: Array, c: Array, ball: Ball, n_unknowns: int) -> tuple[Array, float, Array]:
    """Return the centre of the ball near a place, its radius, and the covariance for unit noise.

    With three unknowns the radius stays as it is, with four it is estimated too. The prior, a third
    of the radius on a start good to that, keeps a handful of returns from running away.
    """
    radius, inverse = ball.radius, np.eye(n_unknowns)
    for _ in range(_N_STEPS):
        N, pull, axes, scatter = _equations(points, c, ball, radius)
        prior = (scatter / (_LOOSE * ball.radius)) ** 2 * np.eye(n_unknowns)
        inverse = np.linalg.inv(N[:n_unknowns, :n_unknowns] + prior)
        step = inverse @ pull[:n_unknowns]
        step *= min(1.0, 0.5 * ball.radius / (float(np.linalg.norm(step)) + 1e-12))
        c = c + step[:3] @ axes
        if n_unknowns > 3:
            radius = float(np.clip(radius + step[3], 0.3 * ball.radius, 3.0 * ball.radius))
    return c, radius, np.asarray(inverse)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _equations(
    points: Array, c: Array, ball: Ball, radius: float
) -> tuple[Array, Array, Array, float]:
    """Return normal matrix and right-hand side of centre and radius, in axes that come with them.

    The last is the scatter about the ball as it is [m].
    """
    seen, v_across, v_up = view(points, c, ball.up)
    distance = np.sqrt(np.sum(c**2))
    axes = np.empty((3, 3))
    axes[0], axes[1], axes[2] = v_across, v_up, c / distance
    residuals, J = _shape(seen, radius)
    scatter = _scatter(seen, residuals, radius)
    weights = _weights(seen, residuals, radius, 0.5 * ball.divergence * distance, scatter)
    N, pull = np.zeros((4, 4)), np.zeros(4)
    for i in range(len(seen)):
        if weights[i] > 0.0:
            for j in range(4):
                pull[j] += weights[i] * residuals[i] * J[i, j]
                for k in range(4):
                    N[j, k] += weights[i] * J[i, j] * J[i, k]
    return N, pull, axes, scatter


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


def _solve(J: Array, residuals: Array, weights: Array, prior: float) -> tuple[Array, Array]:
    """Return the weighted least-squares step and the inverse of its normal matrix."""
    weighted = J * weights[:, None]
    inverse = np.asarray(
        np.linalg.inv(weighted.T @ J + prior * np.eye(J.shape[1])), dtype=np.float64
    )
    return inverse @ (weighted.T @ residuals), inverse


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
