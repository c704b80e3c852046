"""The range that a beam of finite width measures to a sphere, with exact derivatives.

Hides the integral over the footprint. A beam lights an ellipse evenly; its range is the mean over
the part of the ellipse that falls on the sphere. Near the outline that is several millimetres from
the range of the central ray, and stays smooth where the central ray begins to miss.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial

from spheremark.pipelines.compilation import FUSED, compiled, compiled_with
from spheremark.pipelines.model import Array, Beams, Index

_N_STRIPS = 8  # strips of the ellipse; with 8 the mean is good to 0.01 mm of a 0.1 m ball at 8 m
_N_STRIPS_FEW = 6  # along the way to the middle, so that the outline cuts them at one end
_MIDDLE = 0.3  # radii: returns nearer to the middle belong to no side
_THIN = 1e-6  # [m]; a thinner footprint is a ray, and this one differs from it by nothing
_TINY = 1e-300


def _strips(n: int) -> Array:
    """Return heights of strips of the unit disc and their half widths, (n, 2)."""
    theta = np.pi * np.arange(1, n + 1) / (n + 1)
    return np.column_stack([np.cos(theta), np.sin(theta)])


def _rays() -> Array:
    """Return places in the unit disc and their weights, (7, 3) (Radon, 1948)."""
    r, t, s = np.sqrt([2.0 / 3.0, 1.0 / 6.0, 1.0 / 2.0])
    places = [(0, 0), (r, 0), (-r, 0), (t, s), (-t, s), (t, -s), (-t, -s)]
    return np.column_stack([places, [1.0 / 4.0, *[1.0 / 8.0] * 6]])


def _arctan() -> Array:
    """Return the series of arctan(t) / t in t squared up to t = 1, highest power first."""
    series = Chebyshev.interpolate(
        lambda square: np.arctan(np.sqrt(square)) / np.sqrt(square), 8, domain=[0.0, 1.0]
    )
    return np.array(series.convert(kind=Polynomial, domain=[-1, 1], window=[-1, 1]).coef[::-1])


_STRIPS, _STRIPS_FEW = _strips(_N_STRIPS), _strips(_N_STRIPS_FEW)
_RAYS = _rays()
_ARCTAN = _arctan()


class Prediction(NamedTuple):
    """What beams should measure to spheres.

    Attributes
    ----------
    ranges : (n,)
        Predicted ranges; for a beam that passes by, the range of its closest approach [m].
    J : (n, 4)
        Derivatives of the ranges by the centre and by the radius.
    lit : (n,)
        Share of the footprint that falls on the sphere.
    offsets : (n, 2)
        Where the middle of the beam passes the centre, along the footprint's two axes [m].
    """

    ranges: Array
    J: Array
    lit: Array
    offsets: Array


def predict(beams: Beams, centres: Array, radii: Array, which: Index) -> Prediction:
    """Predict the ranges that beams measure to spheres.

    Parameters
    ----------
    beams : Beams
        Shots; their measured ranges only scale the footprint.
    centres : (m, 3)
        Centres in the base frame [m].
    radii : (m,)
        Radii [m].
    which : (n,)
        The sphere that each beam is aimed at.

    Returns
    -------
    Prediction
        Ranges with derivatives, lit shares and offsets.

    Notes
    -----
    Rays of one beam are taken as parallel, which changes the mean by less than 0.05 mm beyond 1 m.
    Strips along the first axis are integrated in closed form, their sum is Gauss and Chebyshev's
    rule of the second kind, whose weight is the ellipse's own width; so the outline is integrated
    exactly along each strip and the mean has no steps.
    """
    half_widths = 0.5 * beams.ranges[:, None] * beams.divergence
    aim = (beams.origins_base, beams.directions_base, beams.across_base)
    return Prediction(*_predict(aim, np.maximum(half_widths, _THIN), centres, radii, which))


@compiled
def share_of_outline(directions: Array, across: Array, offsets: Array, radius: float) -> float:
    """Tell how much of a sphere's visible half has returns."""
    n = directions.shape[1]
    middle, first = np.zeros(3), np.zeros(3)
    for j in range(3):
        middle[j] = np.sum(directions[j]) / n
    # the footprint's axes turn over between the two faces of the scan, these do not
    first[np.argmin(np.abs(middle))] = 1.0
    first = np.cross(middle, first)
    first /= np.sqrt(np.sum(first**2))
    second = np.cross(middle, first)
    is_seen = np.zeros(8, dtype=np.bool_)
    for i in range(n):
        u, a, x, y = directions[:, i], across[:, i], 0.0, 0.0
        b = (u[1] * a[2] - u[2] * a[1], u[2] * a[0] - u[0] * a[2], u[0] * a[1] - u[1] * a[0])
        for j in range(3):
            passed = offsets[0, i] * a[j] + offsets[1, i] * b[j]
            x += passed * first[j]
            y += passed * second[j]
        if x * x + y * y > (_MIDDLE * radius) ** 2:
            is_seen[4 * (y < 0.0) + 2 * (x < 0.0) + (abs(y) > abs(x))] = True
    return np.sum(is_seen) / 8.0


