"""Pages of plans: the planner, a stored plan with its results, and random plans."""

from __future__ import annotations

from collections.abc import Sequence
from urllib.parse import urlencode

import plotly.graph_objects as go

from spheremark.web import theme
from spheremark.web.columns import MM
from spheremark.web.figures import random_plans
from spheremark.web.figures.elements import add_line, add_points, blank_figure
from spheremark.web.pages.base import Frame, Panel, Row
from spheremark.web.templating import render

_WITHIN_95 = 0.95
_OUTCOMES = {
    "achieved_sigma_3d_m": theme.Style("sigma of the survey", theme.OURS, "circle-open"),
    "error_3d_m": theme.Style("error against truth", theme.OURS),
}


def plan_page(frame: Frame, plan: Row) -> str:
    """Return a stored plan: its prediction and, once surveyed, its results."""
    stops = plan["stops"]
    is_known = any(stop["sigma_3d_m"] is not None for stop in stops)
    panels = (Panel("outcome", outcomes([plan]), _CAPTION),) if is_known else ()
    kept = sum(stop["probability_within_tolerance"] >= _WITHIN_95 for stop in stops)
    shown = {"panels": panels, "n_kept": kept, "address": address(plan)}
    return render("plan.html", frame=frame, plan=plan, **shown)


def random_plans_page(frame: Frame, options: Row, results: Row) -> str:
    """Return the results of random arrangements, with the options of the address."""
    panels = [Panel(name, draw(results), caption) for name, draw, caption in _RANDOM_PLANS]
    return render("random.html", frame=frame, options=options, results=results, panels=panels)


_RANDOM_PLANS = (
    (
        "by-angle",
        random_plans.error_by_angle,
        "Error of a position against the included angle of two marks, the third beside the first: "
        "median over all signs of the error. Grey: the window that the study recommends.",
    ),
    (
        "by-number",
        random_plans.pass_rate_by_number,
        "Arrangements whose three best marks keep the window; more marks make it more likely that "
        "three cut well.",
    ),
    (
        "by-worst-angle",
        random_plans.pass_rate_by_angle,
        "All arrangements, inside the window and outside, by the angle that decides.",
    ),
)
_CAPTION = (
    "Each stop of the plan. Filled: the error against truth; open: the sigma that the survey "
    "itself states. On the line, prediction and outcome agree; errors scatter below and above it."
)


def outcomes(plans: Sequence[Row]) -> go.Figure:
    """Draw the results of planned stops against their predictions."""
    figure = blank_figure("Promised and achieved", "Promised 3-D sigma [mm]", "Achieved [mm]")
    stops = [stop for plan in plans for stop in plan["stops"] if stop["sigma_3d_m"] is not None]
    hover = "{text}<br>promised {x:.2f} mm<br>achieved {y:.2f} mm"
    for key, style in _OUTCOMES.items():
        rows = [stop for stop in stops if stop[key] is not None]
        x, y = ([MM * row[name] for row in rows] for name in ("sigma_3d_m", key))
        add_points(figure, x, y, style, hover, text=[row["stop"] for row in rows])
    ends = [0, 1.1 * MM * max((stop["sigma_3d_m"] for stop in stops), default=1e-3)]
    style = theme.Style("as promised", theme.FAINT)
    add_line(figure, ends, ends, style, line_width=1, line_dash="dash")
    figure.update_xaxes(rangemode="tozero")
    return figure.update_yaxes(rangemode="tozero")


def address(plan: Row) -> str:
    """Return the address that opens a stored plan in the planner."""
    request = plan["request"]
    query = {
        "site": request["site"],
        "method": request["method"],
        "tolerance": f"{MM * request['tolerance_m']:g}",
        "turn": f"{request['turn_s']:g}",
        "rpm": f"{request['spin_rpm']:g}",
        "step": f"{request.get('step_deg', 0.0):g}",
        "rests": f"{request.get('rest_revolutions', 3)}",
        "model": request["model"],
        "a": ";".join(
            f"{mark['name']}:{mark['position_m'][0]:.3f},{mark['position_m'][1]:.3f},"
            f"{mark['pole_height_m']:.3f}"
            for mark in plan["marks"]
        ),
    }
    if request.get("stops"):
        query["stops"] = ";".join(
            f"{stop['name']}:{stop['x_m']:.3f},{stop['y_m']:.3f}" for stop in request["stops"]
        )
    if request.get("keep_out_m"):
        areas = (";".join(f"{x:g},{y:g}" for x, y in area) for area in request["keep_out_m"])
        query["keep"] = "|".join(areas)
    return f"/plan?{urlencode(query)}"
