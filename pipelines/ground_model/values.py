"""Inputs and result of an elevation model."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.errors import ConfigError
from spheremark.pipelines.geometry import turn_in_place
from spheremark.pipelines.model import Array, Column, Mask, StationFix, seal
from spheremark.pipelines.network import AdjustedNetwork


@dataclass(frozen=True, slots=True, kw_only=True)
class ElevationConfig:
    """Options of an elevation model.

    Attributes
    ----------
    cell : float
        Edge of a cell [m]. 0.25: a turn leaves some ten returns in such a cell at 10 m.
    range_max : float
        Horizontal distance from a station within which ground is used [m]. 15: beyond, beams graze
        at less than 4 degrees and see crests only.
    object_max : float
        Width up to which objects are removed from the ground [m]. 0.6: rocks, poles, markers, legs;
        wider ones are left out where they rise steeply.
    sigma_range : float
        Noise of a range [m]. 10.7 mm: a VLP-16 on dark ground.
    sigma_laser_bias : float
        Standard deviation of the range bias of a laser [m].
    sigma_direction : float
        Standard deviation of the directions of a whole stop, averaged over two faces [rad].
    gap_max : float
        Distance from seen ground up to which holes are interpolated [m]; 0: none.
    """

    cell: float = 0.25
    range_max: float = 15.0
    object_max: float = 0.6
    sigma_range: float = 0.0107
    sigma_laser_bias: float = 0.003
    sigma_direction: float = 1e-4
    gap_max: float = 0.0

    def __post_init__(self) -> None:
        bounds = {
            "cell": (0.05, 10.0),
            "range_max": (1.0, 100.0),
            "object_max": (0.1, 10.0),
            "sigma_range": (1e-4, 0.1),
            "sigma_laser_bias": (0.0, 0.1),
            "sigma_direction": (0.0, 0.01),
            "gap_max": (0.0, 10.0),
        }
        for name, (low, high) in bounds.items():
            value = getattr(self, name)
            if not low <= value <= high or not math.isfinite(value):
                raise ConfigError(
                    f"elevation.{name} is {value!r}; it must be a number from {low:g} to {high:g}."
                )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StationPose:
    """Pose of a stop in the site."""

    name: str  # name of the stop
    T_site_station: Array  # (4, 4) pose of the levelled frame [m]
    # (6, 6) covariance of a small motion (rotation [rad], translation [m]) on the left, without the
    # heading that mounting, encoder and clocks leave unknown: it turns points and centres alike
    cov_T_site_station: Array

    def __post_init__(self) -> None:
        seal(self, T_site_station=(4, 4), cov_T_site_station=(6, 6))


def poses_of_network(result: AdjustedNetwork) -> tuple[StationPose, ...]:
    """Return the poses of an adjusted network, in the order of its stations.

    Parameters
    ----------
    result : AdjustedNetwork
        The network.

    Returns
    -------
    tuple of StationPose
        One for each station, with covariance.
    """
    network = result.network
    headings = zip(network.sigma_headings.tolist(), network.R_station_base[:, :, 2], strict=True)
    columns = (result.T_site_station, result.cov_T_site_station, headings)
    return tuple(
        pose_of_points(name, T, cov, heading)
        for name, T, cov, heading in zip(network.stations, *columns, strict=True)
    )


def pose_of_fix(name: str, fix: StationFix) -> StationPose:
    """Return the pose of a station that was positioned alone."""
    heading = fix.sigma_heading, fix.axis_station
    return pose_of_points(name, fix.T_site_station, fix.cov_T_site_station, heading)


def pose_of_points(name: str, T: Array, cov: Array, heading: tuple[float, Array]) -> StationPose:
    """Return the pose of the points of a scan from that of its station.

    Parameters
    ----------
    name : str
        Name of the stop.
    T : (4, 4)
        Pose of the station.
    cov : (6, 6)
        Its covariance, with the heading that mounting, encoder and clocks leave unknown.
    heading : (float, (3,))
        Standard deviation of that heading [rad], and the axis in the station frame about which it
        turns: that of the gimbal.

    Returns
    -------
    StationPose
        Without it.
    """
    sigma, axis = heading
    turn = turn_in_place(T, axis)
    own = cov - sigma**2 * np.outer(turn, turn)
    return StationPose(name=name, T_site_station=T.copy(), cov_T_site_station=own)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ElevationModel:
    """Mean height of the ground in each cell of a grid, with its standard deviation."""

    corner: Array  # (2,) south-western corner of the first cell, x and y in the site frame [m]
    cell: float  # edge of a cell [m]
    # (rows, columns) float32 mean height of the ground; NaN where none was seen; rows run north [m]
    heights: Column
    sigmas: Column  # (rows, columns) float32 standard deviation of that height; NaN likewise [m]
    # (rows, columns) int32 returns that carry it; 0 where it is interpolated or missing
    counts: NDArray[np.int32]
    is_filled: Mask  # (rows, columns) bool whether it is interpolated from cells around

    def __post_init__(self) -> None:
        shape = self.heights.shape
        seal(self, corner=(2,), heights=shape, sigmas=shape, counts=shape, is_filled=shape)

    @property
    def xs(self) -> Array:
        """Centres of the columns [m]."""
        return np.asarray(self.corner[0] + (np.arange(self.heights.shape[1]) + 0.5) * self.cell)

    @property
    def ys(self) -> Array:
        """Centres of the rows [m]."""
        return np.asarray(self.corner[1] + (np.arange(self.heights.shape[0]) + 0.5) * self.cell)

    @property
    def share_known(self) -> float:
        """Share of the cells in which ground was seen."""
        return float(np.mean(self.counts > 0)) if self.counts.size else 0.0
