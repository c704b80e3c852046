"""The commands ``spheremark plan``: where to put markers."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from spheremark.pipelines.errors import ConfigError

plan = typer.Typer(
    help="Where to put markers: evaluate, optimise, simulate at random.", no_args_is_help=True
)

_WIDE = 160  # columns of a table that goes into a file or a pipe
out = Console(width=None if sys.stdout.isatty() else _WIDE)
err = Console(stderr=True)

Scenario = Annotated[
    str, typer.Option(help="Simulated field: paper-field, rock-field or clutter-field.")
]
Seed = Annotated[int, typer.Option(min=0, help="Source of chance of the field.")]
Terrain = Annotated[
    Path | None,
    typer.Option(help="Terrain instead: elevation model (.tif, .asc) or cloud (.laz, .las, .ply)."),
]
StopsFile = Annotated[
    Path | None,
    typer.Option(exists=True, dir_okay=False, help="Stops (CSV: name,x_m,y_m and, if known, z_m)."),
]
Tolerance = Annotated[float, typer.Option(help="3-D error that is accepted \\[m].")]
Method = Annotated[str, typer.Option(help="Resection: free_station or paper.")]
SigmaMarks = Annotated[float, typer.Option(help="Sigma per axis of the marks themselves \\[m].")]
TurnS = Annotated[float, typer.Option(help="Time of a full turn of the gimbal \\[s].")]
Rpm = Annotated[float, typer.Option(help="Speed of the LiDAR [1/min].")]
StepDeg = Annotated[
    float, typer.Option(help="Step of a gimbal that rests between \\[deg]; 0 turns evenly.")
]
Rests = Annotated[int, typer.Option(help="Revolutions of the LiDAR during each rest.")]
Data = Annotated[
    Path | None,
    typer.Option(file_okay=False, help="Data folder whose fits give the accuracy of centres."),
]
Server = Annotated[
    str | None,
    typer.Option("--url", "--server", help="Address of a running service, for the same."),
]
Survey = Annotated[str, typer.Option(help="Only the fits of this survey.")]
Csv = Annotated[Path | None, typer.Option(dir_okay=False, help="Write marks and stops (CSV).")]
GeoJson = Annotated[
    Path | None,
    typer.Option(dir_okay=False, help="Write marks and stops (GeoJSON); needs --origin."),
]
Points = Annotated[
    list[Path] | None,
    typer.Option(dir_okay=False, help="Write marks and stops (.dxf or LandXML's .xml)."),
]
Origin = Annotated[
    str | None,
    typer.Option(help="Where the site is: LON,LAT[,BEARING of the y axis] in degrees (WGS 84)."),
]
KeepOut = Annotated[
    Path | None,
    typer.Option(exists=True, dir_okay=False, help="Polygons where no mark may stand (GeoJSON)."),
]
Poles = Annotated[
    tuple[float, float], typer.Option(help="Least and greatest height of a centre \\[m].")
]
ReachM = Annotated[float, typer.Option(help="Farthest a mark may stand from a stop \\[m].")]
SlopeDeg = Annotated[float, typer.Option(help="Steepest ground for a pole \\[deg].")]
Inside = Annotated[bool, typer.Option("--inside", help="Marks may stand between the stops too.")]
SpacingM = Annotated[
    float, typer.Option(help="Grid of places that are tried \\[m]; 0 takes one that suits.")
]
AsJson = Annotated[bool, typer.Option("--json", help="JSON for programs.")]


@plan.command()
def evaluate(
    marks: Annotated[
        Path,
        typer.Option(exists=True, dir_okay=False, help="Marks: JSON or CSV of a plan, or control."),
    ],
    scenario: Scenario = "paper-field",
    seed: Seed = 0,
    terrain: Terrain = None,
    stops: StopsFile = None,
    tolerance_m: Tolerance = 0.03,
    method: Method = "free_station",
    sigma_marks_m: SigmaMarks = 0.0,
    turn_s: TurnS = 13.2,
    rpm: Rpm = 600.0,
    step_deg: StepDeg = 0.0,
    rest_revolutions: Rests = 3,
    data: Data = None,
    server: Server = None,
    survey: Survey = "",
    suggest: Annotated[
        bool, typer.Option("--suggest", help="Name the one more mark that would help most.")
    ] = False,
    csv: Csv = None,
    geojson: GeoJson = None,
    points: Points = None,
    origin: Origin = None,
    as_json: AsJson = False,
) -> None:
    """Predict the accuracy of an arrangement of marks at every stop, without simulating a scan."""
    from spheremark.pipelines.placement import Requirement
    from spheremark.service.planning import plans
    from spheremark.storage.imports.plan_files import read_marks

    sensor = _sensor(turn_s, rpm, step_deg, rest_revolutions)
    requirement = Requirement(tolerance=tolerance_m, method=method, sigma_marks=sigma_marks_m)
    ground = plans.read_ground(f"{scenario}@{seed}", terrain, stops)
    query = _query(data, server, survey)
    assembled = plans.assemble(ground, read_marks(marks), sensor, requirement, query, survey)
    found = plans.evaluate(assembled)
    if suggest:
        found["one_more"] = plans.suggest(assembled)
    _deliver(found, csv, [*(points or []), *filter(None, [geojson])], origin)
    _show(found, as_json=as_json)


@plan.command()
def optimise(
    marks: Annotated[
        int | None, typer.Option(help="Number of marks; if not given, the least that suffices.")
    ] = None,
    scenario: Scenario = "paper-field",
    seed: Seed = 0,
    terrain: Terrain = None,
    stops: StopsFile = None,
    tolerance_m: Tolerance = 0.03,
    probability: Annotated[
        float, typer.Option(help="With which the tolerance shall be kept at every stop.")
    ] = 0.95,
    method: Method = "free_station",
    robust: Annotated[
        bool, typer.Option(help="Whether it shall be kept after the loss of any one mark too.")
    ] = True,
    keep_out: KeepOut = None,
    pole_m: Poles = (0.62, 1.50),
    reach_m: ReachM = 6.0,
    slope_deg: SlopeDeg = 15.0,
    inside: Inside = False,
    spacing_m: SpacingM = 0.0,
    sigma_marks_m: SigmaMarks = 0.0,
    turn_s: TurnS = 13.2,
    rpm: Rpm = 600.0,
    step_deg: StepDeg = 0.0,
    rest_revolutions: Rests = 3,
    data: Data = None,
    server: Server = None,
    survey: Survey = "",
    csv: Csv = None,
    geojson: GeoJson = None,
    points: Points = None,
    origin: Origin = None,
    as_json: AsJson = False,
) -> None:
    """Find the best places for a number of marks, or the fewest that keep the tolerance."""
    from spheremark.pipelines.placement import Goal, PlaceRules, Requirement
    from spheremark.service.planning import plans

    sensor = _sensor(turn_s, rpm, step_deg, rest_revolutions)
    requirement = Requirement(tolerance=tolerance_m, method=method, sigma_marks=sigma_marks_m)
    field = f"{scenario}@{seed}"
    ground = plans.read_ground(field, terrain, stops, keep_out=keep_out, poles=pole_m)
    query = _query(data, server, survey)
    assembled = plans.assemble(ground, None, sensor, requirement, query, survey)
    rules = PlaceRules(
        reach=reach_m,
        slope_max=math.radians(slope_deg),
        spacing=spacing_m,
        is_inside_allowed=inside,
    )
    goal = Goal(n_marks=marks, probability=probability, is_robust=robust)
    found = plans.optimise(assembled, rules, goal)
    _deliver(found, csv, [*(points or []), *filter(None, [geojson])], origin)
    _show(found, as_json=as_json)


@plan.command()
def random(
    arrangements: Annotated[int, typer.Option(min=1, help="How many are simulated.")] = 100_000,
    least: Annotated[int, typer.Option(help="Least number of marks.")] = 3,
    most: Annotated[int, typer.Option(help="Greatest number of marks.")] = 14,
    distance_m: Annotated[
        float | None, typer.Option(help="Greatest distance \\[m]; of the results if not given.")
    ] = None,
    angle_deg: Annotated[
        tuple[float, float] | None,
        typer.Option(help="Window of included angles \\[deg]; of the results if not given."),
    ] = None,
    error_m: Annotated[
        float, typer.Option(help="Error on each axis of a centre \\[m]; 0 takes the model's.")
    ] = 0.017,
    tolerance_m: Tolerance = 0.03,
    seed: Seed = 0,
    fit_method: Annotated[
        str, typer.Option(help="Fitting method whose results give distance and window.")
    ] = "paper",
    turn_s: TurnS = 13.2,
    rpm: Rpm = 600.0,
    step_deg: StepDeg = 0.0,
    rest_revolutions: Rests = 3,
    data: Data = None,
    server: Server = None,
    survey: Survey = "",
    folder: Annotated[
        Path | None, typer.Option("--out", file_okay=False, help="Write tables and figures.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Simulate random arrangements as in the study: an error on every centre, pass or fail."""
    from spheremark.pipelines.placement import RandomPlanSpec, sensor_model
    from spheremark.service.planning import random_plans
    from spheremark.service.planning.centre_models import model_of_surveys

    query = _query(data, server, survey)
    limits = random_plans.limits_of_results(query, fit_method, tolerance_m, survey)
    low, high = (None, None) if angle_deg is None else map(math.radians, angle_deg)
    spec = RandomPlanSpec(
        n_arrangements=arrangements,
        n_marks=(least, most),
        error=error_m or None,
        tolerance=tolerance_m,
        seed=seed,
    )
    spec = random_plans.within_limits(spec, limits, distance_m, (low, high))
    sensor = _sensor(turn_s, rpm, step_deg, rest_revolutions)
    model = (
        sensor_model(sensor)
        if query is None
        else model_of_surveys(query, sensor, 0.100, survey=survey)
    )
    results = random_plans.run(spec, model, limits)
    if folder:
        random_plans.write(folder, results)
    if as_json:
        sys.stdout.write(json.dumps(results, indent=2, allow_nan=False) + "\n")
    else:
        _print_random(results)


