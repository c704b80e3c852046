"""The shapes that may stand at a place, and the likelihood of the beams about it given one.

Hides surfaces, outlines, poles, and what becomes of a beam that an outline divides. Lengths are in
radii of the sphere that is searched for; x is across the line of sight, y up it, z along it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.detection.beams import NEAR, Beams
from spheremark.pipelines.model import Array

NAMES = (
    "sphere",
    "sphere of another radius",
    "boulder on the ground",
    "head on shoulders",
    "short cylinder",
    "post",
    "solid of another shape",
    "panel, edge or leaf",
    "foliage or other clutter",
)
"""What may stand at a place; the first is a marker."""

SPHERE, BALL, BOULDER, HEAD, CYLINDER, POST, SOLID, PANEL, CLUTTER = range(len(NAMES))

# Places of the parameters of a shape: centre, at the mean depth of its surface; logarithm of the
# noise; half widths of a beam outside an outline where half the beams hit, before an empty sky and
# before what sends an echo of its own; logarithm of how much wider a beam is along the spin axis
# than its data sheet says; that of the scatter of beams about their stated directions, in half
# widths of a beam; that of a stretch of depths; up to ten of form; the place of one face of the
# scan against the other; logarithm of the width of the pole over that of what it holds
X, Y, Z, NOISE, EDGE, ALONG, SCATTER, STRETCH, FORM, SHIFT, POLE, N_PARAMETERS = (
    *(0, 1, 2, 3, 4, 6, 7, 8, 9, 19, 22, 23),
)

MEAN = 2.0 / 3.0  # of a radius: mean height of a sphere's surface over its disc
_POLE_FROM, _POLE_SHARE = 0.8, 0.7  # radii below a centre that a pole begins; of its beams it stops
_POLE_MOST = 0.9  # of the radius of what it holds: half the width of a pole
_OFF_AXIS, _POLE_SCATTER = 0.1, 0.1  # radii: of upright poles, and of their surface about a line
_POLE_DEPTH = 0.4  # radii off the axis: legs of tripods, and poles that lean
_STRAY = 0.02  # share of the returns from a surface that lie anywhere: crosstalk, dust, strays
_MERGED = 0.6  # share of the echoes of a beam that an outline halves, between it and what is behind
_MISPLACED = 0.01  # share of the beams on a solid surface that seem to end behind it
_SOFT = (0.07, 0.35)  # radii, and half widths of a beam besides, over which beams come to hit
_STEP = 4.5  # width of a smooth step over the standard deviation of its derivative: 20 ** 0.5
_LEAST_COSINE = 0.3  # of the incidence on a round surface, whose limb would be infinitely steep
_N_ALIKE = 500.0  # beams that share errors of the model so that each counts as half a beam
_LEAST_BEHIND = 0.1  # radii from a surface to what is behind it: anything nearer touches it
_UNEVEN = 0.05  # share of that distance by which what is behind may be nearer or farther
_FLOOR = 1e-9


class _Beam(NamedTuple):
    """How far outside an outline a beam comes to hit; half its width; its scatter [radii]."""

    edge: float
    across: float
    up: float
    scatter: float


@compiled
def _normal(off: float, sigma: float) -> float:
    """Return the density of a normal distribution about zero."""
    return float(np.exp(-0.5 * off * off / (sigma * sigma)) / (2.5066283 * sigma))


@compiled
def _inside(inner: float, blur: float, beam: _Beam) -> float:
    """Return the probability that a beam hits what it passes so far inside the outline of."""
    soft = np.sqrt((_SOFT[0] + _SOFT[1] * blur) ** 2 + (_STEP * beam.scatter) ** 2)
    share = float(min(max((inner + beam.edge * blur) / soft + 0.5, 0.0), 1.0))
    return share * share * (3.0 - 2.0 * share)


@compiled
def _divided(inner: float, blur: float) -> float:
    """Return how evenly an outline divides a beam that passes so far inside it: 0 to 1."""
    share = inner / (blur + _FLOOR)
    return max(1.0 - share * share, 0.0)


@compiled
def _round(gap: float, radius: float, blur: float) -> float:
    """Return the mean depth of the part of a beam on a round surface, from its centre or axis."""
    middle = gap if gap + blur < radius else 0.5 * (min(max(gap - blur, 0.0), radius) + radius)
    return -float(np.sqrt(max(radius * radius - middle * middle, 0.0)))


@compiled
def _slope(depth: float, radius: float) -> float:
    """Return the tangent of the incidence on a round surface at a depth from its centre or axis."""
    cosine = -depth / radius
    return float(np.sqrt(max(1.0 - cosine * cosine, 0.0)) / max(cosine, _LEAST_COSINE))


@compiled
def _optics_of(shape: Array, beams: Beams) -> _Optics:
    """Return half the width of a beam across and up, and the scatter of beams."""
    widths, wider = beams.widths, np.exp(shape[ALONG])
    across = np.hypot(widths[0, 0], wider * widths[0, 1])
    scatter = np.exp(shape[SCATTER]) * np.sqrt(0.5 * (widths * widths).sum())
    return across, np.hypot(widths[1, 0], wider * widths[1, 1]), scatter


@compiled
def _beam(shape: Array, optics: _Optics, beams: Beams, i: int) -> _Beam:
    """Return what is known of a beam."""
    empty = beams.empty[i]
    edge = empty * shape[EDGE] + (1.0 - empty) * (shape[EDGE + 1] + beams.even[i])
    return _Beam(edge, optics[0], optics[1], optics[2])


@compiled
def _unheard(share: float, hearing: _Hearing) -> float:
    """Return the probability that a beam that is partly on an object has no return."""
    lost, faintest = hearing
    heard = min(max(share / faintest - 0.5, 0.0), 1.0)
    return 1.0 - heard * (1.0 - max(_MISPLACED, lost))


_Form = tuple[float, float, float, float]
_Optics = tuple[float, float, float]  # half the width of a beam across and up, and the scatter
_Hit = tuple[float, float, float, float]  # share of a beam on a surface, depth, divided, slope
_Off = tuple[float, float, float]  # depth off the axis of a pole, off its surface; its scatter
_Pole = tuple[float, float, float, float]  # depth off its place, variance; beams on it, and not
_Hearing = tuple[float, float]  # ``lost`` and ``faintest`` of ``Beams``


@compiled
def _form_of(kind: int, shape: Array) -> _Form:
    """Return what the surface of a shape is computed with."""
    a, b = np.exp(shape[FORM]), np.exp(shape[FORM + 1])
    if kind <= HEAD:
        return a, b, np.exp(shape[FORM + 2] + shape[STRETCH]), 0.0
    if kind == CLUTTER:
        return a, 1.0 / (1.0 + 1.0 / b), np.exp(2.0 * shape[FORM + 2]), 0.0
    if kind == SOLID:  # as much lower than wide as its waves make it
        return a, np.exp(shape[FORM + 4] - shape[FORM + 1]), 0.0, 0.0
    return a, b, shape[FORM + 2], shape[FORM + 3]


@compiled
def _surface(kind: int, x: float, y: float, shape: Array, form: _Form, beam: _Beam) -> _Hit:
    """Return the share of a beam on an object, the depth, how evenly it is divided, and the slope.

    An ellipsoid is taken to be as steep as a ball.
    """
    (a, b, c, d), blur_across, blur_up = form, beam.across, beam.up
    if kind == SOLID:
        hit: _Hit = _solid(x, y, shape[FORM:SHIFT], beam)
        return hit
    if kind <= HEAD or kind == CLUTTER:
        gap2 = x * x + y * y + _FLOOR
        blur = np.sqrt(((blur_across * x) ** 2 + (blur_up * y) ** 2) / gap2)
        if kind == CLUTTER:
            return b * _inside(a - np.sqrt(gap2), blur, beam), 0.0, 0.0, 0.0
        gap = np.sqrt(x * x + y * y / (b * b))
        inner = (a - gap) * min(b, 1.0)
        share, divided = _inside(inner, blur, beam), _divided(inner, blur)
        if share + divided <= 0.0:
            return 0.0, 0.0, 0.0, 0.0
        depth = _round(gap, a, blur)
        return share, c * (depth + MEAN * a), divided, c * _slope(depth, a)
    over = b - y if kind == POST else b - abs(y)
    share = min(_inside(a - abs(x), blur_across, beam), _inside(over, blur_up, beam))
    divided = min(a - abs(x), over * blur_across / (blur_up + _FLOOR))
    divided = _divided(divided, blur_across)
    if kind == PANEL:
        return share, c * x + d * y, divided, np.sqrt(c * c + d * d)
    depth = _round(abs(x), a, blur_across)
    return share, depth + MEAN * a, divided, _slope(depth, a)


@compiled
def _share_on_pole(x: float, pole: float, beam: _Beam) -> float:
    """Return the share of a beam that a pole stops, by half its width: a thin one covers a part."""
    blur = beam.across
    return float(_POLE_SHARE * pole / (pole + 0.5 * blur) * _inside(pole - abs(x), blur, beam))


@compiled
def _ended(rest: float, share: float, z: float, h: _Hearing) -> float:
    """Return the density of a beam without a return near, of which a pole would stop a share."""
    return share * (_unheard(share, h) if z == np.inf else _MISPLACED) + (1.0 - share) * rest


@compiled
def _stopped(
    rest: float, share: float, off: _Off, pole: _Pole, passing: float
) -> tuple[float, _Pole]:
    """Return the density of a beam of which a pole stops a share, and the pole as known after it.

    ``rest`` is the density of what becomes of the others; ``off`` is how much deeper the beam ends
    than the axis and the surface of an upright round pole, and the scatter of returns about that;
    ``passing`` is the share of the beam that passes what the pole holds.
    What earlier beams show of a pole is expected of the next: where it is off the axis of what it
    holds by a constant (as by a Kalman filter), and how many of its returns are about there. The
    product is the likelihood of all beams, and each depth is judged by those before it.
    """
    (axis, surface, noise), (mean, variance, n_on, n_off) = off, pole
    straight = n_on / (n_on + n_off) * _normal(surface - mean, np.sqrt(variance + noise * noise))
    on_pole = share * (straight + n_off / (n_on + n_off) * _normal(axis, _POLE_DEPTH))
    density = on_pole + (1.0 - share) * rest
    is_straight = passing * share * straight / (density + _FLOOR)
    variance = 1.0 / (1.0 / variance + is_straight / (noise * noise))
    mean += is_straight * variance / (noise * noise) * (surface - mean)
    n_off += passing * on_pole / (density + _FLOOR) - is_straight
    return density, (mean, variance, n_on + is_straight, n_off)


@compiled
def _solid(x: float, y: float, form: Array, beam: _Beam) -> _Hit:
    """Return what ``_surface`` does, of a deformed sphere.

    Its outline has waves of two and three in a turn, its depth any tilt and curvature.
    """
    gap = np.sqrt(x * x + y * y + _FLOOR)
    blur = np.sqrt((beam.across * x) ** 2 + (beam.up * y) ** 2) / gap
    c, s = x / gap, y / gap
    c2, s2 = c * c - s * s, 2.0 * s * c
    waves = form[1] * c2 + form[2] * s2
    waves += form[3] * (c * c2 - s * s2) + form[4] * (s * c2 + c * s2)
    radius, ratio = np.exp(form[0]), np.exp(waves)
    inner = radius * ratio - gap
    share, divided = _inside(inner, blur, beam), _divided(inner, blur)
    if share + divided <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    depth = _round(gap / ratio, radius, blur)
    slope = _slope(depth, radius) / ratio + 2.0 * form[7] * gap + form[5] * c + form[6] * s
    depth += MEAN * radius + form[5] * x + form[6] * y
    depth += form[7] * (gap * gap - 0.5) + gap * gap * (form[8] * c2 + form[9] * s2)
    return share, depth, divided, slope


@compiled
def _on_surface(kind: int, share: float, off: float, sigma: float, z: float, h: _Hearing) -> float:
    """Return the density of a beam of which a surface stops a share; it ends so far off that."""
    if z < NEAR:
        stray = (_STRAY + _MERGED * 4.0 * share * (1.0 - share)) / (2.0 * NEAR)
        return float(stray + (1.0 - _STRAY) * _normal(off, sigma))
    if z == np.inf and kind != CLUTTER:  # leaves have gaps anyway
        return float(_unheard(share, h))
    return _MISPLACED


@compiled
def _merged(
    apart: float, share: float, beams: Beams, i: int, surface: tuple[float, float]
) -> float:
    """Return the density of a beam whose echoes from a surface and from behind it may be one.

    The one range lies anywhere between the two. ``apart`` is the density where they are two,
    ``share`` the probability that they are one, ``surface`` how deep it is, and the noise.
    """
    if share <= 0.0:
        return apart
    (depth, sigma), z, one = surface, beams.z[i] - surface[0], _STRAY * beams.behind[i]
    gap, far = max(beams.away[i] - depth, _LEAST_BEHIND), NEAR - depth
    if z == np.inf:
        one += _MISPLACED
    elif z >= far:  # only that it ends so deep is known
        one += max(1.0 - far / gap, _MISPLACED)
    else:
        low, high = z / sigma, (gap - z) / (sigma + _UNEVEN * gap)
        one += 1.0 / (gap * (1.0 + np.exp(-max(low, -30.0))) * (1.0 + np.exp(-max(high, -30.0))))
    return float(share * one + (1.0 - share) * apart)


@compiled
def _held_at(kind: int, form: _Form) -> tuple[float, float]:
    """Return how high over its middle a pole holds an object, and how deep the axis lies there."""
    if kind == PANEL:
        return -form[1], 0.0
    return -form[1] if kind == CYLINDER else -_POLE_FROM * form[0] * form[1], MEAN * form[0]


@compiled
def trust(beams: Beams) -> float:
    """Return the information of a beam among others, as a share of its information alone."""
    return 1.0 / (1.0 + len(beams.x) / _N_ALIKE)


@compiled
def log_likelihood(kind: int, shape: Array, prior: Array, beams: Beams, densities: Array) -> float:
    """Return the logarithm of likelihood times prior density of a shape; write those of beams."""
    total, product, form = 0.0, 1.0, _form_of(kind, shape)
    pole = form[0] * min(np.exp(shape[POLE]), _POLE_MOST) if prior[1, POLE] > 0.0 else 0.0
    variance = form[2] if kind == CLUTTER else np.exp(2.0 * shape[NOISE])
    sigma = np.sqrt(variance)
    bottom, behind = _held_at(kind, form)
    hearing, optics = (beams.lost, beams.faintest), _optics_of(shape, beams)
    known = (0.0, _OFF_AXIS * _OFF_AXIS, 1.0, 1.0)  # half of the poles are upright, or any share
    for i in range(len(beams.x)):
        x = beams.x[i] - shape[X] - beams.face[i] * shape[SHIFT]
        y = beams.y[i] - shape[Y] - beams.face[i] * shape[SHIFT + 1]
        moved = shape[Z] + beams.face[i] * shape[SHIFT + 2]
        z = beams.z[i] - moved
        rest, beam = beams.behind[i], _beam(shape, optics, beams, i)
        share, depth, divided, slope = _surface(kind, x, y, shape, form, beam)
        spread = np.sqrt(variance + (slope * beam.scatter) ** 2)
        if pole > 0.0 and y < bottom:
            held = (1.0 - beams.wide[i]) * _share_on_pole(x, pole, beam)
            if beams.z[i] >= NEAR:
                rest = _ended(rest, held, beams.z[i], hearing)
            elif held > 0.0:
                axis = z - behind - y * (beams.plumb[0] + y * beams.plumb[1])
                off = (axis, axis - _round(abs(x), pole, beam.across), sigma + _POLE_SCATTER)
                rest, known = _stopped(rest, held, off, known, 1.0 - share)
        on = 0.0
        if share > 0.0:
            on = _on_surface(kind, share, z - depth, spread, beams.z[i], hearing)
        density = share * on + (1.0 - share) * rest
        surface = (moved + depth, spread)
        density = _merged(density, divided * beams.merged[i], beams, i, surface) + _FLOOR
        densities[i] = density
        product *= density
        if not 1e-200 < product < 1e200:
            total, product = total + np.log(product), 1.0
    return float(_log_prior(shape, prior) + trust(beams) * (total + np.log(product)))


@compiled
def _log_prior(shape: Array, prior: Array) -> float:
    """Return the logarithm of the prior density of a shape, but for a constant."""
    total = 0.0
    for j in range(N_PARAMETERS):
        if prior[1, j] > 0.0:
            total -= 0.5 * ((shape[j] - prior[0, j]) / prior[1, j]) ** 2
    return total


@compiled
def align(kind: int, shape: Array, beams: Beams) -> None:
    """Move a shape to the mean depth of the returns that it would explain."""
    n, total, form, optics = 0, 0.0, _form_of(kind, shape), _optics_of(shape, beams)
    for i in range(len(beams.x)):
        x = beams.x[i] - shape[X] - beams.face[i] * shape[SHIFT]
        y = beams.y[i] - shape[Y] - beams.face[i] * shape[SHIFT + 1]
        share, depth, _, _ = _surface(kind, x, y, shape, form, _beam(shape, optics, beams, i))
        if share > 0.5 and abs(beams.z[i]) < 1.5:
            n += 1
            total += beams.z[i] - depth
    if n:
        shape[Z] = total / n
