"""Better places for stops beside given marks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.distance import cdist

from spheremark.pipelines.model import Array, Mask
from spheremark.pipelines.placement.evaluation import predict_observables
from spheremark.pipelines.placement.plan import Arrangement, Site, Stops, bilinear
from spheremark.pipelines.placement.scoring import Problem
from spheremark.pipelines.placement.station_covariance import predict_positions
from spheremark.pipelines.placement.visibility import find_visibility, with_occlusion

_RINGS = 4  # of places that are tried round a stop
_CLEARANCE = 0.1  # [m] that what stands on the ground may rise under the rover
_DIGITS = 3  # of coordinates: millimetres


def moved_stops(given: Stops, reach: float, problem: Problem, marks: Arrangement) -> Stops:
    """Return each stop at the best of places round where it was given, beside given marks.

    The marks keep their least distance from stops; a stop that has no better place stays.
    """
    site, present = problem.site, problem.stops
    rules = problem.candidates.rules
    clear = rules.clear + rules.placement if rules is not None else 0.0
    rings = [(reach * r / _RINGS, 6 * r) for r in range(1, _RINGS + 1)]
    around = np.concatenate(
        [
            radius * np.column_stack([np.cos(t), np.sin(t)])
            for radius, n in rings
            for t in [2.0 * np.pi * np.arange(n) / n]
        ]
    )
    tried = np.repeat(given.p_site[:, None], len(around), axis=1)
    tried[..., :2] += around
    tried = np.round(tried, _DIGITS)
    tried[..., 2] += site.ground_at(tried) - site.ground_at(given.p_site)[:, None]
    tried = np.concatenate([present.p_site[:, None], tried], axis=1)
    places = tried.reshape(-1, 3)
    is_free = _is_free(site, places)
    is_free &= cdist(places[:, :2], marks.p_site[:, :2]).min(axis=1, initial=np.inf) >= clear
    sigmas = np.full(len(places), np.inf)
    sigmas[is_free] = _sigmas(problem, places[is_free], marks)
    best = sigmas.reshape(tried.shape[:2])
    best[:, 0] = np.where(np.isfinite(best[:, 0]), best[:, 0], np.finfo(float).max)
    p_site = tried[np.arange(len(tried)), best.argmin(axis=1)]
    return replace(given, p_site=p_site)


def _is_free(site: Site, places: Array) -> Mask:
    """Return at which places the ground is known and nothing stands on it."""
    rises = bilinear(site, np.nan_to_num(site.surface - site.ground), places)
    return np.asarray(np.isfinite(places[:, 2]) & (rises < _CLEARANCE))


def _sigmas(problem: Problem, places: Array, marks: Arrangement) -> Array:
    """Return the 3-D sigmas of positions at places [m]."""
    site, requirement = problem.site, problem.requirement
    visibility = with_occlusion(site, places, marks, find_visibility(site, places, marks))
    _, observables = predict_observables(places, marks, problem.model, requirement, visibility)
    covs = predict_positions(observables, requirement).cov_motion[:, 3:, 3:]
    return np.asarray(np.sqrt(np.trace(covs, axis1=1, axis2=2)))
