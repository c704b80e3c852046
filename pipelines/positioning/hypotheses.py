"""Candidate poses that lay some fits on some marks: how they are found, thinned out and scored.

Two fits and two marks that are as far apart, and rise alike, give a heading and a translation.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import Array, Index

_N_CANDIDATES = 300_000  # pairs of pairs that are compared at most; more find nothing new
_N_HYPOTHESES = 1000  # poses that are looked at; the true one has many votes
_N_CELLS = 500  # of the way across the marks: they are sorted into these


class Spans(NamedTuple):
    """Marks two by two, in both orders, the nearest to each other first."""

    first: Index  # (h,) places among the marks
    second: Index
    targets: Array  # (h, 3) from the first to the second [m]
    lengths: Array  # (h,) how long each is [m]


class Hypotheses(NamedTuple):
    """Poses of the levelled frame that are to be tried."""

    yaws: Array  # (h,) headings [rad]
    translations: Array  # (h, 3) translations [m]


IDENTITY = Hypotheses(np.zeros(1), np.zeros((1, 3)))
"""The identity pose."""


def spans_between(marks_site: Array, longest: float) -> Spans:
    """List marks two by two.

    Parameters
    ----------
    marks_site : (m, 3)
        Marks [m].
    longest : float
        How far apart they may be [m].

    Returns
    -------
    Spans
        What two fits can be compared with.
    """
    pairs = cKDTree(marks_site).query_pairs(longest, output_type="ndarray")
    first, second = np.concatenate([pairs, pairs[:, ::-1]]).T
    targets = marks_site[second] - marks_site[first]
    lengths = np.linalg.norm(targets, axis=1)
    order = np.lexsort((second, first, lengths))
    return Spans(first[order], second[order], targets[order], lengths[order])


def align(
    levelled: Array, marks_site: Array, tolerance: float, slope: float, spans: Spans | None = None
) -> Hypotheses:
    """Find the poses that bring some two fits onto some two marks."""
    return _voted(_laid(levelled, marks_site, tolerance, slope, spans), levelled, tolerance)


def _laid(
    levelled: Array, marks_site: Array, tolerance: float, slope: float, known: Spans | None
) -> Hypotheses:
    """Return all these poses."""
    first, second = pairs_far_first(len(levelled))
    spans = levelled[second] - levelled[first]
    usable = np.hypot(spans[:, 0], spans[:, 1]) > 2.0 * tolerance
    first, second, spans = first[usable], second[usable], spans[usable]
    reach = np.linalg.norm(spans, axis=1)
    longest = float(reach.max(initial=0.0)) + 2.0 * tolerance
    goals = known or spans_between(marks_site, longest)
    low = np.searchsorted(goals.lengths, reach - tolerance)
    counts = np.searchsorted(goals.lengths, reach + tolerance) - low
    counts[np.cumsum(counts) > max(_N_CANDIDATES, counts[:1].sum())] = 0
    slacks = tolerance + slope * reach
    middles = (levelled[first] + levelled[second]) / 2.0
    fits = (spans, middles, slacks)
    return Hypotheses(*_aligned(fits, (low, low + counts), goals, marks_site))


@compiled
def _aligned(
    fits: tuple[Array, Array, Array], ranges: tuple[Index, Index], goals: Spans, marks_site: Array
) -> tuple[Array, Array]:
    """Return the poses that bring spans between fits onto those of a range that rise alike.

    ``fits`` are the spans, their middles, and by how much they may rise more or less.
    """
    (spans, middles, slacks), (low, high), n = fits, ranges, 0
    for k in range(len(spans)):
        for g in range(low[k], high[k]):
            n += abs(goals.targets[g, 2] - spans[k, 2]) <= slacks[k]
    yaws, translations, n = np.empty(n), np.empty((n, 3)), 0
    for k in range(len(spans)):
        x, y, z = middles[k]
        azimuth = np.arctan2(spans[k, 1], spans[k, 0])
        for g in range(low[k], high[k]):
            if abs(goals.targets[g, 2] - spans[k, 2]) > slacks[k]:
                continue
            p, q = marks_site[goals.first[g]], marks_site[goals.second[g]]
            yaws[n] = np.arctan2(goals.targets[g, 1], goals.targets[g, 0]) - azimuth
            c, s = np.cos(yaws[n]), np.sin(yaws[n])
            translations[n, 0] = (p[0] + q[0]) / 2.0 - (c * x - s * y)
            translations[n, 1] = (p[1] + q[1]) / 2.0 - (s * x + c * y)
            translations[n, 2] = (p[2] + q[2]) / 2.0 - z
            n += 1
    return yaws, translations


@lru_cache(maxsize=8)
def pairs_far_first(n: int) -> tuple[Index, Index]:
    """Return all pairs of fits, those far apart in azimuth first."""
    first, second = np.triu_indices(n, 1)
    apart = np.minimum(second - first, n - (second - first))
    order = np.argsort(-apart, kind="stable")
    return first[order], second[order]


def _voted(hypotheses: Hypotheses, levelled: Array, tolerance: float) -> Hypotheses:
    """Return the hypotheses that most others agree with."""
    if len(hypotheses.yaws) <= _N_HYPOTHESES:
        return hypotheses
    middle = levelled.mean(axis=0)
    spread = np.sqrt(np.mean(np.sum((levelled - middle)[:, :2] ** 2, axis=1)))
    (x, y, _), c, s = middle, np.cos(hypotheses.yaws), np.sin(hypotheses.yaws)
    place = np.column_stack([c * x - s * y, s * x + c * y]) + hypotheses.translations[:, :2]
    turns = spread * (hypotheses.yaws % (2.0 * np.pi))
    cells = np.column_stack([place - place.min(axis=0), turns]) // (2.0 * tolerance)
    width = cells.max(axis=0) + 1.0
    keys = (cells[:, 0] * width[1] + cells[:, 1]) * width[2] + cells[:, 2]
    _, cell, votes = np.unique(keys, return_inverse=True, return_counts=True)
    chosen = np.argsort(-votes[cell], kind="stable")[:_N_HYPOTHESES]
    return Hypotheses(hypotheses.yaws[chosen], hypotheses.translations[chosen])


def assign(
    p: Array, hypotheses: Hypotheses, marks_site: Array, tolerance: float, slack: float
) -> tuple[Index, Array]:
    """Give fits the marks that they are near to.

    Notes
    -----
    A mark goes to the fit that is nearest. The score of a matched fit falls from 1 to 0 with the
    square of its distance (MSAC, Torr and Zisserman 2000).
    """
    eastwards = np.argsort(marks_site[:, 0])
    extent = float(np.ptp(marks_site[:, 0]))
    side = max(tolerance, extent / _N_CELLS)
    west = float(marks_site[eastwards[0], 0])
    edges = west + side * np.arange(int(extent / side) + 2)
    starts = np.searchsorted(marks_site[eastwards, 0], edges)
    table = (eastwards, marks_site[eastwards], starts)
    marks = np.full((len(hypotheses.yaws), len(p)), -1, dtype=np.intp)
    return marks, _assign(p, hypotheses, table, (tolerance, slack, west, side), marks)


@compiled
def _assign(
    p: Array,
    hypotheses: Hypotheses,
    table: tuple[Index, Array, Index],
    limits: tuple[float, float, float, float],
    marks: Index,
) -> Array:
    """Fill in marks, of which there are none yet, and return scores.

    ``table`` are the marks from west to east, and where cells begin among them; limits as of
    ``_nearest``.
    """
    n, scores, (eastwards, marks_site, starts) = len(p), np.zeros(len(marks)), table
    near, squares = np.empty(n, dtype=np.intp), np.empty(n)
    owners = np.full(len(eastwards), -1, dtype=np.intp)
    for h in range(len(marks)):
        c, s = np.cos(hypotheses.yaws[h]), np.sin(hypotheses.yaws[h])
        t = hypotheses.translations[h]
        for i in range(n):
            x, y, z = c * p[i, 0] - s * p[i, 1], s * p[i, 0] + c * p[i, 1], p[i, 2]
            place = (x + t[0], y + t[1], z + t[2])
            near[i], squares[i] = _nearest(place, marks_site, starts, limits)
            owner = owners[near[i]] if near[i] >= 0 else i
            if near[i] >= 0 and (owner < 0 or squares[i] < squares[owner]):
                owners[near[i]] = i
        for i in range(n):
            if near[i] >= 0 and owners[near[i]] == i:
                marks[h, i] = eastwards[near[i]]
                scores[h] += 1.0 - squares[i] / limits[0] ** 2
        for i in range(n):
            if near[i] >= 0:
                owners[near[i]] = -1
    return scores


@compiled
def _nearest(
    place: tuple[float, float, float],
    marks: Array,
    starts: Index,
    limits: tuple[float, float, float, float],
) -> tuple[int, float]:
    """Return the nearest mark, in the order of the table, or -1; and the square of its distance.

    ``limits`` are tolerance, slack of heights, where the first cell begins and how wide each is.
    """
    (x, y, z), (tolerance, slack, west, side) = place, limits
    best, least = -1, tolerance * tolerance
    cell = min(max(int((x - tolerance - west) / side), 0), len(starts) - 1)
    for j in range(starts[cell], len(marks)):
        if marks[j, 0] > x + tolerance:
            break
        dx, dy, dz = marks[j, 0] - x, marks[j, 1] - y, (marks[j, 2] - z) / slack
        square = dx * dx + dy * dy + dz * dz
        if square < least:
            best, least = j, square
    return best, least


def agreements(marks: Index, others: Index) -> Index:
    """Count the fits that have the same mark in each of many matches and in another one."""
    return np.asarray(np.sum((marks == others) & (others >= 0), axis=1))
