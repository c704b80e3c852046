"""How likely each shape is at a place: the evidence of the beams about it.

Hides where the search for the best shape of each kind begins, and which evidence is integrated.
"""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.detection.beams import Beams
from spheremark.pipelines.detection.maxima import climbed, information, searched, walked
from spheremark.pipelines.detection.shapes import (
    ALONG,
    BALL,
    BOULDER,
    CLUTTER,
    CYLINDER,
    FORM,
    HEAD,
    N_PARAMETERS,
    NOISE,
    POLE,
    POST,
    SHIFT,
    SOLID,
    SPHERE,
    STRETCH,
    align,
    log_likelihood,
)
from spheremark.pipelines.detection.volumes import log_integral, log_volume
from spheremark.pipelines.estimation.linear_algebra import invert
from spheremark.pipelines.model import Array

_GIVEN_UP = 12.0  # logarithm of odds against the sphere from which no other shape is sought
_GLANCED = (BALL, CYLINDER, POST, CLUTTER)  # one that is far better than a sphere ends the search
_ORDER = (0, 4, 8, 7, 1, 6, 5, 3, 2)  # the sphere, then what refutes it at the least cost
_STARTS = (0.0, -0.3, 0.3)  # of the logarithm of the radius of a ball
_UNSURE = (-4.0, 9.0)  # logarithms of odds for the sphere between which evidence is integrated


def _evidence(kind: int, shape: Array, prior: Array, beams: Beams, least: float) -> float:
    """Return the logarithm of the evidence of a hypothesis; its best shape replaces the start.

    By Laplace's approximation. Minus infinity where it falls hopelessly below the least.
    """
    steps = 0.4 * prior[1]
    if kind in (SPHERE, BALL):  # the centre is fitted already
        steps[:NOISE] = np.minimum(steps[:NOISE], 2.0 * np.exp(prior[0, NOISE]))
    found = searched(kind, shape, steps, prior, beams, least)
    if found == -np.inf:
        return -np.inf
    return float(found + log_volume(kind, shape, prior, beams))


def _evidence_nearby(kind: int, shape: Array, prior: Array, beams: Beams) -> float:
    """Return the logarithm of the evidence of a hypothesis; its best shape nearby replaces it."""
    found = log_likelihood(kind, shape, prior, beams, np.empty(len(beams.x)))
    found = climbed(kind, shape, prior[1] > 0.0, prior, beams, found)
    return float(found + log_volume(kind, shape, prior, beams))


def shared_by(sphere: Array, prior: Array, sigma_along: float, beams: Beams) -> tuple[Array, Array]:
    """Return what a sphere shares with other markers, from the best one, and its covariance.

    How much wider beams are along the spin axis is known to a sigma; the comparison takes it as
    given, as what all hypotheses have in common.
    """
    shape, prior = sphere.copy(), prior.copy()
    prior[1, ALONG] = sigma_along
    found = log_likelihood(SPHERE, shape, prior, beams, np.empty(len(beams.x)))
    climbed(SPHERE, shape, prior[1] > 0.0, prior, beams, found)
    free, N = information(SPHERE, shape, prior, beams)
    invert(N, N)
    first, sigmas = int(np.searchsorted(free, NOISE)), prior[1, NOISE : FORM + 1]
    own = slice(first, first + len(sigmas))
    return shape[NOISE : FORM + 1], np.asarray(N[own, own] * sigmas[:, None] * sigmas)


def compared(beams: Beams, priors: Array, log_priors: Array, begun: Array) -> tuple[Array, Array]:
    """Return the logarithms of prior times evidence of all hypotheses, and their best shapes.

    ``begun`` are the best shapes by other priors, from which these are climbed to, NaN where one
    was not sought; (0, p) if there are none. A solid is always sought anew, beside the best sphere.
    Where the decision is close then, what may turn it is integrated.
    """
    found = np.full(len(log_priors), -np.inf)
    shapes = np.full((len(log_priors), N_PARAMETERS), np.nan)
    shapes[SPHERE] = priors[SPHERE, 0]
    for kind in _ORDER:
        is_named = kind != BALL or found[CYLINDER] < found.max()  # the two are easily confused
        if found[SPHERE] < found.max() - _GIVEN_UP and is_named:
            continue
        is_begun = kind != SOLID and len(begun) > 0 and not np.isnan(begun[kind, 0])
        if is_begun:
            shape = begun[kind].copy()
            shape[ALONG] = priors[kind, 0, ALONG]
            own = _evidence_nearby(kind, shape, priors[kind], beams)
            _keep(kind, shape, own + log_priors[kind], found, shapes)
        else:
            _seek(kind, priors, log_priors, beams, (found, shapes))
        if kind in (BALL, BOULDER) and found[kind] > -np.inf:
            _seek_sphere(shapes[kind], priors, log_priors, beams, (found, shapes))
        if kind == SPHERE and not len(begun):
            _glance(priors, log_priors, beams, (found, shapes))
    odds = found[SPHERE] - found[SPHERE + 1 :].max()
    if len(begun) > 0 and _UNSURE[0] < odds < _UNSURE[1]:
        _integrate(priors, log_priors, beams, (found, shapes))
    return found, shapes


