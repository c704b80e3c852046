"""The returns of a stop for a cloud of the whole site."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spheremark.pipelines.errors import ConfigError
from spheremark.pipelines.geometry import levelling_rotation
from spheremark.pipelines.ground_model.values import StationPose
from spheremark.pipelines.model import (
    Array,
    Column,
    Index,
    Rings,
    Shape,
    StitchedCloud,
    same_length,
    seal,
)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StationPoints:
    """Returns of one stop in the station frame, with its pose in the site."""

    name: str  # name of the stop
    T_site_station: Array  # (4, 4) its pose [m]
    p_station: Column  # (n, 3) float32 returns [m]
    intensities: Column  # (n,) float32 calibrated reflectivity, 0-255
    rings: Rings  # (n,) uint8 laser of each return
    times: Column  # (n,) float32 instant of each return since the first of the stop [s]
    # instant of that first one by the clock of the log [ns]; 0 where it is not known
    start_ns: int = 0

    def __post_init__(self) -> None:
        columns: dict[str, Shape] = dict.fromkeys(("intensities", "rings", "times"), (None,))
        seal(self, T_site_station=(4, 4), p_station=(None, 3), **columns)
        same_length(self, "p_station", *columns)

    @property
    def p_site(self) -> Array:
        """Returns in the site frame, (n, 3) [m]."""
        T = self.T_site_station
        return np.asarray(self.p_station.astype(np.float64) @ T[:3, :3].T + T[:3, 3])


def station_points(
    cloud: StitchedCloud, pose: StationPose, *, range_max: float = np.inf, voxel: float = 0.0
) -> StationPoints:
    """Choose the returns of a stop for the cloud of its site.

    Parameters
    ----------
    cloud : StitchedCloud
        The stop.
    pose : StationPose
        Its pose.
    range_max : float
        Returns farther from the station are left out [m].
    voxel : float
        Edge of the cubes of the site in which a stop keeps one return, the first [m]; 0 keeps all.

    Returns
    -------
    StationPoints
        In the order of time.

    Raises
    ------
    ConfigError
        If the distance or the edge cannot be used.
    """
    if not range_max > 0.0 or not (voxel == 0.0 or voxel >= 0.001):
        raise ConfigError(
            f"A cloud with returns up to {range_max!r} m, thinned to cubes of {voxel!r} m, cannot "
            "be made; give a distance above 0, and an edge of 0 (all returns) or 0.001 and more."
        )
    rows = np.flatnonzero(np.sum(np.square(cloud.p_base, dtype=np.float64), axis=1) <= range_max**2)
    p_station = cloud.p_base[rows] @ levelling_rotation(cloud.levelling).T
    T = pose.T_site_station
    if voxel:
        kept = _first_in_cubes(p_station @ T[:3, :3].T + T[:3, 3], voxel)
        rows, p_station = rows[kept], p_station[kept]
    return StationPoints(
        name=cloud.name,
        T_site_station=T.copy(),
        p_station=p_station.astype(np.float32),
        intensities=cloud.intensities[rows],
        rings=cloud.rings[rows],
        times=cloud.times[rows],
        start_ns=cloud.start_ns,
    )


def _first_in_cubes(p_site: Array, edge: float) -> Index:
    """Return the rows of the first point in each cube, ascending."""
    cubes = np.floor(p_site / edge).astype(np.int64)
    cubes -= cubes.min(axis=0, initial=0)
    sides = cubes.max(axis=0, initial=0) + 1
    keys = (cubes[:, 0] * sides[1] + cubes[:, 1]) * sides[2] + cubes[:, 2]
    return np.asarray(np.sort(np.unique(keys, return_index=True)[1]), dtype=np.intp)
