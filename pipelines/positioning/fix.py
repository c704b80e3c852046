"""Adjustment -> StationFix, the same for all resection methods."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spheremark.pipelines.estimation.least_squares import Adjustment
from spheremark.pipelines.geometry import included_angle
from spheremark.pipelines.model import Array, Exclusion, Index, StationFix, Status
from spheremark.pipelines.positioning.matching import Scene


class Pose(NamedTuple):
    """A station in the unshifted site frame, with what its adjustment says of it."""

    T_site_station: Array  # (4, 4) pose [m]
    cov_T_site_station: Array  # (6, 6) its covariance
    cov_p_site: Array  # (3, 3) covariance of the position [m^2]
    J_position: Array  # (3, p) derivative of the position by the unknowns of the adjustment
    residuals_site: Array  # (k, 3) residuals of the centres [m]


def station_fix(
    method: str,
    scene: Scene,
    pairs: Index,
    adjustment: Adjustment,
    pose: Pose,
    findings: tuple[list[str], tuple[Exclusion, ...]],
) -> StationFix:
    """Assemble a fix from the markers in use, why it is weak, and which markers were left out."""
    n, (reasons, excluded) = len(pairs), findings
    first, second = np.triu_indices(n, 1)
    centres = scene.centres_base[pairs[:, 0]]
    angles = included_angle(centres[first], centres[second])
    return StationFix(
        method=method,
        T_site_station=pose.T_site_station,
        cov_T_site_station=pose.cov_T_site_station,
        cov_p_site=pose.cov_p_site,
        matches=np.array(pairs),
        sigma_heading=scene.sigma_heading,
        residuals_site=pose.residuals_site,
        redundancies=adjustment.redundancies[:n],
        w_statistics=adjustment.w_statistics[:n],
        detectable_biases=adjustment.detectable_biases[:n],
        external_reliabilities=adjustment.external_reliabilities(pose.J_position)[:n],
        dof=adjustment.dof,
        sigma0=adjustment.sigma0,
        passes_global_test=adjustment.passes_global_test,
        included_angles=np.array([angles.min(), angles.max()]),
        status=Status.WEAK if reasons else Status.OK,
        reason="; ".join(reasons),
        excluded=excluded,
    )


def failed_global_test(adjustment: Adjustment) -> list[str]:
    """Return that the global test fails; nothing if it passes."""
    if adjustment.passes_global_test:
        return []
    return [
        f"the global test fails (sigma0 = {adjustment.sigma0:.2f}): residuals are larger than "
        "their sigmas promise"
    ]


def assumed_levelling(scene: Scene) -> list[str]:
    """Return that the levelling was not measured; nothing if it was."""
    return [] if scene.is_levelled else ["no AHRS: the levelling is only assumed"]
