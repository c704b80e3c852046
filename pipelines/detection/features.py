"""What a group of returns looks like when it is taken for a ball of the known radius.

Hides how a ball is brought to rest on a group and its shape measured: mean shift of a disc, then
robust fits along the beams with known radius, with free radius, and with missing curvature.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import REASSOCIATED, compiled, compiled_with
from spheremark.pipelines.detection.cells import Cells
from spheremark.pipelines.detection.neighbourhoods import (
    Patches,
    patches_about,
    rays_near,
    runs_about,
)
from spheremark.pipelines.detection.seeds import thinned
from spheremark.pipelines.detection.target import Ball, View, blur_at, passing, seen_from, view_of
from spheremark.pipelines.estimation.linear_algebra import invert
from spheremark.pipelines.model import Array, Mask, StitchedCloud
from spheremark.pipelines.threads import side_by_side

NOISE_MIN = 0.006
"""Scatter of any VLP-16: what scatters less is not known better [m]."""

RESOLUTION = 0.055
"""Scatter, in radii, below which a shape is seen more closely than nature makes balls."""

N_RESOLVED = 60
"""Returns that such a shape needs at least."""

_CLOSE, _LOOSE = 0.04, 0.3  # radii: least and most that returns may scatter about a ball
_N_LOOK = 4  # returns without which there is nothing to look at
_N_WORTH = 20  # places that are worth a thread
_N_SAMPLE = 1500  # returns in the cells about a seed that tell whether to look there
_N_WHOLE = 2000  # returns there that are looked at at once
_NORMAL = 1.4826  # standard deviations of the normal distribution in a median deviation
_STRAY_SIGMAS = 4.0
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
    gain_free : float
        By how much that ball explains the returns better: likelihood ratio as a chi-square with one
        degree of freedom.
    flat_across, sigma_across : float
        How much of the ball's curvature across is missing: 0 a ball, 1 a plane.
    flat_along, sigma_along : float
        The same along the vertical: 0 a ball, 1 a post.
    blur : float
        Half the width of a beam there [m].
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
    gain_free: float
    flat_across: float
    sigma_across: float
    flat_along: float
    sigma_along: float
    blur: float

    @property
    def p_base(self) -> Array:
        """Return the centre in the base frame."""
        return np.array([self.x, self.y, self.z])


_N_FIELDS = len(Look._fields)


def look_at(cloud: StitchedCloud, cells: Cells, seeds: Array, ball: Ball) -> list[Look]:
    """Return what is seen where the seeds' discs came to rest with little around them."""
    patches = patches_about(cloud.p_base, cells, seeds, ball.radius)
    found = _shared(_approached, patches, seeds, ball)
    found = found[(found[:, 3] >= _N_LOOK) & (found[:, 4] > 0.0)]
    found = found[np.lexsort((found[:, 2], found[:, 1], found[:, 0], -found[:, 3]))]
    places = thinned(found[:, :4].copy(), 0.5 * ball.radius)[:, :3]
    rows = _shared(_looked, patches, places, ball)
    return [
        Look(*row[:3], *(int(count) for count in row[3:7]), *row[7:])
        for row in rows.tolist()
        if row[3]
    ]


def _shared(
    work: Callable[[Patches, Array, Ball], Array], patches: Patches, places: Array, ball: Ball
) -> Array:
    """Do something at all places, dealt out to threads by azimuth: neighbours share returns."""
    n, in_turn = len(places), np.argsort(np.arctan2(places[:, 1], places[:, 0]))
    dealt = np.concatenate([in_turn[0::2], in_turn[1::2]])
    mine = places[dealt]
    parts = side_by_side(lambda first, end: work(patches, mine[first:end], ball), n, worth=_N_WORTH)
    rows = np.concatenate(parts)
    found = np.empty_like(rows)
    found[dealt] = rows
    return found


