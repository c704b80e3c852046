"""Features of a group of returns, measured against a sphere of the known radius.

Mean shift of a disc finds the place; a robust fit along the beams measures the shape.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.detection.cells import Cells, rows_about
from spheremark.pipelines.detection.target import Target, View, blur_at, seen_from, view_of
from spheremark.pipelines.estimation.linear_algebra import solve
from spheremark.pipelines.model import Array, Column, StitchedCloud
from spheremark.pipelines.threads import by_turns

NOISE_MIN = 0.006
"""Scatter of any VLP-16: a smaller sample scatter is chance [m]."""

RESOLUTION = 0.08
"""Scatter, in radii, below which a shape is rounder than stones are, whose relief is as high."""

N_RESOLVED = 60
"""Least number of returns of such a shape."""

_CLOSE, _LOOSE = 0.04, 0.3  # radii: least and most that returns may scatter about a ball
_N_TURN = 10  # places that a thread measures at a time
_NORMAL = 1.4826  # standard deviations of the normal distribution in a median deviation
_N_SHIFTS, _N_STEPS = 4, 6  # of a fit that only has to classify
_N_COARSE, _N_MANY = 9, 1000  # steps that use about so many returns at most
_REACH = 3.0  # radii about a seed: returns on a sphere that is found there, and beside it


class Features(NamedTuple):
    """Features of a group, measured against a sphere of the known radius.

    Attributes
    ----------
    x, y, z : float
        Centre in the base frame [m].
    n_points : int
        Returns on the sphere.
    n_off : int
        Returns at about its distance that are off it: inside its limb all; beside it, above its
        middle, twice those of the emptier side.
    scatter : float
        Robust standard deviation along the beams [m].
    width, height : float
        Extent of the returns on the sphere, across and along the vertical [m].
    """

    x: float
    y: float
    z: float
    n_points: int
    n_off: int
    scatter: float
    width: float
    height: float

    @property
    def p_base(self) -> Array:
        """Return the centre in the base frame."""
        return np.array([self.x, self.y, self.z])


_N_FIELDS = len(Features._fields)


def measure_features(
    cloud: StitchedCloud, cells: Cells, seeds: Array, target: Target
) -> list[Features]:
    """Return the features of the groups where the discs of seeds came to rest."""
    parts = by_turns(
        lambda first, end: _measured(cloud.p_base, cells, seeds[first:end], target),
        len(seeds),
        size=_N_TURN,
        threaded_from=2 * _N_TURN,
    )
    return [
        Features(x, y, z, int(n_points), int(n_off), scatter, width, height)
        for x, y, z, n_points, n_off, scatter, width, height in np.concatenate(parts).tolist()
        if n_points
    ]


@compiled
def _measured(p_base: Column, cells: Cells, places: Array, target: Target) -> Array:
    """Return the fields of ``Features`` near places; zeros without a sphere there."""
    out, radius = np.zeros((len(places), _N_FIELDS)), target.radius
    for k in range(len(places)):
        c, reach = places[k].copy(), _REACH * radius
        near = p_base[rows_about(p_base, cells, c, reach, reach)]
        some = near[:: 1 + len(near) // _N_MANY].copy()
        for step_no in range(_N_SHIFTS + _N_STEPS):
            view = view_of(c, target.up)
            points = some if step_no < _N_COARSE else near
            seen, blur = seen_from(points, view) / radius, blur_at(c, target) / radius
            step = _shift(seen) if step_no < _N_SHIFTS else _adjust(seen, blur)[1]
            _move(c, view, step, radius)
        seen, blur = seen_from(near, view_of(c, target.up)) / radius, blur_at(c, target) / radius
        weights, _, scatter = _adjust(seen, blur)
        across, along = seen[0][weights > 0.0], seen[1][weights > 0.0]
        if len(across):
            out[k, :3], out[k, 3], out[k, 4] = c, len(across), _n_off(seen, weights, blur)
            out[k, 5], out[k, 6], out[k, 7] = scatter, np.ptp(across), np.ptp(along)
            out[k, 5:] *= radius
    return out


@compiled
def _move(c: Array, view: View, step: Array, radius: float) -> None:
    """Move a centre across, up and away from the sensor by a step in radii, at most by one."""
    share = radius / max(float(np.sqrt(step @ step)), 1.0)
    away = step[2] / np.sqrt(c @ c)
    for axis in range(3):
        c[axis] += share * (step[0] * view.across[axis] + step[1] * view.up[axis] + away * c[axis])


@compiled
def _shift(seen: Array) -> Array:
    """Return the step from a disc's centre to that of a sphere with the mean of its returns."""
    step, n = np.zeros(3), 0
    for i in range(seen.shape[1]):
        is_in = (np.hypot(seen[0, i], seen[1, i]) < 1.15) & (-2.0 < seen[2, i] < 0.8)
        n += is_in
        step += is_in * seen[:, i]
    step /= max(n, 1)
    step[2] += 2.0 / 3.0 if n else 0.0
    return step


@compiled
def _adjust(seen: Array, blur: float) -> tuple[Array, Array, float]:
    """Return Tukey's weights of beams, the step across, up and away by them, and the scatter.

    A beam that misses is expected at the limb. The prior, a third of the radius on a start good to
    that, bounds the step of a handful of returns.
    """
    gaps = np.hypot(seen[0], seen[1])
    before = np.sqrt(np.maximum(1.0 - gaps * gaps, 0.0))
    residuals = seen[2] + before
    inside = np.abs(residuals)[(gaps < 0.9) & (np.abs(residuals) < 1.5)]
    scatter = _NORMAL * np.median(inside) if len(inside) > 2 else _LOOSE
    scatter = min(max(scatter, _CLOSE), _LOOSE)
    shares = np.maximum(1.0 - (residuals / (4.7 * scatter)) ** 2, 0.0)
    weights = np.where((gaps < 1.0 + blur) & (seen[1] > -0.9), shares * shares, 0.0)
    # the footprint bounds the slope at the limb
    J = np.where(before > 0.0, -1.0 / np.maximum(before, 0.25), 0.0) * seen
    J[2] = 1.0
    N, step = (weights * J) @ J.T, J @ (weights * residuals)
    for j in range(3):
        N[j, j] += (scatter / _LOOSE) ** 2
    solve(N, step)
    return weights, step, np.sqrt(np.sum(weights * residuals**2) / np.sum(weights))


@compiled
def _n_off(seen: Array, weights: Array, blur: float) -> int:
    """Count returns at about a sphere's distance that are off it, but for what may hold it up.

    Of those beside it, above its middle, twice those of the emptier side: what stands beside a
    sphere or behind its edge is on one side.
    """
    gaps, depths = np.hypot(seen[0], seen[1]), np.abs(seen[2])
    is_inside = (gaps < 0.9) & (seen[1] > -0.8) & (depths < 2.0) & (weights <= 0.0)
    is_beside = (gaps > 1.1 + blur) & (gaps < 2.5 + blur) & (depths < 1.0) & (seen[1] > 0.0)
    n_left, n_beside = np.sum(is_beside & (seen[0] < 0.0)), np.sum(is_beside)
    n_off: int = np.sum(is_inside) + 2 * min(n_left, n_beside - n_left)
    return n_off
