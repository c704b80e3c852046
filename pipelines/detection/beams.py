"""The beams about a place that are compared, and what stands behind and beside the object there.

Hides which beams say most, and what happens to a beam that passes the object by. Lengths are in
radii of the sphere that is searched for; x is across the line of sight, y up it, z along it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.detection.evidence import N_ROWS, ROW, Evidence
from spheremark.pipelines.model import Array, Index, Mask

NEAR = 3.0
"""Depth about a centre within which a return may belong to the object there."""

BELOW = -0.3
"""Beams that pass so far below a centre are beside its pole, not beside the object."""

_AROUND = 1.35  # beams that pass so far from a centre, beside half a beam, show its outline
_LOWEST = -0.9  # anything lower may be what it stands on
_UNDER = (0.5, -3.0)  # half width and depth below a centre where its pole or the rest of a post is
_BESIDE = (1.2, 2.2)  # distances from a centre, beside half a beam, of beams that pass it by
_CELL, _N_CELL = 0.1, 2  # beams that pass the same place share the errors of the model
_N_SIDES, _ANY_SIDE = 12, 0.3  # sides of an object; beams on each of which nothing is known
_N_PLANE, _ROUGH = 5, 0.1  # returns that show a plane beside it, and the least scatter about one
_ALIKE = 0.3  # heights of beams, and depths, within which what is wide is alike
_SQUARE = 0.1  # squared radii: fewer beams across do not show that a side is askew
_CORNER = 0.2  # share of what is wide that is as deep beneath as nothing beside it shows
_TINY = 1e-9
_FAINT = 1e-9  # least strength of an echo
_AWAY = 40.0  # depth of what is not seen behind an object: too far to matter
_WIDTHS = np.linspace(-1.0, 1.0, 401)  # half widths of a beam from its middle to an outline
_SHARES = (np.arccos(_WIDTHS) - _WIDTHS * np.sqrt(1.0 - _WIDTHS**2)) / np.pi  # of it, inside

GATES = np.array([0.0, *np.geomspace(0.1, 1.0, 8)])
"""Distances [m] below which the echoes of two surfaces are one; the first: they never are."""


class Beams(NamedTuple):
    """Beams about a place.

    Attributes
    ----------
    x, y, z, face : (n,)
        Where they pass it; how much deeper they end, infinite without a return; plus or minus a
        half by the face of the scan.
    behind : (n,)
        Density of what happens to them when they pass the object.
    wide : (n,)
        Probability that something wide, nearer than a pole would be, hides it at their height.
    empty : (n,)
        Share of the beams on the same side of the object, but beside it, that are not heard.
    even : (n,)
        Half widths of a beam outside its outline where the echo of what stands beside it is as
        strong as that of the object.
    away : (n,)
        How deep the beams end, in the mean, that pass the object by on the same side.
    merged : (n,)
        Probability that the echoes of the object and of what is there are one; zero at first.
    widths : (2, 2)
        Half the width of a beam across and up, as ``Evidence.widths``.
    lost, faintest : float
        Share of the pulses on a surface that are not heard, and of a beam that must be on it.
    plumb : float, float
        Depth of an upright line through the place, by how far up it a beam passes: slope, and
        factor of the square.
    """

    x: Array
    y: Array
    z: Array
    face: Array
    behind: Array
    wide: Array
    empty: Array
    even: Array
    away: Array
    merged: Array
    widths: Array
    lost: float
    faintest: float
    plumb: tuple[float, float] = (0.0, 0.0)


def beams_about(
    evidence: Evidence,
    radius: float,
    strength: float,
    hearing: tuple[float, float],
    held: Array,
    n_most: int,
) -> Beams:
    """Return the beams that are compared.

    Parameters
    ----------
    evidence : Evidence
        The beams towards and about a place.
    radius : float
        Of the sphere that is searched for [m].
    strength : float
        Reflectivity over squared range of the object [1/m^2].
    hearing : float, float
        ``lost`` and ``faintest`` of ``Beams``.
    held : (9,)
        Probabilities that something wide holds it that has begun at each row of ``ROW``.
    n_most : int
        Most beams that are compared: each costs as much.
    """
    every = _every_beam(evidence, radius)
    every = every[:, every[2] >= -NEAR]
    x, y, z = every[:3]
    blurs = evidence.blur / radius
    gap, blur, is_near = np.hypot(x, y), blurs.max(), z < NEAR
    is_beside = (gap > _BESIDE[0] + blur) & (gap < _BESIDE[1] + blur)
    is_high = is_beside & (y > -0.5)
    is_under = (np.abs(x) < _UNDER[0] + blurs[0]) & (y > _UNDER[1]) & (y < 0.0)
    kept = _chosen(every, is_under | ((gap < _AROUND + blur) & (y > _LOWEST)), n_most)
    n_near, n_past = int(np.sum(is_high & is_near)), int(np.sum(is_high & ~is_near))
    share = (n_near + 0.3) / (n_near + n_past + 1.3)
    is_low = (np.abs(x) > _BESIDE[0] + blurs[0]) & (np.abs(x) < _BESIDE[1] + blurs[0])
    is_low &= (y > _UNDER[1]) & (y < BELOW)
    behind = share * _density_near(every[:3, kept], every[:3, is_high & is_near])
    rows = np.clip((-y[kept] / ROW).astype(np.intp), 0, N_ROWS - 1)
    on_wide = held[rows] * (gap[kept] > _BESIDE[0] + blur)
    behind, wide = _behind(every[:3, kept], every[:3, is_low], on_wide, (behind, 1.0 - share))
    empty, even, away = _beside(every[:, kept], every[:, is_beside], strength)
    return Beams(
        x=x[kept],
        y=y[kept],
        z=z[kept],
        face=every[3, kept],
        behind=behind,
        wide=wide,
        empty=empty,
        even=even,
        away=away,
        merged=np.zeros(len(kept)),
        widths=evidence.widths / radius,
        lost=hearing[0],
        faintest=hearing[1],
    )


def _every_beam(evidence: Evidence, radius: float) -> Array:
    """Return all beams: where they pass, how deep they end, face and strength of the echo."""
    order = np.argsort(evidence.seen[0], kind="stable")  # whatever the order of the returns
    heard = (evidence.seen / radius, evidence.faces, evidence.strengths)
    every: Array = np.vstack(heard)[:, order]
    if evidence.silent is None:
        return every
    x, y, face = evidence.silent
    silent = (x / radius, y / radius, np.full(len(x), np.inf), face, np.zeros(len(x)))
    return np.hstack([every, np.vstack(silent)])


def _chosen(every: Array, is_wanted: Mask, n_most: int) -> Index:
    """Return some beams: few of those that pass the same place and end alike, evenly if many."""
    rows = np.flatnonzero(is_wanted)
    x, y, z, face = every[:4, rows]
    places = np.floor(np.stack([x, y]) / _CELL).astype(np.int64)
    kinds = (places[0] * 4096 + places[1]) * 4 + 2 * (z < NEAR) + (face > 0.0)
    _, own, counts = np.unique(kinds, return_inverse=True, return_counts=True)
    order = np.argsort(own, kind="stable")
    ranks = np.empty(len(rows), np.int64)
    ranks[order] = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    rows = rows[ranks < _N_CELL]
    n = min(len(rows), n_most)
    return np.asarray(rows[(np.arange(n) * (len(rows) / max(n, 1))).astype(np.intp)])


def _density_near(kept: Array, near: Array) -> Array:
    """Return the density of depths of beams that end near: half of it on a plane beside them."""
    density = np.full(kept.shape[1], 0.5 / NEAR)
    if near.shape[1] > _N_PLANE:
        x, y, z = near
        rows = np.column_stack([np.ones(len(x)), x, y])
        plane = np.linalg.solve(rows.T @ rows + 1e-3 * np.eye(3), rows.T @ z)
        sigma = max(1.4826 * float(np.median(np.abs(z - rows @ plane))), _ROUGH)
        off = (kept[2] - plane[0] - plane[1:] @ kept[:2]) / sigma
        density = 0.5 * density + 0.5 * np.exp(-0.5 * off * off) / (sigma * np.sqrt(2.0 * np.pi))
    return density


def _behind(
    kept: Array, low: Array, on_wide: Array, beside: tuple[Array, float]
) -> tuple[Array, Array]:
    """Return ``behind`` and ``wide``.

    Low down, beams end as those do that pass farther to the sides at the same height: what a sphere
    stands on may be wider than a pole. On something wide they end as the others on it do, too:
    ``on_wide`` is how probably each beam is on it. ``beside`` is the density of those that end
    near, and the share of the others, higher up.
    """
    density = np.where(kept[2] < NEAR, *beside)
    is_under = kept[1] < _LOWEST
    y, z = kept[1:3, is_under]
    others = np.hstack([low, kept])
    weights = np.exp(-0.5 * ((y[:, None] - others[1]) / _ALIKE) ** 2)
    weights[:, low.shape[1] :] *= on_wide * ~np.eye(len(on_wide), dtype=np.bool_)[is_under]
    is_near = others[2] < NEAR
    total, wide = weights.sum(axis=1) + 1.0, np.zeros(kept.shape[1])
    near = _density_between(kept[:3, is_under], others[:, is_near], weights[:, is_near])
    alike = np.where(z < NEAR, near, weights @ ~is_near)
    density[is_under] = (density[is_under] + alike) / total
    wide[is_under] = weights @ (others[2] < 0.0) / total
    return density, wide


def _density_between(kept: Array, near: Array, weights: Array) -> Array:
    """Return the density of depths between beams that end near, times the sum of their weights.

    Some are as deep as any of these, some on the line across their depths, for the side of a box
    goes on, and some anywhere near, for it may turn a corner.
    """
    x, _, z = kept
    off = (np.where(z < NEAR, z, 0.0)[:, None] - near[2]) / _ALIKE
    alike = np.sum(weights * np.exp(-0.5 * off * off), axis=1) / (_ALIKE * np.sqrt(2.0 * np.pi))
    n = weights.sum(axis=1) + _TINY
    mean_x, mean_z = weights @ near[0] / n, weights @ near[2] / n
    dx, dz = near[0] - mean_x[:, None], near[2] - mean_z[:, None]
    slope = np.sum(weights * dx * dz, axis=1) / (np.sum(weights * dx * dx, axis=1) + _SQUARE)
    rest = dz - slope[:, None] * dx
    sigma = np.sqrt(np.sum(weights * rest * rest, axis=1) / n + _ROUGH**2)
    off_line = (z - mean_z - slope * (x - mean_x)) / sigma
    line = n * np.exp(-0.5 * off_line * off_line) / (sigma * np.sqrt(2.0 * np.pi))
    return np.asarray(0.5 * (1.0 - _CORNER) * (alike + line) + _CORNER * n / (2.0 * NEAR))


def _beside(kept: Array, beside: Array, strength: float) -> tuple[Array, Array, Array]:
    """Return ``empty``, ``even`` and ``away``: what beams show that pass on the same side."""
    is_heard, own = beside[2] < np.inf, _sides(beside)
    logs = np.log(np.maximum(beside[4] / strength, _FAINT))
    depths = np.minimum(beside[2], _AWAY)
    silent, heard, logs, depths = (
        sums + np.roll(sums, 1) + np.roll(sums, -1)
        for sums in (
            np.bincount(own, weights=weights, minlength=_N_SIDES)
            for weights in (~is_heard, is_heard, logs * is_heard, depths * is_heard)
        )
    )
    empty = (silent + _ANY_SIDE) / (silent + heard + 2.0 * _ANY_SIDE)
    ratios = np.exp(logs / (heard + _ANY_SIDE))
    even = np.interp(ratios / (1.0 + ratios), _SHARES[::-1], _WIDTHS[::-1])
    away = (depths + _AWAY * _ANY_SIDE) / (heard + _ANY_SIDE)
    sides = _sides(kept)
    return empty[sides], even[sides], away[sides]


def merged_within(beams: Beams, gates: Array, radius: float) -> Beams:
    """Return the beams with ``merged`` by the probabilities of each of ``GATES``."""
    return beams._replace(merged=(beams.away[:, None] * radius < GATES) @ gates)


def _sides(beams: Array) -> Index:
    """Return the side of the object on which each beam passes it."""
    turns = np.arctan2(beams[1], beams[0]) / (2.0 * np.pi) + 0.5
    return np.asarray((turns * _N_SIDES).astype(np.intp) % _N_SIDES)
