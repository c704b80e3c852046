"""The page of an adjusted network, in the order of a survey report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.network.comparison import SIGMA_GIVEN
from spheremark.web.columns import MM, Columns, floats, has_errors, plain_rows, rms, select, texts
from spheremark.web.figures import network as figures
from spheremark.web.links import query_text, stop_url
from spheremark.web.pages.base import Frame, Panel, Readout, Row
from spheremark.web.templating import number, render

_ORDER = ("refused", "doubtful", "confirmed")  # of the decisions on marks
_N_WORST = 40  # observations in the table; all are in the database and in the files
_MAP = (
    "Solid: the 95 % ellipse; dotted: the standard ellipse (39 %). The fill is the mean redundancy "
    "of the centres: 0 is uncontrolled, 3 is controlled completely by the others."
)
_RESIDUALS = "Along the axes of the network. Crosses are left out."
_TESTS = (
    "A centre above the limit is a gross error. With little redundancy, on the left, the minimal "
    "detectable bias is large."
)
_CHECKS = (
    "Position of each mark from the network without its coordinates. Bars are twice the sigma of "
    "the difference."
)


def adjustment_page(
    frame: Frame,
    adjustment: Row | None,
    tables: Mapping[str, Columns],
    files: tuple[str, ...],
    **more: Any,
) -> str:
    """Return the page of a network from its rows of each table.

    ``more`` are all networks of the survey, the number of its control marks, and the id of the
    network that is its chosen solution; without a network the number of its logs.
    """
    if adjustment is None:
        return render("adjustment.html", frame=frame, adjustment=None, **more)
    observations = tables["adjusted_observations"]
    rows = {name: plain_rows(columns) for name, columns in tables.items()}
    centres = select(observations, observations["kind"] == "centre")
    return render(
        "adjustment.html",
        frame=frame,
        adjustment=adjustment,
        files=files,
        readouts=_readouts(adjustment, tables),
        panels=_panels(adjustment, tables, centres),
        tables=rows,
        worst=_worst(rows["adjusted_observations"]),
        n_worst=_N_WORST,
        left_out=[row for row in rows["adjusted_observations"] if not row["used"]],
        decisions=_decisions(rows["mark_decisions"], rows["mark_evidence"]),
        n_centres=len(centres["kind"]),
        has_truth=has_errors(tables["adjusted_stations"]),
        **more,
    )


def _readouts(one: Row, tables: Mapping[str, Columns]) -> list[Readout]:
    """Return the key numbers of a network."""
    test = "passes" if one["passes_global_test"] else "fails"
    limit = (
        f"v'Pv {number(one['vtpv'], 1)}, limit {number(one['vtpv_limit'], 1)} (chi-square, "
        f"one-sided, level {one['test_level']:g})"
    )
    factor = number(None if one["sigma0"] is None else one["sigma0"] ** 2, 3)
    prior = f"1 a priori; sigma0 {number(one['sigma0'], 3)}"
    counts = f"{one['n_observations']} observations, {one['n_unknowns']} unknowns"
    fitted = ", after a fit to the truth" if one["datum"] == "free" else ""
    found = [
        Readout("Global test", test, "", limit),
        Readout("Variance factor", factor, "a posteriori", prior),
        Readout("Degrees of freedom", str(one["dof"]), "", counts),
    ]
    for what in ("station", "mark"):
        rows = tables[f"adjusted_{what}s"]
        free = select(rows, floats(rows, "sigma_3d_m") > SIGMA_GIVEN)
        if len(free[what]):
            is_valid = bool(one["passes_global_test"])
            found.append(_sizes(f"{what.capitalize()}s", free, fitted, is_valid=is_valid))
    checks = tables["control_checks"]
    return [*found, _left_out(checks)] if len(checks["mark"]) else found


def _sizes(what: str, rows: Columns, fitted: str, *, is_valid: bool) -> Readout:
    """Return the accuracy of stations or marks: against truth if known, else predicted."""
    sigma, error = floats(rows, "sigma_3d_m"), floats(rows, "error_3d_m")
    known = error[np.isfinite(error)]
    largest = f"largest {number(float(sigma.max()) * MM, 2)} mm"
    predicted = number(rms(sigma) * MM, 2)
    if not is_valid and not len(known):
        note = "the global test fails, so predicted sigmas are not valid"
        return Readout(f"{what}, predicted", "\N{EN DASH}", "mm RMS sigma", note)
    if not len(known):
        note = f"{largest}; truth not known"
        return Readout(f"{what}, predicted", predicted, "mm RMS sigma", note)
    note = f"predicted {predicted} mm RMS, {largest}{fitted}" if is_valid else "sigmas not valid"
    return Readout(f"{what}, against truth", number(rms(known) * MM, 2), "mm RMS error", note)


def _left_out(checks: Columns) -> Readout:
    """Return the differences of control marks that were left out in turn."""
    difference, sigma = floats(checks, "difference_3d_m"), floats(checks, "sigma_3d_m")
    worst = int(difference.argmax())
    largest = f"largest {number(float(difference[worst]) * MM, 1)} mm at {checks['mark'][worst]}"
    note = f"predicted minus given; sigma {number(rms(sigma) * MM, 2)} mm, {largest}"
    return Readout("Control left out in turn", number(rms(difference) * MM, 2), "mm RMS", note)


def _panels(one: Row, tables: Mapping[str, Columns], centres: Columns) -> list[Panel]:
    """Return the figures of a network."""
    stations, survey = tables["adjusted_stations"], str(one["survey"])
    names = zip(texts(stations, "station"), texts(stations, "stop"), strict=True)
    stops = dict(names)
    stations = {**stations, **_links(survey, stops, texts(stations, "station"))}
    observed = (texts(centres, "station"), str(one["fit_method"]), texts(centres, "marker"))
    centres = {**centres, **_links(survey, stops, *observed)}
    rows = query_text("adjusted_observations", adjustment_id=str(one["adjustment_id"]))
    places = figures.network_map(stations, tables["adjusted_marks"])
    tested = select(centres, np.isfinite(floats(centres, "w")))
    panels = [
        Panel("map", places, _MAP),
        Panel("residuals", figures.residuals(centres), _RESIDUALS, sql=rows),
        Panel("tests", figures.tests(tested, one["w_limit"]), _TESTS, sql=rows),
    ]
    if len(tables["control_checks"]["mark"]):
        figure = figures.control_differences(tables["control_checks"])
        panels.append(Panel("checks", figure, _CHECKS))
    return panels


def _decisions(
    decisions: list[dict[str, Any]], evidence: list[dict[str, Any]]
) -> list[dict[str, Any]]:
    """Return the marks with the evidence of their stations, those in doubt first."""
    of_marks: dict[str, list[dict[str, Any]]] = {row["mark"]: [] for row in decisions}
    for row in evidence:
        of_marks[row["mark"]].append(row)
    rows = [row | {"stations": of_marks[row["mark"]]} for row in decisions]
    return sorted(rows, key=lambda row: _ORDER.index(row["decision"]))


def _worst(observations: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the most critical centres: those left out, then by w."""
    centres = [row for row in observations if row["kind"] == "centre"]
    return sorted(centres, key=lambda row: (row["used"], -(row["w"] or 0.0)))[:_N_WORST]


def _links(
    survey: str,
    stops: Mapping[str, str],
    stations: Sequence[str],
    method: str = "",
    markers: Sequence[str] = (),
) -> dict[str, NDArray[Any]]:
    """Return the column of links to the stop of each station, or to the marker observed there."""
    links = [
        stop_url(survey, stops.get(station, station), method, marker)
        for station, marker in zip_longest(stations, markers, fillvalue="")
    ]
    return {"link": np.array(links, dtype=object)}
