"""How likely each shape is at a place: the evidence of the beams about it.

Hides where the search for the best shape of each kind begins, and which evidence is integrated.
"""

from __future__ import annotations

from typing import NamedTuple

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
from spheremark.pipelines.detection.volumes import log_another, log_integral, log_volume
from spheremark.pipelines.estimation.linear_algebra import invert
from spheremark.pipelines.model import Array

_GIVEN_UP = 12.0  # logarithm of odds against the sphere from which no other shape is sought
_GLANCED = (BALL, CYLINDER, POST, CLUTTER)  # one that is far better than a sphere ends the search
_ORDER = (0, 4, 8, 7, 1, 6, 5, 3, 2)  # the sphere, then what refutes it at the least cost
_STARTS = (0.0, -0.3, 0.3)  # of the logarithm of the radius of a ball
_UNSURE = (-4.0, 9.0)  # logarithms of odds for the sphere between which evidence is integrated


def shared_by(
    sphere: Array, prior: Array, sigmas_of_beams: Array, beams: Beams
) -> tuple[Array, Array]:
    """Return what a sphere shares with other markers, from the best one, and its covariance.

    ``sigmas_of_beams`` (2,) are those of how much wider beams are along the spin axis and of their
    scatter. The comparison takes both as given, as what all hypotheses have in common.
    """
    shape, prior = sphere.copy(), prior.copy()
    prior[1, ALONG:STRETCH] = sigmas_of_beams
    found = log_likelihood(SPHERE, shape, prior, beams, np.empty(len(beams.x)))
    climbed(SPHERE, shape, prior[1] > 0.0, prior, beams, found)
    free, N = information(SPHERE, shape, prior, beams)
    invert(N, N)
    first, sigmas = int(np.searchsorted(free, NOISE)), prior[1, NOISE : FORM + 1]
    own = slice(first, first + len(sigmas))
    return shape[NOISE : FORM + 1], np.asarray(N[own, own] * sigmas[:, None] * sigmas)


class _Search(NamedTuple):
    """What is compared, and what is found so far: arrays that the search writes.

    Attributes
    ----------
    beams : Beams
        About the place.
    priors : (k, 2, p)
        Means and standard deviations of the parameters.
    log_priors : (k,)
        Logarithms of the probabilities of the hypotheses.
    found : (k,)
        Logarithms of prior times evidence; minus infinity where nothing is found.
    shapes : (k, p)
        The best shapes; NaN where none was sought.
    """

    beams: Beams
    priors: Array
    log_priors: Array
    found: Array
    shapes: Array


def compared(beams: Beams, priors: Array, log_priors: Array, begun: Array) -> tuple[Array, Array]:
    """Return the logarithms of prior times evidence of all hypotheses, and their best shapes.

    ``begun`` are the best shapes by other priors, from which these are climbed to, NaN where one
    was not sought; (0, p) if there are none. A solid is always sought anew, beside the best sphere.
    Where the decision is close then, what may turn it is integrated.
    """
    n = len(log_priors)
    found, shapes = np.full(n, -np.inf), np.full((n, N_PARAMETERS), np.nan)
    shapes[SPHERE] = priors[SPHERE, 0]
    search = _Search(beams, priors, log_priors, found, shapes)
    for kind in _ORDER:
        is_named = kind != BALL or found[CYLINDER] < found.max()  # the two are easily confused
        if found[SPHERE] < found.max() - _GIVEN_UP and is_named:
            continue
        if kind != SOLID and len(begun) > 0 and not np.isnan(begun[kind, 0]):
            shape = begun[kind].copy()
            shape[ALONG:STRETCH] = priors[kind, 0, ALONG:STRETCH]
            _keep(kind, shape, _climbed(kind, shape, search), search)
        else:
            _seek(kind, search)
        if kind in (BALL, BOULDER) and found[kind] > -np.inf:  # a sphere may be there, too
            shape = _start(SPHERE, priors[SPHERE], shapes[kind], 0.0, beams)
            _keep(SPHERE, shape, _climbed(SPHERE, shape, search), search)
        if kind == SPHERE and not len(begun):
            _glance(search)
    odds = found[SPHERE] - found[SPHERE + 1 :].max()
    if len(begun) > 0 and _UNSURE[0] < odds < _UNSURE[1]:
        _integrate(search)
    return found, shapes


def _integrate(search: _Search) -> None:
    """Integrate the evidence of what may turn a close decision."""
    beams, priors, log_priors, found, shapes = search
    least, before = found.max() - _UNSURE[1], found[SPHERE]
    for kind in _ORDER:
        if kind == BALL:  # but for its size a sphere: corrected as that is
            found[BALL] += found[SPHERE] - before
        elif found[kind] > least:
            own = log_integral(kind, shapes[kind], priors[kind], beams)
            own += log_another(kind, shapes[kind], priors[kind], beams)
            found[kind] = own + log_priors[kind]


def _seek(kind: int, search: _Search) -> None:
    """Search for the best shape of a kind, where the best sphere is."""
    beams, priors, log_priors, found, shapes = search
    sphere, prior = shapes[SPHERE].copy(), priors[kind]
    steps = 0.4 * prior[1]
    if kind in (SPHERE, BALL):  # the centre is fitted already
        steps[:NOISE] = np.minimum(steps[:NOISE], 2.0 * np.exp(prior[0, NOISE]))
    for start in _STARTS if kind == BALL else _STARTS[:1]:
        shape = _start(kind, prior, sphere, start, beams)
        if kind == SOLID:
            own = _climbed(kind, shape, search)
        else:
            own = searched(kind, shape, steps, prior, beams, found.max() - log_priors[kind])
        if own > -np.inf:
            _keep(kind, shape, own, search)


def _glance(search: _Search) -> None:
    """Walk once to shapes of other kinds; keep them where they make the sphere hopeless.

    Their evidence is rough where a walk ends before the best.
    """
    beams, priors, log_priors, found, shapes = search
    glanced, most = [], -np.inf
    for kind in _GLANCED:
        prior = priors[kind]
        shape = _start(kind, prior, shapes[SPHERE], 0.0, beams)
        own = log_likelihood(kind, shape, prior, beams, np.empty(len(beams.x)))
        own = walked(kind, shape, 0.4 * prior[1], prior, beams, (own, -np.inf))
        most = max(most, own + log_volume(kind, shape, prior, beams) + log_priors[kind])
        glanced.append((kind, shape, own))
    if found[SPHERE] < most - 2.0 * _GIVEN_UP:
        for one in glanced:
            _keep(*one, search)


def _climbed(kind: int, shape: Array, search: _Search) -> float:
    """Move a shape to the best one nearby; return the logarithm of likelihood times prior."""
    beams, prior = search.beams, search.priors[kind]
    found = log_likelihood(kind, shape, prior, beams, np.empty(len(beams.x)))
    return float(climbed(kind, shape, prior[1] > 0.0, prior, beams, found))


def _keep(kind: int, shape: Array, log_most: float, search: _Search) -> None:
    """Replace the shape of a kind by one with greater evidence, by Laplace's approximation.

    ``log_most`` is the logarithm of its likelihood times prior.
    """
    beams, priors, log_priors, found, shapes = search
    own = log_most + log_volume(kind, shape, priors[kind], beams) + log_priors[kind]
    if own > found[kind]:  # else it is worse without that, too: a probability only lowers it
        own += log_another(kind, shape, priors[kind], beams)
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
