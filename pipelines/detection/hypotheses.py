"""The hypotheses about a place, and how likely each is given all beams about it.

Hides the shapes, their priors, and the likelihood of returns at a place's depth, of returns far
behind, and of pulses without a return. Lengths are in radii of the sphere that is searched for; x
is across the line of sight, y up it, z along it.
"""

from __future__ import annotations

from math import erfc, exp, hypot, lgamma
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.detection.evidence import Evidence, n_beside_pole
from spheremark.pipelines.detection.target import ASIDE
from spheremark.pipelines.estimation.linear_algebra import invert
from spheremark.pipelines.model import Array

NAMES = (
    "sphere",
    "sphere of another radius",
    "boulder on the ground",
    "head on shoulders",
    "short cylinder",
    "post",
    "box",
    "panel, edge or leaf",
    "foliage or other clutter",
)
"""What may stand at a place; the first is a marker."""

_SPHERE, _BALL, _BOULDER, _HEAD, _CYLINDER, _POST, _BOX, _PANEL, _CLUTTER = range(len(NAMES))

# Places of the parameters of a shape: centre, at the mean depth of its surface; logarithm of the
# noise; half widths of a beam outside an outline where half the beams hit; four of form; the place
# of one face of the scan against the other; logarithm of half the width of the pole
_X, _Y, _Z, _NOISE, _EDGE, _FORM, _SHIFT, _POLE, _N_PARAMETERS = 0, 1, 2, 3, 4, 5, 9, 12, 13

_MEAN = 2.0 / 3.0  # of a radius: mean height of a sphere's surface over its disc
_NEAR = 3.0  # depth about a centre within which a return may belong to the object there
_AROUND = 1.35  # beams that pass so far from a centre, beside half a beam, show its outline
_LOWEST = -0.9  # anything lower may be what it stands on
_UNDER = (0.5, -3.0)  # half width and depth below a centre where its pole or the rest of a post is
_BESIDE = (1.2, 2.2)  # distances from a centre, beside half a beam, of beams that pass it by
_POLE_FROM, _POLE_DEPTH, _POLE_SHARE = 0.8, 0.4, 0.7  # of a pole, and of its beams that it stops
_STRAY = 0.02  # share of the returns from a surface that lie anywhere: crosstalk, dust, strays
_MERGED = 0.6  # share of the echoes of a beam that an outline halves, between it and what is behind
_MISPLACED = 0.01  # share of the beams on a solid surface that seem to end behind it
_SOFT = (0.1, 0.5)  # radii, and half widths of a beam besides, over which beams come to hit
_CELL, _N_CELL = 0.1, 2  # beams that pass the same place share the errors of the model
_N_MAX = 96  # beams that are compared: more decide nothing, and errors of the model add up
_FLOOR = 1e-9
_NEVER = 60.0  # logarithm of odds behind the best that stand for any more
_HOPELESS = 15.0  # logarithm of odds behind the best from which a hypothesis is given up
_GIVEN_UP = 12.0  # the same of the sphere, from which no other hypothesis is compared
_ORDER = (0, 8, 7, 4, 6, 5, 3, 2, 1)  # the sphere, then what refutes it at the least cost
_CLOSE = 0.05  # logarithm of odds: a round of a search that gains less is followed by finer steps
_N_ROUNDS = 7
_SAME = 0.15  # relative deviation of a radius, or of three axes, within which it may be a marker
_AS_ROUND = 0.002  # share of other balls and stones that are known to be so, and are no markers

