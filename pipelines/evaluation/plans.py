"""Optimised arrangements of marks against chance, and against the best of all in small cases."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial
from itertools import product
from time import process_time
from typing import NamedTuple

import numpy as np

from spheremark.pipelines.evaluation.experiment import Column, Experiment, Plain, Table
from spheremark.pipelines.placement import (
    PLAN_METHODS,
    Goal,
    PlaceRules,
    Requirement,
    Sensor,
    Site,
    Stops,
    best_without_search,
    find_candidates,
    optimise,
    sensor_model,
    site_of_field,
    stops_of_field,
)
from spheremark.pipelines.simulation import scenario

_NUMBERS = (3, 4, 5, 6, 8, 10, 14)  # of marks
_OBJECTIVES = ("worst", "after_loss")
_N_SMALL = 6  # cases in which every arrangement is judged
_PLACES_SMALL, _MARKS_SMALL = 14, 4


class _Case(NamedTuple):
    """A positioning method with a number of marks, or with the number of a small case."""

    method: str
    number: int
    objective: str = ""  # of a number of marks


def plans(n_drawn: int, seed: int) -> Experiment[_Case, Plain, Plain]:
    """Return the experiment that compares optimised marks with marks at random.

    Parameters
    ----------
    n_drawn : int
        Arrangements that are drawn for each number of marks.
    seed : int
        Seed of the field.

    Returns
    -------
    Experiment
        Its report has the objective of optimised marks (the 3-D sigma at the worst stop, or that
        after the loss of any mark), of the best of those drawn, the bound over all, and, in small
        cases, the best of all.
    """
    large = [_Case(*one) for one in product(PLAN_METHODS, _NUMBERS, _OBJECTIVES)]
    small = [_Case(*one) for one in product(PLAN_METHODS, range(_N_SMALL))]
    return Experiment(
        worlds=large + small,
        run_world=partial(_case, n_drawn=n_drawn, seed=seed),
        pool=lambda rows: _report(rows, n_drawn, seed),
        tables=_tables,
    )


def _tables(report: Plain) -> list[Table]:
    """Return a table of numbers of marks, with the small cases below it."""
    title = f"{report['site']}: 3-D sigma at the worst stop, or after the worst loss"
    columns = (
        Column("method", "method"),
        Column("n_marks", "marks", "", "d"),
        Column("objective", "least"),
        Column("optimised_sigma_3d_m", "optimised", "mm", ".3f"),
        Column("drawn_sigma_3d_m", f"best of {report['n_drawn']:,}", "mm", ".3f"),
        Column("ratio", "ratio", "", ".3f"),
        Column("bound_sigma_3d_m", "bound", "mm", ".3f"),
        Column("processor_s", "processor time", "s", ".0f"),
    )
    note = (
        f"{len(report['small_cases'])} small cases ({_MARKS_SMALL} of {_PLACES_SMALL} places, "
        "every choice judged): best over found "
        f"{report['least_ratio_to_brute_force']:.3f} at the least."
    )
    return [Table(title=title, columns=columns, rows=report["against_chance"], notes=[note])]


@lru_cache(maxsize=1)
def _ground(seed: int) -> tuple[Site, Stops]:
    """Return the site and the stops of the study's field."""
    field = scenario("paper-field", seed)
    return site_of_field(field), stops_of_field(field)


def _report(rows: list[Plain], n_drawn: int, seed: int) -> Plain:
    """Return the rows of both kinds of cases."""
    small = [row for row in rows if "best_sigma_3d_m" in row]
    return {
        "site": _ground(seed)[0].name,
        "n_drawn": n_drawn,
        "against_chance": [row for row in rows if "best_sigma_3d_m" not in row],
        "small_cases": small,
        "least_ratio_to_brute_force": min(case["ratio"] for case in small),
    }


def _case(case: _Case, *, n_drawn: int, seed: int) -> Plain:
    """Return the row of one case."""
    site, stops = _ground(seed)
    if not case.objective:
        return _against_all(site, stops, case.method, case.number)
    return _against_chance(site, stops, case, n_drawn)


def _against_chance(site: Site, stops: Stops, case: _Case, n_drawn: int) -> Plain:
    """Return one number of marks: optimised, and the best of many drawn from the same places."""
    method, k, objective = case
    given = (site, stops, find_candidates(site, stops, PlaceRules()), sensor_model(Sensor()))
    requirement = Requirement(method=method)
    by_chance = n_drawn, np.random.default_rng(k)
    drawn, begin = best_without_search(*given, requirement, k, by_chance, objective), process_time()
    goal = Goal(n_marks=k, objective=objective)
    found = optimise(*given, requirement, goal, np.random.default_rng(0))
    is_worst = objective == "worst"
    sigma = found.evaluation.worst_sigma_3d if is_worst else found.worst_after_loss
    return {
        "method": method,
        "n_marks": k,
        "objective": objective,
        "optimised_sigma_3d_m": sigma,
        "drawn_sigma_3d_m": drawn,
        "ratio": sigma / drawn,
        "bound_sigma_3d_m": found.bound if is_worst else found.bound_after_loss,
        "processor_s": process_time() - begin,
    }


def _against_all(site: Site, every_stop: Stops, method: str, i: int) -> Plain:
    """Return a small case: three stops and a few places, of which every choice is judged."""
    rng = np.random.default_rng([i, _PLACES_SMALL])
    some = rng.choice(len(every_stop.names), 3, replace=False)
    stops = every_stop.rows(some)
    places = find_candidates(site, every_stop, PlaceRules())
    few = rng.choice(len(places.p_site), _PLACES_SMALL, replace=False)
    places = replace(places, p_site=places.p_site[few], ground=places.ground[few], rules=None)
    given = (site, stops, places, sensor_model(Sensor()))
    requirement = Requirement(method=method)
    best = best_without_search(*given, requirement, _MARKS_SMALL, None)
    goal = Goal(n_marks=_MARKS_SMALL, is_robust=False)
    sigma = optimise(*given, requirement, goal, rng).evaluation.worst_sigma_3d
    return {"method": method, "best_sigma_3d_m": best, "sigma_3d_m": sigma, "ratio": best / sigma}
