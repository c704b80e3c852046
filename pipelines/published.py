"""What the reference study published, as numbers to compare with; nothing here is an input.

"Evaluation Method of Spherical Marker Arrangement for LiDAR-SLAM using a Robot Simulator": 14
spheres of 0.20 m diameter, a VLP-16 tilted by 90 degrees on a gimbal, one turn per stop. Its
Table 4 and its figures exist only as descriptions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spheremark.pipelines.model import Array, same_length, seal

TITLE = "Evaluation Method of Spherical Marker Arrangement for LiDAR-SLAM using a Robot Simulator"
"""Title of the study."""

TOLERANCE = 0.03
"""Error that the study accepts [m]."""

SIGMA_RANGE = 0.03
"""Noise of a range in the study's simulation [m]. It gives none: this is the accuracy of ranging
that it names, and what the model of a VLP-16 that comes with its simulator, Webots, says of itself
(0.03 m over a reach of 100 m)."""

GREATEST_DISTANCE = 7.5
"""Distance up to which the study says that its tolerance is kept [m]."""

LEAST_ANGLE, WIDEST_ANGLE = np.radians(30.0), np.radians(150.0)
"""Included angles between which the study says that its tolerance is kept [rad]."""

SMALLEST_COUNT = 100
"""Number of returns from which the study says that its tolerance is kept."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PublishedCentres:
    """Errors of sphere centres as a table of the study gives them."""

    ranges: Array  # (n,) distances from the LiDAR to the centres [m]
    n_points: Array  # (n,) numbers of returns
    # (n, 3) errors along the axes of the study's own frame, which it does not define [m]
    errors: Array
    errors_3d: Array  # (n,) lengths of the errors as printed [m]

    def __post_init__(self) -> None:
        seal(self, ranges=(None,), n_points=(None,), errors=(None, 3), errors_3d=(None,))
        same_length(self, "ranges", "n_points", "errors", "errors_3d")


_TABLE_2 = np.array(
    [
        [6.84, 142, -0.0084, -0.0193, -0.0140, 0.0253],
        [7.15, 130, 0.0068, 0.0119, 0.0156, 0.0208],
        [7.19, 150, 0.0012, -0.0244, -0.0118, 0.0271],
        [7.71, 107, 0.0300, 0.0079, 0.0208, 0.0374],
        [7.76, 122, 0.0222, 0.0074, 0.0155, 0.0281],
        [7.84, 119, 0.0016, -0.0226, -0.0166, 0.0281],
        [7.90, 96, 0.0007, 0.0248, 0.0094, 0.0265],
        [7.94, 108, 0.0067, 0.0238, 0.0137, 0.0283],
        [7.99, 111, 0.0130, 0.0156, 0.0125, 0.0239],
        [8.17, 121, 0.0022, 0.0272, 0.0049, 0.0277],
        [8.27, 83, 0.0186, 0.0085, 0.0187, 0.0277],
        [9.02, 80, 0.0266, 0.0271, 0.0222, 0.0438],
        [9.13, 68, 0.0048, 0.0229, 0.0130, 0.0268],
        # printed with y 0.2920, which its own 3-D error contradicts; 0.0292 agrees with it
        [9.34, 93, 0.0153, 0.0292, 0.0186, 0.0379],
    ]
)

TABLE_2 = PublishedCentres(
    ranges=_TABLE_2[:, 0].copy(),
    n_points=_TABLE_2[:, 1].copy(),
    errors=_TABLE_2[:, 2:5].copy(),
    errors_3d=_TABLE_2[:, 5].copy(),
)
"""Table 2, "Estimation accuracy of marker center location by distance"."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PublishedStations:
    """Errors of the station by included angle as the study's Table 3 gives them."""

    included_angles: Array  # (n,) between its two markers, seen from the station [rad]
    errors: Array  # (n,) error of the station [m]

    def __post_init__(self) -> None:
        seal(self, included_angles=(None,), errors=(None,))
        same_length(self, "included_angles", "errors")


TABLE_3 = PublishedStations(
    included_angles=np.radians([17.54, 33.19, 57.54, 99.27, 133.13, 148.59, 165.05]),
    errors=np.array([0.0560, 0.0350, 0.0277, 0.0256, 0.0284, 0.0324, 0.0477]),
)
"""Table 3, "Accuracy of self-position estimation for each included angle"."""

GRANTED_ERROR = 0.017
"""Error that the study grants each axis of each marker's centre [m]."""

GRANTED_DISTANCE = 7.5
"""Distance of its markers in that experiment, to a few centimetres [m]."""
