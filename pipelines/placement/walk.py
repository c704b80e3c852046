"""The way from mark to mark: how far it is to set them up and to take them down."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from spheremark.pipelines.model import Array


def round_trip(start: Array, places: Array) -> float:
    """Return the length of a short round from a start past all places, seen from above [m].

    Parameters
    ----------
    start : (3,)
        Where it begins and ends [m].
    places : (n, 3)
        What it passes [m].

    Returns
    -------
    float
        Its length [m].

    Notes
    -----
    The nearest next, then edges exchanged in pairs while that shortens the round (Croes, 1958).
    """
    p = np.vstack([start[:2], places[:, :2]])
    d = cdist(p, p)
    tour, left = [0], set(range(1, len(p)))
    while left:
        tour.append(min(left, key=lambda k: d[tour[-1], k]))
        left.remove(tour[-1])
    is_better = True
    while is_better:
        is_better = False
        for i in range(len(tour) - 1):
            for j in range(i + 2, len(tour)):
                a, b, c, e = tour[i], tour[i + 1], tour[j], tour[(j + 1) % len(tour)]
                if d[a, c] + d[b, e] < d[a, b] + d[c, e] - 1e-9:
                    tour[i + 1 : j + 1] = tour[i + 1 : j + 1][::-1]
                    is_better = True
    return float(d[tour, np.roll(tour, -1)].sum())


def perimeters(places: Array) -> Array:
    """Return the perimeters of sets of places, (m, k, 3), in the order of their azimuths [m].

    Near the length of ``round_trip`` where the places surround the stops.
    """
    flat = places[..., :2]
    off = flat - flat.mean(axis=1, keepdims=True)
    order = np.argsort(np.arctan2(off[..., 1], off[..., 0]), axis=1)
    ring = np.take_along_axis(flat, order[..., None], axis=1)
    return np.asarray(np.linalg.norm(ring - np.roll(ring, 1, axis=1), axis=2).sum(axis=1))
