"""Answers as tables for people; lengths in metres or millimetres, as the heads say."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from spheremark.storage.recordings import Preflight

_ROWS_SHOWN = 100  # of an answer in SQL; programs get all
_WIDEST = 100_000  # [characters]; no row is wider
_COLOURS = {"ok": "green", "weak": "yellow", "refused": "red", "failed": "red"}

Plain = Mapping[str, Any]


def print_preflight(out: Console, name: str, report: Preflight) -> None:
    """Print what a log holds and lacks."""
    out.print(f"[bold]{escape(name)}[/]: {_coloured(report.verdict)}")
    for reason in (*report.reasons, *report.notes):
        out.print(f"  {escape(reason)}", highlight=False)
    if report.topics:
        rows = [
            (t.topic, t.schema, f"{t.n_messages:,}", f"{t.rate_hz:.1f}", f"{t.longest_gap_s:.3f}")
            for t in report.topics
        ]
        heads = ("topic", "type", "messages", "rate [Hz]", "longest gap [s]")
        out.print(_table(heads, rows, left=2))
    facts = {
        "returns": f"{report.n_returns:,}",
        "duration [s]": _fixed(report.duration_s, 1),
        "stops": str(report.n_stops),
        "gimbal coverage [deg]": _fixed(report.gimbal_coverage_deg, 1),
        "gimbal speed [deg/s]": _fixed(report.gimbal_speed_deg_per_s, 2),
        "LiDAR speed [1/min]": _fixed(report.lidar_speed_rpm, 1),
        "coverage gap [deg]": _fixed(report.coverage_gap_deg, 2),
        "clock skew [s]": _fixed(report.clock_skew_s, 3),
        "time for each shot": "yes" if report.has_shot_times else "no",
        "orientation (AHRS)": "yes" if report.has_orientation else "no",
        "rig": report.rig or "not in the log",
    }
    out.print(_table(("fact", "value"), list(facts.items())))


def print_answer(out: Console, answer: Plain) -> None:
    """Print markers and station of each stop of a log."""
    for stop in answer["stops"]:
        out.print(f"[bold]{escape(stop['name'])}[/]  (centres in the {stop['frame']} frame)")
        out.print(_markers(stop["markers"]))
        for one in stop["markers"]:
            if one["reason"]:
                text = f"  {one['id']} ({one['method']}): {escape(one['reason'])}"
                out.print(text, highlight=False, soft_wrap=True)
        for note in stop["scan"]["notes"]:
            out.print(f"  {note}", highlight=False)
        if stop["rejected"]:
            out.print(f"  {len(stop['rejected'])} groups of returns were refused (see --json).")
        if not stop["stations"]:
            out.print(f"  {stop['reason']}")
        for station in stop["stations"]:
            _print_station(out, station)
        _print_distances(out, stop["distances"])


def _print_distances(out: Console, distances: Plain | None) -> None:
    """Print how the distances between marks compare with the control."""
    if distances is None or not distances["n"]:
        return
    n, n_off = distances["n"], distances["n_off"]
    worst = max(distances["pairs"], key=lambda pair: abs(pair["residual_m"] / pair["sigma_m"]))
    first, second = worst["marks"]
    text = (
        f"  Distances between marks against control: {n_off} of {n} are off; worst {first} - "
        f"{second}: {1e3 * worst['residual_m']:+.1f} mm, sigma {1e3 * worst['sigma_m']:.1f} mm"
    )
    if distances["suspects"]:
        text += f"; look at {', '.join(distances['suspects'])}"
    out.print(text, highlight=False, markup=False, soft_wrap=True)


def print_calibration(out: Console, answer: Plain) -> None:
    """Print what scans tell of a rig: lengths in millimetres, angles in degrees."""
    scales = {"m": (1e3, "mm"), "rad": (math.degrees(1.0), "deg"), "s": (1e3, "ms")}
    rows = []
    for parameter in answer["parameters"]:
        scale, unit = scales[parameter["unit"]]
        numbers = [scale * parameter[key] for key in ("start", "estimate", "sigma")]
        rows.append((parameter["name"], unit, *(f"{number:.4f}" for number in numbers)))
    out.print(_table(("parameter", "unit", "start", "estimate", "sigma"), rows, left=2))
    out.print(
        f"{answer['n_two_faced']} of {answer['n_spheres']} spheres on both faces, "
        f"{answer['n_returns']:,} returns; residuals {1e3 * answer['residual_rms_before_m']:.1f} "
        f"-> {1e3 * answer['residual_rms_after_m']:.1f} mm; rig {answer['rig_digest']}"
    )
    for held in answer["not_separable"]:
        out.print(f"  {held['name']} stays as it was. {held['reason']}", highlight=False)


def print_rows(out: Console, answer: Plain) -> None:
    """Print an answer in SQL."""
    heads = [column["name"] for column in answer["columns"]]
    rows = [["" if v is None else _short(v) for v in row] for row in answer["rows"][:_ROWS_SHOWN]]
    table = _table(heads, rows, left=len(heads))
    if Measurement.get(out, out.options.update(max_width=_WIDEST), table).maximum <= out.width:
        out.print(table)
    else:
        _print_one_by_one(out, heads, rows)
    shown, n = len(rows), len(answer["rows"])
    more = f", {shown} shown (--json or --csv for all)" if shown < n else ""
    out.print(f"{n:,} rows in {answer['elapsed_ms']:.1f} ms{more}")


def _print_one_by_one(out: Console, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print rows that are wider than the terminal one below the other."""
    for i, row in enumerate(rows, start=1):
        out.print(f"[bold]row {i}[/]")
        out.print(_table(("column", "value"), list(zip(heads, row, strict=True)), left=2))