# Means and standard deviations of the parameters
_CENTRE, _POLE_SIZE = (0.3, 0.3, 0.4), (float(np.log(0.2)), 0.8)
_TURNED, _MOVED = 0.003, 0.01  # [rad] and [m] by which the faces lie apart with a rough mounting
_HEAD_SIZE = (0.085, 1.3, 0.12)  # [m] half the width of a head, its height over it, their spread
_RELIEF, _SIGMA_LOG_RELIEF = 0.08, 0.3  # of stones, hair and faces about an ellipsoid
_FORMS: dict[int, tuple[tuple[float, float], ...]] = {
    _SPHERE: ((0.0, 0.07),),
    _BALL: ((0.0, 0.4),),
    _BOULDER: ((0.0, 0.3), (0.0, 0.2), (0.0, 0.3)),
    _CYLINDER: ((-0.1, 0.4), (0.0, 0.4)),
    _POST: ((-0.1, 0.6), (0.0, 0.4)),
    _BOX: ((-0.1, 0.4), (0.0, 0.4), (0.785, 0.4)),
    _PANEL: ((0.0, 0.5), (0.0, 0.5), (0.0, 0.7), (0.0, 0.7)),
    _CLUTTER: ((0.0, 0.4), (1.0, 1.5), (-0.7, 0.7)),
}
_YAWS = (0.785, 0.2, 1.37)  # [rad] starts of a box
ABUNDANCE = (208, 31, 274, 10, 33, 191, 18, 36, 36)
"""Groups that were compared in 31 random worlds of the simulator and were each."""

# Beta distributions of the share of beams that end near, and the probability that it is any
_OPEN, _CLOSED, _ANY = (0.3, 5.0, 0.1), (5.0, 0.3, 0.01), (0.5, 0.5, 1.0)
_SHOULDERS = (5.0, 0.3, 0.001)  # every head has them
_SHARES_BELOW = (_OPEN, _OPEN, _CLOSED, _SHOULDERS, _OPEN, _ANY, _OPEN, _ANY, _ANY)
_SHARES_BESIDE = (*(_OPEN,) * 7, _ANY, _ANY)
_HEIGHTS = 2.5  # [m] up to which markers stand
_LEAST_HEIGHTS = {_HEAD: 10.0, _BALL: 1.0, _SPHERE: 3.0, _CYLINDER: 1.0, _BOX: 1.0}
_BOULDER_HEIGHT = (0.3, 0.6)  # radii: centre above the ground, and standard deviation
_NOT_GROUND = 0.1  # probability that the ground about a place is not what it stands on

_N_NEAR_FREE = 0.2  # groups near what stands free, in the mean
_CROWDED = 5.0 / 6.0  # odds of one more group near leaves, panels and posts: five in the mean
_AMONG = 0.03  # probability that what stands free stands among these


_BELOW = -0.3  # radii: beams so far below a centre pass a marker beside its pole


class Physics(NamedTuple):
    """What a scan shows of its own physics.

    Attributes
    ----------
    noise, sigma_log_noise : float
        Standard deviation of ranges [m], and how far its logarithm may be off.
    lost : float
        Share of the pulses on a surface without a return.
    weakest : float
        Reflectivity over squared range of the weakest returns [1/m^2].
    edge, sigma_edge : float
        Half widths of a beam outside an outline where half the beams hit, and how far that may be
        off.
    """

    noise: float
    sigma_log_noise: float
    lost: float
    weakest: float
    edge: float = 0.6
    sigma_edge: float = 0.4


class _Beams(NamedTuple):
    """Beams about a place.

    Attributes
    ----------
    x, y, z, face, behind : (n,)
        Where they pass it; how much deeper they end, infinite without a return; plus or minus a
        half by the face of the scan; density of what happens to them when they pass the object.
    blur, blur_up : float
        Half the width of a beam across and up.
    lost, faintest : float
        Share of the pulses on a surface that are not heard, and of a beam that must be on it.
    """

    x: Array
    y: Array
    z: Array
    face: Array
    behind: Array
    blur: float
    blur_up: float
    lost: float
    faintest: float