@compiled
def _predict(
    aim: tuple[Array, Array, Array], half_widths: Array, centres: Array, radii: Array, which: Index
) -> tuple[Array, Array, Array, Array]:
    """Return the fields of ``Prediction``; ``aim`` is origins, directions and first axes."""
    origins, directions, across = aim
    n = len(origins)
    ranges, J, lit, offsets = np.empty(n), np.zeros((n, 4)), np.empty(n), np.empty((n, 2))
    for i in range(n):
        u, a = directions[i], across[i]
        b0, b1, b2 = (
            u[1] * a[2] - u[2] * a[1],
            u[2] * a[0] - u[0] * a[2],
            u[0] * a[1] - u[1] * a[0],
        )
        v = centres[which[i]] - origins[i]
        closest = v[0] * u[0] + v[1] * u[1] + v[2] * u[2]
        x0 = v[0] * a[0] + v[1] * a[1] + v[2] * a[2]
        y0 = v[0] * b0 + v[1] * b1 + v[2] * b2
        depth, by_x, by_y, by_radius, share = _mean_depth(
            x0, y0, radii[which[i]], half_widths[i, 0], half_widths[i, 1]
        )
        ranges[i] = closest - depth
        J[i, 0] = u[0] - by_x * a[0] - by_y * b0
        J[i, 1] = u[1] - by_x * a[1] - by_y * b1
        J[i, 2] = u[2] - by_x * a[2] - by_y * b2
        J[i, 3] = -by_radius
        lit[i] = share
        offsets[i, 0], offsets[i, 1] = -x0, -y0
    return ranges, J, lit, offsets


@compiled_with(fastmath=FUSED)
def depths_inside(places: Array, n: int, found: Array) -> None:
    """Find ``_mean_depth`` where footprints lie well inside the outline.

    Notes
    -----
    Radon's rule of degree five for the disc: seven rays, exact to 0.01 mm of a ball of 0.1 m where
    the footprint ends 0.1 radii inside the outline.
    """
    for i in range(n):
        x0, y0, radius = places[0, i], places[1, i], places[2, i]
        mean, by_x, by_y, by_radius = 0.0, 0.0, 0.0, 0.0
        for k in range(len(_RAYS)):
            dx, dy = places[3, i] * _RAYS[k, 0] - x0, places[4, i] * _RAYS[k, 1] - y0
            depth = np.sqrt(radius * radius - dx * dx - dy * dy)
            slope = _RAYS[k, 2] / depth
            mean += _RAYS[k, 2] * depth
            by_x += slope * dx
            by_y += slope * dy
            by_radius += slope * radius
        found[0, i], found[1, i], found[2, i], found[3, i] = mean, by_x, by_y, by_radius


@compiled_with(fastmath=FUSED)
def depths_anywhere(places: Array, n: int, found: Array) -> None:
    """Find ``_mean_depth`` without derivatives, at a small fraction of its cost.

    Notes
    -----
    Without a branch and strip by strip, so that the compiler takes several footprints at once: a
    strip that is not lit has no length.
    """
    found[:, :n] = 0.0
    _turn_to_middle(places, n)
    for k in range(len(_STRIPS_FEW)):
        height, weight = _STRIPS_FEW[k, 0], _STRIPS_FEW[k, 1]
        for i in range(n):
            x0, y0, radius = places[0, i], places[1, i], places[2, i]
            half_x, half_y = places[3, i], places[4, i]
            dy, half = half_y * height - y0, half_x * weight
            h2 = max(radius * radius - dy * dy, 0.0)
            left, depth_left = _end(-half - x0, h2)
            right, depth_right = _end(half - x0, h2)
            turn = _angle(
                right * depth_left - left * depth_right, depth_left * depth_right + left * right
            )
            found[0, i] += weight * 0.5 * (right * depth_right - left * depth_left + h2 * turn)
            found[1, i] += weight * (right - left)
    for i in range(n):
        found[0, i] = found[0, i] / found[1, i] if found[1, i] > 0.0 else 0.0


