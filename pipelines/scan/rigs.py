"""The VLP-16's laser table, and rigs as plain mappings with a digest."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from spheremark.pipelines.errors import InputError, RigError
from spheremark.pipelines.geometry import rigid, rot_y
from spheremark.pipelines.model import Array, ImuMount, Rig

N_LASERS = 16
FIRING_CYCLE = 55.296e-6  # [s] between two firings of the same laser
LASER_CYCLE = 2.304e-6  # [s] between two lasers of one firing
RANGE_STEP = 0.002  # [m] resolution of a range
AZIMUTH_STEP = np.radians(0.01)  # resolution of an azimuth
N_BLOCKS, FIRINGS_PER_BLOCK = 12, 2  # of a packet
VLP16_ELEVATIONS = np.radians(np.arange(-15.0, 16.0, 2.0))
"""Elevation of each laser above the plane of the spin, the lowest first [rad]."""

FIRING_ORDER = np.array([0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15])
"""Laser index (0 the lowest) in the order of firing: -15, +1, -13, +3, ... degrees."""

BEAM_WINDOW = np.array([12.7e-3, 9.5e-3])
"""Width of a VLP-16's beam at its window, across and along the spin axis [m]."""

LASER_DELAYS = np.argsort(FIRING_ORDER) * LASER_CYCLE
"""Instant of each laser within a firing [s]."""

_FOCAL_OFFSET = 0.04191  # [m] from the spin axis to where the beams cross (VLP-16 manual)
_SIGMA_HEADING = np.radians(0.02)  # what careful mounting and an encoder's index leave
_DIVERGENCE = (3.0e-3, 1.5e-3)  # [rad] full widths across and along the spin axis
_RIGID_TOLERANCE = 1e-6  # how far a rotation matrix may be from orthonormal


def vlp16(
    name: str,
    T_head_lidar: Array,
    *,
    R_mount_imu: ArrayLike | None = None,
    imu_mount: ImuMount = ImuMount.BASE,
) -> Rig:
    """Return a rig with a VLP-16 as the maker describes it.

    Parameters
    ----------
    name : str
        Name of the rig in results.
    T_head_lidar : (4, 4)
        Mounting of the LiDAR on the gimbal's head; its vertical translation is set to zero [m].
    R_mount_imu : (3, 3), optional
        Mounting of the AHRS; aligned with its mount by default.
    imu_mount : ImuMount
        The part that carries the AHRS.

    Returns
    -------
    Rig
        Without range biases, eccentricity or clock offset.

    Notes
    -----
    Elevations and vertical offsets after the VLP-16 user manual (63-9243), section 9: the beams
    cross 41.91 mm off the spin axis, which gives the offset of each laser.
    """
    mounting = np.array(T_head_lidar, dtype=np.float64)
    mounting[2, 3] = 0.0
    return Rig(
        name=name,
        T_head_lidar=mounting,
        R_mount_imu=np.eye(3) if R_mount_imu is None else np.array(R_mount_imu, dtype=np.float64),
        imu_mount=imu_mount,
        laser_elevations=VLP16_ELEVATIONS.copy(),
        laser_heights=-_FOCAL_OFFSET * np.tan(VLP16_ELEVATIONS),
        laser_range_biases=np.zeros(N_LASERS),
        cloud_carries_heights=True,
        divergence=np.array(_DIVERGENCE),
        encoder_eccentricity=np.zeros(2),
        gimbal_clock_offset=0.0,
        sigma_heading=float(_SIGMA_HEADING),
    )


def tilted_vlp16(name: str, axis_offset: ArrayLike, tilt: float = np.pi / 2) -> Rig:
    """Return the published rig: a VLP-16 whose spin axis is tilted about y, with an axis offset.

    Parameters
    ----------
    name : str
        Name of the rig in results.
    axis_offset : (2,)
        Position of the LiDAR's origin in the head frame, x and y [m].
    tilt : float
        Angle from the gimbal axis to the spin axis, about y [rad].

    Returns
    -------
    Rig
        With its AHRS on the base.
    """
    x, y = np.asarray(axis_offset, dtype=np.float64)
    return vlp16(name, rigid(rot_y(tilt), (x, y, 0.0)))