def log_likelihoods(
    evidence: Evidence,
    distance: float,
    level: float,
    n_neighbours: int,
    radius: float,
    physics: Physics,
) -> tuple[Array, float]:
    """Return the logarithms of the likelihoods of all hypotheses, and the edge of the best sphere.

    Parameters
    ----------
    evidence : Evidence
        The beams towards and about it.
    distance : float
        From the sensor [m].
    level : float
        Height above the sensor [m].
    n_neighbours : int
        Other groups that stand near it.
    radius : float
        Of the sphere that is searched for [m].
    physics : Physics
        Of the scan.

    Notes
    -----
    The evidence of a shape is the likelihood at its best parameters by Laplace's
    approximation, with a diagonal Hessian. Beams are independent but for those of one place.
    """
    silent = np.zeros((3, 0))
    if evidence.silent is not None:
        silent = evidence.silent * np.array([[1.0 / radius], [1.0 / radius], [1.0]])
    faintest = physics.weakest * distance**2 / max(evidence.brightness, 1.0)
    order = np.argsort(evidence.seen[0], kind="stable")  # whatever the order of the returns
    beams, n_beside, n_passing = _beams_about(
        evidence.seen[:, order] / radius,
        evidence.faces[order],
        silent,
        evidence.blur / radius,
        physics.lost,
        faintest,
    )
    logs = np.zeros(len(NAMES))
    n_below, n_past = evidence.n_held + evidence.n_short, evidence.n_past
    if evidence.silent is None:  # pulses are as dense below, and those without a return go past
        n_past = max(n_past, evidence.n_on - n_below)
    is_low = silent[1] < -level / radius  # no ground is above the horizon, in the mean
    unheard, blur = silent[:, is_low], evidence.blur.max() / radius
    n_known = n_past - _n_unknown(evidence.seen[:2] / radius, unheard, blur)
    for kind in range(len(NAMES)):
        logs[kind] += _log_share(n_beside, n_passing, _SHARES_BESIDE[kind])
        logs[kind] += _log_share(n_below, n_known, _SHARES_BELOW[kind])
        logs[kind] += np.log(_height_density(kind, evidence.height, evidence.sigma_height, radius))
        logs[kind] += np.log(_neighbour_probability(kind, n_neighbours))
    priors = _priors(radius, physics)
    if abs(beams.face.sum()) < 0.5 * len(beams.face) - 3:
        moved = _MOVED / radius
        priors[_SPHERE, 1, _SHIFT:_POLE] = moved
        priors[_SPHERE, 1, _SHIFT : _SHIFT + 2] = hypot(_TURNED * distance / radius, moved)
    found, sphere = _compared(beams, priors, logs)
    never = float(found.max()) - _NEVER
    return np.asarray(np.maximum(found, never)), float(sphere[_EDGE])


def _n_unknown(seen: Array, silent: Array, blur: float) -> float:
    """Return how many pulses without a return below a place may have met ground that is not heard.

    The beams to the sides, past where a pole or shoulders would be, show how much of it is heard.
    """
    n_heard, n_silent = (
        int(np.sum((up < _BELOW) & (abs(across) > ASIDE + blur)))
        for across, up in (seen, silent[:2])
    )
    n_below = n_beside_pole(silent, blur)
    return float(n_below * (n_silent + 0.5) / (n_heard + n_silent + 1.0))


def _priors(radius: float, physics: Physics) -> Array:
    """Return means and standard deviations of the parameters of all hypotheses, (k, 2, p)."""
    priors = np.zeros((len(NAMES), 2, _N_PARAMETERS))
    priors[:, 1, :3], priors[:, 0, _Z] = _CENTRE, -_MEAN
    priors[:, :, _NOISE] = np.log(physics.noise / radius), physics.sigma_log_noise
    priors[:, :, _EDGE] = physics.edge, physics.sigma_edge
    half, height, spread = _HEAD_SIZE
    head = ((np.log(half / radius), spread), (np.log(height), spread), (np.log(height), spread))
    for kind, form in {**_FORMS, _HEAD: head}.items():
        priors[kind, :, _FORM : _FORM + len(form)] = np.transpose(form)
    priors[:, 0, _POLE] = _POLE_SIZE[0]
    priors[[_SPHERE, _BALL, _HEAD, _CYLINDER, _BOX], 1, _POLE] = _POLE_SIZE[1]
    rough = hypot(physics.noise / radius, _RELIEF)
    priors[[_BOULDER, _HEAD], :, _NOISE] = np.log(rough), _SIGMA_LOG_RELIEF
    priors[_CLUTTER, 1, _NOISE] = 0.0  # its own scatter is a parameter of form
    return priors


