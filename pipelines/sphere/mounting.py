"""How errors of the mounting of LiDAR and gimbal move the two faces of a sphere.

A sphere is swept twice in a turn: upwards, and half a turn of the gimbal later downwards. An error
of the mounting moves one face against the other. Where both faces sample the sphere alike the mean
is right; with lines of rest that coincide, or less than a full turn, the error must be estimated.
"""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.model import Array

N_MOUNTING = 6
"""Unknowns of the mounting: two directions, two offsets, two amplitudes of the encoder."""

_ECCENTRICITY = 0.5  # sigma of the encoder's amplitudes over that of a direction


def sigmas_of(sigma_direction: float, sigma_offset: float) -> Array:
    """Return the prior standard deviations of the unknowns of the mounting.

    Parameters
    ----------
    sigma_direction : float
        Of the directions in which LiDAR and gimbal sit, per axis [rad].
    sigma_offset : float
        Of where the LiDAR sits on the gimbal, per axis [m].

    Returns
    -------
    (6,)
        Of directions [rad], offsets [m] and amplitudes of the encoder [rad].
    """
    angles, amplitudes = np.full(2, sigma_direction), np.full(2, _ECCENTRICITY * sigma_direction)
    return np.concatenate([angles, np.full(2, sigma_offset), amplitudes])


def effects_on(centres: Array) -> Array:
    """Return the derivatives of the upward face; those of the other are opposite.

    Parameters
    ----------
    centres : (m, 3)
        Centres in base [m].

    Returns
    -------
    (m, 3, 6)
        Derivatives of the centres by the unknowns of the mounting.
    """
    x, y, z = centres.T
    flat, zero = np.maximum(np.hypot(x, y), 1e-9), np.zeros(len(centres))
    c, s = x / flat, y / flat
    sideways, outward = np.stack([-s, c, zero]), np.stack([c, s, zero])
    upward = np.stack([-z * c, -z * s, x * c + y * s])  # times the distance
    distances = np.linalg.norm(centres, axis=1)
    effects = [sideways * distances, upward, outward, sideways, sideways * x, sideways * y]
    return np.stack(effects, axis=-1).transpose(1, 0, 2)