@compiled
def _approached(patches: Patches, seeds: Array, ball: Ball) -> Array:
    """Return where seeds' discs came to rest, the returns in them, and 1 if worth a look, (k, 5).

    Where returns are many, a sample of them must not show clearly that it is not.
    """
    out = np.zeros((len(seeds), 5))
    for k in range(len(seeds)):
        runs = runs_about(patches, seeds[k])
        n = np.sum(runs[:, 1] - runs[:, 0])
        if n > _N_WHOLE:
            every = n / _N_SAMPLE
            rays = rays_near(patches, runs, seeds[k], every)
            if not _tried(rays, seeds[k], ball, every)[2]:
                continue
        c, n, is_worth = _tried(rays_near(patches, runs, seeds[k], 1.0), seeds[k], ball, 1.0)
        out[k, :3], out[k, 3], out[k, 4] = c, n, is_worth
    return out


@compiled
def _tried(rays: Array, seed: Array, ball: Ball, every: float) -> tuple[Array, int, bool]:
    """Return where a seed's disc comes to rest, the returns in it, and whether to look there.

    Little lies about a free ball; one that is seen closely needs no free space to be believed. Of
    a sample, one return of so many, both are asked with room for chance.
    """
    c, n = _shifted(rays, seed, ball.up, ball.radius)
    n_beside, n_below = _surroundings(rays, c, ball)
    n_about = n_beside + n_below
    room = 2.0 * np.sqrt(n + n_about) if every > 1.0 else 0.0
    is_free = n_about <= 2.0 + 0.6 * n + room
    return c, n, is_free or (n * every >= N_RESOLVED and _is_resolved(rays, c, ball, every))


@compiled_with(fastmath=REASSOCIATED)
def _shifted(rays: Array, c: Array, up: Array, radius: float) -> tuple[Array, int]:
    """Return where a disc of the ball's size comes to rest, and how many returns it holds."""
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
def _surroundings(rays: Array, c: Array, ball: Ball) -> tuple[int, int]:
    """Count the returns beside and below the outline that a free ball on a pole would not have."""
    n_beside, n_below, radius = 0, 0, ball.radius
    blur = blur_at(c, ball)
    inner2 = (1.1 * radius + blur) ** 2  # no footprint that touches the ball is farther out
    beside2, below2 = (2.2 * radius + blur) ** 2, (2.8 * radius + blur) ** 2
    view = view_of(c, ball.up)
    for i in range(rays.shape[1]):
        across, along, depth = passing(view, rays, i)
        gap2, aside = across * across + along * along, abs(across)
        is_out = (gap2 >= inner2) & ~((along < 0.0) & (aside < 0.6 * radius + blur))
        is_high = along > -0.5 * radius
        n_beside += is_out & is_high & (gap2 < beside2) & (abs(depth) < 1.5 * radius)
        # what is farther out stands on its own
        is_under = is_out & ~is_high & (aside < 1.9 * radius + blur) & (gap2 < below2)
        n_below += is_under & (depth > -3.0 * radius) & (depth < 1.5 * radius)
    return n_beside, n_below


@compiled
def _is_resolved(rays: Array, c: Array, ball: Ball, every: float) -> bool:
    """Tell whether a ball fits so closely that it needs no free space about it to be believed."""
    rays, scatter, is_sample = _within(rays, c, 2.0 * ball.radius), np.inf, every > 1.0
    for step_no in range(_N_STEPS):
        view = view_of(c, ball.up)
        seen, residuals, scatter = _residuals_about(rays, view, c, ball, ball.radius)
        if step_no > is_sample and scatter > 4.0 * RESOLUTION * ball.radius:
            break  # it will not come to that any more
        weights = _weights(seen, residuals, ball.radius, blur_at(c, ball), scatter)
        N, pull = _normals(seen, residuals, weights, ball.radius)
        c = _moved(c, view, _solved(N, pull, 1e-3, 3, 0.5 * ball.radius)[0])
    return scatter < (2.5 if is_sample else 1.5) * RESOLUTION * ball.radius


