"""How well the two faces of scans agree with a rig: what a calibration is to make small."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from spheremark.pipelines.calibration.faces import both_faces
from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.model import Array, MarkerFit, Rig, ScanLog, seal
from spheremark.pipelines.scan.stitching import stitch


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class FaceGaps:
    """How far apart the two faces of scans put the centres of spheres, one row per sphere.

    Attributes
    ----------
    stops : tuple of str
        The stop of each.
    p_base : (n, 3)
        Middle of both centres [m].
    gap_base : (n, 3)
        Front minus back [m].
    cov_gap_base : (n, 3, 3)
        Its covariance, by those of the centres [m^2].
    """

    stops: tuple[str, ...]
    p_base: Array
    gap_base: Array
    cov_gap_base: Array

    def __post_init__(self) -> None:
        n = len(self.stops)
        seal(self, p_base=(n, 3), gap_base=(n, 3), cov_gap_base=(n, 3, 3))

    @property
    def rms(self) -> float:
        """Root mean square length of the gaps."""
        return _rms(np.sum(self.gap_base**2, axis=1))

    @property
    def sigma(self) -> float:
        """What ``rms`` should be by the covariances."""
        return _rms(np.trace(self.cov_gap_base, axis1=1, axis2=2))


def face_gaps(stops: Iterable[ScanLog], rig: Rig, config: SurveyConfig) -> FaceGaps:
    """Compare what the two faces of scans show of each sphere.

    Parameters
    ----------
    stops : iterable of ScanLog
        Stops with the same rig.
    rig : Rig
        The rig to stitch them with.
    config : SurveyConfig
        How spheres are found.

    Returns
    -------
    FaceGaps
        Spheres that both faces of a stop show; there may be none.

    Notes
    -----
    Each face is fitted apart and knows nothing of the other, so that the gaps judge a rig that was
    estimated from the same scans by something else than its own residuals.
    """
    names: list[str] = []
    pairs: list[tuple[MarkerFit, MarkerFit]] = []
    for log in stops:
        found = both_faces(stitch(log, rig, config.stitching), config)
        names += [log.origin.name] * len(found)
        pairs += found
    front, back = (
        np.array([fits[side].p_base for fits in pairs]).reshape(-1, 3) for side in (0, 1)
    )
    cov = [one.cov_p_base + other.cov_p_base for one, other in pairs]
    return FaceGaps(
        stops=tuple(names),
        p_base=(front + back) / 2.0,
        gap_base=front - back,
        cov_gap_base=np.array(cov).reshape(-1, 3, 3),
    )


def _rms(squares: Array) -> float:
    """Return the root of the mean of squares; NaN of none."""
    return float(np.sqrt(np.mean(squares))) if len(squares) else float("nan")
