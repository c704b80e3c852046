"""What the data sheets of a random world's LiDAR, rig and AHRS say, as settings of a survey."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.model import Rig
from spheremark.pipelines.scan.rigs import N_LASERS
from spheremark.pipelines.simulation import RandomWorld, recorded_time
from spheremark.pipelines.simulation.worlds import PRIORS, latency_rms


def data_sheet(world: RandomWorld) -> SurveyConfig:
    """Return the settings of a survey whose user knows the data sheets of the instruments.

    Parameters
    ----------
    world : RandomWorld
        A world.

    Returns
    -------
    SurveyConfig
        The sigmas of the errors, not the errors: of range biases between lasers and in common, of
        the scale of ranges, of mounting, offset and levelling, and of the clocks.
    """
    config, family = world.config, world.field.family
    lasers, common = config.sigma_laser_bias, PRIORS["range_bias"].rms(family)
    scale = PRIORS["range_scale"].rms(family)
    drift = config.sigma_ahrs_drift * 0.5 * recorded_time(config)  # of the mean of all samples
    return SurveyConfig.from_mapping(
        {
            "marker_radius": world.field.marker_radius,
            "stitching": {
                "sigma_levelling": float(np.hypot(config.sigma_ahrs_bias, drift)),
                "sigma_clock": float(np.hypot(latency_rms(family), config.sigma_joint_stamp)),
            },
            "fitting": {
                "methods": ["along_beam"],
                "sigma_range_bias": lasers,
                "sigma_range_common": common,
                "sigma_range_scale": scale,
                "sigma_mounting": config.sigma_misalignment,
                "sigma_offset": config.sigma_axis_offset,
                "sigma_gimbal_clock": min(latency_rms(family), 0.1),
            },
            "resection": {
                "sigma_range": float(np.hypot(common, lasers / np.sqrt(N_LASERS))),
                "sigma_range_scale": scale,
            },
        }
    )


def with_sheet(rig: Rig, world: RandomWorld) -> Rig:
    """Return the rig of a log with a heading as uncertain as its mounting."""
    sigma = max(rig.sigma_heading, world.config.sigma_misalignment)
    return replace(rig, sigma_heading=sigma)
