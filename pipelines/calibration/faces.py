"""A rough rig from the two centres of each sphere.

Each face of a scan is whole in itself, whatever the rig: it is found and fitted apart, and what
separates the two centres of a sphere is put down to the rig.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.calibration.estimation import separable
from spheremark.pipelines.calibration.gimbal import (
    GIMBAL,
    MOUNTING,
    aimed,
    motions,
    moved,
    recorded_pulses,
)
from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.errors import DegenerateGeometryError, RigError
from spheremark.pipelines.estimation.linear_algebra import inverse, invert_each
from spheremark.pipelines.model import Array, Index, MarkerFit, Mask, Rig, ScanLog, StitchedCloud
from spheremark.pipelines.scan.stitching import stitch
from spheremark.pipelines.sphere import fit_markers

_GATE = 0.05  # [m] and
_GATE_SLOPE = 0.025  # [rad]: the two centres of one sphere may be so far apart at a distance
_TILT_MIN = np.radians(20.0)  # of the spin axis: with less there are no two faces
_N_PAIRS = 3
_N_ROBUST = 6
_COLUMNS = ("p_base", "gimbal_angles", "intensities", "rings", "times")


class _Pair(NamedTuple):
    """How far apart the two centres of a sphere are, and how the rig moves them apart.

    ``gap`` is (3,) [m], ``cov`` its covariance, ``J``, (3, q), its derivative by ``MOUNTING``.
    """

    gap: Array
    cov: Array
    J: Array


def front_face(cloud: StitchedCloud) -> Mask:
    """Return which returns were made on the front of the head."""
    spin = cloud.rig.T_head_lidar[:3, 2]
    side = np.array([-spin[1], spin[0]])
    if np.linalg.norm(side) < np.sin(_TILT_MIN):
        raise RigError(
            "The LiDAR's spin axis is less than 20 degrees from the gimbal axis: its scan has no "
            "two faces, and spheres cannot calibrate it. Check T_head_lidar of the rig."
        )
    angles = cloud.gimbal_angles[:]
    c, s = np.cos(angles), np.sin(angles)
    x, y = cloud.p_base[:, 0], cloud.p_base[:, 1]
    return np.asarray((c * x + s * y) * side[0] + (c * y - s * x) * side[1] > 0.0)


def rig_from_faces(stops: Iterable[ScanLog], start: Rig, config: SurveyConfig) -> Rig:
    """Estimate the mounting roughly, from a start that may be bad.

    Notes
    -----
    Least squares of the differences, linear in the parameters, with Cauchy's weights against pairs
    that are no pairs.
    """
    pairs, coverages = [], []
    for log in stops:
        cloud = stitch(log, start, config.stitching)
        coverages.append(np.degrees(cloud.coverage))
        pairs += _pairs(log, cloud, config)
    if len(pairs) < _N_PAIRS:
        raise DegenerateGeometryError(
            f"A calibration needs at least {_N_PAIRS} spheres that are seen on both faces; in "
            f"{len(coverages)} scan{'' if len(coverages) == 1 else 's'}, whose gimbal turned by "
            f"{max(coverages):.0f} degrees at most, {len(pairs) or 'none'} were found. Turn it by "
            "360 degrees among more markers, or give more scans."
        )
    return moved(start, _solved(pairs), np.zeros_like(start.laser_range_biases))


def _pairs(log: ScanLog, cloud: StitchedCloud, config: SurveyConfig) -> list[_Pair]:
    """Return the spheres that both faces of a stop show."""
    return [_pair(log, cloud, fits) for fits in both_faces(cloud, config)]


def both_faces(cloud: StitchedCloud, config: SurveyConfig) -> list[tuple[MarkerFit, MarkerFit]]:
    """Fit the spheres of a stop on either face apart."""
    front = front_face(cloud)
    sides = [_fits(cloud, rows, config) for rows in (np.flatnonzero(front), np.flatnonzero(~front))]
    if not all(sides):
        return []
    p, q = (np.array([fit.p_base for fit in side]) for side in sides)
    gaps = np.linalg.norm(p[:, None] - q[None], axis=2)
    near = gaps < _GATE + _GATE_SLOPE * np.linalg.norm(p, axis=1)[:, None]
    mutual = (gaps == gaps.min(axis=1, keepdims=True)) & (gaps == gaps.min(axis=0))
    return [(sides[0][i], sides[1][j]) for i, j in np.argwhere(near & mutual)]


def _fits(cloud: StitchedCloud, rows: Index, config: SurveyConfig) -> list[MarkerFit]:
    """Return the fits of one face, with their rows in the whole cloud."""
    face = replace(cloud, **{name: getattr(cloud, name)[rows] for name in _COLUMNS})
    # without times: the detection would take the pulses of the other face for ones not returned
    untimed = replace(face, times=np.zeros(len(rows), np.float32))
    candidates = extract(untimed, config.extraction, config.marker_radius)
    # the mounting is estimated here, and what ranges have in common is alike on both faces
    alone = replace(config.fitting, sigma_mounting=0.0, sigma_offset=0.0)
    alone = replace(alone, sigma_range_common=0.0, sigma_range_scale=0.0)
    fits = fit_markers("along_beam", face, candidates, alone, config.marker_radius).fits
    return [replace(fit, used=rows[fit.used], rejected=rows[fit.rejected]) for fit in fits]


def _pair(log: ScanLog, cloud: StitchedCloud, fits: tuple[MarkerFit, MarkerFit]) -> _Pair:
    """Return two centres of a sphere with how the rig moves each."""
    effects = []
    for fit in fits:
        seen = recorded_pulses(log, cloud, fit.used, np.zeros(len(fit.used), dtype=np.intp))
        turns, shifts = motions(seen, cloud.rig)
        arms = cloud.p_base[fit.used] - aimed(seen, cloud.rig).origins_base
        effects.append((shifts + np.cross(turns, arms[:, None])).mean(axis=0).T)
    front, back = fits
    return _Pair(
        gap=front.p_base - back.p_base,
        cov=front.cov_p_base + back.cov_p_base,
        J=(effects[1] - effects[0])[:, : len(MOUNTING)],
    )


def _solved(pairs: list[_Pair]) -> Array:
    """Return the changes of the parameters that bring the pairs together best."""
    gaps, covs, J = (np.array(column) for column in zip(*pairs, strict=True))
    weights, _ = invert_each(covs)
    trust = np.ones(len(pairs))
    changes = np.zeros(len(GIMBAL))
    for _ in range(_N_ROBUST):
        N = np.einsum("k,kip,kij,kjq->pq", trust, J, weights, J)
        is_free, _ = separable(N, MOUNTING)
        free = np.flatnonzero(is_free)
        rhs = np.einsum("k,kip,kij,kj->p", trust, J, weights, gaps)
        changes[free] = inverse(N[np.ix_(free, free)]) @ rhs[free]
        left = gaps - J @ changes[: len(MOUNTING)]
        squares = np.einsum("ki,kij,kj->k", left, weights, left)
        trust = 1.0 / (1.0 + squares / (3.0 * max(float(np.median(squares)), 1.0)))
    return changes
