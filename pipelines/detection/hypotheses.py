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
from spheremark.pipelines.estimation.linear_algebra import factorise, invert, solve
from spheremark.pipelines.model import Array, Index, Mask

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
_HEARD = 0.5  # of a beam: an object that is heard at all needs no larger share
_MISPLACED = 0.01  # share of the beams on a solid surface that seem to end behind it
_SOFT = (0.07, 0.35)  # radii, and half widths of a beam besides, over which beams come to hit
_CELL, _N_CELL = 0.1, 2  # beams that pass the same place share the errors of the model
_N_MAX = 96  # beams that are compared: more decide nothing
_N_ALIKE = 300.0  # beams that share errors of the model so that each counts as half a beam
_FLOOR = 1e-9
_NEVER = 60.0  # logarithm of odds behind the best that stand for any more
_HOPELESS = 15.0  # logarithm of odds behind the best from which a hypothesis is given up
_GIVEN_UP = 12.0  # the same of the sphere, from which no other hypothesis is compared
_ORDER = (0, 4, 8, 7, 1, 6, 5, 3, 2)  # the sphere, then what refutes it at the least cost
_N_BEGINS, _N_ROUNDS, _N_CLIMBS = 2, 4, 10  # of a search; of its walks; and of its climbs
_CLOSE = 0.05  # logarithm of odds: a round of a walk that gains less is followed by finer steps
_ARRIVED, _MOST_DAMPED = 0.02, 1e3  # the same, which ends a climb; and damping that ends it
_JUMPS = (-1.5, -0.75, 0.75, 1.5)  # standard deviations of a prior, for parameters with two maxima
_STEP = 0.1  # of the standard deviations of a prior, between which scores are taken
_SAME = 0.15  # relative deviation of a radius, or of three axes, within which it may be a marker
_AS_LARGE = 0.002  # share of balls as large as markers that are known to be none
_AS_ROUND = 0.3  # of the stones that would be as round as markers by their prior: fewer are

# Means and standard deviations of the parameters
_CENTRE, _POLE_SIZE = (0.3, 0.3, 0.4), (float(np.log(0.2)), 0.8)
_TURNED, _MOVED = 0.003, 0.01  # [rad] and [m] by which the faces lie apart with a rough mounting
_HEAD_SIZE = (0.085, 1.3, 0.12)  # [m] half the width of a head, its height over it, their spread
_STRETCH = 0.1  # of depths: what an echo is, and its strength, move the limb against the middle
_RELIEF, _SIGMA_LOG_RELIEF = 0.08, 0.3  # of stones, hair and faces about an ellipsoid
_FORMS: dict[int, tuple[tuple[float, float], ...]] = {
    _SPHERE: ((0.0, 0.05), (0.0, 0.0), (0.0, _STRETCH)),
    _BALL: ((0.0, 0.4), (0.0, 0.0), (0.0, _STRETCH)),
    _BOULDER: ((0.0, 0.3), (0.0, 0.2), (0.0, 0.3)),
    _CYLINDER: ((-0.1, 0.4), (0.0, 0.4)),
    _POST: ((-0.1, 0.6), (0.0, 0.4)),
    _BOX: ((-0.1, 0.4), (0.0, 0.4), (0.785, 0.4)),
    _PANEL: ((0.0, 0.5), (0.0, 0.5), (0.0, 0.7), (0.0, 0.7)),
    _CLUTTER: ((0.0, 0.4), (1.0, 1.5), (-0.7, 0.7)),
}
_STARTS = ((0.0, 0.0), (-0.585, -0.3), (0.585, 0.3))  # [rad] of a box; ln radii of a ball
ABUNDANCE = (208, 31, 274, 10, 33, 191, 18, 36, 36)
"""Groups that were compared in 31 random worlds of the simulator and were each."""