@compiled
def _looked(patches: Patches, places: Array, ball: Ball) -> Array:
    """Return what is seen near places, (k, 19), as ``Look`` names it; zeros if no ball is there."""
    out = np.zeros((len(places), _N_FIELDS))
    for k in range(len(places)):
        rays = rays_near(patches, runs_about(patches, places[k]), places[k], 1.0)
        _look(rays, places[k], ball, out[k])
    return out


@compiled
def _look(rays: Array, start: Array, ball: Ball, out: Array) -> None:
    """Write what is seen near a place; nothing if hardly a return lies on a ball there."""
    radius = ball.radius
    c, _, _ = _settled(rays, start, ball, 3)
    blur = blur_at(c, ball)
    seen = seen_from(rays, view_of(c, ball.up))
    residuals = _residuals(seen, radius)
    scatter = max(_scatter(seen, residuals, radius), NOISE_MIN)
    weights = _weights(seen, residuals, radius, blur, scatter)
    if np.sum(weights > 0.0) < _N_LOOK:
        return
    rms = np.sqrt(np.sum(weights * residuals**2) / np.sum(weights))
    noise = max(rms, NOISE_MIN)
    flat, cov_flat = _flatness(seen, residuals, weights, radius)
    c_free, radius_free, cov_free = _settled(rays, c, ball, 4)
    seen_free = seen_from(rays, view_of(c_free, ball.up))
    residuals_free = _residuals(seen_free, radius_free)
    scatter_free = _scatter(seen_free, residuals_free, radius_free)
    weights_free = _weights(seen_free, residuals_free, radius_free, blur, scatter)
    out[:3] = c
    out[3], out[4] = np.sum(weights > 0.0), _n_strange(seen, weights, radius)
    out[5], out[6] = _surroundings(rays, c, ball)
    out[7], out[8], out[9] = rms, _extent(seen[0], weights), _extent(seen[1], weights)
    out[10], out[11] = radius_free, noise * np.sqrt(cov_free[3, 3])
    out[12] = scatter_free
    is_in = (weights > 0.0) | (weights_free > 0.0)
    out[13] = _gain(residuals, residuals_free, is_in, _STRAY_SIGMAS * max(scatter, scatter_free))
    out[14], out[15] = flat[3], noise * np.sqrt(cov_flat[3, 3])
    out[16], out[17] = flat[4], noise * np.sqrt(cov_flat[4, 4])
    out[18] = blur


@compiled
def _gain(residuals: Array, others: Array, is_in: Mask, limit: float) -> float:
    """Return how much better the others explain the returns: of few, the noise is not known either.

    What is farther off than the limit is a stray, and tells nothing by how far.
    """
    n, known, free = 0, 0.0, 0.0
    for i in range(len(residuals)):
        if is_in[i]:
            n += 1
            known += min(abs(residuals[i]), limit) ** 2
            free += min(abs(others[i]), limit) ** 2
    least = n * NOISE_MIN**2
    return max(n - 4, 0) * float(np.log(max(known, least) / max(free, least)))


@compiled
def _n_strange(seen: Array, weights: Array, radius: float) -> int:
    """Count the returns inside the outline, about as far away, that the ball does not explain."""
    n = 0
    for i in range(len(weights)):
        x, y = seen[0, i], seen[1, i]
        is_inside = (x * x + y * y < (0.9 * radius) ** 2) & (y > -0.8 * radius)
        n += is_inside & (abs(seen[2, i]) < 2.0 * radius) & (weights[i] <= 0.0)
    return n


@compiled
def _extent(places: Array, weights: Array) -> float:
    """Return how far apart the places are that have a weight [m]."""
    low, high = np.inf, -np.inf
    for i in range(len(places)):
        if weights[i] > 0.0:
            low, high = min(low, places[i]), max(high, places[i])
    return high - low


