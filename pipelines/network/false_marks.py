"""Marks that may be false."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from spheremark.pipelines.model import Array, MarkerFit, MarkerFits, Status

if TYPE_CHECKING:
    from spheremark.pipelines.network.assembly import _Map

_FEW = 2.0  # fewer than one in so many of the stations that stand near: a mark may be false
_VERY_FEW = 4.0  # and then it most likely is
_N_HOLD = 3  # marks that a station keeps, suspect ones included
_ODD_SIGMAS, _ODD_SLACK = 3.29, 0.006  # [m] by which the mean radius of a sphere may be off

Scan = tuple[str, MarkerFits]


def suspect_marks(
    scans: Sequence[Scan], found: _Map, used: dict[int, list[tuple[int, int]]]
) -> tuple[dict[int, str], dict[tuple[int, int], str]]:
    """Return the suspect marks, and the centres dropped because their mark is probably false.

    A sphere is visible from all around. What only a few of the stations near it see is no mark for
    the network, unless a station would be left with too few others.
    """
    suspicions: dict[int, str] = {}
    dropped: dict[tuple[int, int], str] = {}
    n_marks = {i: len(pairs) for i, pairs in used.items()}
    places = np.array([found.poses[i][:3, 3] for i in used])
    for mark, seen in sorted(_sightings(used).items()):
        if mark < found.n_control:
            continue
        near, reason = _as_near(scans, places, found.p_site[mark], seen), ""
        is_weak = all(scans[i][1].fits[fit].status is Status.WEAK for i, fit in seen)
        if _FEW * len(seen) < near:
            reason = f"Only {len(seen)} of the {near} stations that stand near enough see it."
        if is_weak:
            weakness = scans[seen[0][0]][1].fits[seen[0][1]].reason.rstrip(".")
            reason += f" All {len(seen)} of its markers are weak: {weakness}."
        reason += _odd_radius([scans[i][1].fits[fit] for i, fit in seen])
        limit = _FEW if is_weak else _VERY_FEW
        if limit * len(seen) <= near and all(n_marks[i] > _N_HOLD for i, _ in seen):
            dropped |= dict.fromkeys(seen, f"{reason.strip()} It may be false.")
            for i, _ in seen:
                n_marks[i] -= 1
        elif reason:
            suspicions[mark] = reason.strip()
    return suspicions, dropped


def _sightings(used: dict[int, list[tuple[int, int]]]) -> dict[int, list[tuple[int, int]]]:
    """Return, by mark, the (station, fit) that see it."""
    seen: dict[int, list[tuple[int, int]]] = {}
    for i, pairs in used.items():
        for fit, mark in pairs:
            seen.setdefault(mark, []).append((i, fit))
    return seen


def _as_near(
    scans: Sequence[Scan], places: Array, p_site: Array, seen: list[tuple[int, int]]
) -> int:
    """Return how many stations stand as near to a mark as the farthest that sees it."""
    reach = max(float(np.linalg.norm(scans[i][1].fits[fit].p_base)) for i, fit in seen)
    return int(np.sum(np.linalg.norm(places - p_site, axis=1) < reach + 0.1))


def _odd_radius(fits: list[MarkerFit]) -> str:
    """Return that the sightings of a mark agree on another radius; empty if they do not."""
    known = [fit for fit in fits if np.isfinite(fit.radius_free) and fit.sigma_radius_free > 0.0]
    if not known:
        return ""
    weights = np.array([fit.sigma_radius_free**-2.0 for fit in known])
    mean = float(np.average([fit.radius_free for fit in known], weights=weights))
    off, sigma = mean - known[0].radius, float(weights.sum() ** -0.5)
    if abs(off) < _ODD_SIGMAS * sigma + _ODD_SLACK:
        return ""
    return f" Its own radius is {1e3 * mean:.0f} mm, sigma {1e3 * sigma:.0f} mm."