def print_bench(out: Console, report: Plain) -> None:
    """Print times as ratios to one read of the file, and what the usual libraries need."""
    log = report["log"]
    out.print(
        f"{log['name']}: {log['size_bytes'] / 1e6:.1f} MB, {log['n_returns']:,} returns; "
        f"best of {report['repeats']}. 1 x is {report['yardstick']}: "
        f"{1e3 * report['yardstick_seconds']:.1f} ms."
    )
    rows = [
        (step["step"], f"{step['seconds'] * 1e3:,.1f}", f"{step['ratio']:,.2f}")
        for step in report["steps"]
    ]
    out.print(_table(("step", "time [ms]", "x read+CRC"), rows))
    _print_variants(out, report)
    _print_peers(out, report)
    _print_growth(out, report)
    memory = report["memory"]
    out.print(
        f"Memory of a fresh process: {memory['before_bytes'] / 1e6:,.0f} MB resident after its "
        f"imports, at most {memory['peak_bytes'] / 1e6:,.0f} MB during one scan "
        f"(bar: {memory['bar_bytes'] / 1e6:,.0f} MB)."
    )


def _print_variants(out: Console, report: Plain) -> None:
    """Print what the chain costs on one scan in each dress, against what it may cost."""
    rows = [
        (
            one["name"],
            f"{one['size_bytes'] / 1e6:.1f}",
            f"{1e3 * one['read_log_seconds']:,.1f}",
            f"{one['read_log_ratio']:.2f}",
            f"{1e3 * one['chain_seconds']:,.1f}",
            f"{one['ratio']:.1f}",
            f"{one['cpu_ratio']:.1f}",
            "-" if one["bar_ratio"] is None else f"{one['bar_ratio']:.0f}",
            f"{1e3 * one['peer_seconds']:,.0f}" if "peer_seconds" in one else "-",
            f"{one['factor']:.1f}" if "factor" in one else "-",
        )
        for one in report["variants"]
    ]
    reading, chain = ("reading [ms]", "x"), ("log to rows [ms]", "x", "x CPU", "bar")
    heads = ("log", "MB", *reading, *chain, "usual libraries [ms]", "x ours")
    out.print(_table(heads, rows))


def _print_peers(out: Console, report: Plain) -> None:
    """Print times and accuracy beside those of the usual libraries."""
    if peers := report.get("peers"):
        rows = [
            (
                one["step"],
                f"{1e3 * one['ours_seconds']:,.1f}",
                f"{1e3 * one['peer_seconds']:,.1f}",
                f"{one['factor']:,.1f}",
            )
            for one in peers
        ]
        out.print(_table(("step", "ours [ms]", "usual libraries [ms]", "x ours"), rows))
        out.print(f"Bar: the chain at least {report['bar_factor']:.0f} times quicker than theirs.")
    if pcl := report.get("pcl"):
        said = ", ".join(
            f"{step} {1e3 * pcl[f'{step}_seconds']:,.0f} ms"
            for step in ("plane", "clusters")
            if f"{step}_seconds" in pcl
        )
        out.print(f"PCL, files not counted: {said}.")
    if accuracy := report.get("accuracy"):
        rows = [
            (
                one["method"],
                f"{one['n_found']} of {one['n_markers']}",
                str(one["n_false"]),
                "-" if one["error_rms_m"] is None else f"{1e3 * one['error_rms_m']:.1f}",
            )
            for one in accuracy
        ]
        out.print(_table(("centres", "found", "false", "RMS error [mm]"), rows))


