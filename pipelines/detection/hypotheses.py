"""Other hypotheses about a group: a post or a smaller sphere that explains its beams better.

Hides the likelihood of the beams given a shape: the places and depths of the returns on it and the
beams that pass it. A far group has too few returns to test one property after another; the
likelihood of all its beams together still differs between shapes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.detection.features import Features
from spheremark.pipelines.detection.target import Target
from spheremark.pipelines.model import Array, Mask

_SMALL = (0.3, 0.7)  # radii of a smaller sphere
_POST = (0.05, 1.1)  # radii of a post
_STARTS_POST = (0.25, 0.6, 1.0)
_LOW, _HIGH = -3.0, 2.0  # radii below and above the centre whose beams are used
_ASIDE = 1.6  # radii to a side, beside half a beam
_BAND = 0.5  # radii: height of the bands in which beams past a shape may lack returns
_N_BANDS = int((_HIGH - _LOW) / _BAND)
_ON = (-2.0, 1.0)  # radii of depth of returns that may lie on the shape
_PAST = 8.5  # radii of depth: anything nearer may mix with the shape in one echo
_OUTLIER_SHARE = 0.02  # share of beams that hit and do not show it, or pass and seem to hit
_EDGE, _SIGMA_EDGE = 0.6, 0.4  # half widths of a beam outside the outline where half the beams hit
_EDGES = (-0.5, 1.2)
_SOFT = (0.1, 0.3)  # radii, and half widths besides, over which beams come to hit
_POLE_FROM = 0.7  # radii below the centre a pole may be seen
_HELD = 0.85  # radii: a lower return may be the pole's
_MEAN_WIDTH = 0.75  # of the greater half width of a beam: in any direction
_LIMB = 0.08  # radii: standard deviation of the depth of a beam at the limb
_CLIP = 9.0  # squared standard deviations: anything farther off is an outlier
_TINY = 1e-200  # products of probabilities below it are turned into logarithms
_N_ROUNDS, _N_HALVINGS = 2, 4
_POST_DENSITY = (
    0.45  # density of a post's returns below, at least, over that at the sphere's height
)
_SPREAD_SMALL = 0.75  # of the spread of a sphere's returns: less may be that of a smaller sphere
_N_CLEAR = 60  # returns that show a shape by themselves


class LikelihoodRatios(NamedTuple):
    """Log likelihood ratios of other shapes against the sphere of the known radius.

    Attributes
    ----------
    post : float
        That of the best upright post; minus infinity where a post was excluded beforehand.
    small : float
        That of the best smaller sphere; minus infinity likewise.
    half_width_post, radius_small : float
        Sizes of these two [m].
    """

    post: float
    small: float
    half_width_post: float
    radius_small: float


def compare_hypotheses(
    features: Features, seen: Array, spread: float, target: Target, noise: float
) -> LikelihoodRatios:
    """Compare the sphere of the known radius with a post and with smaller spheres.

    Notes
    -----
    Beams are spread evenly over the outline of a shape and its surroundings. Against the sky beams
    past it have no return: only the hits are known, and their density is that over the area of the
    shape. The place where a wide beam begins to hit is an unknown with a prior. Ranges are those
    to the part of a beam that is on the shape.
    """
    blur = features.blur / target.radius
    found = _log_ratios(seen / target.radius, blur, noise / target.radius, spread)
    return LikelihoodRatios(found[0], found[1], found[2] * target.radius, found[3] * target.radius)


class _Beams(NamedTuple):
    """Beams about a group, in radii.

    Attributes
    ----------
    hits : (3, n)
        Where returns at its depth pass the centre, across and up, and how much deeper they lie.
    on : (n,)
        Which of them are on the sphere of the known radius, and not on its pole.
    passes : (2, m)
        Where beams that end far behind pass the centre.
    is_dark : (k,)
        Bands from low to high in which no beam goes past, and none ends before.
    n_dark : int
        Hits in these bands.
    blur, noise : float
        Half the width of a beam, and the standard deviation of a range.
    """

    hits: Array
    on: Mask
    passes: Array
    is_dark: Mask
    n_dark: int
    blur: float
    noise: float


# A shape is seven numbers: centre across, up, in depth; radius; edge in half widths of a beam; half
# width of its pole, and the share of the beams there that hit. A post ends at its centre upwards.
_X, _Y, _DEPTH, _RADIUS, _EDGED, _POLE, _SHARE = range(7)
_IS_BALL, _IS_POST = np.int64(0), np.int64(1)  # no literals: one compiled form serves both
_STEPS = np.array([0.2, 0.2, 0.1, 0.1, 0.3, 0.1, 0.3])


@compiled
def _log_ratios(
    seen: Array, blur: float, noise: float, spread: float
) -> tuple[float, float, float, float]:
    """Return the fields of ``LikelihoodRatios``."""
    beams = _sorted_beams(seen, blur, noise)
    n_on, highest = 0, 0.0
    for i in range(beams.hits.shape[1]):
        n_on += beams.on[i]
        highest = beams.hits[1, i] if i == 0 else max(highest, beams.hits[1, i])
    is_few = n_on < _N_CLEAR
    may_be_post = is_few and _goes_on_below(beams)
    may_be_small = is_few and spread < _SPREAD_SMALL
    post, small, half_width, radius = -np.inf, -np.inf, 0.0, 0.0
    if not (may_be_post or may_be_small):
        return post, small, half_width, radius
    shape = np.array([0.0, 0.0, 0.0, 1.0, _EDGE, 0.2, 0.5])
    known = _best(beams, shape, (1.0, 1.0), _IS_BALL)[0]
    if may_be_post:
        for start in _STARTS_POST:
            shape = np.array([0.0, highest + 0.05, start - 1.0, start, _EDGE, 0.0, 0.0])
            gain, shape = _best(beams, shape, _POST, _IS_POST)
            if gain - known > post:
                post, half_width = gain - known, shape[_RADIUS]
    if may_be_small:
        shape = np.array([0.0, 0.0, -0.4, 0.6, _EDGE, 0.2, 0.5])
        gain, shape = _best(beams, shape, _SMALL, _IS_BALL)
        small, radius = gain - known, shape[_RADIUS]
    return post, small, half_width, radius


@compiled
def _sorted_beams(seen: Array, blur: float, noise: float) -> _Beams:
    """Return the beams sorted into hits, passes and dark bands."""
    n = seen.shape[1]
    hits, passes, on = np.empty((3, n)), np.empty((2, n)), np.empty(n, np.bool_)
    is_dark, counts = np.ones(_N_BANDS, np.bool_), np.zeros(_N_BANDS, np.int64)
    n_hits, n_passes, n_dark = 0, 0, 0
    for i in range(n):
        x, y, depth = seen[0, i], seen[1, i], seen[2, i]
        if abs(x) > _ASIDE + blur or y < _LOW or y >= _HIGH:
            continue
        band = int((y - _LOW) / _BAND)
        if _ON[0] < depth < _ON[1]:
            hits[0, n_hits], hits[1, n_hits], hits[2, n_hits] = x, y, depth
            on[n_hits] = np.hypot(x, y) < 1.0 + blur and y > -_HELD
            n_hits += 1
            counts[band] += 1
        elif depth >= _PAST:
            passes[0, n_passes], passes[1, n_passes] = x, y
            n_passes += 1
        is_dark[band] &= _ON[0] < depth < _PAST
    for band in range(_N_BANDS):
        n_dark += counts[band] if is_dark[band] else 0
    return _Beams(
        hits[:, :n_hits].copy(),
        on[:n_hits].copy(),
        passes[:, :n_passes].copy(),
        is_dark,
        n_dark,
        blur,
        noise,
    )


@compiled
def _goes_on_below(beams: _Beams) -> bool:
    """Return whether returns below a sphere are about as dense as at its height."""
    n_middle, n_low, begins = 0, 0, -1.1 - beams.blur
    for i in range(beams.hits.shape[1]):
        is_near = abs(beams.hits[0, i]) < 1.0 + beams.blur
        n_middle += is_near and abs(beams.hits[1, i]) < _HELD
        n_low += is_near and beams.hits[1, i] < begins
    return n_low * 2.0 * _HELD > _POST_DENSITY * n_middle * (begins - _LOW)


@compiled
def _best(
    beams: _Beams, shape: Array, radii: tuple[float, float], kind: int
) -> tuple[float, Array]:
    """Return the greatest likelihood of a kind of shape near a first guess, and that shape.

    Pattern search (Hooke and Jeeves, 1961), because the likelihood is not smooth.
    """
    low = np.array([-1.0, -1.0, -2.0, radii[0], _EDGES[0], 0.05, _OUTLIER_SHARE])
    high = np.array([1.0, _HIGH, 2.0, radii[1], _EDGES[1], 0.35, 1.0 - _OUTLIER_SHARE])
    best, steps = _likelihood(beams, shape, kind), _STEPS.copy()
    for _ in range(_N_HALVINGS):
        for _ in range(_N_ROUNDS):
            for j in range(_POLE if kind == _IS_POST else 7):
                for sign in (-1.0, 1.0):
                    trial = shape.copy()
                    trial[j] = min(max(shape[j] + sign * steps[j], low[j]), high[j])
                    gain = _likelihood(beams, trial, kind)
                    if gain > best:
                        best, shape = gain, trial
        steps *= 0.5
    return best, shape


@compiled
def _likelihood(beams: _Beams, shape: Array, kind: int) -> float:
    """Return the logarithm of the likelihood of a shape."""
    total, product = -0.5 * ((shape[_EDGED] - _EDGE) / _SIGMA_EDGE) ** 2, 1.0
    for i in range(beams.hits.shape[1]):
        x, y = beams.hits[0, i] - shape[_X], beams.hits[1, i] - shape[_Y]
        product *= _hit_probability(x, y, shape, beams.blur, kind)
        if beams.on[i]:
            gap = abs(x) if kind == _IS_POST else np.hypot(x, y)
            depth, off = _depth(gap, shape[_RADIUS], _MEAN_WIDTH * beams.blur)
            variance = beams.noise**2 + off**2
            z2 = (beams.hits[2, i] - shape[_DEPTH] - depth) ** 2 / variance
            total -= 0.5 * min(z2, _CLIP)
            product *= beams.noise / np.sqrt(variance) if off > 0.0 else 1.0
        if product < _TINY:
            total, product = total + np.log(product), 1.0
    for i in range(beams.passes.shape[1]):
        x, y = beams.passes[0, i] - shape[_X], beams.passes[1, i] - shape[_Y]
        product *= 1.0 - _hit_probability(x, y, shape, beams.blur, kind)
        if product < _TINY:
            total, product = total + np.log(product), 1.0
    total += np.log(product)
    if beams.n_dark:
        total -= beams.n_dark * np.log(_dark_area(beams, shape, kind))
    return float(total)


@compiled
def _hit_probability(x: float, y: float, shape: Array, blur: float, kind: int) -> float:
    """Return the probability that a beam hits a shape whose centre it passes at (x, y)."""
    soft = _SOFT[0] + _SOFT[1] * blur
    outer = shape[_RADIUS] + shape[_EDGED] * blur
    if kind == _IS_POST:
        share = min(max((outer - abs(x)) / soft + 0.5, 0.0), 1.0) if y < 0.0 else 0.0
    else:
        share = min(max((outer - np.hypot(x, y)) / soft + 0.5, 0.0), 1.0)
        if share < shape[_SHARE] and y < -_POLE_FROM * shape[_RADIUS]:
            inside = (shape[_POLE] + shape[_EDGED] * blur - abs(x)) / soft + 0.5
            share = max(share, shape[_SHARE] * min(max(inside, 0.0), 1.0))
    return _OUTLIER_SHARE + (1.0 - 2.0 * _OUTLIER_SHARE) * share


@compiled
def _depth(gap: float, radius: float, half: float) -> tuple[float, float]:
    """Return the mean depth of the part of a beam on a round shape, and its standard deviation."""
    if gap + half < radius:
        return -np.sqrt(radius * radius - gap * gap), 0.0
    low, high = min(max(gap - half, 0.0), 0.99 * radius), min(gap + half, radius)
    area = high * np.sqrt(radius * radius - high * high) + radius**2 * np.arcsin(high / radius)
    area -= low * np.sqrt(radius * radius - low * low) + radius**2 * np.arcsin(low / radius)
    return -0.5 * area / (high - low), _LIMB


@compiled
def _dark_area(beams: _Beams, shape: Array, kind: int) -> float:
    """Return the area where beams would hit a shape, in the dark bands."""
    outer = shape[_RADIUS] + shape[_EDGED] * beams.blur
    pole = 2.0 * shape[_SHARE] * (shape[_POLE] + shape[_EDGED] * beams.blur)
    area = 0.0
    for band in range(_N_BANDS):
        if not beams.is_dark[band]:
            continue
        low = _LOW + band * _BAND - shape[_Y]
        area += _BAND * _OUTLIER_SHARE * 2.0 * (_ASIDE + beams.blur)
        if kind == _IS_POST:
            area += 2.0 * max(outer, 0.0) * min(max(-low, 0.0), _BAND)
        else:
            y = low + 0.5 * _BAND
            width = 2.0 * np.sqrt(max(outer * outer - y * y, 0.0))
            area += _BAND * max(width, pole if y < -_POLE_FROM * shape[_RADIUS] else 0.0)
    return area
