"""The two faces of a scan: a full turn sweeps each place twice, from either side of the spin axis.

Hides how far apart they show the same sphere where the mounting is not known well, and the mounting
with which they show it at one place.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.geometry import rot_z
from spheremark.pipelines.model import Array, Column, Rig, StitchedCloud

TURNED, MOVED = 0.003, 0.01
"""Standard deviations of how far the faces lie apart with a rough mounting [rad], [m]."""

_N_LEAST = 2  # spheres that both faces show
_DIFFER = 0.25  # of these deviations: how far spheres of a scan differ in that, at least
_CERTAIN = 5.0  # standard deviations of their median
_ROUGH = 1.4826 * 1.2533  # of a median, over the median deviation and the root of the number


class Apart(NamedTuple):
    """How much higher [rad] and deeper [m] the first face shows a place: +0.5 of ``faces_of``."""

    higher: float
    deeper: float


def faces_of(rig: Rig, angles: Column, c: Array) -> Array:
    """Return plus or minus a half by the face of the scan: the side of the spin axis of a place."""
    (x, y), cos, sin = rig.T_head_lidar[:2, 2], np.cos(angles), np.sin(angles)
    side = x * (cos * c[1] - sin * c[0]) - y * (cos * c[0] + sin * c[1])
    return np.where(side > 0.0, 0.5, -0.5)


def apart_of(shifts: Array, distances: Array) -> Apart | None:
    """Return how far apart the faces show the spheres of a scan; None where they agree.

    Parameters
    ----------
    shifts : (n, 3)
        Of each sphere that both show: across the line of sight, up it and along it [m].
    distances : (n,)
        Of these [m].
    """
    if len(distances) < _N_LEAST:
        return None
    values = np.column_stack([shifts[:, 1] / distances, shifts[:, 2]])
    found = np.median(values, axis=0)
    rough, scatters = np.array([TURNED, MOVED]), np.median(np.abs(values - found), axis=0)
    sigmas = np.maximum(_ROUGH * scatters, _DIFFER * rough) / np.sqrt(len(values))
    is_far = np.abs(found) > np.maximum(_CERTAIN * sigmas, 0.5 * rough)
    return Apart(*found.tolist()) if is_far.any() else None


def joined(cloud: StitchedCloud, apart: Apart) -> StitchedCloud:
    """Return a scan as with the mounting by which its faces agree.

    The LiDAR is turned about its spin axis and moved square to it and to the gimbal's: each by half
    of what lies between the faces.
    """
    T_head_lidar = cloud.rig.T_head_lidar.copy()
    x, y = T_head_lidar[:2, 2] / np.linalg.norm(T_head_lidar[:2, 2])
    T_head_lidar[:3, :3] = T_head_lidar[:3, :3] @ rot_z(-0.5 * apart.higher)
    T_head_lidar[:2, 3] += 0.5 * apart.deeper * np.array([y, -x])
    moved = T_head_lidar @ np.linalg.inv(cloud.rig.T_head_lidar)
    angles = np.asarray(cloud.gimbal_angles)
    cos, sin = np.cos(angles), np.sin(angles)
    x, y, z = cloud.p_base.T
    with np.errstate(invalid="ignore"):  # returns that are none stay none
        p_head = np.column_stack([cos * x + sin * y, cos * y - sin * x, z])
        x, y, z = (p_head @ moved[:3, :3].T.astype(np.float32) + moved[:3, 3].astype(np.float32)).T
        p_base = np.column_stack([cos * x - sin * y, cos * y + sin * x, z])
    rig = replace(cloud.rig, T_head_lidar=T_head_lidar)
    return replace(cloud, p_base=p_base, rig=rig)