def _log_share(n_near: int, n_past: float, beta: tuple[float, float, float]) -> float:
    """Return the log probability that so many beams end near, and so many go past."""

    def of(a: float, b: float) -> float:
        begun = lgamma(a + b) - lgamma(a) - lgamma(b)
        return exp(
            begun + lgamma(a + n_near) + lgamma(b + n_past) - lgamma(a + b + n_near + n_past)
        )

    a, b, otherwise = beta
    return float(np.log((1.0 - otherwise) * of(a, b) + otherwise * of(*_ANY[:2]) + _FLOOR))


def _neighbour_probability(kind: int, n: int) -> float:
    """Return the probability of so many other groups nearby: crowns, walls and fences have many."""
    crowded = (1.0 - _CROWDED) * _CROWDED**n
    if kind in (_POST, _PANEL, _CLUTTER):
        return crowded
    alone = exp(n * np.log(_N_NEAR_FREE) - _N_NEAR_FREE - lgamma(n + 1))
    return _AMONG * crowded + (1.0 - _AMONG) * alone


def _height_density(kind: int, height: float, sigma: float, radius: float) -> float:
    """Return the density of the height of a centre above the ground about it [1/m]."""
    unknown = 1.0 / _HEIGHTS
    if not sigma < _HEIGHTS:
        return unknown
    if kind == _BOULDER:
        spread = hypot(_BOULDER_HEIGHT[1] * radius, sigma)
        off = (height - _BOULDER_HEIGHT[0] * radius) / spread
        known = exp(-0.5 * off * off) / (2.5066 * spread)
    elif kind in _LEAST_HEIGHTS:
        known = 0.5 * unknown * erfc((_LEAST_HEIGHTS[kind] * radius - height) / (1.4142 * sigma))
    else:
        known = unknown
    return _NOT_GROUND * unknown + (1.0 - _NOT_GROUND) * known


@compiled
def _beams_about(
    seen: Array, faces: Array, silent: Array, blurs: Array, lost: float, faintest: float
) -> tuple[_Beams, int, int]:
    """Return the beams that are compared, and how many beside the object end near or go past."""
    n_seen, n = seen.shape[1], 0
    most = n_seen + silent.shape[1]
    kept, blur = np.empty((5, most)), blurs.max()
    counts = np.zeros((2, 2, 80, 80), np.int8)
    near, past = np.empty((3, most)), 0
    n_near = 0
    for i in range(most):
        if i < n_seen:
            x, y, z, face = seen[0, i], seen[1, i], seen[2, i], faces[i]
        else:
            x, y, z, face = (
                silent[0, i - n_seen],
                silent[1, i - n_seen],
                np.inf,
                silent[2, i - n_seen],
            )
        if z < -_NEAR or abs(x) > 3.9 or abs(y) > 3.9:
            continue
        gap, is_near = np.sqrt(x * x + y * y), z < _NEAR
        if y > -0.5 and _BESIDE[0] + blur < gap < _BESIDE[1] + blur:
            past += not is_near
            if is_near:
                near[0, n_near], near[1, n_near], near[2, n_near] = x, y, z
                n_near += 1
        is_under = abs(x) < _UNDER[0] + blurs[0] and _UNDER[1] < y < 0.0
        if (gap < _AROUND + blur and y > _LOWEST) or is_under:
            place = counts[int(is_near), int(face > 0.0), int((x + 4.0) / _CELL)]
            row = int((y + 4.0) / _CELL)
            if place[row] < _N_CELL:
                place[row] += 1
                kept[0, n], kept[1, n], kept[2, n], kept[3, n] = x, y, z, face
                n += 1
    every = max(n / _N_MAX, 1.0)
    n = int(n / every)
    for i in range(n):
        row = int(i * every)
        for j in range(4):
            kept[j, i] = kept[j, row]
    _describe_behind(kept[:, :n], near[:, :n_near], past)
    columns = (kept[0, :n], kept[1, :n], kept[2, :n], kept[3, :n], kept[4, :n])
    return _Beams(*columns, blurs[0], blurs[1], lost, faintest), n_near, past


