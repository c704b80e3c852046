"""The tests and tables of a network, from its JSON, and the text report that they make."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from spheremark.pipelines.tables import Column, Table

Plain = Mapping[str, Any]

_RULE = "-" * 78


def vector(key: str, unit: str, form: str, titles: Sequence[str] = "XYZ") -> tuple[Column, ...]:
    """Return the columns of the coordinates of a vector."""
    return tuple(Column(_at(key, i), title, unit, form) for i, title in enumerate(titles))


def _at(key: str, i: int) -> Callable[[Plain], Any]:
    """Return the function to an element of a vector of a row."""
    return lambda row: row[key][i]


def _sigma(i: int) -> Callable[[Plain], float]:
    """Return the function to the standard deviation of a coordinate of a row."""
    return lambda row: math.sqrt((row.get("position_covariance_m2") or row["covariance_m2"])[i][i])


def _n_found(finding: str) -> Callable[[Plain], int]:
    """Return the function to the number of stations with a finding."""
    return lambda row: sum(one["finding"] == finding for one in row["stations"])


_PLACES = (
    Column(lambda row: row["name"] + "*" * row.get("is_control", False), "Name"),
    *vector("position_m", "m", "12.4f"),
    *(Column(_sigma(i), f"s{axis}", "mm", ".2f") for i, axis in enumerate("XYZ")),
    Column("ellipse_major_95_m", "a95", "mm", ".2f"),
    Column("ellipse_minor_95_m", "b95", "mm", ".2f"),
    Column("ellipse_bearing_deg", "bearing", "deg", ".0f"),
    Column("n_observations", "seen", "", "d"),
)
_W = (Column("redundancy", "r", "", ".2f"), Column("w", "w", "", ".2f"))
_CENTRES = (
    Column("station", "Station"),
    Column("marker", "Marker"),
    Column("mark", "Mark"),
    *vector("residual_m", "mm", ".1f", ("vX", "vY", "vZ")),
    *_W,
    Column.mm("minimal_detectable_bias_m", "MDB"),
    Column.mm("external_reliability_station_m", "EX stn"),
    Column.mm("external_reliability_mark_m", "EX mark"),
    Column(lambda row: "" if row["used"] else "left out", ""),
)
_LEVELLING = (
    Column("station", "Station"),
    Column(lambda row: math.degrees(row["residual_rad"][0]), "vX", "deg", ".3f"),
    Column(lambda row: math.degrees(row["residual_rad"][1]), "vY", "deg", ".3f"),
    *_W,
)
_CONTROL = (
    Column("mark", "Mark"),
    *vector("residual_m", "mm", ".2f", ("vX", "vY", "vZ")),
    Column("w", "w", "", ".2f"),
)
_LEFT_OUT = (
    Column("mark", "Left out"),
    *vector("predicted_minus_given_m", "mm", "+.2f", ("dX", "dY", "dZ")),
    *vector("sigma_predicted_minus_given_m", "mm", ".2f", ("sX", "sY", "sZ")),
)
_EVIDENCE = (
    Column("mark", "Mark"),
    Column("decision", "Decision"),
    Column("probability", "probability", "", ".3f"),
    Column("log_odds", "log odds", "", ".1f"),
    *(
        Column(_n_found(finding), finding, "", "d")
        for finding in ("marker", "possible", "refused", "nothing", "hidden")
    ),
    Column("hypothesis", "Best other hypothesis"),
)
_RIG = (
    Column("name", "Parameter"),
    Column("unit", "unit"),
    *(Column(name, name, "", ".7f") for name in ("start", "estimate", "sigma")),
)


def report(network: Plain, title: str = "") -> str:
    """Return the report of a network as text, from its JSON."""
    lines = [f"NETWORK ADJUSTMENT{'  ' + title if title else ''}", "=" * 78]
    lines += [f"{name:<31} {value:>8}" for name, value in summary(network)]
    lines += [*(f"WARNING: {one}" for one in network["warnings"]), ""]
    for table in tables(network):
        lines += [table.title, _RULE, *_aligned(table), *table.notes, ""]
    return "\n".join(lines)


def summary(network: Plain) -> list[tuple[str, str]]:
    """Return what an adjustment is and whether its tests pass, as pairs of name and value."""
    test, factors, sigma0 = network["global_test"], network["variance_factors"], network["sigma0"]
    passed = "passed" if network["passes_global_test"] else "FAILED"
    pairs = [
        ("Stations", str(len(network["stations"]))),
        ("Marks", str(len(network["marks"]))),
        ("Observations (coordinates)", str(network["n_observations"])),
        ("Unknowns", str(network["n_unknowns"])),
        ("Defect of the datum", str(network["datum"]["defect"])),
        ("Degrees of freedom", str(network["dof"])),
        ("Sigma0 a priori", "1.000"),
        ("Sigma0 a posteriori", _number(sigma0)),
        *((f"Variance factor of {kind}", _number(factor)) for kind, factor in factors.items()),
        (
            f"Global test (chi2, level {test['level']:g})",
            f"{passed}: v'Pv = {test['vtpv']:.1f}, limit {test['limit']:.1f}",
        ),
        ("Limit of the local test (w)", f"{network['critical_w']:.2f}"),
        ("Sigmas and ellipses", "a priori; not scaled by the result of the test"),
        ("Datum", network["datum"]["text"]),
    ]
    if bias := network["range_bias"]:
        value, sigma, prior = (1e3 * bias[k] for k in ("value_m", "sigma_m", "sigma_a_priori_m"))
        text = f"{value:.2f} mm, sigma {sigma:.2f} mm (a priori {prior:.2f} mm)"
        pairs.append(("Range bias of all stations", text))
    return pairs


def tables(network: Plain) -> list[Table]:
    """Return all tables of a report."""
    return [
        *places(network),
        *evidence(network),
        *_observations(network),
        *checks(network),
        *_rest(network),
    ]


def _number(value: float | None) -> str:
    """Return a factor, or a hyphen where it is not known."""
    return "-" if value is None else f"{value:.3f}"


def places(network: Plain) -> list[Table]:
    """Return the tables of stations and marks."""
    return [
        Table(title="Adjusted stations", columns=_PLACES, rows=network["stations"]),
        Table(title="Adjusted marks (* control)", columns=_PLACES, rows=network["marks"]),
    ]


def evidence(network: Plain) -> list[Table]:
    """Return what all stations make of each mark, and each station of those in doubt."""
    marks = network.get("evidence")
    if not marks:
        return []
    notes = [
        f"{mark['mark']} {mark['decision']}, own radius of all its fits: "
        f"{mark['log_odds_radius']:+.1f}."
        for mark in marks
        if mark["decision"] != "confirmed" and mark["log_odds_radius"]
    ]
    notes += [
        f"{mark['mark']} {mark['decision']}, {one['station']} at {one['range_m']:.1f} m: "
        f"{one['finding']} ({one['log_odds']:+.1f}). {one['reason']}".rstrip()
        for mark in marks
        if mark["decision"] != "confirmed"
        for one in mark["stations"]
    ]
    title = "Evidence of all stations (log odds of a marker; number of stations by finding)"
    return [Table(title=title, columns=_EVIDENCE, rows=marks, notes=notes)]


def checks(network: Plain) -> list[Table]:
    """Return what is known of the accuracy without truth."""
    rows = [row for row in network["control"] if row["predicted_minus_given_m"] is not None]
    notes = [f"Mark {row['name']}: {row['reason']}" for row in network["marks"] if row["reason"]]
    notes += [
        f"Control {row['mark']} left out: nothing else determines it."
        for row in network["control"]
        if row["predicted_minus_given_m"] is None
    ]
    notes += [
        f"{' and '.join(row['stations'])}: {1e3 * row['apart_3d_m']:.1f} mm apart, centres of "
        f"{row['n_marks']} marks agree to {1e3 * row['difference_rms_m']:.2f} mm RMS "
        f"(predicted {1e3 * row['predicted_rms_m']:.2f})"
        for row in network["repeated_stops"]
    ]
    if not rows and not notes:
        notes = ["No control mark and no repeated stop: the accuracy is known by sigmas only."]
    title = "Checks without truth: control left out, predicted - given"
    return [Table(title=title, columns=_LEFT_OUT, rows=rows, notes=notes)]


def not_used(network: Plain) -> Iterator[str]:
    """Yield what is not part of a network, with the reasons."""
    for one in network["refused"]:
        yield f"Station {one['station']}: {one['reason']}"
    for one in network["excluded"]:
        what = " ".join(part for part in (one["station"], one["marker"], one["mark"]) if part)
        yield f"{one['kind'].capitalize()} {what}: {one['reason']}"


def _observations(network: Plain) -> Iterator[Table]:
    """Yield the tables of residuals: centres with reliability, levelling, control."""
    title = "Observed centres, largest w first (v observed - computed, r of 3, EX: shift by an MDB)"
    centres = sorted(network["observations"], key=lambda row: -(row["w"] or 0.0))
    yield Table(title=title, columns=_CENTRES, rows=centres)
    yield Table(title="Observed levelling", columns=_LEVELLING, rows=network["gravity"])
    if network["control"]:
        yield Table(title="Control marks", columns=_CONTROL, rows=network["control"])


def _rest(network: Plain) -> Iterator[Table]:
    """Yield the rig, if it was adjusted with the network, and what was not used."""
    if rig := network["calibration"]:
        held = [f"{one['name']}: {one['reason']}" for one in rig["not_separable"]]
        title = "Rig, adjusted with the network"
        yield Table(title=title, columns=_RIG, rows=rig["parameters"], notes=held)
    notes = list(not_used(network)) or ["Nothing: all observations were used."]
    yield Table(title="Not used", notes=notes)


def _aligned(table: Table) -> list[str]:
    """Return heads, units and rows in columns of equal width."""
    if not table.rows:
        return []
    units = [f"[{column.unit}]" if column.unit else "" for column in table.columns]
    lines = [[column.title for column in table.columns], units]
    lines += [[column.cell(row) for column in table.columns] for row in table.rows]
    widths = [max(map(len, cells)) for cells in zip(*lines, strict=True)]
    sides = [">" if column.form else "<" for column in table.columns]
    forms = [f"{side}{width}" for side, width in zip(sides, widths, strict=True)]
    return [" ".join(map(format, cells, forms)).rstrip() for cells in lines]
