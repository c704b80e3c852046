"""The page of a calibration: each parameter before and after, with its reason if not estimated."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from spheremark.web.columns import MM, Columns, plain_rows, select, texts
from spheremark.web.figures import calibration as figures
from spheremark.web.pages.base import Frame, Panel
from spheremark.web.pages.readouts import Readout
from spheremark.web.templating import number, render

Row = Mapping[str, Any]
_LASER = "laser_range_bias_"
_SHOWN = {"m": ("mm", 1e3, 2), "rad": ("deg", math.degrees(1.0), 4), "s": ("ms", 1e3, 3)}
"""Displayed unit, factor and decimals by the unit of a parameter."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationPage:
    """A calibration; ``is_chosen`` if the survey uses its rig."""

    frame: Frame
    calibration: Row
    parameters: Columns
    gaps: Columns
    files: tuple[str, ...]
    is_chosen: bool


def calibration_page(page: CalibrationPage) -> str:
    """Return the page of a calibration."""
    rows = [_readable(row) for row in plain_rows(page.parameters)]
    estimated = [row for row in rows if row["is_estimated"]]
    return render(
        "calibration.html",
        page,
        here="survey",
        readouts=_readouts(page.calibration),
        panels=_panels(page),
        estimated=[row for row in estimated if not row["parameter"].startswith(_LASER)],
        lasers=[row for row in estimated if row["parameter"].startswith(_LASER)],
        held=[row for row in rows if not row["is_estimated"]],
    )


def _readable(row: Row) -> dict[str, Any]:
    """Return a parameter in its displayed unit, with its change in sigmas."""
    if not row["is_estimated"]:
        return {**row, "label": _label(row)}
    unit, factor, decimals = _SHOWN.get(row["unit"], (row["unit"], 1.0, 6))
    numbers = {
        name: number(row[column] * factor, decimals)
        for name, column in (("before", "start_value"), ("after", "estimate"), ("sigma", "sigma"))
    }
    change = (row["estimate"] - row["start_value"]) / row["sigma"] if row["sigma"] else math.nan
    return {**row, **numbers, "unit": unit, "label": _label(row), "change": number(change, 1)}


def _label(row: Row) -> str:
    """Return the displayed name of a parameter."""
    name = str(row["parameter"])
    if name.startswith(_LASER):
        return f"laser {name.removeprefix(_LASER)}"
    return name.replace("_", " ")


def _readouts(one: Row) -> tuple[Readout, ...]:
    """Return the key numbers of a calibration."""
    before, after = one["residual_rms_before_m"], one["residual_rms_after_m"]
    return (
        Readout(
            label="Faces apart, before",
            value=_mm(one["gap_rms_before_m"]),
            unit="mm RMS",
            note="front minus back of each sphere",
        ),
        Readout(
            label="Faces apart, after",
            value=_mm(one["gap_rms_after_m"]),
            unit="mm RMS",
            note=f"{_mm(one['gap_sigma_after_m'])} mm predicted from the noise of the centres",
            method="along_beam",
        ),
        Readout(
            label="Residuals of the returns",
            value=f"{_mm(after)}",
            unit="mm RMS after",
            note=f"{_mm(before)} mm before; sigma0 {number(one['sigma0'], 2)}",
        ),
        Readout(
            label="Spheres on both faces",
            value=str(one["n_two_faced"]),
            unit=f"of {one['n_spheres']}",
            note=f"{one['n_returns']:,} returns in {len(one['stops'])} "
            f"scan{'' if len(one['stops']) == 1 else 's'}, {one['dof']:,} degrees of freedom",
        ),
    )


def _mm(value: float | None) -> str:
    """Format a length in millimetres."""
    return number(None if value is None else value * MM, 1)


def _panels(page: CalibrationPage) -> tuple[Panel, ...]:
    """Return the figures of a calibration."""
    panels = []
    if len(page.gaps["stop"]):
        is_after = np.asarray(page.gaps["is_after"], dtype=bool)
        panels.append(
            Panel(
                name="gaps",
                figure=figures.face_gaps(select(page.gaps, ~is_after), select(page.gaps, is_after)),
                caption="Each face is fitted alone, with the rig before (hollow) and after "
                "(filled). Afterwards the differences should scatter about zero without a pattern.",
                kind="tall",
            )
        )
    lasers = np.array([name.startswith(_LASER) for name in texts(page.parameters, "parameter")])
    lasers &= np.asarray(page.parameters["is_estimated"], dtype=bool)
    if lasers.any():
        panels.append(
            Panel(
                name="lasers",
                figure=figures.laser_biases(select(page.parameters, lasers)),
                caption="Against the mean of all lasers, which spheres do not determine. Bars are "
                "twice the sigma.",
            )
        )
    return tuple(panels)
