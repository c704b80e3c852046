"""How much better optimised arrangements are than chance, and how near to the best of all."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from spheremark.pipelines.placement import (
    PLAN_METHODS,
    Goal,
    PlaceRules,
    Requirement,
    Sensor,
    Stops,
    best_without_search,
    find_candidates,
    optimise,
    sensor_model,
)
from spheremark.pipelines.survey import Progress
from spheremark.service.planning.requests import Ground, simulated_ground

_NUMBERS = range(4, 15)  # of marks
_N_SMALL = 6  # cases in which every arrangement is judged
_PLACES_SMALL, _MARKS_SMALL = 14, 4


def run(n_drawn: int, seed: int, progress: Progress) -> dict[str, Any]:
    """Return the worst stop's 3-D sigma of optimised marks, and of the best of so many drawn."""
    ground = simulated_ground(f"paper-field@{seed}")
    cases = [(method, k) for method in PLAN_METHODS for k in _NUMBERS]
    rows = []
    for i, (method, k) in enumerate(cases):
        progress(i / (len(cases) + 1), f"{method}, {k} marks")
        rows.append(_against_chance(ground, method, k, n_drawn))
    progress(len(cases) / (len(cases) + 1), "small cases")
    small = [_against_all(ground, method, i) for method in PLAN_METHODS for i in range(_N_SMALL)]
    return {
        "site": ground.site.name,
        "n_drawn": n_drawn,
        "against_chance": rows,
        "small_cases": small,
        "least_ratio_to_brute_force": min(case["ratio"] for case in small),
    }


def _against_chance(ground: Ground, method: str, k: int, n_drawn: int) -> dict[str, Any]:
    """Return one number of marks: optimised, and the best of many drawn from the same places."""
    candidates = find_candidates(ground.site, ground.stops, PlaceRules())
    given = (ground.site, ground.stops, candidates, sensor_model(Sensor()))
    wish = Requirement(method=method)
    drawn = best_without_search(*given, wish, k, (n_drawn, np.random.default_rng(k)))
    found = optimise(*given, wish, Goal(n_marks=k), np.random.default_rng(0))
    sigma = found.evaluation.worst_sigma_3d
    return {
        "method": method,
        "n_marks": k,
        "optimised_sigma_3d_m": sigma,
        "drawn_sigma_3d_m": drawn,
        "ratio": sigma / drawn,
    }


def _against_all(ground: Ground, method: str, i: int) -> dict[str, Any]:
    """Return a small case: three stops and a few places, of which every choice is judged."""
    rng = np.random.default_rng([i, _PLACES_SMALL])
    some = rng.choice(len(ground.stops.names), 3, replace=False)
    stops = Stops(
        names=tuple(ground.stops.names[j] for j in some), p_site=ground.stops.p_site[some]
    )
    places = find_candidates(ground.site, ground.stops, PlaceRules())
    few = rng.choice(len(places.p_site), _PLACES_SMALL, replace=False)
    places = replace(places, p_site=places.p_site[few], ground=places.ground[few])
    given = (ground.site, stops, places, sensor_model(Sensor()))
    wish = Requirement(method=method)
    best = best_without_search(*given, wish, _MARKS_SMALL, None)
    goal = Goal(n_marks=_MARKS_SMALL, is_robust=False)
    sigma = optimise(*given, wish, goal, rng).evaluation.worst_sigma_3d
    return {"method": method, "best_sigma_3d_m": best, "sigma_3d_m": sigma, "ratio": best / sigma}


def print_report(out: Console, report: dict[str, Any]) -> None:
    """Print a table of numbers of marks, and the small cases in a sentence."""
    table = Table(title=f"{report['site']}: 3-D sigma at the worst stop [mm]", title_justify="left")
    for heading in ("method", "marks", "optimised", f"best of {report['n_drawn']:,}", "ratio"):
        table.add_column(heading, justify="left" if heading == "method" else "right")
    for row in report["against_chance"]:
        lengths = (f"{1e3 * row[f'{which}_sigma_3d_m']:.3f}" for which in ("optimised", "drawn"))
        table.add_row(row["method"], str(row["n_marks"]), *lengths, f"{row['ratio']:.3f}")
    out.print(table)
    out.print(
        f"{len(report['small_cases'])} small cases ({_MARKS_SMALL} of {_PLACES_SMALL} places, "
        "every choice judged): best over found "
        f"{report['least_ratio_to_brute_force']:.3f} at the least."
    )
