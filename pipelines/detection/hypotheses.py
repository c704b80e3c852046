"""The hypotheses about a place, and how likely each is given all beams about it.

Hides their priors, and what the height of a place shows.
"""

from __future__ import annotations

from math import erfc, exp, hypot, log
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.detection.beams import GATES, Beams, beams_about, merged_within
from spheremark.pipelines.detection.evidence import Evidence
from spheremark.pipelines.detection.faces import MOVED, TURNED
from spheremark.pipelines.detection.search import compared, shared_by
from spheremark.pipelines.detection.shapes import (
    ALONG,
    BALL,
    BOULDER,
    CLUTTER,
    CYLINDER,
    FORM,
    HEAD,
    MEAN,
    N_PARAMETERS,
    NAMES,
    NOISE,
    PANEL,
    POLE,
    POST,
    SHIFT,
    SOLID,
    SPHERE,
    STRETCH,
    Z,
    log_likelihood,
)
from spheremark.pipelines.detection.support import log_supports
from spheremark.pipelines.detection.target import Target, slope_of
from spheremark.pipelines.model import Array

_FLOOR = 1e-9
_HEARD = 0.5  # of a beam: an object that is heard at all needs no larger share
_N_BEAMS = (192, 400)  # that are compared at most: to find shapes, and where they are known
_NEVER = 60.0  # logarithm of odds behind the best that stand for any more

_STAND = (SPHERE, BALL, CYLINDER, SOLID)  # on a pole or on something wide, or on the ground

# Means and standard deviations of the parameters
_CENTRE, _POLE_SIZE = (0.3, 0.3, 0.4), (float(np.log(0.2)), 0.8)
_HEAD_SIZE = (0.085, 1.3, 0.12)  # [m] half the width of a head, its height over it, their spread
_RELIEF, _SIGMA_LOG_RELIEF = 0.08, 0.3  # radii: of stones, hair and faces about an ellipsoid
STONES = (0.3, 0.6)
"""Standard deviations of the logarithm of the relief of stones: in a scan, and between scans."""
SOLIDS = (
    *((0.0, 0.3), (0.0, 0.14), (0.0, 0.1), (0.0, 0.1), (0.0, 0.1)),
    *((0.0, 0.2), (0.0, 0.2), (-0.35, 0.3), (0.0, 0.4), (0.0, 0.2)),
)
"""Means and standard deviations of the form of a solid of another shape: the logarithm of its size;
waves of two and of three of its outline, cosine and sine; tilt across and up, curvature, and its
cosine and sine of two, of its depth. By least squares of cubes, cylinders, cones, lamps and mirrors
that lean by up to 30 degrees."""

_FORMS: dict[int, tuple[tuple[float, float], ...]] = {
    BALL: ((0.0, 0.4),),
    SOLID: SOLIDS,
    BOULDER: ((0.0, 0.3), (0.0, 0.2), (0.0, 0.3)),
    CYLINDER: ((-0.1, 0.4), (0.0, 0.4)),
    POST: ((-0.1, 0.6), (0.0, 0.4)),
    PANEL: ((0.0, 0.5), (0.0, 0.5), (0.0, 0.7), (0.0, 0.7)),
    CLUTTER: ((0.0, 0.4), (1.0, 1.5), (-0.7, 0.7)),
}
ABUNDANCE = (208, 31, 274, 10, 33, 191, 18, 36, 36)
"""Groups of each hypothesis in 31 random worlds of the simulator, without those that something wide
held up: the usual abundance of what stands free. Their markers stood on poles or on the ground."""

ABUNDANCE_HELD = (29, 171, 432, 42, 107, 360, 185, 301, 873)
"""Groups of each hypothesis that something wide holds up, or the ground, in as many worlds."""

