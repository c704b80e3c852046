"""Numbers, arrays and ellipses as plain values: what is not finite is null."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from spheremark.pipelines.model import ErrorEllipse

Plain = dict[str, Any]


def number(value: float) -> float | None:
    """Return a number, or null where JSON has none for it."""
    return float(value) if math.isfinite(value) else None


def numbers(values: ArrayLike) -> Any:
    """Return an array as nested lists, with null where JSON has no number."""
    array = np.asarray(values, dtype=np.float64)
    if np.isfinite(array).all():
        return array.tolist()
    return [numbers(part) for part in array] if array.ndim else None


def ellipse_fields(ellipse: ErrorEllipse) -> Plain:
    """Return an error ellipse, standard and 95 %."""
    return {
        "ellipse_major_m": ellipse.major,
        "ellipse_minor_m": ellipse.minor,
        "ellipse_bearing_deg": math.degrees(ellipse.bearing),
        "ellipse_major_95_m": ellipse.major_95,
        "ellipse_minor_95_m": ellipse.minor_95,
    }