_EACH = ("assembly a station [ms CPU]", "adjustment a station [ms CPU]")


def _print_growth(out: Console, report: Plain) -> None:
    """Print how cost grows with returns and with stations."""
    if linearity := report.get("linearity"):
        rows = [
            (
                f"{one['n_returns']:,}",
                f"{one['seconds']:.3f}",
                f"{one['ns_per_return']:.0f}",
                f"{one['cpu_ns_per_return']:.0f}",
                f"{one['ratio']:.1f}",
            )
            for one in linearity["sizes"]
        ]
        heads = ("returns", "log to rows [s]", "ns a return", "CPU [ns]", "x read+CRC")
        out.print(_table(heads, rows))
        for what, fit in (("Time", linearity), ("CPU", linearity["cpu"])):
            each = f"{1e9 * fit['line_seconds_each']:.1f} ns a return"
            out.print(_straight(what, each, fit))
    if networks := report.get("network"):
        costs = [
            (
                f"{one['n_stations']:,} x {one['n_marks']}",
                f"{one['assembly_seconds']:.2f}",
                f"{one['adjustment_seconds']:.2f}",
                f"{1e3 * one['assembly_cpu_seconds'] / one['n_stations']:.2f}",
                f"{1e3 * one['adjustment_cpu_seconds'] / one['n_stations']:.2f}",
            )
            for one in networks
        ]
        names = ("stations x marks", "assembly [s]", "adjustment [s]", *_EACH)
        out.print(_table(names, costs))
        lines = report["network_linearity"]
        for step in ("assembly", "adjustment"):
            each = f"{1e3 * lines[step]['line_seconds_each']:.2f} ms a station"
            what = f"CPU of {step} with {lines['n_marks']} marks"
            out.print(_straight(what, each, lines[step]))


def _straight(what: str, each: str, fit: Plain) -> str:
    """Say what a straight line through costs is."""
    return (
        f"{what} in a straight line: {1e3 * fit['fixed_seconds']:.1f} ms and {each}; no size is "
        f"farther from it than {100 * fit['worst_share_off_line']:.0f} %."
    )


_SAID = ("distance", "count", "mean_distance", "mean_count")


def print_reproduction(out: Console, report: Plain) -> None:
    """Print the study's tables again, and what keeps the tolerance."""
    study, tolerance = report["study"], 1e3 * report["tolerance_m"]
    rows = [
        (
            f"{row['distance_m']:.2f}",
            str(row["study_n_points"]),
            _mm(row["study_error_3d_m"]),
            _fixed(row["paper_n_points_mean"], 0),
            _mm(row["paper_error_3d_mean_m"]),
            _difference(row["paper_minus_study_m"]),
            _fixed(row["along_beam_n_points_mean"], 0),
            _mm(row["along_beam_error_3d_mean_m"]),
        )
        for row in report["table2"]
    ]
    out.print("[bold]Table 2[/]  centres by distance; mean errors over the simulated worlds")
    heads = ("distance [m]", "study: returns", "error [mm]", "paper: returns", "error [mm]")
    out.print(_table((*heads, "- study", "along_beam: returns", "error [mm]"), rows))
    out.print(
        f"Mean of the paper's method minus the study's {_mm(study['table2_error_3d_mean_m'])} mm: "
        f"{_difference(report['table2_paper_minus_study_m'])} mm, with the noise and the cut that "
        "the page names\n",
        highlight=False,
        soft_wrap=True,
    )
    _print_angles(out, report)
    by_stop = [
        (row["stop"], _mm(row["paper_error_3d_mean_m"]), _mm(row["along_beam_error_3d_mean_m"]))
        for row in report["table4"]
    ]
    out.print("[bold]Table 4[/]  mean error of the centres at each stop of lane 2")
    out.print(_table(("stop", "paper [mm]", "along_beam [mm]"), by_stop))
    low, high = study["table2_error_3d_range_m"]
    out.print(
        f"[bold]What keeps {tolerance:g} mm[/]  (95 % confidence); the study says, by its mean of "
        f"{_mm(study['table2_error_3d_mean_m'])} mm ({_mm(low)} to {_mm(high)}): up to "
        f"{study['greatest_distance_m']:g} m and from {study['smallest_count']} returns",
        highlight=False,
        soft_wrap=True,
    )
    kept = [
        (one["place"], one["fit_method"], *(one["said"][key] for key in _SAID))
        for one in report["statements"]
    ]
    said = ("where", "method", "p95: distance", "p95: returns", "mean: distance", "mean: returns")
    out.print(_table(said, kept, left=2))
    out.print(f"{report['n_scans']} scans, seed {report['seed']}. Page: {report['page']}")


