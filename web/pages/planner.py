"""Pages of plans: the planner, a stored plan with its results, and random plans."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Any
from urllib.parse import urlencode

import numpy as np
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


def random_plans_page(frame: Frame, options: Row, search: Row | None) -> str:
    """Return the results of random arrangements, or the search that finds them."""
    results = (search or {}).get("random")
    shown: dict[str, Any] = {"options": options, "results": results, "search": search, "panels": []}
    if results:
        draws = [(name, draw(results), caption) for name, draw, caption in _RANDOM_PLANS]
        shown["panels"] = [Panel(*one) for one in draws]
    return render("random.html", frame=frame, request={"random": options}, **shown)


def search_page(frame: Frame, search: Row) -> str:
    """Return a search of plans: how far it has come, or what it found."""
    best, result = search.get("optimised"), search.get("trade_off")
    moments = ((key, search[key]) for key in ("created_at", "finished_at"))
    instants = {key: text and datetime.fromisoformat(text) for key, text in moments}
    shown: dict[str, Any] = {"best": None, "result": result, "tables": [], "panels": []}
    if best:
        shown["best"] = best | _addresses(search, best)
    if result:
        for name, title, about, first, key in _COMPARED:
            rows = [
                plan | _addresses(search, plan) | {"first": f"{value:g}"}
                for plan, value in zip(result[name], result[key], strict=True)
            ]
            if rows:
                shown["tables"].append((name, title, about, f">{first}", rows))
        if len(result["by_number"]) > 1:
            caption = "Each point is the best arrangement that was found; below the line is none."
            shown["panels"] = [Panel("trade-off", trade_off_figure(result), caption)]
    request = search["request"] if search["kind"] == "random" else {}
    given = {key: value for key, value in request.items() if value is not None}
    search = {**search, **instants}
    return render("search.html", frame=frame, search=search, random=_random(given), **shown)


_COMPARED = (
    ("by_number", "By number of marks", "The best of each number.", "Marks", "numbers"),
    (
        "by_loss_weight",
        "By weight of a loss",
        "The worst stop against the worst stop after the loss of any one mark.",
        "Weight",
        "loss_weights",
    ),
)


def _random(given: Row) -> str:
    """Return the address of random arrangements."""
    given = {k: v for k, v in given.items() if k != "error_per_axis_m"} | {
        "error_per_axis_mm": MM * (given.get("error_per_axis_m") or 0.0)
    }
    return f"/plan/random?{urlencode(given)}"


def _addresses(search: Row, plan: Row) -> Row:
    """Return the addresses that open a plan of a search in the planner and as a field sheet."""
    request = dict(search["request"])
    if request.get("stop_reach_m"):
        places = ((stop["name"], *stop["position_m"][:2]) for stop in plan["stops"])
        request["stops"] = [{"name": name, "x_m": x, "y_m": y} for name, x, y in places]
    opened = address({"request": request, "marks": plan["marks"]})
    return {"address": opened, "sheet": opened.replace("/plan?", "/plan/sheet?", 1)}


def trade_off_figure(result: Row) -> go.Figure:
    """Draw worst stop, after a loss, and the bound against the number of marks."""
    figure = blank_figure("Accuracy against marks", "Marks", "3-D sigma [mm]")
    plans, numbers = result["by_number"], result["numbers"]
    hover = "{x} marks<br>{y:.3f} mm"
    for key, style in _TRADED.items():
        values = [_of(plan, key) for plan in plans]
        known = [(n, MM * v) for n, v in zip(numbers, values, strict=True) if v is not None]
        if known:
            xs, ys = zip(*known, strict=True)
            add_points(figure, list(xs), list(ys), style, hover)
    bounds = [MM * v for plan in plans if (v := _of(plan, "worst_sigma_3d_bound_m")) is not None]
    if len(bounds) == len(plans):
        style = theme.Style("no arrangement below", theme.FAINT)
        add_line(figure, numbers, bounds, style, line_width=1, line_dash="dash")
    figure.update_xaxes(dtick=1)
    return figure.update_yaxes(type="log", dtick="D2")


def _of(plan: Row, key: str) -> float | None:
    """Return a number of a plan or of its quality."""
    value: float | None = plan.get(key, plan["optimum"].get(key))
    return value


_TRADED = {
    "worst_sigma_3d_m": theme.Style("worst stop", theme.OURS),
    "worst_sigma_3d_after_loss_m": theme.Style("after the loss of a mark", theme.PAPER),
    "mean_sigma_3d_m": theme.Style("mean of stops", theme.FAINT),
}


def sheet_page(frame: Frame, plan: Row, walk: float, opened: str) -> str:
    """Return the field sheet of a plan: map, coordinates and stake-out distances."""
    shown = {"map": _sheet_map(plan), "stake_out": _stake_out(plan), "walk": walk}
    return render("field_sheet.html", frame=frame, plan=plan, address=opened, **shown)


def _sheet_map(plan: Row) -> Row:
    """Return the lines and symbols of a map, in its own units."""
    p = np.array([one["position_m"][:2] for one in (*plan["marks"], *plan["stops"])])
    low, high = p.min(axis=0) - 1.5, p.max(axis=0) + 1.5
    scale = _SHEET_SIZE / float((high - low).max())
    width, height = (scale * (high - low)).tolist()
    step = _round_step(_LINE_LEAST / scale)

    def at(x: float, y: float) -> tuple[float, float]:
        return round(scale * (x - low[0]), 1), round(scale * (high[1] - y), 1)

    lines, labels = [], []
    for axis in (0, 1):
        for value in np.arange(np.ceil(low[axis] / step) * step, high[axis], step):
            begin, end = low.copy(), high.copy()
            begin[axis] = end[axis] = value
            a, b = at(*begin), at(*end)
            lines.append((*a, *b))
            spot = (a[0], round(height - 3, 1), "middle") if axis == 0 else (3, a[1] - 2, "start")
            labels.append((*spot[:2], f"{value:g}", spot[2]))
    places = {
        kind: [(*at(*one["position_m"][:2]), one["name"]) for one in plan[kind]]
        for kind in ("marks", "stops")
    }
    return {
        "width": width,
        "height": height,
        "step": step,
        "lines": lines,
        "labels": labels,
        **places,
    }


def _round_step(least: float) -> float:
    """Return the least of 1, 2 and 5 times a power of ten that is not below a length [m]."""
    power = 10.0 ** np.floor(np.log10(least))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= least))


def _stake_out(plan: Row) -> list[Row]:
    """Return the distances of each mark from two stops that cut well, and to the next mark."""
    marks, stops = plan["marks"], plan["stops"]
    rows: list[Row] = []
    for i, mark in enumerate(marks):
        here = np.array(mark["position_m"][:2])
        v = here - np.array([stop["position_m"][:2] for stop in stops])
        d = np.maximum(np.linalg.norm(v, axis=1), 1e-6)
        first = int(np.argmin(d))
        units = v / d[:, None]
        sines = np.abs(units[:, 0] * units[first, 1] - units[:, 1] * units[first, 0])
        second = int(np.argmax(np.where(np.arange(len(d)) == first, -1.0, sines / np.sqrt(d))))
        chosen = [first, second][: len(stops)]
        following = marks[(i + 1) % len(marks)]
        off = np.array(following["position_m"][:2]) - here
        rows.append(
            {
                "mark": mark["name"],
                "stops": [
                    {
                        "name": stops[k]["name"],
                        "distance": float(d[k]),
                        "bearing": float(np.degrees(np.arctan2(v[k][0], v[k][1])) % 360.0),
                    }
                    for k in chosen
                ],
                "next": {"name": following["name"], "distance": float(np.hypot(*off))},
            }
        )
    return rows


_SHEET_SIZE, _LINE_LEAST = 640.0, 34.0  # longer side, and least spacing of lines: units of the map


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


_OPTIONAL = (
    ("noise", "noise_m", MM),
    ("sigma_marks", "sigma_marks_m", MM),
    ("occlusion", "occlusion", 100.0),
)


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
    for name, key, scale in _OPTIONAL:
        if request.get(key):
            query[name] = f"{scale * request[key]:g}"
    if poles := request.get("pole_heights_m"):
        query |= {"pole_low": f"{poles[0]:g}", "pole_high": f"{poles[1]:g}"}
    if request.get("stops"):
        query["stops"] = ";".join(
            f"{stop['name']}:{stop['x_m']:.3f},{stop['y_m']:.3f}" for stop in request["stops"]
        )
    if request.get("keep_out_m"):
        areas = (";".join(f"{x:g},{y:g}" for x, y in area) for area in request["keep_out_m"])
        query["keep"] = "|".join(areas)
    return f"/plan?{urlencode(query)}"
