"""The commands ``spheremark plan``: where to put markers."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spheremark.pipelines.errors import InputError
from spheremark.service.cli.options import AsJson, Results, Scans, grouped
from spheremark.service.cli.terminal import out, print_json

if TYPE_CHECKING:
    from spheremark.pipelines.placement import Requirement
    from spheremark.service.planning.plans import Aim
    from spheremark.service.planning.requests import Ground, Plan

plan = typer.Typer(
    help="Where to put markers: evaluate, optimise, simulate at random.", no_args_is_help=True
)

Seed = Annotated[int, typer.Option(min=0, help="Source of chance of the field.")]
Tolerance = Annotated[float, typer.Option(help="3-D error that is accepted \\[m].")]


@dataclass(frozen=True, kw_only=True)
class PlannedField:
    """The field of a plan, its stops, and the requirement there."""

    scenario: Annotated[
        str, typer.Option(help="Simulated field: paper-field, rock-field or clutter-field.")
    ] = "paper-field"
    seed: Seed = 0
    terrain: Annotated[
        Path | None,
        typer.Option(
            help="Terrain instead: elevation model (.tif, .asc) or cloud (.laz, .las, .ply)."
        ),
    ] = None
    stops: Annotated[
        Path | None,
        typer.Option(
            exists=True, dir_okay=False, help="Stops (CSV: name,x_m,y_m and, if known, z_m)."
        ),
    ] = None
    tolerance_m: Tolerance = 0.03
    method: Annotated[str, typer.Option(help="Resection: free_station or paper.")] = "free_station"
    sigma_marks_m: Annotated[
        float, typer.Option(help="Sigma per axis of the marks themselves \\[m].")
    ] = 0.0
    occlusion: Annotated[
        float, typer.Option(help="Probability that what passes hides a mark from a stop.")
    ] = 0.0

    def requirement(self) -> Requirement:
        """Return the requirement of the core."""
        from spheremark.pipelines.placement import Requirement

        return Requirement(
            tolerance=self.tolerance_m,
            method=self.method,
            sigma_marks=self.sigma_marks_m,
            occlusion=self.occlusion,
        )

    def ground(self, **more: Any) -> Ground:
        """Return the field with its stops, and with polygons and poles if given."""
        from spheremark.service.planning.plans import read_ground

        return read_ground(f"{self.scenario}@{self.seed}", self.terrain, self.stops, **more)


@dataclass(frozen=True, kw_only=True)
class PlanFiles:
    """The files of a plan."""

    csv: Annotated[
        Path | None, typer.Option(dir_okay=False, help="Write marks and stops (CSV).")
    ] = None
    geojson: Annotated[
        Path | None,
        typer.Option(dir_okay=False, help="Write marks and stops (GeoJSON); needs --origin."),
    ] = None
    points: Annotated[
        list[Path] | None,
        typer.Option(dir_okay=False, help="Write marks and stops (.dxf or LandXML's .xml)."),
    ] = None
    origin: Annotated[
        str | None,
        typer.Option(
            help="Where the site is: LON,LAT[,BEARING of the y axis] in degrees (WGS 84)."
        ),
    ] = None
    as_json: AsJson = False

    def deliver(self, found: dict[str, Any]) -> None:
        """Write a plan to files and to standard output."""
        from spheremark.service.cli import render
        from spheremark.service.serialise.plans import plan_points, to_csv
        from spheremark.storage.exports.points import GeographicOrigin, format_points

        place = GeographicOrigin.parse(self.origin) if self.origin else None
        if self.csv:
            self.csv.write_text(to_csv(found), encoding="utf-8")
        for path in [*(self.points or []), *([self.geojson] if self.geojson else [])]:
            text = format_points(plan_points(found), path.suffix, place)
            path.write_text(text, encoding="utf-8")
        if self.as_json:
            print_json(found)
        else:
            render.print_plan(out, found)


@plan.command()
@grouped
def evaluate(
    marks: Annotated[
        Path,
        typer.Option(exists=True, dir_okay=False, help="Marks: JSON or CSV of a plan, or control."),
    ],
    field: PlannedField,
    scans: Scans,
    results: Results,
    files: PlanFiles,
    suggest: Annotated[
        bool, typer.Option("--suggest", help="Name the one more mark that would help most.")
    ] = False,
) -> None:
    """Predict the accuracy of an arrangement of marks at every stop, without simulating a scan."""
    from spheremark.service.planning import plans
    from spheremark.storage.imports.plan_files import read_marks

    assembled = plans.assemble(
        field.ground(),
        read_marks(marks),
        scans.sensor(),
        field.requirement(),
        results.query(),
        results.survey,
    )
    found = plans.evaluate(assembled)
    if suggest:
        found["one_more"] = plans.suggest(assembled)
    files.deliver(found)


@dataclass(frozen=True, kw_only=True)
class Search:
    """Where marks may stand, and what is best."""

    objective: Annotated[
        str, typer.Option(help="What is least: worst (stop), after_loss or mean.")
    ] = "worst"
    probability: Annotated[
        float, typer.Option(help="With which the tolerance shall be kept at every stop.")
    ] = 0.95
    robust: Annotated[
        bool, typer.Option(help="Whether it shall be kept after the loss of any one mark too.")
    ] = True
    most: Annotated[int, typer.Option(help="Most marks where the fewest are searched.")] = 20
    loss_weight: Annotated[
        float,
        typer.Option(
            help="Weight of the worst stop after a loss: 0 ignores it, 1 counts it alone."
        ),
    ] = 0.03
    walk_weight: Annotated[
        float, typer.Option(help="Weight of the way past all marks, 0 to 1: 0 ignores it.")
    ] = 0.0
    stop_reach_m: Annotated[
        float, typer.Option(help="How far stops may be moved to better places \\[m].")
    ] = 0.0
    standing: Annotated[
        Path | None,
        typer.Option(
            exists=True, dir_okay=False, help="Marks that stand already and stay (JSON or CSV)."
        ),
    ] = None
    cost_mark: Annotated[float, typer.Option(help="Cost of a mark, in any unit.")] = 0.0
    cost_metre: Annotated[float, typer.Option(help="Cost of a metre past all marks.")] = 0.0
    keep_out: Annotated[
        Path | None,
        typer.Option(
            exists=True, dir_okay=False, help="Polygons where no mark may stand (GeoJSON)."
        ),
    ] = None
    pole_m: Annotated[
        tuple[float, float], typer.Option(help="Least and greatest height of a centre \\[m].")
    ] = (0.62, 1.50)
    reach_m: Annotated[float, typer.Option(help="Farthest a mark may stand from a stop \\[m].")] = (
        6.0
    )
    clear_m: Annotated[float, typer.Option(help="Least distance from stops \\[m].")] = 1.0
    apart_m: Annotated[float, typer.Option(help="Least distance between marks \\[m].")] = 1.0
    placement_m: Annotated[
        float, typer.Option(help="How far from its place a mark may end up \\[m].")
    ] = 0.0
    slope_deg: Annotated[float, typer.Option(help="Steepest ground for a pole \\[deg].")] = 15.0
    inside: Annotated[
        bool, typer.Option("--inside", help="Marks may stand between the stops too.")
    ] = False
    spacing_m: Annotated[
        float, typer.Option(help="Grid of places that are tried \\[m]; 0 takes one that suits.")
    ] = 0.0

    def plan(self, field: PlannedField, scans: Scans, results: Results) -> Plan:
        """Return the plan to search, with the marks that stand."""
        from spheremark.service.planning import plans
        from spheremark.storage.imports.plan_files import read_marks

        ground = field.ground(keep_out=self.keep_out, poles=self.pole_m)
        marks = None if self.standing is None else read_marks(self.standing)
        requirement, query = field.requirement(), results.query()
        return plans.assemble(ground, marks, scans.sensor(), requirement, query, results.survey)

    def aim(self, n_marks: int | None) -> Aim:
        """Return what the search is for."""
        from spheremark.pipelines.placement import Costs, Goal, PlaceRules
        from spheremark.service.planning.plans import Aim

        rules = PlaceRules(
            reach=self.reach_m,
            clear=self.clear_m,
            apart=self.apart_m,
            slope_max=math.radians(self.slope_deg),
            spacing=self.spacing_m,
            is_inside_allowed=self.inside,
            placement=self.placement_m,
        )
        goal = Goal(
            n_marks=n_marks,
            probability=self.probability,
            is_robust=self.robust,
            most=self.most,
            objective=self.objective,
            loss_weight=self.loss_weight,
            walk_weight=self.walk_weight,
            stop_reach=self.stop_reach_m,
        )
        costs = Costs(per_mark=self.cost_mark, per_metre=self.cost_metre)
        return Aim(rules=rules, goal=goal, costs=costs, keeps_marks=self.standing is not None)


@plan.command()
@grouped
def optimise(
    field: PlannedField,
    scans: Scans,
    results: Results,
    files: PlanFiles,
    search: Search,
    marks: Annotated[
        int | None, typer.Option(help="Number of marks; if not given, the least that suffices.")
    ] = None,
) -> None:
    """Find the best places for a number of marks, or the fewest that keep the tolerance."""
    from spheremark.service.cli.terminal import searching
    from spheremark.service.planning import plans

    assembled = search.plan(field, scans, results)
    with searching() as report:
        found = plans.optimise(assembled, search.aim(marks), report)
    files.deliver(found)


@plan.command("trade-off")
@grouped
def trade_off(
    field: PlannedField,
    scans: Scans,
    results: Results,
    search: Search,
    numbers: Annotated[
        str, typer.Option(help="Numbers of marks, as 4-8,10,14; empty for none.")
    ] = "4,5,6,8,10,14",
    loss_weights: Annotated[
        str, typer.Option(help="Weights of a loss to compare, as 0,0.03,0.2,1.")
    ] = "",
    marks: Annotated[
        int | None,
        typer.Option(
            help="Number of marks for these weights; the largest of --numbers if missing."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compare the best arrangements of several numbers of marks, and weights of a loss."""
    from spheremark.service.cli import render
    from spheremark.service.cli.terminal import searching
    from spheremark.service.planning import plans

    aim = search.aim(marks)
    chosen = _numbers(numbers), _weights(loss_weights)
    assembled = search.plan(field, scans, results)
    with searching() as report:
        found = plans.trade_off(assembled, aim, *chosen, report)
    if as_json:
        print_json(found)
    else:
        render.print_trade_off(out, found)


