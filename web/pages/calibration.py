"""The page of a calibration: each parameter before and after, with its reason if not estimated."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from spheremark.web.columns import MM, Columns, plain_rows, select, texts
from spheremark.web.figures import calibration as figures
from spheremark.web.pages.base import Frame, Panel, Readout, Row
from spheremark.web.templating import number, render

_LASER = "laser_range_bias_"
_SHOWN = {"m": ("mm", 1e3, 2), "rad": ("deg", math.degrees(1.0), 4), "s": ("ms", 1e3, 3)}
"""Displayed unit, factor and decimals by the unit of a parameter."""
_GAPS = (
    "Each face is fitted alone, with the rig before (hollow) and after (filled). Afterwards the "
    "differences should scatter about zero without a pattern."
)
_LASERS = (
    "Against the mean of all lasers, which spheres do not determine. Bars are twice the sigma."
)


def calibration_page(
    frame: Frame, calibration: Row | None, parameters: Columns, gaps: Columns, **more: Any
) -> str:
    """Return the page of a calibration.

    ``more`` are its files, whether its rig is in use, all calibrations of the survey and its rig.
    """
    if calibration is None:
        return render("calibration.html", frame=frame, calibration=None, **more)
    rows = [_readable(row) for row in plain_rows(parameters)]
    estimated = [row for row in rows if row["is_estimated"]]
    return render(
        "calibration.html",
        frame=frame,
        calibration=calibration,
        readouts=_readouts(calibration),
        panels=_panels(parameters, gaps),
        estimated=[row for row in estimated if not row["parameter"].startswith(_LASER)],
        lasers=[row for row in estimated if row["parameter"].startswith(_LASER)],
        held=[row for row in rows if not row["is_estimated"]],
        **more,
    )


def _readable(row: Row) -> dict[str, Any]:
    """Return a parameter in its displayed unit, with its change in sigmas."""
    name = str(row["parameter"])
    label = name.replace("_", " ")
    if name.startswith(_LASER):
        label = f"laser {name.removeprefix(_LASER)}"
    if not row["is_estimated"]:
        return {**row, "label": label}
    unit, factor, decimals = _SHOWN.get(row["unit"], (row["unit"], 1.0, 6))
    columns = {"before": "start_value", "after": "estimate", "sigma": "sigma"}
    numbers = {name: number(row[column] * factor, decimals) for name, column in columns.items()}
    change = (row["estimate"] - row["start_value"]) / row["sigma"] if row["sigma"] else math.nan
    return {**row, **numbers, "unit": unit, "label": label, "change": number(change, 1)}


def _readouts(one: Row) -> tuple[Readout, ...]:
    """Return the key numbers of a calibration."""
    before, after = (_mm(one[f"gap_rms_{when}_m"]) for when in ("before", "after"))
    predicted = f"{_mm(one['gap_sigma_after_m'])} mm predicted from the noise of the centres"
    sigma0 = f"sigma0 {number(one['sigma0'], 2)}"
    residuals = f"{_mm(one['residual_rms_before_m'])} mm before; {sigma0}"
    n, left = len(one["stops"]), _mm(one["residual_rms_after_m"])
    returns = (
        f"{one['n_returns']:,} returns in {n} scan{'' if n == 1 else 's'}, {one['dof']:,} degrees "
        "of freedom"
    )
    spheres = (str(one["n_two_faced"]), f"of {one['n_spheres']}")
    return (
        Readout("Faces apart, before", before, "mm RMS", "front minus back of each sphere"),
        Readout("Faces apart, after", after, "mm RMS", predicted, "along_beam"),
        Readout("Residuals of the returns", left, "mm RMS after", residuals),
        Readout("Spheres on both faces", *spheres, returns),
    )


def _mm(value: float | None) -> str:
    """Format a length in millimetres."""
    return number(None if value is None else value * MM, 1)


def _panels(parameters: Columns, gaps: Columns) -> list[Panel]:
    """Return the figures of a calibration."""
    panels = []
    if len(gaps["stop"]):
        is_after = np.asarray(gaps["is_after"], dtype=bool)
        figure = figures.face_gaps(select(gaps, ~is_after), select(gaps, is_after))
        panels.append(Panel("gaps", figure, _GAPS, "tall"))
    lasers = np.array([name.startswith(_LASER) for name in texts(parameters, "parameter")])
    lasers &= np.asarray(parameters["is_estimated"], dtype=bool)
    if lasers.any():
        panels.append(Panel("lasers", figures.laser_biases(select(parameters, lasers)), _LASERS))
    return panels