# Beta distributions of the share of beams that end near, and the probability that it is any
_OPEN, _CLOSED, _ANY = (0.3, 5.0, 0.1), (5.0, 0.3, 0.01), (0.5, 0.5, 1.0)
_SHOULDERS = (5.0, 0.3, 0.001)  # every head has them
_SHARES_BELOW = (_OPEN, _OPEN, _CLOSED, _SHOULDERS, _OPEN, _ANY, _OPEN, _ANY, _ANY)
_NEIGHBOUR = 0.05  # probability that something else stands beside its pole
_SHARES_BESIDE = (*(_OPEN,) * 7, _ANY, _ANY)
_HEIGHTS = 2.5  # [m] up to which markers stand
_LEAST_HEIGHTS = {_HEAD: 10.0, _BALL: 1.0, _SPHERE: 1.0, _CYLINDER: 1.0, _BOX: 1.0}
_BOULDER_HEIGHT = (0.3, 0.6)  # radii: centre above the ground, and standard deviation
_NOT_GROUND = 0.02  # probability that the ground about a place is not what it stands on

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
) -> tuple[Array, tuple[float, float]]:
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
    faintest = min(max(faintest, _FLOOR), _HEARD)  # its own returns are heard
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
    n_known = max(n_past - _n_unknown(evidence.seen[:2] / radius, unheard, blur), 0.0)
    n_alone = evidence.n_carrying + evidence.n_short
    for kind in range(len(NAMES)):
        logs[kind] += _log_share(n_beside, n_passing, _SHARES_BESIDE[kind])
        logs[kind] += _log_below(n_below, n_alone, n_known, _SHARES_BELOW[kind])
        logs[kind] += np.log(_height_density(kind, evidence.height, evidence.sigma_height, radius))
        logs[kind] += np.log(_neighbour_probability(kind, n_neighbours))
    priors = _priors(radius, physics)
    if abs(beams.face.sum()) < 0.5 * len(beams.face) - 3:
        moved = _MOVED / radius
        priors[_SPHERE, 1, _SHIFT:_POLE] = moved
        priors[_SPHERE, 1, _SHIFT : _SHIFT + 2] = hypot(_TURNED * distance / radius, moved)
    found, sphere = _compared(beams, priors, logs)
    never = float(found.max()) - _NEVER
    edge = float(sphere[_EDGE]), _sigma_edge(sphere, priors[_SPHERE], beams)
    return np.asarray(np.maximum(found, never)), edge


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
        return begun + lgamma(a + n_near) + lgamma(b + n_past) - lgamma(a + b + n_near + n_past)

    a, b, otherwise = beta
    any_share = of(*_ANY[:2])
    if otherwise == 1.0:
        return any_share
    return float(np.logaddexp(np.log1p(-otherwise) + of(a, b), np.log(otherwise) + any_share))


def _log_below(
    n_below: int, n_alone: int, n_known: float, beta: tuple[float, float, float]
) -> float:
    """Return the log probability of the beams below: all by what is there, or some by a neighbour.

    Without those of a neighbour fewer end near; it stops all of its own.
    """
    every = _log_share(n_below, n_known, beta)
    if beta is not _OPEN:
        return every
    alone = _log_share(n_alone, n_known, beta) + _log_share(max(n_below - n_alone, 0), 0, _ANY)
    return float(np.logaddexp(every + np.log(1.0 - _NEIGHBOUR), alone + np.log(_NEIGHBOUR)))


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
    _describe_behind(kept[:, :n], near[:, :n_near], past, _share_low(seen, silent, blurs))
    columns = (kept[0, :n], kept[1, :n], kept[2, :n], kept[3, :n], kept[4, :n])
    return _Beams(*columns, blurs[0], blurs[1], lost, faintest), n_near, past


@compiled
def _share_low(seen: Array, silent: Array, blurs: Array) -> float:
    """Return the share of the beams low down, beside the place of a pole, that end near."""
    x, y = np.append(seen[0], silent[0]), np.append(seen[1], silent[1])
    z = np.append(seen[2], np.full(silent.shape[1], np.inf))
    is_beside = (np.abs(x) > _UNDER[0] + blurs[0]) & (np.abs(x) < _BESIDE[1] + blurs[0])
    is_beside &= (y > _UNDER[1]) & (y < _BELOW) & (np.hypot(x, y) > 1.0 + blurs.max())
    n, n_near = np.sum(is_beside & (z >= -_NEAR)), np.sum(is_beside & (np.abs(z) < _NEAR))
    return float((n_near + 0.3) / (n + 1.3))


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
def _describe_behind(beams: Array, near: Array, n_past: int, share_low: float) -> None:
    """Write the density of what happens to each beam that passes the object by.

    By the beams beside it: a share of them ends near, half of it on a plane through them. Low
    down, where the ground may be near, by those beside the place of a pole.
    """
    n_near = near.shape[1]
    share_high = (n_near + 0.3) / (n_near + n_past + 1.3)
    plane, sigma = _plane(near) if n_near > 5 else (np.zeros(3), 0.0)
    for i in range(beams.shape[1]):
        density = 0.5 / _NEAR
        share = max(share_low, share_high) if beams[1, i] < _LOWEST else share_high
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
    share = min(max((inner + edge * blur) / (_SOFT[0] + _SOFT[1] * blur) + 0.5, 0.0), 1.0)
    return share * share * (3.0 - 2.0 * share)


