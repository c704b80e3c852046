"""Bounds that no arrangement goes below: they refuse impossible goals and certify plans.

A best linear unbiased estimate is at least as good as any station of ``station_covariance``: its
information is a sum over marks, with the error that all ranges share as a seventh unknown, and the
variance of a position is convex in it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.stats import chi

from spheremark.pipelines.estimation.linear_algebra import invert_each
from spheremark.pipelines.geometry import by_motion
from spheremark.pipelines.model import Array, Index
from spheremark.pipelines.placement.plan import Requirement
from spheremark.pipelines.placement.station_covariance import (
    Observables,
    covariances,
)
from spheremark.pipelines.progress import checkpoint

_N_UNKNOWNS = 7  # rotation, position, and the error of range that all centres share
_ROWS, _COLUMNS = np.tril_indices(_N_UNKNOWNS)
_POSITION = [3, 4, 5]
_TWICE = np.where(_ROWS == _COLUMNS, 1.0, 2.0)  # of elements off the diagonal in a trace
_LOOSE_PRIOR = np.array([3.0, 3.0, 3.0, 10.0, 10.0, 10.0, 1.0])  # [rad, m] before a mark is seen
_STEPS = 600  # of the relaxation; the gap to its optimum is then some 0.2 %
_FULL_EVERY = 10  # steps with all places; only these bound
_ACTIVE = 1000  # places of the steps between, by shares
_SETTLED, _PATIENCE = 1e-4, 16  # a smaller gain is none; so many of these in turn end it
_ROUNDS = 4  # in which the scale of shares settles well enough: the bound holds for any
_ROUNDING = 1e-5  # of single precision, in which information is kept
_PACE = 8.0  # exponent of the first steps of the weights of stops


class Relaxation(NamedTuple):
    """The best arrangement if marks could be divided among places."""

    bound: float  # 3-D sigma at the worst stop that no arrangement of whole marks goes below [m]
    shares: Array  # (c,) of a mark at each place


def information_of(observables: Observables, requirement: Requirement) -> Array:
    """Return the information of each mark at each station, lower triangles, (n, s * 28)."""
    v, is_seen = observables.vectors, observables.is_seen[..., None, None]
    weights, _ = invert_each(np.where(is_seen, covariances(observables, requirement)[1], np.eye(3)))
    along = v / np.maximum(np.linalg.norm(v, axis=2, keepdims=True), 1e-9)
    J = np.concatenate([by_motion(v), along[..., None]], axis=-1)
    found = np.swapaxes(J, -1, -2) @ np.where(is_seen, weights, 0.0) @ J
    found *= observables.found[..., None, None]
    rows = np.swapaxes(found[..., _ROWS, _COLUMNS], 0, 1).reshape(v.shape[1], -1)
    return np.asarray(rows, dtype=np.float32)


def start_information(variance: float, requirement: Requirement) -> Array:
    """Return the information of a station without marks: gravity, and the range error's size."""
    level = requirement.sigma_levelling**-2.0
    shared = 1.0 / max(variance, 1e-18)
    return np.diag([level, level, 0.0, 0.0, 0.0, 0.0, shared])


def relax(  # noqa: PLR0913  all that a relaxation is made of
    information: Array,
    start: Array,
    groups: Index,
    n_marks: int,
    sigma_height: float,
    *,
    is_mean: bool = False,
    report: Callable[[float, float], None] = lambda _share, _bound: None,
) -> Relaxation:
    """Bound the 3-D sigma at the worst stop, or its mean over stops, over all arrangements.

    ``groups`` are places too near to each other for two marks; ``start`` is the information of
    stations without marks; the share of the steps and the bound so far are reported.

    Notes
    -----
    The least largest variance over shares of marks, of which no group has more than one, is a
    convex problem. Multiplicative steps on shares and on weights of the stops (Fedorov and Hackl,
    1997; Arora et al., 2012) approach it, most of them on the places with the largest shares
    alone; the bound needs no convergence. For weights ``w``, and with ``Y`` the position's columns
    of any inverse, ``sum w (2 trace(Y_p) - trace(Y' N Y))`` is below the weighted variance of every
    arrangement and linear in its information, so that the arrangement with the largest sum of
    scores, one in each group, bounds them all. A sigma is convex in the information too, so that
    tangents bound its mean.
    """
    n_stops = information.shape[1] // len(_ROWS)
    weights = np.ones(n_stops)
    shares = np.full(len(information), n_marks / len(information))
    best, gains = Relaxation(0.0, shares), 0
    start = np.broadcast_to(start, (n_stops, _N_UNKNOWNS, _N_UNKNOWNS))
    part, some, fixed = information, np.arange(len(information)), start
    for step in range(_STEPS):
        checkpoint()
        is_full = step % _FULL_EVERY == 0
        if is_full:
            part, some, fixed = information, np.arange(len(shares)), start
        normal = fixed + unpacked(shares[some].astype(np.float32) @ part)
        columns = np.linalg.inv(normal)[:, :, _POSITION]
        variances = np.trace(columns[:, _POSITION], axis1=1, axis2=2)
        sigmas = np.sqrt(variances + sigma_height**2)
        weights = 0.5 / sigmas / n_stops if is_mean else weights / weights.sum()
        squares = columns @ np.swapaxes(columns, 1, 2)
        scores = _scored(part, weights[:, None, None] * squares)
        moved = shares[some] * np.sqrt(np.maximum(scores, 0.0))
        if is_full:
            own = np.einsum("sij,sij->s", start, squares)
            free = variances - own + (sigmas / weights / n_stops if is_mean else variances)
            bound = float(weights @ free) - _largest_sum(scores, groups, n_marks)
            gains = gains + 1 if bound < (1.0 + _SETTLED) * best.bound else 0
            if bound > best.bound:
                best = Relaxation(bound, shares)
            shares = _divided(moved, groups, n_marks)
            report(step / _STEPS, _sigma(best.bound, sigma_height, is_mean=is_mean))
            if gains >= _PATIENCE:
                break
            some = np.argsort(-shares)[:_ACTIVE]
            part = information[some]
            others = np.delete(np.arange(len(shares)), some)
            fixed = start + unpacked(shares[others].astype(np.float32) @ information[others])
        else:
            shares = shares.copy()
            shares[some] = moved * (shares[some].sum() / moved.sum())
            shares = _divided(shares, groups, n_marks)
        pace = _PACE / np.sqrt(1.0 + step / 50.0)
        weights = weights * np.exp(pace * 0.5 * (variances / variances.max() - 1.0))
    return best._replace(bound=_sigma(best.bound, sigma_height, is_mean=is_mean))