_HEIGHTS, _TALLER = 2.5, 1.0  # [m] up to which markers stand; and how much higher, if they do
_ON_NARROW = 0.1  # probability of standing on something but a pole that is narrow, as a tripod
_ON_WIDE, _WIDE = 0.1, 0.4  # probability of standing on something wide, and how high that is [m]
_ON_TALL = 0.02  # probability of lying on something wide that is as high as poles: vehicles, walls
_LYING, _UNEVEN = 0.1, 0.2  # probability of lying on the ground; radii that it sinks in, or less
_OTHERWISE = np.array([_ON_NARROW, _ON_WIDE + _LYING, _ON_TALL])
_STANDING = np.array([1.0 - _OTHERWISE.sum(), *_OTHERWISE])
_BOULDER_HEIGHT = (0.3, 0.6)  # radii: centre above the ground, and standard deviation
_PERCHED, _STONE = 0.1, 0.5  # probability that a boulder lies on another, and mean height [m] of it
_HEAD_HEIGHT, _LOWERED = (1.6, 0.12), 0.2  # [m] of adults who stand (1.70 m tall); share of others
_NOT_GROUND = 0.02  # probability that the ground about a place is not what it stands on


class Physics(NamedTuple):
    """What a scan shows of its own physics, at a group.

    Attributes
    ----------
    shared, sigmas : (7,)
        What its markers have in common, and how far that may be off: the logarithm of the noise of
        ranges [m]; half widths of a beam outside an outline where half the beams hit, before
        nothing that is heard, and, beyond where both are as strong, before something; and the
        logarithms of how much wider beams are along the spin axis than their data sheet says, of
        their scatter about their stated directions [half widths], of how far depths are stretched
        and of how far the radius is another.
    lost : float
        Share of the pulses on a surface without a return.
    weakest : float
        Reflectivity over squared range of the weakest returns [1/m^2].
    stones : (2,)
        Logarithm of how far surfaces of stones lie about an ellipsoid [radii], noise and all, and
        its standard deviation.
    gates : (9,)
        Probabilities of each of ``GATES``.
    """

    shared: Array
    sigmas: Array
    lost: float
    weakest: float
    stones: Array
    gates: Array = np.eye(1, len(GATES))[0]


USUAL = (1.0, -0.1, 0.0, log(0.15), 0.0, 0.0)  # edges: measured on markers of random worlds
"""What markers share in a scan that nothing is known of, as in ``Physics``, but for the noise."""

SIGMAS = (0.35, 0.6, 0.35, 0.7, 0.1, 0.02)
"""How far these may be off: what an echo is moves the limb, and the limb against the middle. A beam
that is twice as wide one way by its data sheet may be round. What steps and jitter of the angles
scatter beams by, 0.2 mrad of a VLP-16, is known to a factor of two. Radii are known to 2 % in
common."""


def log_likelihoods(
    evidence: Evidence,
    centre: Array,
    target: Target,
    physics: Physics,
    begun: Array,
) -> tuple[Array, Array]:
    """Return the logarithms of the likelihoods of all hypotheses, and the best shape by each.

    Parameters
    ----------
    evidence : Evidence
        The beams towards and about it.
    centre : (3,)
        The place, in base [m].
    target : Target
        What is searched for.
    physics : Physics
        Of the scan.
    begun : (k, p)
        The best shapes by other physics, to begin with; (0, p) if there are none.

    Returns
    -------
    (k,), (k, p)
        Logarithms, and shapes.

    Notes
    -----
    The evidence of a shape is the integral of the likelihood over its prior: Laplace's
    approximation, or a sequential Monte Carlo where the decision is close. Beams are independent
    but for those of one place.
    """
    height, sigma, radius = evidence.height, evidence.sigma_height, target.radius
    logs, _ = _log_supports(evidence, centre, target)
    for kind in range(len(NAMES)):
        logs[kind] += np.log(_height_density(kind, height, sigma, radius))
    beams, priors = _compared_at(evidence, centre, target, physics, _N_BEAMS[len(begun) > 0])
    found, shapes = compared(beams, priors, logs, begun)
    return np.asarray(np.maximum(found, found.max() - _NEVER)), shapes