def _integrate(priors: Array, log_priors: Array, beams: Beams, known: tuple[Array, Array]) -> None:
    """Integrate the evidence of what may turn a close decision; ``known`` as ``compared``."""
    found, shapes = known
    least, before = found.max() - _UNSURE[1], found[SPHERE]
    for kind in _ORDER:
        if kind == BALL:  # but for its size a sphere: corrected as that is
            found[BALL] += found[SPHERE] - before
        elif found[kind] > least:
            own = log_integral(kind, shapes[kind], priors[kind], beams)
            found[kind] = own + log_priors[kind]


def _seek(
    kind: int, priors: Array, log_priors: Array, beams: Beams, known: tuple[Array, Array]
) -> None:
    """Search for the best shape of a kind, where the best sphere is; ``known`` as ``compared``."""
    found, shapes = known
    sphere = priors[SPHERE, 0] if kind == SPHERE else shapes[SPHERE]
    for start in _STARTS if kind == BALL else _STARTS[:1]:
        shape = _start(kind, priors[kind], sphere, start, beams)
        if kind == SOLID:
            own = _evidence_nearby(kind, shape, priors[kind], beams)
        else:
            own = _evidence(kind, shape, priors[kind], beams, found.max() - log_priors[kind])
        _keep(kind, shape, own + log_priors[kind], found, shapes)


def _seek_sphere(
    other: Array, priors: Array, log_priors: Array, beams: Beams, known: tuple[Array, Array]
) -> None:
    """Search for the best sphere where another shape is; ``known`` as ``compared``."""
    shape = _start(SPHERE, priors[SPHERE], other, 0.0, beams)
    own = _evidence_nearby(SPHERE, shape, priors[SPHERE], beams)
    _keep(SPHERE, shape, own + log_priors[SPHERE], *known)


def _glance(priors: Array, log_priors: Array, beams: Beams, known: tuple[Array, Array]) -> None:
    """Walk once to shapes of other kinds; keep them where they make the sphere hopeless.

    Their evidence is rough where a walk ends before the best. ``known`` as ``compared``.
    """
    found, shapes = known[0].copy(), known[1].copy()
    for kind in _GLANCED:
        shape = _start(kind, priors[kind], shapes[SPHERE], 0.0, beams)
        own = log_likelihood(kind, shape, priors[kind], beams, np.empty(len(beams.x)))
        own = walked(kind, shape, 0.4 * priors[kind, 1], priors[kind], beams, (own, -np.inf))
        own += log_volume(kind, shape, priors[kind], beams)
        _keep(kind, shape, own + log_priors[kind], found, shapes)
    if found[SPHERE] < found.max() - 2.0 * _GIVEN_UP:
        known[0][:], known[1][:] = found, shapes


def _keep(kind: int, shape: Array, own: float, found: Array, shapes: Array) -> None:
    """Replace the shape of a kind by one with greater evidence."""
    if own > found[kind]:
        found[kind], shapes[kind] = own, shape


def _start(kind: int, prior: Array, sphere: Array, start: float, beams: Beams) -> Array:
    """Return a start of the search for the best shape of a kind where the best sphere is."""
    shape: Array = prior[0].copy()
    shape[:STRETCH], shape[SHIFT:] = sphere[:STRETCH], sphere[SHIFT:]
    if kind == HEAD:
        shape[NOISE] = prior[0, NOISE]
    if kind in (SPHERE, BALL):
        shape[STRETCH] = sphere[STRETCH]
    if kind == SOLID:
        shape[POLE] = prior[0, POLE]
    if kind in (BALL, BOULDER, SOLID):
        shape[FORM] = sphere[FORM]
    if kind == SPHERE:  # its size is nearly known
        mean, sigma = prior[:, FORM]
        shape[FORM] = min(max(sphere[FORM], mean - 2.0 * sigma), mean + 2.0 * sigma)
    if kind == BALL:
        shape[FORM] += start
    if kind == BOULDER:
        shape[FORM + 2] = sphere[STRETCH]
    align(kind, shape, beams)
    return shape