@compiled
def _plane(near: Array) -> tuple[Array, float]:
    """Return the plane through some returns, depth and slopes, and the robust scatter about it."""
    N, rhs, plane = np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    for i in range(near.shape[1]):
        row = (1.0, near[0, i], near[1, i])
        for j in range(3):
            rhs[j] += row[j] * near[2, i]
            for k in range(3):
                N[j, k] += row[j] * row[k]
    for j in range(3):
        N[j, j] += 1e-3
    invert(N, N)
    for j in range(3):
        for k in range(3):
            plane[j] += N[j, k] * rhs[k]
    off = np.abs(near[2] - plane[0] - plane[1] * near[0] - plane[2] * near[1])
    sigma = max(1.4826 * np.median(off), 0.1)
    return plane, sigma


@compiled
def _describe_behind(beams: Array, near: Array, n_past: int) -> None:
    """Write the density of what happens to each beam that passes the object by.

    By the beams beside it: a share of them ends near, half of it on a plane through them.
    """
    n_near = near.shape[1]
    share = (n_near + 0.3) / (n_near + n_past + 1.3)
    plane, sigma = _plane(near) if n_near > 5 else (np.zeros(3), 0.0)
    for i in range(beams.shape[1]):
        density = 0.5 / _NEAR
        if beams[2, i] >= _NEAR:
            beams[4, i] = 1.0 - share
            continue
        if sigma > 0.0:
            expected = plane[0] + plane[1] * beams[0, i] + plane[2] * beams[1, i]
            density = 0.5 * density + 0.5 * _normal(beams[2, i] - expected, sigma)
        beams[4, i] = share * density


@compiled
def _normal(off: float, sigma: float) -> float:
    """Return the density of a normal distribution about zero."""
    return float(np.exp(-0.5 * off * off / (sigma * sigma)) / (2.5066283 * sigma))


@compiled
def _inside(inner: float, blur: float, edge: float) -> float:
    """Return the probability that a beam hits what it passes so far inside the outline of."""
    return min(max((inner + edge * blur) / (_SOFT[0] + _SOFT[1] * blur) + 0.5, 0.0), 1.0)


@compiled
def _round(gap: float, radius: float, blur: float) -> float:
    """Return the mean depth of the part of a beam on a round surface."""
    middle = gap if gap + blur < radius else 0.5 * (min(max(gap - blur, 0.0), radius) + radius)
    return -float(np.sqrt(max(radius * radius - middle * middle, 0.0)))


_Form = tuple[float, float, float, float]


@compiled
def _form_of(kind: int, shape: Array) -> _Form:
    """Return what the surface of a shape is computed with."""
    a, b = np.exp(shape[_FORM]), np.exp(shape[_FORM + 1])
    if kind <= _HEAD:
        return a, b, np.exp(shape[_FORM + 2]), 0.0
    if kind == _BOX:
        t = np.tan(shape[_FORM + 2])
        return a, b, t, a * (1.0 - t) / (1.0 + t)
    if kind == _CLUTTER:
        return a, 1.0 / (1.0 + 1.0 / b), np.exp(2.0 * shape[_FORM + 2]), 0.0
    return a, b, shape[_FORM + 2], shape[_FORM + 3]


@compiled
def _surface(
    kind: int, x: float, y: float, form: _Form, edge: float, blurs: tuple[float, float]
) -> tuple[float, float]:
    """Return the share of a beam that an object stops there, and the depth."""
    a, b, c, d = form
    if kind <= _HEAD or kind == _CLUTTER:
        gap2 = x * x + y * y + _FLOOR
        blur = np.sqrt(((blurs[0] * x) ** 2 + (blurs[1] * y) ** 2) / gap2)
        if kind == _CLUTTER:
            return b * _inside(a - np.sqrt(gap2), blur, edge), 0.0
        gap = np.sqrt(x * x + y * y / (b * b))
        share = _inside((a - gap) * min(b, 1.0), blur, edge)
        return share, c * (_round(gap, a, blur) + _MEAN * a) if share > 0.0 else 0.0
    over = b - y if kind == _POST else b - abs(y)
    share = min(_inside(a - abs(x), blurs[0], edge), _inside(over, blurs[1], edge))
    if kind == _PANEL:
        return share, c * x + d * y
    if kind == _BOX:  # from the upright edge that is nearest
        away = x + d
        return share, min(max(away * c, -away / c), 2.0 * a)
    return share, _round(abs(x), a, blurs[0]) + _MEAN * a


