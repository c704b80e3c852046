"""What the mounting, which is not known exactly, does to the two faces of a sphere.

A sphere is swept twice in a turn: upwards, and half a turn of the gimbal later downwards. What is
wrong in how LiDAR and gimbal sit moves one face against the other. An even turn tells as much of a
centre by both from all sides, and the mean is right; lines of rests that fall together, or a turn
that is not full, do not, and then this has to be estimated.
"""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import Array

N_MOUNTING = 6
"""Unknowns of the mounting: two directions, two offsets, two amplitudes of the encoder."""

_ECCENTRICITY = 0.5  # of the standard deviation of a direction: that of the encoder's amplitudes


def sigmas_of(sigma_direction: float, sigma_offset: float) -> Array:
    """Return what is known of the mounting before the scan is seen."""
    angles, amplitudes = np.full(2, sigma_direction), np.full(2, _ECCENTRICITY * sigma_direction)
    return np.concatenate([angles, np.full(2, sigma_offset), amplitudes])


@compiled
def effects_on(centres: Array) -> Array:
    """Return how the mounting moves what is swept upwards; the other face moves against it."""
    effects = np.zeros((len(centres), 3, N_MOUNTING))
    for m in range(len(centres)):
        x, y, z = centres[m, 0], centres[m, 1], centres[m, 2]
        flat = max(np.sqrt(x * x + y * y), 1e-9)
        distance = np.sqrt(x * x + y * y + z * z)
        c, s = x / flat, y / flat
        aside, ahead = (-s, c, 0.0), (c, s, 0.0)
        above = (-z * c, -z * s, x * c + y * s)  # times the distance
        for j in range(3):
            effects[m, j, 0], effects[m, j, 1] = aside[j] * distance, above[j]
            effects[m, j, 2], effects[m, j, 3] = ahead[j], aside[j]
            effects[m, j, 4], effects[m, j, 5] = aside[j] * x, aside[j] * y
    return effects
