"""Results as tables for the terminal; the heads of columns carry the units."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

from rich import table as rich_table
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.text import Text

from spheremark.pipelines.tables import Column, Table
from spheremark.service.serialise.network_report import checks, evidence, not_used, places, vector
from spheremark.storage.recordings import Preflight

_ROWS_SHOWN = 100  # of a query; programs get all
_WIDEST = 100_000  # [characters]; no row is wider
_COLOURS = {"ok": "green", "weak": "yellow", "refused": "red", "failed": "red"}
_UNITS = {"m": (1e3, "mm"), "rad": (math.degrees(1.0), "deg"), "s": (1e3, "ms")}

Plain = Mapping[str, Any]


def print_tables(out: Console, tables: Iterable[Table]) -> None:
    """Print tables with their titles and notes."""
    for one in tables:
        if one.title:
            out.print(f"[bold]{escape(one.title)}[/]", highlight=False, soft_wrap=True)
        if one.rows:
            out.print(_drawn(one))
        for note in one.notes:
            _say(out, note)


def _drawn(table: Table) -> rich_table.Table:
    """Return a table for the terminal: units below the heads, text flush left, numbers right."""
    drawn = rich_table.Table(box=None, padding=(0, 1, 0, 0), pad_edge=False, header_style="bold")
    for column in table.columns:
        head = escape(f"{column.title}\n[{column.unit}]" if column.unit else column.title)
        justify = "right" if column.form else "left"
        drawn.add_column(head, justify=justify, overflow="fold")  # type: ignore[arg-type]
    for row in table.rows:
        cells = [column.cell(row).strip() for column in table.columns]
        drawn.add_row(*(Text(cell, style=_COLOURS.get(cell, "")) for cell in cells))
    return drawn


def _say(out: Console, sentence: str) -> None:
    """Print a sentence; nothing in it is markup."""
    out.print(sentence, highlight=False, markup=False, soft_wrap=True)


_TOPICS = (
    Column("topic", "topic"),
    Column("schema", "type"),
    Column.whole("n_messages", "messages"),
    Column("rate_hz", "rate", "Hz", ".1f"),
    Column("longest_gap_s", "longest gap", "s", ".3f"),
)
_FACTS = (Column("fact", "fact"), Column("value", "value", "", ">"))
_MARKERS = (
    Column("id", "marker"),
    Column("status", "status"),
    *vector("centre_m", "m", ".4f", "xyz"),
    Column.mm("sigma_3d_m", "sigma"),
    Column("range_m", "range", "m", ".2f"),
    Column("n_points", "returns", "", "d"),
    Column.mm("rms_m", "rms"),
)
_ERROR = Column.mm("error_3d_m", "error")
_PARAMETERS = (
    Column("name", "parameter"),
    Column("unit", "unit"),
    *(Column(name, name, "", ".4f") for name in ("start", "estimate", "sigma")),
)


def print_preflight(out: Console, name: str, report: Preflight) -> None:
    """Print the preflight report of a log."""
    out.print(f"[bold]{escape(name)}[/]: {_coloured(report.verdict)}")
    for reason in (*report.reasons, *report.notes, *report.diagnosis):
        _say(out, f"  {reason}")
    facts = {
        "returns": f"{report.n_returns:,}",
        "duration [s]": _text(report.duration_s, 1, 1),
        "stops": str(report.n_stops),
        "gimbal coverage [deg]": _text(report.gimbal_coverage_deg, 1, 1),
        "gimbal speed [deg/s]": _text(report.gimbal_speed_deg_per_s, 1, 2),
        "LiDAR speed [1/min]": _text(report.lidar_speed_rpm, 1, 1),
        "coverage gap [deg]": _text(report.coverage_gap_deg, 1, 2),
        "clock skew [s]": _text(report.clock_skew_s, 1, 3),
        "time for each return": "yes" if report.has_shot_times else "no",
        "orientation (AHRS)": "yes" if report.has_orientation else "no",
        "rig": report.rig or "not in the log",
    }
    topics = Table(columns=_TOPICS, rows=[asdict(topic) for topic in report.topics])
    rows = [{"fact": fact, "value": value} for fact, value in facts.items()]
    tables = [topics] if report.topics else []
    if report.n_returns:  # else all facts would be zeros
        tables.append(Table(columns=_FACTS, rows=rows))
    print_tables(out, tables)


def print_log(out: Console, result: Plain) -> None:
    """Print markers and station of each stop of a log."""
    for stop in result["stops"]:
        markers = stop["markers"]
        columns = (*_MARKERS, _ERROR) if any("error_3d_m" in one for one in markers) else _MARKERS
        for method in dict.fromkeys(one["method"] for one in markers):
            title = f"{stop['name']}, {method} (centres in the {stop['frame']} frame)"
            own = [one for one in markers if one["method"] == method]
            notes = [f"  {one['id']}: {one['reason']}" for one in own if one["reason"]]
            print_tables(out, [Table(title=title, columns=columns, rows=own, notes=notes)])
        for note in stop["scan"]["notes"]:
            _say(out, f"  {note}")
        for one in stop["possible"]:
            place = ", ".join(f"{x:.2f}" for x in one["centre_m"])
            _say(
                out,
                f"  Possible marker at ({place}) m, {one['n_points']} returns, not used: "
                f"{one['reason']}",
            )
        if stop["rejected"]:
            _say(out, f"  {len(stop['rejected'])} groups of returns were refused (see --json).")
        if not stop["stations"]:
            _say(out, f"  {stop['reason']}")
        for station in stop["stations"]:
            _print_station(out, station)
        _print_distances(out, stop["distances"])


def print_spheres(out: Console, result: Plain) -> None:
    """Print the spheres in the cloud of a single scan."""
    found = result["spheres"]
    reasons = [
        f"  {', '.join(f'{value:.3f}' for value in one['centre_m'])}: {one['reason']}"
        for one in (*found, *result["rejected"])
        if one["reason"]
    ]
    if not found:
        text = f"  No sphere of {result['radius_m']} m. Is --station where the scanner stood?"
        reasons.insert(0, text)
    title = f"{result['file']}: {result['n_points']:,} points"
    print_tables(out, [Table(title=title, columns=_MARKERS, rows=found, notes=reasons)])


def _print_distances(out: Console, distances: Plain | None) -> None:
    """Print how the distances between marks compare with the control."""
    if distances is None or not distances["n"]:
        return
    worst = max(distances["pairs"], key=lambda pair: abs(pair["residual_m"] / pair["sigma_m"]))
    text = (
        f"  Distances between marks against control: {distances['n_off']} of {distances['n']} are "
        f"off; worst {' - '.join(worst['marks'])}: {1e3 * worst['residual_m']:+.1f} mm, sigma "
        f"{1e3 * worst['sigma_m']:.1f} mm"
    )
    suspects = ", ".join(distances["suspects"])
    _say(out, f"{text}; check {suspects}" if suspects else text)


def print_calibration(out: Console, result: Plain) -> None:
    """Print a calibration: lengths in millimetres, angles in degrees."""
    rows = []
    for row in result["parameters"]:
        scale, unit = _UNITS[row["unit"]]
        numbers = {key: scale * row[key] for key in ("start", "estimate", "sigma")}
        rows.append({"name": row["name"], "unit": unit, **numbers})
    summary = (
        f"{result['n_two_faced']} of {result['n_spheres']} spheres on both faces, "
        f"{result['n_returns']:,} returns; residuals {1e3 * result['residual_rms_before_m']:.1f} "
        f"-> {1e3 * result['residual_rms_after_m']:.1f} mm; rig {result['rig_digest']}"
    )
    held = [f"  {one['name']} does not change. {one['reason']}" for one in result["not_separable"]]
    print_tables(out, [Table(columns=_PARAMETERS, rows=rows, notes=[summary, *held])])


def print_rows(out: Console, result: Plain) -> None:
    """Print the result of a query; rows wider than the terminal one below the other."""
    heads = [column["name"] for column in result["columns"]]
    rows = [["" if v is None else _short(v) for v in row] for row in result["rows"][:_ROWS_SHOWN]]
    table = rich_table.Table(box=None, pad_edge=False, header_style="bold")
    for head in heads:
        table.add_column(escape(head))
    for row in rows:
        table.add_row(*map(escape, row))
    if Measurement.get(out, out.options.update(max_width=_WIDEST), table).maximum <= out.width:
        out.print(table)
    else:
        columns = (Column("column", "column"), Column("value", "value"))
        for i, row in enumerate(rows, start=1):
            pairs = zip(heads, row, strict=True)
            shown = [{"column": head, "value": value} for head, value in pairs]
            print_tables(out, [Table(title=f"row {i}", columns=columns, rows=shown)])
    shown_n, n = len(rows), len(result["rows"])
    more = f", {shown_n} shown (--json or --csv for all)" if shown_n < n else ""
    out.print(f"{n:,} rows in {result['elapsed_ms']:.1f} ms{more}")


def print_network(out: Console, result: Plain) -> None:
    """Print stations, marks and datum of a network."""
    test = "passed" if result["passes_global_test"] else "[red]failed[/]"
    out.print(
        f"[bold]Network[/]: {_coloured(result['status'])}  {len(result['stations'])} stations, "
        f"{len(result['marks'])} marks, {result['dof']} degrees of freedom, sigma0 "
        f"{_text(result['sigma0'], 1, 2)}, global test {test}"
    )
    _say(out, result["datum"]["text"])
    for warning in result["warnings"]:
        out.print(f"[yellow]Warning:[/] {escape(warning)}", highlight=False, soft_wrap=True)
    marks = result.get("evidence", [])
    doubts = [mark for mark in marks if mark["decision"] != "confirmed"]
    print_tables(out, [*places(result), *evidence({"evidence": doubts}), *checks(result)])
    if marks:
        _say(out, f"{len(marks) - len(doubts)} of {len(marks)} marks confirmed by their evidence.")
    if result["calibration"]:
        print_calibration(out, result["calibration"])
    if errors := result.get("errors"):
        _say(
            out,
            f"Against truth, place and attitude apart: marks {1e3 * errors['rms_marks_m']:.2f} mm "
            f"RMS, stations {1e3 * errors['rms_stations_m']:.2f} mm RMS"
            f"{_nees(errors)}; {errors['n_false_marks']} false marks",
        )
    for sentence in not_used(result):
        _say(out, f"  {sentence}")


def _nees(errors: Plain) -> str:
    """Return the normalised squared errors that are known, as a part of a sentence."""
    known = [
        f"{_text(errors[f'nees_per_dof_{kind}'], 1, 2)} ({kind})"
        for kind in ("marks", "stations")
        if errors[f"nees_per_dof_{kind}"] is not None
    ]
    return f"; normalised squared error {' and '.join(known)}" if known else ""


def _print_station(out: Console, station: Plain) -> None:
    """Print a station with its status."""
    methods = f"{station['fit_method']}, {station['method']}"
    if station.get("position_m") is None:
        out.print(f"  Station ({methods}): [red]none[/]; {escape(station['reason'])}")
        return
    x, y, z = station["position_m"]
    error = station.get("error_3d_m")
    against = "" if error is None else f"; error {1e3 * error:.1f} mm"
    out.print(
        f"  Station ({methods}): {_coloured(station['status'])}  x {x:.4f} y {y:.4f} z {z:.4f} m, "
        f"yaw {station['yaw_deg']:.3f} deg (sigma {station['sigma_yaw_deg']:.3f}), "
        f"sigma {1e3 * station['sigma_3d_m']:.1f} mm (3-D) "
        f"from {len(station['matches'])} marks, sigma0 {_text(station['sigma0'], 1, 2)}{against}",
        highlight=False,
        soft_wrap=True,
    )
    if station["reason"]:
        _say(out, f"  {station['reason']}")


def _coloured(status: str) -> str:
    """Return a status in its colour."""
    return f"[{_COLOURS[status]}]{status}[/]"


def _short(value: object) -> str:
    """Return a value of a query, numbers to six digits."""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


_PASSED = (
    Column("pass_rate", "pass", "%", ".1f"),
    Column.mm("median_error_3d_m", "median"),
    Column.mm("p95_error_3d_m", "p95"),
)
_BY_NUMBER = (Column("n_marks", "marks", "", "d"), Column.whole("n", "in the window"), *_PASSED)
_BY_ANGLE = (
    Column(
        lambda row: f"{row['angle_from_deg']:g} - {row['angle_to_deg']:g}", "worst angle", "deg"
    ),
    Column.whole("n", "all"),
    *_PASSED,
)
_TABLE_3 = (
    Column("included_angle_deg", "included angle", "deg", ".2f"),
    Column.mm("study_error_3d_m", "study"),
    Column.mm("median_error_3d_m", "here"),
)
_PLANNED_MARKS = (
    Column("name", "mark"),
    *(Column(axis, axis, "m", ".3f") for axis in "xyz"),
    Column("pole_height_m", "pole", "m", ".2f"),
)


def print_random_plans(out: Console, results: Plain) -> None:
    """Print how many arrangements pass."""
    limits = results["limits"]
    out.print(
        f"{results['n_arrangements']:,} arrangements from {results['distance_min_m']:g} to "
        f"{results['distance_max_m']:g} m ({limits['distance_source']}), included angles from "
        f"{results['angle_min_deg']:g} to {results['angle_max_deg']:g} deg "
        f"({limits['angle_source']}): {results['n_in_window']:,} in the window. "
        f"Of these {_text(results['pass_rate_in_window'], 100.0, 1)} % pass, of the others "
        f"{_text(results['pass_rate_outside'], 100.0, 1)} %.",
        highlight=False,
    )
    print_tables(
        out,
        [
            Table(columns=_BY_NUMBER, rows=results["by_number_of_marks"]),
            Table(columns=_BY_ANGLE, rows=results["by_worst_angle"]),
            Table(columns=_TABLE_3, rows=results["table3"]),
        ],
    )


def print_plan(out: Console, plan: Plain) -> None:
    """Print marks and stops as tables."""
    out.print(f"[bold]{escape(plan['site']['name'])}[/], method {plan['method']}")
    out.print(plan["model"]["text"], markup=False, highlight=False)
    within = f"P(<= {1e3 * plan['tolerance_m']:g} mm)"
    marks = [one | dict(zip("xyz", one["position_m"], strict=True)) for one in plan["marks"]]
    stops = (
        Column("name", "stop"),
        Column("sigma_3d_m", "sigma 3-D", "mm", ".3f"),
        Column("rms_error_3d_m", "with misses", "mm", ".3f"),
        Column("probability_within_tolerance", within, "", ".4f"),
        Column(lambda row: f"{row['n_used']} of {len(row['visible_marks'])}", "marks", "", ">"),
        Column(_angles, "angles", "deg", ">"),
        Column("reason", "note"),
    )
    notes = list(plan.get("notes", ()))
    if one := plan.get("one_more"):
        at = ", ".join(f"{v:.2f}" for v in one["position_m"])
        changes = (
            f"from {_text(one[f'{which}_sigma_3d_before_m'], 1e3, 3)} to "
            f"{_text(one[f'{which}_sigma_3d_m'], 1e3, 3)} mm"
            for which in ("worst", "mean")
        )
        notes.append(
            f"One more mark at {at} m (pole {one['pole_height_m']:.2f} m) would bring the worst "
            "stop {} (3-D sigma), the mean of all stops {}.".format(*changes)
        )
    tables = [Table(columns=_PLANNED_MARKS, rows=marks)]
    print_tables(out, [*tables, Table(columns=stops, rows=plan["stops"], notes=notes)])


def print_trade_off(out: Console, found: Plain) -> None:
    """Print the best plans of several numbers of marks and of several weights of a loss."""
    columns = (
        Column("n_marks", "marks", "", "d"),
        Column("worst_sigma_3d_m", "worst stop", "mm", ".3f"),
        Column("bound", "bound", "mm", ".3f"),
        Column("excess", "within", "%", ".1f"),
        Column("worst_sigma_3d_after_loss_m", "after a loss", "mm", ".3f"),
        Column("mean_sigma_3d_m", "mean", "mm", ".3f"),
        Column("walk_m", "walk", "m", ".0f"),
        Column("cost", "cost", "", "g"),
        Column("kept", "tolerance"),
    )
    tables = []
    for name, head, values in (
        ("by_number", "", found["numbers"]),
        ("by_loss_weight", "weight of a loss", found["loss_weights"]),
    ):
        pairs = zip(found[name], values, strict=True)
        rows = [{**_compared(plan), "value": value} for plan, value in pairs]
        first = (Column("value", head, "", "g"),) if head else ()
        tables += [Table(columns=(*first, *columns), rows=rows)] if rows else []
    print_tables(out, tables)
    if found["cheapest"] is not None:
        out.print(f"{found['cheapest']} marks reach the goal at the least cost.")


def _compared(plan: Plain) -> Plain:
    """Return the row of a plan among several."""
    quality = plan["optimum"]
    excess = quality["excess_over_bound"]
    return {
        **{key: plan[key] for key in plan if key.endswith("_m") and "sigma" in key},
        "n_marks": len(plan["marks"]),
        "bound": quality["worst_sigma_3d_bound_m"],
        "excess": excess,
        "walk_m": quality["walk_m"],
        "cost": quality["cost"],
        "kept": "kept" if quality["keeps_tolerance"] else "not kept",
    }


def _angles(stop: Plain) -> str:
    """Return the included angles of a stop."""
    return " - ".join(_text(stop[f"included_angle_{one}_deg"], 1, 0) for one in ("min", "max"))


def _text(value: float | None, factor: float, digits: int) -> str:
    """Return a number in a larger unit; a dash for none."""
    return "-" if value is None else f"{factor * value:.{digits}f}"