@compiled
def _log_likelihood(kind: int, shape: Array, prior: Array, beams: _Beams) -> float:
    """Return the logarithm of likelihood times prior density of a shape."""
    total, product, edge = 0.0, 1.0, shape[_EDGE]
    for j in range(_N_PARAMETERS):
        if prior[1, j] > 0.0:
            total -= 0.5 * ((shape[j] - prior[0, j]) / prior[1, j]) ** 2
    form, blurs, pole = _form_of(kind, shape), (beams.blur, beams.blur_up), np.exp(shape[_POLE])
    variance = form[2] if kind == _CLUTTER else np.exp(2.0 * shape[_NOISE])
    scale, precision = (1.0 - _STRAY) / np.sqrt(6.283185 * variance), 0.5 / variance
    bottom = -form[1] if kind >= _CYLINDER else -_POLE_FROM * form[0] * form[1]
    pole_share = _POLE_SHARE * pole / (pole + 0.5 * blurs[0])  # a thin pole covers part of a beam
    has_pole = prior[1, _POLE] > 0.0
    for i in range(len(beams.x)):
        x = beams.x[i] - shape[_X] - beams.face[i] * shape[_SHIFT]
        y = beams.y[i] - shape[_Y] - beams.face[i] * shape[_SHIFT + 1]
        z = beams.z[i] - shape[_Z] - beams.face[i] * shape[_SHIFT + 2]
        is_near = beams.z[i] < _NEAR
        rest = beams.behind[i]
        if has_pole and y < bottom:
            share = pole_share * _inside(pole - abs(x), blurs[0], edge)
            on = _normal(z - _MEAN, _POLE_DEPTH) if is_near else _MISPLACED
            rest = share * on + (1.0 - share) * rest
        share, depth = _surface(kind, x, y, form, edge, blurs)
        if share > 0.0:
            on = _MISPLACED
            if is_near:
                stray = (_STRAY + _MERGED * 4.0 * share * (1.0 - share)) / (2.0 * _NEAR)
                on = stray + scale * np.exp(-precision * (z - depth) ** 2)
            elif beams.z[i] == np.inf and kind != _CLUTTER:  # leaves have gaps anyway
                on = max(_MISPLACED, beams.lost) if share > beams.faintest else 1.0
            rest = share * on + (1.0 - share) * rest
        product *= rest + _FLOOR
        if product < 1e-200:
            total, product = total + np.log(product), 1.0
    return float(total + np.log(product))


@compiled
def _align(kind: int, shape: Array, beams: _Beams) -> None:
    """Move a shape to the mean depth of the returns that it would explain."""
    n, total, form = 0, 0.0, _form_of(kind, shape)
    for i in range(len(beams.x)):
        x = beams.x[i] - shape[_X] - beams.face[i] * shape[_SHIFT]
        y = beams.y[i] - shape[_Y] - beams.face[i] * shape[_SHIFT + 1]
        share, depth = _surface(kind, x, y, form, shape[_EDGE], (beams.blur, beams.blur_up))
        if share > 0.5 and abs(beams.z[i]) < 1.5:
            n += 1
            total += beams.z[i] - depth
    if n:
        shape[_Z] = total / n