@compiled
def _settled(rays: Array, start: Array, ball: Ball, n_unknowns: int) -> tuple[Array, float, Array]:
    """Return the centre of the ball near a place, its radius, and the covariance for unit noise.

    With three unknowns the radius stays as it is, with four it is estimated too. The prior, a third
    of the radius on a start good to that, keeps a handful of returns from running away.
    """
    c, radius, inverse = start.copy(), ball.radius, np.eye(n_unknowns)
    for _ in range(_N_STEPS):
        view = view_of(c, ball.up)
        seen, residuals, scatter = _residuals_about(rays, view, c, ball, radius)
        weights = _weights(seen, residuals, radius, blur_at(c, ball), scatter)
        N, pull = _normals(seen, residuals, weights, radius)
        prior = (scatter / (_LOOSE * ball.radius)) ** 2
        step, inverse = _solved(N, pull, prior, n_unknowns, 0.5 * ball.radius)
        c = _moved(c, view, step)
        if n_unknowns > 3:
            radius = min(max(radius + step[3], 0.3 * ball.radius), 3.0 * ball.radius)
    return c, radius, inverse


@compiled
def _residuals_about(
    rays: Array, view: View, c: Array, ball: Ball, radius: float
) -> tuple[Array, Array, float]:
    """Return how beams pass a ball about as near as its outline, residuals, and their scatter."""
    seen = _about(rays, view, radius + blur_at(c, ball))
    residuals = _residuals(seen, radius)
    return seen, residuals, _scatter(seen, residuals, radius)


@compiled
def _moved(c: Array, view: View, step: Array) -> Array:
    """Return a centre after a step across, up and away from the sensor."""
    moved = c.copy()
    distance = np.sqrt(c[0] ** 2 + c[1] ** 2 + c[2] ** 2)
    for axis in range(3):
        moved[axis] += step[0] * view.across[axis] + step[1] * view.up[axis]
        moved[axis] += step[2] * c[axis] / distance
    return moved


@compiled
def _solved(N: Array, pull: Array, prior: float, n: int, longest: float) -> tuple[Array, Array]:
    """Return the step of so many unknowns, shortened if need be, and the inverse normal matrix.

    The prior is the weight of each unknown being zero.
    """
    inverse, step, length2 = N[:n, :n].copy(), np.zeros(n), 0.0
    for i in range(n):
        inverse[i, i] += prior
    invert(inverse, inverse)
    for i in range(n):
        for j in range(n):
            step[i] += inverse[i, j] * pull[j]
        length2 += step[i] * step[i]
    step *= min(1.0, longest / (np.sqrt(length2) + 1e-12))
    return step, inverse


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
    """Return how those beams pass a centre that do so within reach, (3, n)."""
    seen: Array = seen_from(rays, view)
    n = 0
    for i in range(seen.shape[1]):
        across, along, depth = seen[0, i], seen[1, i], seen[2, i]
        seen[0, n], seen[1, n], seen[2, n] = across, along, depth
        n += across * across + along * along < reach * reach
    return seen[:, :n].copy()


@compiled
def _residuals(seen: Array, radius: float) -> Array:
    """Return residuals along the beams; a beam that misses is expected at the outline."""
    residuals = np.empty(seen.shape[1])
    for i in range(len(residuals)):
        h2 = radius * radius - seen[0, i] * seen[0, i] - seen[1, i] * seen[1, i]
        residuals[i] = seen[2, i] + np.sqrt(max(h2, 0.0))
    return residuals


@compiled
def _slopes(x: float, y: float, radius: float) -> tuple[float, float, float]:
    """Return the derivatives of a residual by the centre across and up, and by the radius."""
    h2 = radius * radius - x * x - y * y
    # a beam's footprint keeps the outline from being a cliff
    steep = max(np.sqrt(max(h2, 0.0)), 0.25 * radius)
    share = 1.0 / steep if h2 > 0.0 else 0.0
    return -x * share, -y * share, -radius * share