def rig_to_mapping(rig: Rig) -> dict[str, Any]:
    """Return a rig as plain values with units in the keys, as in a rig file.

    Parameters
    ----------
    rig : Rig
        The rig.

    Returns
    -------
    dict
        What ``rig_from_mapping`` takes.
    """
    return {
        "name": rig.name,
        "T_head_lidar": rig.T_head_lidar.tolist(),
        "R_mount_imu": rig.R_mount_imu.tolist(),
        "imu_mount": str(rig.imu_mount),
        "laser_elevations_rad": rig.laser_elevations.tolist(),
        "laser_heights_m": rig.laser_heights.tolist(),
        "laser_range_biases_m": rig.laser_range_biases.tolist(),
        "cloud_carries_heights": rig.cloud_carries_heights,
        "divergence_rad": rig.divergence.tolist(),
        "encoder_eccentricity_rad": rig.encoder_eccentricity.tolist(),
        "gimbal_clock_offset_s": rig.gimbal_clock_offset,
        "sigma_heading_rad": rig.sigma_heading,
    }


def rig_from_mapping(values: Mapping[str, Any]) -> Rig:
    """Build a rig from a mapping as written by ``rig_to_mapping``.

    Parameters
    ----------
    values : mapping
        ``T_head_lidar`` is required; other missing keys take the values of the VLP-16's maker.

    Returns
    -------
    Rig
        The rig.

    Raises
    ------
    RigError
        If a key is unknown or missing, or a value is of the wrong kind.
    """
    known = rig_to_mapping(tilted_vlp16("", (0.0, 0.0)))
    unknown = [key for key in values if key not in known]
    if unknown:
        raise RigError(f"The rig has an unknown key {unknown[0]!r}; known: {', '.join(known)}.")
    if "T_head_lidar" not in values:
        raise RigError("The rig has no T_head_lidar: a 4x4 matrix from LiDAR to head, in metres.")
    try:
        return _checked(_read(values))
    except RigError:
        raise
    except InputError as error:
        raise RigError(str(error)) from error
    except (AttributeError, TypeError, ValueError) as error:
        raise RigError(f"The rig holds a value of the wrong kind: {error}.") from error


def _read(values: Mapping[str, Any]) -> Rig:
    """Read the values of a rig over the maker's defaults."""
    fields = {
        key.removesuffix("_rad").removesuffix("_m").removesuffix("_s"): value
        for key, value in values.items()
    }
    arrays: dict[str, Any] = {
        k: np.array(v, np.float64) for k, v in fields.items() if isinstance(v, list)
    }
    if arrays.get("T_head_lidar", np.zeros(0)).shape != (4, 4):
        raise RigError("The rig's T_head_lidar must be a list of four rows of four numbers.")
    rest: dict[str, Any] = {k: v for k, v in fields.items() if k not in arrays}
    if "imu_mount" in rest:
        rest["imu_mount"] = ImuMount(rest["imu_mount"])
    if not isinstance(rest.get("cloud_carries_heights", True), bool):
        raise RigError("The rig's cloud_carries_heights must be true or false.")
    for name in ("gimbal_clock_offset", "sigma_heading"):
        if name in rest:
            rest[name] = float(rest[name])
    base = vlp16(str(rest.pop("name", "unnamed")), arrays.pop("T_head_lidar"))
    return replace(base, **arrays, **rest)


def _checked(rig: Rig) -> Rig:
    """Return the rig if its rotations are rotations and its numbers are finite."""
    for name, R in (("T_head_lidar", rig.T_head_lidar[:3, :3]), ("R_mount_imu", rig.R_mount_imu)):
        off = float(np.abs(R @ R.T - np.eye(3)).max())
        if not off < _RIGID_TOLERANCE or np.linalg.det(R) < 0:
            raise RigError(f"The rig's {name} is not a rotation (off by {off:.2g}).")
    try:
        json.dumps(rig_to_mapping(rig), allow_nan=False)
    except ValueError as error:
        raise RigError("The rig holds numbers that are not finite.") from error
    return rig


def rig_digest(rig: Rig) -> str:
    """Return the digest of a rig: 16 hexadecimal digits.

    Parameters
    ----------
    rig : Rig
        The rig.

    Returns
    -------
    str
        Start of the SHA-256 of the rig's sorted JSON.
    """
    text = json.dumps(rig_to_mapping(rig), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]