def _print_angles(out: Console, report: Plain) -> None:
    """Print the study's Table 3 again, and what the free station gives there."""
    rows = [
        (
            f"{row['included_angle_deg']:.2f}",
            _mm(row["study_error_m"]),
            _mm(row["three_circles_error_m"]),
            _difference(row["three_circles_minus_study_m"]),
            _mm(row["two_centres_error_m"]),
            _mm(row["three_centres_error_m"]),
        )
        for row in report["table3"]
    ]
    out.print(
        "[bold]Table 3[/]  the station by included angle, 17 mm granted to each axis of each mark"
    )
    heads = ("angle [deg]", "study [mm]", "circles [mm]", "- study")
    out.print(_table((*heads, "free station: two [mm]", "three [mm]"), rows))


def _difference(value: float | None) -> str:
    """Write a difference [m] in millimetres, with its sign."""
    return "-" if value is None else f"{1e3 * value:+.1f}"


def print_network(out: Console, answer: Plain) -> None:
    """Print stations and marks of a network, and what it rests on."""
    verdict = "passed" if answer["passes_global_test"] else "[red]failed[/]"
    out.print(
        f"[bold]Network[/]: {_coloured(answer['status'])}  {len(answer['stations'])} stations, "
        f"{len(answer['marks'])} marks, {answer['dof']} degrees of freedom, sigma0 "
        f"{_fixed(answer['sigma0'], 2)}, global test {verdict}"
    )
    out.print(answer["datum"]["text"], highlight=False, soft_wrap=True)
    for warning in answer["warnings"]:
        out.print(f"[yellow]Warning:[/] {escape(warning)}", highlight=False, soft_wrap=True)
    for kind in ("stations", "marks"):
        rows = [
            (
                row["name"],
                *(f"{value:.4f}" for value in row["position_m"]),
                f"{1e3 * row['sigma_3d_m']:.1f}",
                f"{1e3 * row['ellipse_major_95_m']:.1f} x {1e3 * row['ellipse_minor_95_m']:.1f}",
                str(row["n_observations"]),
            )
            for row in answer[kind]
        ]
        heads = ("x [m]", "y [m]", "z [m]", "sigma [mm]", "95 % ellipse [mm]", "centres")
        out.print(_table((kind[:-1], *heads), rows))
    _print_checks(out, answer)
    for one in answer["refused"]:
        out.print(
            f"  {escape(one['station'])}: {escape(one['reason'])}", highlight=False, soft_wrap=True
        )
    for one in answer["excluded"]:
        what = " ".join(part for part in (one["station"], one["marker"], one["mark"]) if part)
        text = f"  {one['kind'].capitalize()} {what}: {escape(one['reason'])}"
        out.print(text, highlight=False, soft_wrap=True)


