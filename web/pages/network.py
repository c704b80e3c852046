"""The page of an adjusted network, in the order of a survey report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from spheremark.web.columns import MM, Columns, floats, has_errors, plain_rows, rms, select
from spheremark.web.figures import network as figures
from spheremark.web.pages.base import Frame, Panel
from spheremark.web.pages.readouts import Readout
from spheremark.web.templating import number, render

Row = Mapping[str, Any]
_N_WORST = 40  # observations in the table; all are in the database and in the files


@dataclass(frozen=True, slots=True, kw_only=True)
class AdjustmentPage:
    """An adjusted network with its tables and files."""

    frame: Frame
    adjustment: Row
    stations: Columns
    marks: Columns
    observations: Columns
    checks: Columns
    repeats: tuple[Row, ...]
    refused: tuple[Row, ...]
    files: tuple[str, ...]


def adjustment_page(page: AdjustmentPage) -> str:
    """Return the page of a network."""
    centres = select(page.observations, page.observations["kind"] == "centre")
    return render(
        "adjustment.html",
        page,
        here="survey",
        readouts=_readouts(page),
        panels=_panels(page, centres),
        station_rows=plain_rows(page.stations),
        mark_rows=plain_rows(page.marks),
        worst=_worst(plain_rows(page.observations)),
        n_worst=_N_WORST,
        left_out=[row for row in plain_rows(page.observations) if not row["used"]],
        n_centres=len(centres["kind"]),
        has_truth=has_errors(page.stations),
    )


def _readouts(page: AdjustmentPage) -> tuple[Readout, ...]:
    """Return the key numbers of a network."""
    one = page.adjustment
    test = "passes" if one["passes_global_test"] else "fails"
    a_posteriori = None if one["sigma0"] is None else one["sigma0"] ** 2
    found = [
        Readout(
            label="Global test",
            value=test,
            unit="",
            note=f"v'Pv {number(one['vtpv'], 1)}, limit {number(one['vtpv_limit'], 1)} "
            f"(chi-square, one-sided, level {one['test_level']:g})",
        ),
        Readout(
            label="Variance factor",
            value=number(a_posteriori, 3),
            unit="a posteriori",
            note=f"1 a priori; sigma0 {number(one['sigma0'], 3)}",
        ),
        Readout(
            label="Degrees of freedom",
            value=str(one["dof"]),
            unit="",
            note=f"{one['n_observations']} observations, {one['n_unknowns']} unknowns",
        ),
        _sizes("Stations", page.stations, page),
        _sizes("Marks", page.marks, page),
    ]
    if len(page.checks["mark"]):
        found.append(_left_out(page.checks))
    return tuple(found)


def _sizes(what: str, rows: Columns, page: AdjustmentPage) -> Readout:
    """Return the accuracy of stations or marks: against truth if known, else predicted."""
    sigma, error = floats(rows, "sigma_3d_m"), floats(rows, "error_3d_m")
    known = error[np.isfinite(error)]
    largest = f"largest {number(float(sigma.max()) * MM, 2)} mm"
    if not len(known):
        return Readout(
            label=f"{what}, predicted",
            value=number(rms(sigma) * MM, 2),
            unit="mm RMS sigma",
            note=f"{largest}; truth not known",
        )
    fitted = ", after a fit to the truth" if page.adjustment["datum"] == "free" else ""
    return Readout(
        label=f"{what}, against truth",
        value=number(rms(known) * MM, 2),
        unit="mm RMS error",
        note=f"predicted {number(rms(sigma) * MM, 2)} mm RMS, {largest}{fitted}",
    )


def _left_out(checks: Columns) -> Readout:
    """Return the differences of control marks that were left out in turn."""
    difference, sigma = floats(checks, "difference_3d_m"), floats(checks, "sigma_3d_m")
    worst = int(difference.argmax())
    largest = f"largest {number(float(difference[worst]) * MM, 1)} mm at {checks['mark'][worst]}"
    return Readout(
        label="Control left out in turn",
        value=number(rms(difference) * MM, 2),
        unit="mm RMS",
        note=f"predicted minus given; sigma {number(rms(sigma) * MM, 2)} mm, {largest}",
    )


def _panels(page: AdjustmentPage, centres: Columns) -> tuple[Panel, ...]:
    """Return the figures of a network."""
    panels = [
        Panel(
            name="map",
            figure=figures.network_map(page.stations, page.marks),
            caption="Solid: the 95 % ellipse; dotted: the standard ellipse (39 %). The fill is the "
            "mean redundancy of the centres: 0 is uncontrolled, 3 is controlled completely by the "
            "others.",
        ),
        Panel(
            name="residuals",
            figure=figures.residuals(centres),
            caption="Along the axes of the network. Crosses are left out.",
        ),
        Panel(
            name="tests",
            figure=figures.tests(
                select(centres, np.isfinite(floats(centres, "w"))), page.adjustment["w_limit"]
            ),
            caption="A centre above the limit is a gross error. With little redundancy, on the "
            "left, the minimal detectable bias is large.",
        ),
    ]
    if len(page.checks["mark"]):
        panels.append(
            Panel(
                name="checks",
                figure=figures.control_differences(page.checks),
                caption="Position of each mark from the network without its coordinates. Bars are "
                "twice the sigma of the difference.",
            )
        )
    return tuple(panels)


def _worst(observations: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the most critical centres: those left out, then by w."""
    centres = [row for row in observations if row["kind"] == "centre"]
    return sorted(centres, key=lambda row: (row["used"], -(row["w"] or 0.0)))[:_N_WORST]
