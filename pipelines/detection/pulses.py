"""The pulses about a place that no return shows, and how well a scan hears its echoes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.detection.faces import faces_of
from spheremark.pipelines.detection.target import view_of
from spheremark.pipelines.model import Array, Index, StitchedCloud
from spheremark.pipelines.scan.firings import Clock, in_base, numbers_of, pulses_about, pulses_of
from spheremark.pipelines.scan.rigs import N_LASERS

_N_SAMPLES, _N_SAMPLE = 300, 100  # samples of so many returns that follow each other
_GROUND = (0.25, 0.55)  # sines of the angles below the horizon where the ground is near
_N_SECTORS, _N_IN_SECTOR = 24, 20  # of azimuth, and pulses that show one
_WEAKEST = 0.01  # share of the returns that are taken for the weakest


def unheard_about(clock: Clock, heard: Index, c: Array, up: Array, reach: float) -> Array:
    """Return where pulses without a return pass a centre, across and up [m], and faces, (3, k).

    ``heard`` are the numbers of all others: what stands long before a place hides it.
    """
    pulses, passing, _ = pulses_about(clock, c, reach)
    rows = np.searchsorted(heard, pulses.numbers).clip(max=len(heard) - 1)
    found = heard[rows] != pulses.numbers
    view, angles = view_of(c, up), pulses.angles[found]
    p_base = in_base(clock.rig, passing[:, found], angles)
    return np.array([view.across @ p_base, view.up @ p_base, faces_of(clock.rig, angles, c)])


class Hearing(NamedTuple):
    """How well a scan hears its echoes.

    Attributes
    ----------
    lost : float
        Share of the pulses towards the ground nearby that have no return: the scan loses them
        anyway. 1 where that is not known.
    weakest : float
        Reflectivity over squared range of the weakest returns [1/m^2].
    """

    lost: float
    weakest: float


def hearing_of(cloud: StitchedCloud, clock: Clock, up: Array) -> Hearing:
    """Return how well a scan hears its echoes, by the firings after some that it heard."""
    starts = np.linspace(0, len(cloud.p_base) - _N_SAMPLE, _N_SAMPLES).astype(np.intp)
    in_time = np.argsort(np.asarray(cloud.times), kind="stable")  # whatever the order of returns
    rows = in_time[starts[:, None] + np.arange(_N_SAMPLE)]
    strengths = cloud.intensities[rows] / np.sum(cloud.p_base[rows] ** 2, axis=-1)
    heard = numbers_of(cloud, clock, rows.ravel()).reshape(rows.shape)
    following = heard // N_LASERS + 1
    tried = np.unique(following[following < following.max(axis=1, keepdims=True) - 1])
    pulses = pulses_of(clock, (tried[:, None] * N_LASERS + np.arange(N_LASERS)).ravel())
    x, y, z = in_base(clock.rig, pulses.directions, pulses.angles)
    steep = up @ (x, y, z)
    is_ground = (steep > -_GROUND[1]) & (steep < -_GROUND[0])
    sectors = (np.arctan2(y, x)[is_ground] * _N_SECTORS / 6.2832).astype(int) + _N_SECTORS
    is_heard = np.isin(pulses.numbers[is_ground], heard)
    n, n_heard = np.bincount(sectors), np.bincount(sectors, weights=is_heard)
    is_shown = n >= _N_IN_SECTOR
    shares = 1.0 - n_heard[is_shown] / n[is_shown]  # by sectors: the rover hides some of the ground
    lost = float(np.median(shares)) if len(shares) > _N_SECTORS // 2 else 1.0
    return Hearing(lost, float(np.nanquantile(strengths, _WEAKEST)))