@compiled
def _round(gap: float, radius: float, blur: float) -> float:
    """Return the mean depth of the part of a beam on a round surface."""
    middle = gap if gap + blur < radius else 0.5 * (min(max(gap - blur, 0.0), radius) + radius)
    return -float(np.sqrt(max(radius * radius - middle * middle, 0.0)))


@compiled
def _unheard(share: float, beams: _Beams) -> float:
    """Return the probability that a beam that is partly on an object has no return."""
    heard = min(max(share / beams.faintest - 0.5, 0.0), 1.0)
    return 1.0 - heard * (1.0 - max(_MISPLACED, beams.lost))


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
def _trust(beams: _Beams) -> float:
    """Return the information of a beam among others, as a share of its information alone."""
    return 1.0 / (1.0 + len(beams.x) / _N_ALIKE)


@compiled
def _log_likelihood(
    kind: int, shape: Array, prior: Array, beams: _Beams, densities: Array
) -> float:
    """Return the logarithm of likelihood times prior density of a shape; write those of beams."""
    total, product, edge, log_prior = 0.0, 1.0, shape[_EDGE], 0.0
    for j in range(_N_PARAMETERS):
        if prior[1, j] > 0.0:
            log_prior -= 0.5 * ((shape[j] - prior[0, j]) / prior[1, j]) ** 2
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
            if beams.z[i] == np.inf:
                on = _unheard(share, beams)
            rest = share * on + (1.0 - share) * rest
        share, depth = _surface(kind, x, y, form, edge, blurs)
        if share > 0.0:
            on = _MISPLACED
            if is_near:
                stray = (_STRAY + _MERGED * 4.0 * share * (1.0 - share)) / (2.0 * _NEAR)
                on = stray + scale * np.exp(-precision * (z - depth) ** 2)
            elif beams.z[i] == np.inf and kind != _CLUTTER:  # leaves have gaps anyway
                on = _unheard(share, beams)
            rest = share * on + (1.0 - share) * rest
        densities[i] = rest + _FLOOR
        product *= densities[i]
        if product < 1e-200:
            total, product = total + np.log(product), 1.0
    return float(log_prior + _trust(beams) * (total + np.log(product)))


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

    By Laplace's approximation. Minus infinity where it falls hopelessly below the least.
    """
    steps = 0.4 * prior[1]
    if kind in (_SPHERE, _BALL):  # the centre is fitted already
        steps[:_NOISE] = np.minimum(steps[:_NOISE], 2.0 * np.exp(prior[0, _NOISE]))
    _align(kind, shape, beams)
    found = _search(kind, shape, steps, prior, beams, least)
    if found == -np.inf:
        return -np.inf
    found += _log_volume(kind, shape, prior, beams)
    if kind == _BALL:
        found += _log_other_size(shape, prior, beams)
    return float(found)


@compiled
def _evidence_nearby(shape: Array, prior: Array, beams: _Beams) -> float:
    """Return the logarithm of the evidence of a sphere; its best shape nearby replaces it."""
    _align(_SPHERE, shape, beams)
    found = _log_likelihood(_SPHERE, shape, prior, beams, np.empty(len(beams.x)))
    found = _climbed(_SPHERE, shape, prior[1] > 0.0, prior, beams, found)
    return float(found + _log_volume(_SPHERE, shape, prior, beams))


@compiled
def _search(
    kind: int, shape: Array, steps: Array, prior: Array, beams: _Beams, least: float
) -> float:
    """Move a shape to the greatest likelihood times prior; return its logarithm.

    The likelihood has several maxima: far jumps and walks seek the greatest, and a climb goes up.
    """
    is_free = steps != 0.0
    found = _log_likelihood(kind, shape, prior, beams, np.empty(len(beams.x)))
    for begin in range(_N_BEGINS):
        before = found
        found = _jumped(kind, shape, is_free, prior, beams, found)
        if begin and found < before + _CLOSE:
            break
        found = _walked(kind, shape, steps.copy(), prior, beams, (found, least))
        if found == -np.inf:
            break
        found = _climbed(kind, shape, is_free, prior, beams, found)
    return float(found)


@compiled
def _walked(
    kind: int, shape: Array, steps: Array, prior: Array, beams: _Beams, begun: tuple[float, float]
) -> float:
    """Move a shape by a pattern search (Hooke and Jeeves, 1961).

    Return the logarithm of likelihood times prior; minus infinity where it is hopelessly below the
    least. ``begun`` holds that of the start, and the least.
    """
    found, least = begun
    densities = np.empty(len(beams.x))
    for round_no in range(_N_ROUNDS):
        if found < least - _HOPELESS * (1.0 + 4.0 / (1.0 + round_no)):
            return -np.inf
        before, last = found, shape.copy()
        for j in range(_N_PARAMETERS):
            if steps[j] == 0.0:
                continue
            for _ in range(2):
                kept = shape[j]
                shape[j] = kept + steps[j]
                trial = _log_likelihood(kind, shape, prior, beams, densities)
                if trial > found:
                    found = trial
                    break
                shape[j], steps[j] = kept, -steps[j]
        moved = 2.0 * shape - last
        while found > before:  # as far again, where the parameters only gain together
            trial = _log_likelihood(kind, moved, prior, beams, densities)
            if trial <= found:
                break
            found, last = trial, shape.copy()
            shape[:] = moved
            moved = 2.0 * shape - last
        if found < before + _CLOSE:
            steps *= 0.4
    return float(found)


@compiled
def _jumped(
    kind: int, shape: Array, is_free: Mask, prior: Array, beams: _Beams, found: float
) -> float:
    """Move a shape far along one parameter after the other, where that is better."""
    densities = np.empty(len(beams.x))
    for j in range(_NOISE, _N_PARAMETERS):
        if not is_free[j] or _SHIFT <= j < _POLE:
            continue
        begun = best = shape[j]
        for jump in _JUMPS:
            shape[j] = begun + jump * prior[1, j]
            trial = _log_likelihood(kind, shape, prior, beams, densities)
            if trial > found:
                found, best = trial, shape[j]
        shape[j] = best
    return float(found)


@compiled
def _climbed(
    kind: int, shape: Array, is_free: Mask, prior: Array, beams: _Beams, found: float
) -> float:
    """Move a shape to the greatest likelihood times prior nearby; return its logarithm.

    By damped scoring (Berndt, Hall, Hall and Hausman, 1974).
    """
    free, trust = np.flatnonzero(is_free), _trust(beams)
    damping, densities = 0.1, np.empty(len(beams.x))
    for _ in range(_N_CLIMBS):
        scores = _scores(kind, shape, free, prior, beams)
        pull = (prior[0] - shape)[free] / prior[1][free]
        gradient, squares = pull + trust * scores.sum(axis=1), trust * (scores @ scores.T)
        gained = 0.0
        while damping < _MOST_DAMPED:
            N, step = squares.copy(), gradient.copy()
            for j in range(len(free)):
                N[j, j] += 1.0 + damping * (1.0 + squares[j, j])
            solve(N, step)
            trial = shape.copy()
            for j in range(len(free)):
                trial[free[j]] += step[j] * prior[1, free[j]]
            gained = _log_likelihood(kind, trial, prior, beams, densities) - found
            if gained > 0.0:
                shape[:], found, damping = trial, found + gained, 0.2 * damping
                break
            damping *= 6.0
        if gained < _ARRIVED:
            break
    return float(found)


@compiled
def _log_other_size(shape: Array, prior: Array, beams: _Beams) -> float:
    """Return the logarithm of the probability that a ball is larger or smaller than a marker.

    By how far the likelihood falls from the best radius to the nearest other ones.
    """
    densities, other = np.empty(len(beams.x)), 0.0
    best = _log_likelihood(_BALL, shape, prior, beams, densities)
    for limit in (-_SAME, _SAME):
        at_limit, is_free = shape.copy(), prior[1] > 0.0
        at_limit[_FORM], is_free[_FORM] = limit, False
        _align(_BALL, at_limit, beams)
        begun = _log_likelihood(_BALL, at_limit, prior, beams, densities)
        fallen = best - _climbed(_BALL, at_limit, is_free, prior, beams, begun)
        off = np.sqrt(max(fallen, 0.0))  # over the square root of two standard deviations
        is_beyond = (shape[_FORM] - limit) * limit > 0.0
        other += 0.5 * erfc(-off if is_beyond else off)
    return float(np.log(max(other, _AS_LARGE)))


@compiled
def _scores(kind: int, shape: Array, free: Index, prior: Array, beams: _Beams) -> Array:
    """Return the scores of the beams in some parameters, per their standard deviations."""
    scores = np.zeros((len(free), len(beams.x)))
    above, below = np.empty(len(beams.x)), np.empty(len(beams.x))
    for j in range(len(free)):
        kept, h = shape[free[j]], _STEP * prior[1, free[j]]
        shape[free[j]] = kept + h
        _log_likelihood(kind, shape, prior, beams, above)
        shape[free[j]] = kept - h
        _log_likelihood(kind, shape, prior, beams, below)
        shape[free[j]] = kept
        scores[j] = np.log(above / below) / (2.0 * _STEP)
    return scores


@compiled
def _information(kind: int, shape: Array, prior: Array, beams: _Beams) -> tuple[Index, Array]:
    """Return the free parameters, and their information with the prior, per its variances.

    By the sum of outer products of the scores (Berndt, Hall, Hall and Hausman, 1974): it is
    positive, and takes errors of the parameters together. Those that are a property of the scan,
    the same for all hypotheses, have the prior's alone.
    """
    free = np.flatnonzero(prior[1] > 0.0)
    scores = _scores(kind, shape, free, prior, beams)
    for j in range(len(free)):
        if _SHIFT <= free[j] < _POLE:
            scores[j] = 0.0
    N = _trust(beams) * (scores @ scores.T)
    for j in range(len(free)):
        N[j, j] += 1.0
    return free, N


@compiled
def _log_volume(kind: int, shape: Array, prior: Array, beams: _Beams) -> float:
    """Return the logarithm of the share of the prior that the likelihood leaves about the best."""
    free, N = _information(kind, shape, prior, beams)
    total, same, root = 0.0, 1.0, np.zeros_like(N)
    for j in range(_SHIFT, _POLE):
        if prior[1, j] > 0.0:  # a property of the scan
            total += 0.5 * ((shape[j] - prior[0, j]) / prior[1, j]) ** 2
    factorise(N, root)
    for j in range(len(free)):
        total -= np.log(root[j, j])
    if kind == _BOULDER:
        invert(N, N)
        for j in range(len(free)):
            if _FORM <= free[j] < _SHIFT:
                off = shape[free[j]]
                limit = _SAME if free[j] < _FORM + 2 else _SAME + 2.0 * _STRETCH
                scale = 1.0 / (np.sqrt(2.0 * N[j, j]) * prior[1, free[j]])
                same *= 1.0 - 0.5 * (erfc((limit - off) * scale) + erfc((limit + off) * scale))
        total += np.log(max(1.0 - same, _AS_ROUND))
    return total


@compiled
def _sigma_edge(shape: Array, prior: Array, beams: _Beams) -> float:
    """Return how far the edge of the best sphere may be off."""
    free, N = _information(_SPHERE, shape, prior, beams)
    invert(N, N)
    place = np.searchsorted(free, _EDGE)
    return float(np.sqrt(N[place, place]) * prior[1, _EDGE])


@compiled
def _compared(beams: _Beams, priors: Array, log_priors: Array) -> tuple[Array, Array]:
    """Return the logarithms of prior times evidence of all hypotheses, and the best sphere."""
    found, best = np.full(len(log_priors), -np.inf), -np.inf
    sphere = priors[_SPHERE, 0].copy()
    for kind in _ORDER:
        is_named = kind != _BALL or found[_CYLINDER] < best  # the two are easily confused
        if best - found[_SPHERE] > _GIVEN_UP and is_named:
            continue
        for start in _STARTS:
            shape = _start(kind, priors[kind], sphere, start)
            own = _evidence(kind, shape, priors[kind], beams, best - log_priors[kind])
            found[kind] = max(found[kind], own + log_priors[kind])
            best = max(best, found[kind])
            if kind in (_BALL, _BOULDER):  # it may have found a better place for the sphere too
                again = _start(_SPHERE, priors[_SPHERE], shape, start)
                own = _evidence_nearby(again, priors[_SPHERE], beams)
                if own + log_priors[_SPHERE] > found[_SPHERE]:
                    found[_SPHERE] = own + log_priors[_SPHERE]
                    sphere[:] = again
            if kind == _SPHERE:
                sphere[:] = shape
            if kind not in (_BOX, _BALL):
                break
        best = max(best, found[_SPHERE])
    return found, sphere


@compiled
def _start(kind: int, prior: Array, sphere: Array, start: tuple[float, float]) -> Array:
    """Return a start of the search for the best shape of a kind where the best sphere is."""
    shape: Array = prior[0].copy()
    shape[:_FORM], shape[_SHIFT:] = sphere[:_FORM], sphere[_SHIFT:]
    if kind in (_BOULDER, _HEAD):
        shape[_NOISE] = prior[0, _NOISE]
    if kind == _SPHERE:
        shape[_POLE], shape[_FORM + 2] = prior[0, _POLE], sphere[_FORM + 2]
    if kind in (_BALL, _BOULDER):
        shape[_FORM], shape[_FORM + 2] = sphere[_FORM], sphere[_FORM + 2]
    if kind == _BALL:
        shape[_FORM] += start[1]
    if kind == _BOX:
        shape[_FORM + 2] += start[0]
    return shape