@compiled_with(fastmath=REASSOCIATED)
def _normals(seen: Array, residuals: Array, weights: Array, radius: float) -> tuple[Array, Array]:
    """Return normal matrix and right-hand side of centre across, up, along the beam, and radius."""
    aa, ab, ac, ad, bb, bc, bd, cc, cd, dd = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    pa, pb, pc, pd = 0.0, 0.0, 0.0, 0.0
    for i in range(len(weights)):
        w, r = weights[i], weights[i] * residuals[i]
        a, b, d = _slopes(seen[0, i], seen[1, i], radius)
        aa, ab, ac, ad = aa + w * a * a, ab + w * a * b, ac + w * a, ad + w * a * d
        bb, bc, bd = bb + w * b * b, bc + w * b, bd + w * b * d
        cc, cd, dd = cc + w, cd + w * d, dd + w * d * d
        pa, pb, pc, pd = pa + r * a, pb + r * b, pc + r, pd + r * d
    N, pull = np.empty((4, 4)), np.empty(4)  # quicker than from lists
    N[0], N[1], N[2], N[3] = (aa, ab, ac, ad), (ab, bb, bc, bd), (ac, bc, cc, cd), (ad, bd, cd, dd)
    pull[:] = pa, pb, pc, pd
    return N, pull


@compiled
def _flatness(seen: Array, residuals: Array, weights: Array, radius: float) -> tuple[Array, Array]:
    """Return centre and missing curvatures, and their covariance for unit noise."""
    N, pull, J = 1e-6 * np.eye(5), np.zeros(5), np.zeros(5)
    for i in range(len(weights)):
        if weights[i] > 0.0:
            x, y = seen[0, i], seen[1, i]
            half = np.sqrt(max(radius * radius - x * x - y * y, 0.0))
            J[0], J[1], _ = _slopes(x, y, radius)
            J[2] = 1.0
            J[3] = half - np.sqrt(radius * radius - y * y) if half > 0.0 else 0.0
            J[4] = half - np.sqrt(radius * radius - x * x) if half > 0.0 else 0.0
            for j in range(5):
                pull[j] += weights[i] * J[j] * residuals[i]
                for k in range(5):
                    N[j, k] += weights[i] * J[j] * J[k]
    inverse = np.linalg.inv(N)
    flat: Array = np.dot(inverse, pull)
    return flat, np.asarray(inverse, dtype=np.float64)


@compiled
def _weights(seen: Array, residuals: Array, radius: float, blur: float, scatter: float) -> Array:
    """Return Tukey's weights of the returns that may belong to the ball."""
    weights = np.empty(len(residuals))
    limit, reach2 = 4.7 * scatter, (radius + blur) ** 2
    for i in range(len(residuals)):
        x, y, off = seen[0, i], seen[1, i], abs(residuals[i]) / limit
        is_on = (x * x + y * y < reach2) & (y > -0.9 * radius) & (off < 1.0)
        weights[i] = (1.0 - off * off) ** 2 if is_on else 0.0
    return weights


@compiled
def _scatter(seen: Array, residuals: Array, radius: float) -> float:
    """Return the robust standard deviation of the residuals inside the outline [m]."""
    inside, n, n_close, n_loose = np.empty(len(residuals) + 1), 0, 0, 0
    close, loose = _CLOSE * radius / _NORMAL, _LOOSE * radius / _NORMAL
    for i in range(len(residuals)):
        x, y, off = seen[0, i], seen[1, i], abs(residuals[i])
        is_inside = (x * x + y * y < (0.9 * radius) ** 2) & (off < 1.5 * radius)
        inside[n] = off  # kept only if the next one does not take its place
        n += is_inside
        n_close += is_inside & (off < close)
        n_loose += is_inside & (off > loose)
    if n < 3 or 2 * n_loose > n:
        return _LOOSE * radius
    if 2 * n_close > n:
        return _CLOSE * radius
    return min(max(_NORMAL * np.median(inside[:n]), _CLOSE * radius), _LOOSE * radius)
