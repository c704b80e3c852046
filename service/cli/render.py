"""Results as tables for the terminal; the heads of columns carry the units."""

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

_ROWS_SHOWN = 100  # of a query; programs get all
_WIDEST = 100_000  # [characters]; no row is wider
_COLOURS = {"ok": "green", "weak": "yellow", "refused": "red", "failed": "red"}

Plain = Mapping[str, Any]


def print_preflight(out: Console, name: str, report: Preflight) -> None:
    """Print the preflight report of a log."""
    out.print(f"[bold]{escape(name)}[/]: {_coloured(report.verdict)}")
    for reason in (*report.reasons, *report.notes, *report.diagnosis):
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


def print_log(out: Console, result: Plain) -> None:
    """Print markers and station of each stop of a log."""
    for stop in result["stops"]:
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


def print_spheres(out: Console, result: Plain) -> None:
    """Print the spheres in the cloud of a single scan."""
    out.print(f"[bold]{escape(result['file'])}[/]: {result['n_points']:,} points")
    if result["spheres"]:
        out.print(_markers(result["spheres"]))
    else:
        out.print(f"  No sphere of {result['radius_m']} m. Is --station where the scanner stood?")
    for one in (*result["spheres"], *result["rejected"]):
        if one["reason"]:
            place = ", ".join(f"{value:.3f}" for value in one["centre_m"])
            out.print(f"  {place}: {escape(one['reason'])}", highlight=False, soft_wrap=True)


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


def print_calibration(out: Console, result: Plain) -> None:
    """Print a calibration: lengths in millimetres, angles in degrees."""
    scales = {"m": (1e3, "mm"), "rad": (math.degrees(1.0), "deg"), "s": (1e3, "ms")}
    rows = []
    for parameter in result["parameters"]:
        scale, unit = scales[parameter["unit"]]
        numbers = [scale * parameter[key] for key in ("start", "estimate", "sigma")]
        rows.append((parameter["name"], unit, *(f"{number:.4f}" for number in numbers)))
    out.print(_table(("parameter", "unit", "start", "estimate", "sigma"), rows, left=2))
    out.print(
        f"{result['n_two_faced']} of {result['n_spheres']} spheres on both faces, "
        f"{result['n_returns']:,} returns; residuals {1e3 * result['residual_rms_before_m']:.1f} "
        f"-> {1e3 * result['residual_rms_after_m']:.1f} mm; rig {result['rig_digest']}"
    )
    for held in result["not_separable"]:
        out.print(f"  {held['name']} stays as it was. {held['reason']}", highlight=False)


def print_rows(out: Console, result: Plain) -> None:
    """Print the result of a query."""
    heads = [column["name"] for column in result["columns"]]
    rows = [["" if v is None else _short(v) for v in row] for row in result["rows"][:_ROWS_SHOWN]]
    table = _table(heads, rows, left=len(heads))
    if Measurement.get(out, out.options.update(max_width=_WIDEST), table).maximum <= out.width:
        out.print(table)
    else:
        _print_one_by_one(out, heads, rows)
    shown, n = len(rows), len(result["rows"])
    more = f", {shown} shown (--json or --csv for all)" if shown < n else ""
    out.print(f"{n:,} rows in {result['elapsed_ms']:.1f} ms{more}")


def _print_one_by_one(out: Console, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print rows that are wider than the terminal one below the other."""
    for i, row in enumerate(rows, start=1):
        out.print(f"[bold]row {i}[/]")
        out.print(_table(("column", "value"), list(zip(heads, row, strict=True)), left=2))


def print_network(out: Console, result: Plain) -> None:
    """Print stations, marks and datum of a network."""
    verdict = "passed" if result["passes_global_test"] else "[red]failed[/]"
    out.print(
        f"[bold]Network[/]: {_coloured(result['status'])}  {len(result['stations'])} stations, "
        f"{len(result['marks'])} marks, {result['dof']} degrees of freedom, sigma0 "
        f"{_fixed(result['sigma0'], 2)}, global test {verdict}"
    )
    out.print(result["datum"]["text"], highlight=False, soft_wrap=True)
    for warning in result["warnings"]:
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
            for row in result[kind]
        ]
        heads = ("x [m]", "y [m]", "z [m]", "sigma [mm]", "95 % ellipse [mm]", "centres")
        out.print(_table((kind[:-1], *heads), rows))
    _print_checks(out, result)
    for one in result["refused"]:
        out.print(
            f"  {escape(one['station'])}: {escape(one['reason'])}", highlight=False, soft_wrap=True
        )
    for one in result["excluded"]:
        what = " ".join(part for part in (one["station"], one["marker"], one["mark"]) if part)
        text = f"  {one['kind'].capitalize()} {what}: {escape(one['reason'])}"
        out.print(text, highlight=False, soft_wrap=True)


def _print_checks(out: Console, result: Plain) -> None:
    """Print the checks of a network that need no truth."""
    for row in result["marks"]:
        if row["status"] != "ok":
            out.print(f"  Mark {escape(row['name'])}: {escape(row['reason'])}", highlight=False)
    rows = [
        (
            row["mark"],
            *(f"{1e3 * value:+.1f}" for value in row["predicted_minus_given_m"]),
            *(f"{1e3 * value:.1f}" for value in row["sigma_predicted_minus_given_m"]),
        )
        for row in result["control"]
        if row["predicted_minus_given_m"] is not None
    ]
    if rows:
        heads = ("control left out", "dx [mm]", "dy", "dz", "sigma x [mm]", "y", "z")
        out.print(_table(heads, rows))
    for row in result["repeated_stops"]:
        out.print(
            f"  {' and '.join(row['stations'])} stand {1e3 * row['apart_3d_m']:.1f} mm apart; "
            f"their centres agree to {1e3 * row['difference_rms_m']:.1f} mm (RMS; predicted "
            f"{1e3 * row['predicted_rms_m']:.1f})",
            highlight=False,
        )
    if result["calibration"]:
        print_calibration(out, result["calibration"])
    if errors := result.get("errors"):
        out.print(
            f"Against truth, place and attitude apart: marks {1e3 * errors['rms_marks_m']:.2f} mm "
            f"RMS, stations {1e3 * errors['rms_stations_m']:.2f} mm RMS; normalised squared error "
            f"{_fixed(errors['nees_per_dof_marks'], 2)} and "
            f"{_fixed(errors['nees_per_dof_stations'], 2)}; {errors['n_false_marks']} false marks",
            highlight=False, soft_wrap=True,
        )  # fmt: skip


def to_csv(result: Plain) -> str:
    """Return the result of a query as CSV."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow([column["name"] for column in result["columns"]])
    writer.writerows(result["rows"])
    return text.getvalue()


def _print_station(out: Console, station: Plain) -> None:
    """Print a station with its status."""
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
    """Return a table whose first columns are flush left; strings are not markup."""
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
    """Return a number, or a dash for null."""
    return "-" if value is None else f"{value:.{digits}f}"


def _short(value: object) -> str:
    """Return a value of a query, numbers to six digits."""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