def shown_by(
    evidence: Evidence, centre: Array, target: Target, physics: Physics, sphere: Array
) -> tuple[Array, Array, Array]:
    """Return what the best sphere at a place shows of the physics of its scan.

    Parameters
    ----------
    evidence, centre, target, physics
        As in ``log_likelihoods``.
    sphere : (p,)
        The best one, by the same physics.

    Returns
    -------
    (7,), (7, 7), (9,)
        What markers share, as in ``Physics``, and its covariance; the logarithms of the likelihoods
        of the sphere by each of ``GATES``.
    """
    beams, priors = _compared_at(evidence, centre, target, physics, _N_BEAMS[0])
    of_beams = physics.sigmas[ALONG - NOISE : STRETCH - NOISE]
    shared, cov = shared_by(sphere, priors[SPHERE], of_beams, beams)
    shared[0] += np.log(target.radius)
    by_gate, densities = np.empty(len(GATES)), np.empty(len(beams.x))
    for i, gate in enumerate(np.eye(len(GATES))):
        own = merged_within(beams, gate, target.radius)
        by_gate[i] = log_likelihood(SPHERE, sphere, priors[SPHERE], own, densities)
    return shared, cov, by_gate


def _compared_at(
    evidence: Evidence, centre: Array, target: Target, physics: Physics, n_most: int
) -> tuple[Beams, Array]:
    """Return the beams that are compared at a place, and the priors of all shapes there."""
    distance, radius = float(np.linalg.norm(centre)), target.radius
    strength = max(evidence.brightness, 1.0) / distance**2
    faintest = min(max(physics.weakest / strength, _FLOOR), _HEARD)  # its own returns are heard
    _, held = _log_supports(evidence, centre, target)
    beams = beams_about(evidence, radius, strength, (physics.lost, faintest), held, n_most)
    beams = beams._replace(plumb=(slope_of(centre, target.up), radius / distance))
    beams, priors = merged_within(beams, physics.gates, radius), _priors(radius, physics)
    if abs(beams.face.sum()) < 0.5 * len(beams.face) - 3:  # both faces of the scan show it
        moved = MOVED / radius
        priors[SPHERE, 1, SHIFT:POLE] = moved
        priors[SPHERE, 1, SHIFT : SHIFT + 2] = hypot(TURNED * distance / radius, moved)
    return beams, priors


def _log_supports(evidence: Evidence, centre: Array, target: Target) -> tuple[Array, Array]:
    """Return what ``log_supports`` does, by the height of a place."""
    height, sigma, radius = evidence.height, evidence.sigma_height, target.radius
    standing = _standing_densities(height, sigma, radius)
    on_ground, perched = _boulder_densities(height, sigma, radius)
    lying = np.array([on_ground, 0.5 * perched, 0.5 * perched])
    shares = standing / standing.sum(), lying / lying.sum()
    return log_supports(evidence, float(centre @ target.up), radius, *shares)


def _priors(radius: float, physics: Physics) -> Array:
    """Return means and standard deviations of the parameters of all hypotheses, (k, 2, p)."""
    priors = np.zeros((len(NAMES), 2, N_PARAMETERS))
    priors[:, 1, :3], priors[:, 0, Z] = _CENTRE, -MEAN
    noise = float(np.exp(physics.shared[0])) / radius
    priors[:, 0, NOISE:STRETCH] = np.log(noise), *physics.shared[1:5]
    priors[:, 1, NOISE:ALONG] = physics.sigmas[:3]
    priors[: BALL + 1, :, STRETCH] = physics.shared[5], physics.sigmas[5]
    priors[SPHERE, :, FORM] = physics.shared[6], physics.sigmas[6]
    half, height, spread = _HEAD_SIZE
    head = ((np.log(half / radius), spread), (np.log(height), spread), (np.log(height), spread))
    for kind, form in {**_FORMS, HEAD: head}.items():
        priors[kind, :, FORM : FORM + len(form)] = np.transpose(form)
    priors[:, 0, POLE] = _POLE_SIZE[0]
    priors[[SPHERE, BALL, HEAD, CYLINDER, SOLID, PANEL], 1, POLE] = _POLE_SIZE[1]
    priors[BOULDER, :, NOISE] = physics.stones
    priors[HEAD, :, NOISE] = log(hypot(noise, _RELIEF)), _SIGMA_LOG_RELIEF
    priors[CLUTTER, 1, NOISE] = 0.0  # its own scatter is a parameter of form
    return priors


