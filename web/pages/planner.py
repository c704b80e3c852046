"""Pages of plans: the planner, a stored plan with its results, and random plans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlencode

import plotly.graph_objects as go

from spheremark.web import theme
from spheremark.web.figures import random_plans
from spheremark.web.figures.elements import blank_figure
from spheremark.web.pages.base import Frame, Panel
from spheremark.web.templating import render

Row = Mapping[str, Any]
_MM = 1e3  # [mm/m]
_WITHIN_95 = 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannerPage:
    """The planner: fields that can be planned on, as ``key`` and ``name``, and stored plans."""

    frame: Frame
    sites: Sequence[Row]
    plans: Sequence[Row]


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanPage:
    """A stored plan, with its stops as rows of ``placements``."""

    frame: Frame
    plan: Row


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomPlansPage:
    """Random arrangements: the options, named as in the address, and the results."""

    frame: Frame
    options: Row
    results: Row


def planner_page(page: PlannerPage) -> str:
    """Return the planner."""
    return render("planner.html", page, here="plan")


def plan_page(page: PlanPage) -> str:
    """Return a stored plan: its prediction and its results."""
    stops = page.plan["stops"]
    known = [stop for stop in stops if stop["sigma_3d_m"] is not None]
    panels = (
        (Panel(name="outcome", figure=outcomes([page.plan]), caption=_CAPTION),) if known else ()
    )
    kept = sum(stop["probability_within_tolerance"] >= _WITHIN_95 for stop in stops)
    return render(
        "plan.html", page, here="plan", panels=panels, n_kept=kept, address=address(page.plan)
    )


def random_plans_page(page: RandomPlansPage) -> str:
    """Return the results of random arrangements, as tables and figures."""
    panels = [
        Panel(name=name, figure=draw(page.results), caption=caption)
        for name, draw, caption in _RANDOM_PLANS
    ]
    return render("random.html", page, here="plan", panels=panels)


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
    figure = blank_figure("Promised and achieved")
    stops = [stop for plan in plans for stop in plan["stops"] if stop["sigma_3d_m"] is not None]
    for key, name, symbol in (
        ("achieved_sigma_3d_m", "sigma of the survey", "circle-open"),
        ("error_3d_m", "error against truth", "circle"),
    ):
        rows = [stop for stop in stops if stop[key] is not None]
        figure.add_scatter(
            x=[_MM * stop["sigma_3d_m"] for stop in rows],
            y=[_MM * stop[key] for stop in rows],
            text=[stop["stop"] for stop in rows],
            name=name,
            mode="markers",
            marker={"symbol": symbol, "color": theme.OURS, "size": 8},
            hovertemplate="%{text}<br>promised %{x:.2f} mm<br>achieved %{y:.2f} mm<extra></extra>",
        )
    most = _MM * max((stop["sigma_3d_m"] for stop in stops), default=1e-3)
    figure.add_scatter(
        x=[0, 1.1 * most],
        y=[0, 1.1 * most],
        mode="lines",
        name="as promised",
        line={"color": theme.FAINT, "width": 1, "dash": "dash"},
        hoverinfo="skip",
    )
    figure.update_xaxes(title_text="Promised 3-D sigma [mm]", rangemode="tozero")
    figure.update_yaxes(title_text="Achieved [mm]", rangemode="tozero")
    return figure


def address(plan: Row) -> str:
    """Return the address that opens a stored plan in the planner."""
    request = plan["request"]
    query = {
        "site": request["site"],
        "method": request["method"],
        "tolerance": f"{_MM * request['tolerance_m']:g}",
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