@compiled
def _evidence(kind: int, shape: Array, prior: Array, beams: _Beams, least: float) -> float:
    """Return the logarithm of the evidence of a hypothesis; its best shape replaces the start.

    Pattern search (Hooke and Jeeves, 1961), because the likelihood is not smooth; then Laplace's
    approximation. Minus infinity where it falls hopelessly below the least.
    """
    steps = 0.4 * prior[1]
    if kind in (_SPHERE, _BALL):  # the centre is fitted already
        steps[:_NOISE] = np.minimum(steps[:_NOISE], 2.0 * np.exp(prior[0, _NOISE]))
    _align(kind, shape, beams)
    found = _log_likelihood(kind, shape, prior, beams)
    for round_no in range(_N_ROUNDS if kind != _SPHERE else 2 * _N_ROUNDS):
        if found < least - _HOPELESS * (1.0 + 4.0 / (1.0 + round_no)):
            return -np.inf
        before = found
        for j in range(_N_PARAMETERS):
            if steps[j] == 0.0:
                continue
            for _ in range(2):
                kept = shape[j]
                shape[j] = kept + steps[j]
                trial = _log_likelihood(kind, shape, prior, beams)
                if trial > found:
                    found = trial
                    break
                shape[j], steps[j] = kept, -steps[j]
        if found < before + _CLOSE:
            steps *= 0.4
    return float(found + _log_volume(kind, shape, prior, beams, found))


@compiled
def _log_volume(kind: int, shape: Array, prior: Array, beams: _Beams, best: float) -> float:
    """Return the logarithm of the share of the prior that the likelihood leaves about the best."""
    total, same = 0.0, 1.0
    for j in range(_N_PARAMETERS):
        if prior[1, j] == 0.0:
            continue
        if _SHIFT <= j < _POLE:  # a property of the scan: it is the same for all hypotheses
            total += 0.5 * ((shape[j] - prior[0, j]) / prior[1, j]) ** 2
            continue
        kept, h = shape[j], 0.1 * prior[1, j]
        shape[j] = kept + h
        above = _log_likelihood(kind, shape, prior, beams)
        shape[j] = kept - h
        below = _log_likelihood(kind, shape, prior, beams)
        shape[j] = kept
        curvature = max((2.0 * best - above - below) / (h * h), 1.0 / prior[1, j] ** 2)
        total -= 0.5 * np.log(curvature * prior[1, j] ** 2)
        if _FORM <= j < _SHIFT:
            scale = np.sqrt(0.5 * curvature)  # of a normal distribution, for the error function
            same *= 1.0 - 0.5 * (erfc((_SAME - kept) * scale) + erfc((_SAME + kept) * scale))
    if kind in (_BALL, _BOULDER):
        total += np.log(max(1.0 - same, _AS_ROUND))
    return total


@compiled
def _compared(beams: _Beams, priors: Array, log_priors: Array) -> tuple[Array, Array]:
    """Return the logarithms of prior times evidence of all hypotheses, and the best sphere."""
    found, best = np.full(len(log_priors), -np.inf), -np.inf
    sphere = priors[_SPHERE, 0].copy()
    for kind in _ORDER:
        if best - found[_SPHERE] > _GIVEN_UP:
            break
        shape = sphere
        for yaw in _YAWS:
            shape = priors[kind, 0].copy()
            if kind == _SPHERE:
                shape = sphere
            else:
                shape[:_FORM] = sphere[:_FORM]
                shape[_SHIFT:] = sphere[_SHIFT:]
            if kind in (_BOULDER, _HEAD):
                shape[_NOISE] = priors[kind, 0, _NOISE]
            if kind in (_BALL, _BOULDER):
                shape[_FORM] = sphere[_FORM]
            if kind == _BOX:
                shape[_FORM + 2] = yaw
            own = _evidence(kind, shape, priors[kind], beams, best - log_priors[kind])
            found[kind] = max(found[kind], own + log_priors[kind])
            if kind != _BOX:
                break
        if kind == _BALL:  # it may have found a better place for the sphere too
            own = _evidence(_SPHERE, shape, priors[_SPHERE], beams, -np.inf)
            found[_SPHERE] = max(found[_SPHERE], own + log_priors[_SPHERE])
        best = max(best, found[kind])
    return found, sphere