@compiled_with(fastmath=FUSED)
def _turn_to_middle(places: Array, n: int) -> None:
    """Swap axes so that strips lie along the way to the middle: across it each is lit or not."""
    for i in range(n):
        x, y, half_x, half_y = places[0, i], places[1, i], places[3, i], places[4, i]
        is_across = abs(y) > abs(x)
        places[0, i], places[1, i] = (y, x) if is_across else (x, y)
        places[3, i], places[4, i] = (half_y, half_x) if is_across else (half_x, half_y)


@compiled_with(fastmath=FUSED)
def _end(x: float, h2: float) -> tuple[float, float]:
    """Return where a strip ends, at the outline at most, and how deep the sphere is there.

    ``h2`` is the square of half the sphere's width along the strip. One root serves both.
    """
    rest = h2 - x * x
    root = np.sqrt(rest if rest > 0.0 else h2)
    outline = root if x > 0.0 else -root
    return (x, root) if rest > 0.0 else (outline, 0.0)


@compiled_with(fastmath=FUSED)
def _angle(y: float, x: float) -> float:
    """Return ``arctan2(y, x)`` for y not below zero, to 1e-8, without a branch."""
    away = abs(x)
    tangent = min(y, away) / max(y, away, _TINY)
    square, series = tangent * tangent, 0.0
    for k in range(len(_ARCTAN)):
        series = series * square + _ARCTAN[k]
    angle = tangent * series
    angle = 0.5 * np.pi - angle if y > away else angle
    return np.pi - angle if x < 0.0 else angle


@compiled
def _mean_depth(
    x0: float, y0: float, radius: float, half_x: float, half_y: float
) -> tuple[float, float, float, float, float]:
    """Return how much nearer than its centre a sphere is on average under a footprint.

    ``x0, y0`` is the centre seen from the middle of the footprint. Returns the mean, its
    derivatives by x0, y0 and radius, and the lit share.
    """
    total, total_x, total_y, total_r = 0.0, 0.0, 0.0, 0.0
    length, length_x, length_y, length_r = 0.0, 0.0, 0.0, 0.0
    full = 0.0
    for k in range(_N_STRIPS):
        weight = _STRIPS[k, 1]
        dy = half_y * _STRIPS[k, 0] - y0
        half = half_x * weight
        full += 2.0 * half * weight
        h2 = radius * radius - dy * dy
        if h2 <= 0.0:
            continue
        h = np.sqrt(h2)
        left, right = -half - x0, half - x0
        if left >= h or right <= -h:
            continue
        left_free, right_free = 1.0 * (left > -h), 1.0 * (right < h)
        left, right = max(left, -h), min(right, h)
        # at the outline depth is zero and its angle a quarter turn, without rounding
        depth_left, depth_right, turn = 0.0, 0.0, np.pi
        if left_free:
            depth_left = np.sqrt(h2 - left * left)
            turn -= 0.5 * np.pi + np.arcsin(left / h)
        if right_free:
            depth_right = np.sqrt(h2 - right * right)
            turn -= 0.5 * np.pi - np.arcsin(right / h)
        total += weight * 0.5 * (right * depth_right - left * depth_left + h2 * turn)
        length += weight * (right - left)
        total_x += weight * (depth_left - depth_right)
        length_x += weight * (left_free - right_free)
        # h depends on y0 and on the radius: dh/dy0 = dy / h, dh/dradius = radius / h
        clipped = 2.0 - left_free - right_free
        total_y += weight * turn * dy
        total_r += weight * turn * radius
        length_y += weight * clipped * dy / h
        length_r += weight * clipped * radius / h
    if length <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    mean = total / length
    return (
        mean,
        (total_x - mean * length_x) / length,
        (total_y - mean * length_y) / length,
        (total_r - mean * length_r) / length,
        length / full,
    )