def _print_random(results: dict[str, Any]) -> None:
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
    table = _table("marks", "in the window", "pass [%]", "median [mm]", "p95 [mm]")
    for row in results["by_number_of_marks"]:
        table.add_row(str(row["n_marks"]), *_passed(row))
    out.print(table)
    table = _table("worst angle [deg]", "all", "pass [%]", "median [mm]", "p95 [mm]")
    for row in results["by_worst_angle"]:
        table.add_row(f"{row['angle_from_deg']:g} - {row['angle_to_deg']:g}", *_passed(row))
    out.print(table)
    table = _table("included angle [deg]", "study [mm]", "here [mm]")
    for row in results["table3"]:
        table.add_row(
            f"{row['included_angle_deg']:.2f}",
            _text(row["study_error_3d_m"], 1e3, 1),
            _text(row["median_error_3d_m"], 1e3, 1),
        )
    out.print(table)


def _passed(row: dict[str, Any]) -> tuple[str, ...]:
    """Return the columns of one class of arrangements."""
    lengths = (_text(row[key], 1e3, 1) for key in ("median_error_3d_m", "p95_error_3d_m"))
    return f"{row['n']:,}", _text(row["pass_rate"], 100.0, 1), *lengths


def _sensor(turn_s: float, rpm: float, step_deg: float, rest_revolutions: int) -> Any:
    """Return the sensor of the options."""
    from spheremark.pipelines.placement import Sensor

    return Sensor(
        turn=turn_s,
        spin_rpm=rpm,
        step=math.radians(step_deg),
        rest_revolutions=rest_revolutions,
    )