def _sigma(bound: float, sigma_height: float, *, is_mean: bool) -> float:
    """Return the sigma of a bound of weighted variances, or of the mean of sigmas [m]."""
    bound = max((1.0 - _ROUNDING) * bound, 0.0)
    return bound if is_mean else float(np.sqrt(bound + sigma_height**2))


def groups_of(p_site: Array, apart: float) -> Index:
    """Return boxes, by number, whose places are too near to each other for two marks."""
    n_levels = int(np.ceil(np.ptp(p_site[:, 2]) / (0.55 * apart))) or 1
    height = np.ptp(p_site[:, 2]) / n_levels
    width = 0.999 * np.sqrt((apart**2 - height**2) / 2.0)
    low = p_site.min(axis=0)
    cells = np.floor((p_site - low) / [width, width, max(height, 1e-9)])
    cells[:, 2] = np.minimum(cells[:, 2], n_levels - 1)
    return np.asarray(np.unique(cells, axis=0, return_inverse=True)[1].ravel(), dtype=np.intp)


def gained(information: Array, start: Array, chosen: Array, n_marks: int) -> tuple[float, float]:
    """Return the logarithm of the determinant that marks gain, and its bound over arrangements.

    The bound is the tangent of the concave logarithm at the marks' own information.
    """
    loose = start + np.diag(_LOOSE_PRIOR**-2.0)
    normal = loose + unpacked(chosen.sum(axis=0))
    inverse = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    gain = float((np.linalg.slogdet(normal)[1] - np.linalg.slogdet(loose)[1]).sum())
    scores, own = (_scored(part, inverse) for part in (information, chosen))
    return gain, gain + float(np.sort(scores)[-n_marks:].sum() - own.sum())


def least_sigmas(information: Array, requirement: Requirement) -> Array:
    """Return the 3-D sigmas, (s, n), that no arrangement of so many of the marks goes below.

    Notes
    -----
    As if the station's rotation were known, and every stop had its own best marks:
    ``trace(A^-1) >= 9 / trace(A)``, and traces of information add up. By three circles three marks
    carry a position, out of any number.
    """
    diagonal = np.isin(_ROWS, _POSITION) & (_ROWS == _COLUMNS)
    traces = information.reshape(len(information), -1, len(_ROWS))[..., diagonal].sum(axis=2).T
    best = -np.sort(-traces, axis=1)
    if requirement.method == "paper":
        best[:, 3:] = 0.0
    with np.errstate(divide="ignore"):
        variances = 9.0 / np.cumsum(best, axis=1)
    return np.asarray(np.sqrt(variances + requirement.resection.sigma_height**2))


def widest_sigma(tolerance: float, probability: float) -> float:
    """Return the largest 3-D sigma with which an error can be within a tolerance so probably."""
    return float(max(tolerance * np.sqrt(n) / chi(n).ppf(probability) for n in (1, 2, 3)))


def unpacked(rows: Array) -> Array:
    """Return symmetric matrices, (s, 7, 7), from their lower triangles one after another."""
    rows = rows.reshape(-1, len(_ROWS))
    out = np.empty((len(rows), _N_UNKNOWNS, _N_UNKNOWNS))
    out[:, _ROWS, _COLUMNS] = out[:, _COLUMNS, _ROWS] = rows
    return out


def _scored(information: Array, matrices: Array) -> Array:
    """Return the traces of the products of each mark's information with matrices, all stops."""
    row = (matrices[:, _ROWS, _COLUMNS] * _TWICE).ravel()
    return np.asarray(information @ row.astype(np.float32), dtype=np.float64)


def _largest_sum(scores: Array, groups: Index, n_marks: int) -> float:
    """Return the largest sum of as many scores as there are marks, one of each group."""
    largest = np.zeros(groups.max() + 1)
    np.maximum.at(largest, groups, scores)
    return float(np.sort(largest)[-n_marks:].sum())


def _divided(shares: Array, groups: Index, n_marks: int) -> Array:
    """Return shares in the same proportion that add up to the marks, at most 1 in each group."""
    totals = np.bincount(groups, shares)
    is_full, scale = np.zeros(len(totals), dtype=np.bool_), 1.0
    for _ in range(_ROUNDS):
        scale = (n_marks - is_full.sum()) / max(totals[~is_full].sum(), 1e-300)
        is_full = scale * totals >= 1.0
    return np.asarray(shares * np.minimum(scale, 1.0 / np.maximum(totals, 1e-300))[groups])