def _print_checks(out: Console, answer: Plain) -> None:
    """Print what is known of a network's accuracy without truth."""
    for row in answer["marks"]:
        if row["status"] != "ok":
            out.print(f"  Mark {escape(row['name'])}: {escape(row['reason'])}", highlight=False)
    rows = [
        (
            row["mark"],
            *(f"{1e3 * value:+.1f}" for value in row["predicted_minus_given_m"]),
            *(f"{1e3 * value:.1f}" for value in row["sigma_predicted_minus_given_m"]),
        )
        for row in answer["control"]
        if row["predicted_minus_given_m"] is not None
    ]
    if rows:
        heads = ("control left out", "dx [mm]", "dy", "dz", "sigma x [mm]", "y", "z")
        out.print(_table(heads, rows))
    for row in answer["repeated_stops"]:
        out.print(
            f"  {' and '.join(row['stations'])} stand {1e3 * row['apart_3d_m']:.1f} mm apart; "
            f"their centres agree to {1e3 * row['difference_rms_m']:.1f} mm (RMS; predicted "
            f"{1e3 * row['predicted_rms_m']:.1f})",
            highlight=False,
        )
    if answer["calibration"]:
        print_calibration(out, answer["calibration"])
    if errors := answer.get("errors"):
        out.print(
            f"Against truth, place and attitude apart: marks {1e3 * errors['rms_marks_m']:.2f} mm "
            f"RMS, stations {1e3 * errors['rms_stations_m']:.2f} mm RMS; normalised squared error "
            f"{_fixed(errors['nees_per_dof_marks'], 2)} and "
            f"{_fixed(errors['nees_per_dof_stations'], 2)}; {errors['n_false_marks']} false marks",
            highlight=False, soft_wrap=True,
        )  # fmt: skip


def to_csv(answer: Plain) -> str:
    """Return an answer in SQL as CSV."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow([column["name"] for column in answer["columns"]])
    writer.writerows(answer["rows"])
    return text.getvalue()


def _print_station(out: Console, station: Plain) -> None:
    """Print a station and how far it can be relied on."""
    methods = f"{station['fit_method']}, {station['method']}"
    if station.get("position_m") is None:
        out.print(f"  Station ({methods}): [red]none[/]; {station['reason']}", highlight=False)
        return
    x, y, z = station["position_m"]
    error = station.get("error_3d_m")
    against = "" if error is None else f"; error {1e3 * error:.1f} mm"
    out.print(
        f"  Station ({methods}): {_coloured(station['status'])}  x {x:.4f} y {y:.4f} z {z:.4f} m, "
        f"yaw {station['yaw_deg']:.3f} deg, sigma {1e3 * station['sigma_3d_m']:.1f} mm (3-D) "
        f"from {len(station['matches'])} marks, sigma0 {_fixed(station['sigma0'], 2)}{against}",
        highlight=False,
        soft_wrap=True,
    )
    if station["reason"]:
        out.print(f"  {station['reason']}", highlight=False)


def _markers(markers: Sequence[Plain]) -> Table:
    """Return markers as a table, with errors where there is truth."""
    heads = ["marker", "method", "status", "x [m]", "y [m]", "z [m]", "sigma [mm]", "range [m]"]
    heads += ["points", "rms [mm]"]
    has_errors = any("error_3d_m" in marker for marker in markers)
    rows = []
    for one in markers:
        row = [one["id"], one["method"], Text.from_markup(_coloured(one["status"]))]
        row += [f"{value:.4f}" for value in one["centre_m"]]
        row += [_mm(one["sigma_3d_m"]), f"{one['range_m']:.2f}", str(one["n_points"])]
        row += [_mm(one["rms_m"])]
        rows.append(row + ([_mm(one.get("error_3d_m"))] if has_errors else []))
    return _table(heads + (["error [mm]"] if has_errors else []), rows, left=3)


def _table(heads: Sequence[str], rows: Sequence[Sequence[str | Text]], left: int = 1) -> Table:
    """Return a table whose first columns are flush left; strings stand as they are."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for i, head in enumerate(heads):
        table.add_column(escape(head), justify="left" if i < left else "right")
    for row in rows:
        table.add_row(*(escape(cell) if isinstance(cell, str) else cell for cell in row))
    return table


def _coloured(status: str) -> str:
    """Return a status in its colour."""
    return f"[{_COLOURS[status]}]{status}[/]"


def _mm(length: float | None) -> str:
    """Return a length in millimetres."""
    return "" if length is None else f"{1e3 * length:.1f}"


def _fixed(value: float | None, digits: int) -> str:
    """Return a number, or what stands for one that is not known."""
    return "-" if value is None else f"{value:.{digits}f}"


def _short(value: object) -> str:
    """Return a value of an answer, numbers to six digits."""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