def _query(data: Path | None, server: str | None, survey: str) -> Any:
    """Return the source of results that executes SQL, if one was named."""
    if data is None and server is None:
        if survey:
            raise ConfigError("--survey needs --data or --url, which say where its fits are.")
        return None
    from spheremark.service.cli.source import Source
    from spheremark.service.planning.centre_models import require_survey
    from spheremark.service.settings import Settings

    settings = Settings(data=data) if data else Settings()
    query = Source(settings, server, folder=data).query
    require_survey(query, survey)
    return query


def _deliver(
    found: dict[str, Any], csv: Path | None, points: list[Path], origin: str | None
) -> None:
    """Write a plan to files."""
    from spheremark.service.serialise.plans import plan_points, to_csv
    from spheremark.storage.exports.points import GeographicOrigin, format_points

    place = GeographicOrigin.parse(origin) if origin else None
    if csv:
        csv.write_text(to_csv(found), encoding="utf-8")
    for path in points:
        path.write_text(format_points(plan_points(found), path.suffix, place), encoding="utf-8")


def _show(found: dict[str, Any], *, as_json: bool) -> None:
    """Write a plan to standard output."""
    if as_json:
        sys.stdout.write(json.dumps(found, indent=2, allow_nan=False) + "\n")
    else:
        _print(found)


def _print(plan: dict[str, Any]) -> None:
    """Print marks and stops as tables."""
    out.print(f"[bold]{escape(plan['site']['name'])}[/], method {plan['method']}")
    out.print(plan["model"]["text"], markup=False, highlight=False)
    table = _table("mark", "x [m]", "y [m]", "z [m]", "pole [m]")
    for mark in plan["marks"]:
        place = (f"{v:.3f}" for v in mark["position_m"])
        table.add_row(escape(mark["name"]), *place, _text(mark["pole_height_m"], 1, 2))
    out.print(table)
    tolerance = f"P(<= {1e3 * plan['tolerance_m']:g} mm)"
    table = _table("stop", "sigma 3-D [mm]", tolerance, "marks", "angles [deg]", "note")
    for stop in plan["stops"]:
        angles = (_text(stop[f"included_angle_{which}_deg"], 1, 0) for which in ("min", "max"))
        table.add_row(
            escape(stop["name"]),
            _text(stop["sigma_3d_m"], 1e3, 2),
            f"{stop['probability_within_tolerance']:.4f}",
            f"{stop['n_used']} of {len(stop['visible_marks'])}",
            " - ".join(angles),
            escape(stop["reason"]),
        )
    out.print(table)
    for line in plan.get("notes", ()):
        out.print(line, markup=False, highlight=False)
    if one := plan.get("one_more"):
        at = ", ".join(f"{v:.2f}" for v in one["position_m"])
        out.print(
            f"One more mark at {at} m (pole {one['pole_height_m']:.2f} m) would bring the worst "
            f"stop from {_text(one['worst_sigma_3d_before_m'], 1e3, 3)} to "
            f"{_text(one['worst_sigma_3d_m'], 1e3, 3)} mm (3-D sigma), the mean of all stops from "
            f"{_text(one['mean_sigma_3d_before_m'], 1e3, 3)} to "
            f"{_text(one['mean_sigma_3d_m'], 1e3, 3)} mm.",
            highlight=False,
        )


def _table(*headings: str) -> Table:
    """Return a table whose headings keep their units, which are no markup."""
    return Table(*map(escape, headings))


def _text(value: float | None, factor: float, digits: int) -> str:
    """Return a number in a larger unit; a dash for none."""
    return "-" if value is None else f"{factor * value:.{digits}f}"