def usual_stones(log_noise: float, radius: float) -> float:
    """Return the logarithm of how far stones' surfaces lie about an ellipsoid [radii], usually."""
    return log(hypot(exp(log_noise) / radius, _RELIEF))


def _height_density(kind: int, height: float, sigma: float, radius: float) -> float:
    """Return the density of the height of a centre above the ground about it [1/m]."""
    unknown = 1.0 / _HEIGHTS
    if kind in _STAND:
        share = _share_as_high(height - radius - sigma) if kind == SPHERE else 1.0
        return float(_standing_densities(height, sigma, radius, share).sum())
    if kind == BOULDER:
        return sum(_boulder_densities(height, sigma, radius))
    if not sigma < _HEIGHTS:
        return unknown
    known = 0.5 * unknown * erfc(-height / (1.4142 * sigma))
    if kind == HEAD:
        mean, spread = _HEAD_HEIGHT
        standing = NormalDist(mean, hypot(spread, sigma)).pdf(height)
        known = _LOWERED * known + (1.0 - _LOWERED) * standing
    return _NOT_GROUND * unknown + (1.0 - _NOT_GROUND) * known


def _standing_densities(height: float, sigma: float, radius: float, share: float = 1.0) -> Array:
    """Return the densities of the height of what a pole holds, and of what is held otherwise, (4,).

    By something narrow; by something wide and low, or the ground; by something tall. Their sum is
    the density of all [1/m]. A ground that is wrong shows nothing wide. A share of what is not low
    is so high.
    """
    unknown = 1.0 / _HEIGHTS
    if not sigma < _HEIGHTS:
        return unknown * _STANDING
    above = erfc((radius - height) / (1.4142 * sigma))
    found = 0.5 * unknown * share * above * _STANDING
    found[2] = _ON_WIDE * above * NormalDist(0.0, hypot(_WIDE, sigma)).pdf(height)
    found[2] += _LYING * NormalDist(radius, hypot(_UNEVEN * radius, sigma)).pdf(height)
    found *= 1.0 - _NOT_GROUND
    found[0] += _NOT_GROUND * unknown
    return found


def _share_as_high(height: float) -> float:
    """Return how many of the poles of markers are so high, for each of a lower height.

    Lamps are higher, and crowns of trees.
    """
    return exp(-max(height - _HEIGHTS, 0.0) / _TALLER)


def _boulder_densities(height: float, sigma: float, radius: float) -> tuple[float, float]:
    """Return the densities of the height of a boulder on the ground, and on another.

    Their sum is the density of both [1/m].
    """
    unknown = 1.0 / _HEIGHTS
    if not sigma < _HEIGHTS:
        return (1.0 - _PERCHED) * unknown, _PERCHED * unknown
    mean, spread = _BOULDER_HEIGHT[0] * radius, _BOULDER_HEIGHT[1] * radius
    on_ground = (1.0 - _PERCHED) * NormalDist(mean, hypot(spread, sigma)).pdf(height)
    perched = _PERCHED * _density_above(height, _STONE, sigma)
    on_ground, perched = ((1.0 - _NOT_GROUND) * own for own in (on_ground, perched))
    return on_ground + _NOT_GROUND * unknown, perched


def _density_above(height: float, mean: float, sigma: float) -> float:
    """Return the density of a height of an exponential distribution, known to sigma [1/m]."""
    away = exp(0.5 * (sigma / mean) ** 2 - max(height, -_HEIGHTS) / mean)
    return 0.5 * away * erfc((sigma / mean - height / sigma) / 1.4142) / mean
