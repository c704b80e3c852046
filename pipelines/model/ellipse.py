"""The error ellipse of a horizontal covariance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from spheremark.pipelines.model.arrays import Array

_TO_95 = float(np.sqrt(-2.0 * np.log(0.05)))  # from the standard ellipse to the 95 % ellipse


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorEllipse:
    """The standard error ellipse of a position in the plane."""

    major: float  # semi-axes [m]
    minor: float
    bearing: float  # bearing of the major axis, clockwise from y, 0 to pi [rad]

    @classmethod
    def of(cls, cov: Array) -> Self:
        """Return the ellipse of the first two axes of a covariance [m^2]."""
        variances, axes = np.linalg.eigh(cov[:2, :2])
        minor, major = np.sqrt(np.maximum(variances, 0.0))
        bearing = float(np.arctan2(axes[0, 1], axes[1, 1])) % np.pi
        return cls(major=float(major), minor=float(minor), bearing=bearing)

    @property
    def major_95(self) -> float:
        """Semi-major axis of the 95 % ellipse [m]."""
        return _TO_95 * self.major

    @property
    def minor_95(self) -> float:
        """Semi-minor axis of the 95 % ellipse [m]."""
        return _TO_95 * self.minor
