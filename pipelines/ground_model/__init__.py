"""Ground heights of a site with their uncertainty, from the clouds of its stops.

Hides how ground is told from what stands on it (``ground``) and how stops are joined (``grid``).
The model is one of the *terrain*: rocks, poles, markers and people are taken off. Clouds come one
at a time, so memory grows with the site and not with the survey. ``points`` holds what of a stop
goes into a cloud of the whole site.
"""

from spheremark.pipelines.ground_model.model import Terrain
from spheremark.pipelines.ground_model.points import StationPoints, station_points
from spheremark.pipelines.ground_model.values import (
    ElevationConfig,
    ElevationModel,
    StationPose,
    pose_of_fix,
    poses_of_network,
)

__all__ = [
    "ElevationConfig",
    "ElevationModel",
    "StationPoints",
    "StationPose",
    "Terrain",
    "pose_of_fix",
    "poses_of_network",
    "station_points",
]