def _numbers(text: str) -> list[int]:
    """Return numbers of marks from a list with ranges."""
    parts = [part.strip() for part in text.split(",") if part.strip()]
    ranges = [re.fullmatch(r"(\d{1,3})(?:-(\d{1,3}))?", part) for part in parts]
    found = [range(int(one[1]), int(one[2] or one[1]) + 1) for one in ranges if one]
    if len(found) < len(parts) or not all(found):
        raise InputError(
            f"--numbers is {text!r}; it must be a list as 4-8,10,14, the smaller number of each "
            "range first."
        )
    return [n for one in found for n in one]


def _weights(text: str) -> list[float]:
    """Return weights from a list."""
    try:
        return [float(part) for part in text.split(",") if part.strip()]
    except ValueError as error:
        raise InputError(f"--loss-weights is {text!r}; it must be a list as 0,0.03,1.") from error


@plan.command()
@grouped
def random(
    scans: Scans,
    results: Results,
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
    folder: Annotated[
        Path | None, typer.Option("--out", file_okay=False, help="Write tables and figures.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Simulate random arrangements as in the study: an error on every centre, pass or fail."""
    from spheremark.pipelines.placement import RandomPlanSpec
    from spheremark.service.cli import render
    from spheremark.service.planning import random_plans
    from spheremark.service.planning.centre_models import model_of

    query = results.query()
    limits = random_plans.limits_of_results(query, fit_method, tolerance_m, results.survey)
    low, high = (None, None) if angle_deg is None else map(math.radians, angle_deg)
    spec = RandomPlanSpec(
        n_arrangements=arrangements,
        n_marks=(least, most),
        error=error_m or None,
        tolerance=tolerance_m,
        seed=seed,
    )
    spec = random_plans.within_limits(spec, limits, distance_m, (low, high))
    found = random_plans.run(spec, model_of(query, scans.sensor(), 0.100, results.survey), limits)
    if folder:
        random_plans.write(folder, found)
    if as_json:
        print_json(found)
    else:
        render.print_random_plans(out, found)
