"""Ground heights of a site with their uncertainty, from the clouds of its stops.

Hides how ground is separated from objects (``ground``) and how stops are joined (``grid``). The
model is one of the *terrain*, without rocks, poles, markers and people. Clouds come one at a time,
so memory grows with the site and not with the survey. ``points`` chooses the returns of a stop for
a cloud of the whole site.
"""

from spheremark.pipelines.ground_model.model import Terrain
from spheremark.pipelines.ground_model.points import StationPoints, station_points
from spheremark.pipelines.ground_model.values import (
    ElevationConfig,
    ElevationModel,
    StationPose,
    pose_of_fix,
    pose_of_points,
    poses_of_network,
)

__all__ = [
    "ElevationConfig",
    "ElevationModel",
    "StationPoints",
    "StationPose",
    "Terrain",
    "pose_of_fix",
    "pose_of_points",
    "poses_of_network",
    "station_points",
]
