"""A load test of pages: a database as large as years of surveys, of copies of real rows.

The copies are spread over surveys named ``load-test``; their errors vary about those of the
original, so that quantiles are not all the same. They are no results.

``python -m spheremark.service.bench.load DATA OUT --stops 35000`` writes OUT/spheremark.duckdb.
Serve it with ``SPHEREMARK_DATA=OUT spheremark serve``; ``--time http://127.0.0.1:8000`` times it.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from time import perf_counter

import duckdb
import httpx

from spheremark.service.settings import DATABASE

_N_SURVEYS = 50
_FACTOR = "exp(0.3 * (random() + random() + random() - 1.5))"  # about 1, sigma 15 %
_COPIES = {
    "recordings": "recording_id || '-' || k AS recording_id",
    "runs": "run_id || '-' || k AS run_id, recording_id || '-' || k AS recording_id, "
    "'load-test-' || (k % $n_surveys) AS survey_id",
    "stops": "run_id || '-' || k AS run_id",
    "marker_fits": "run_id || '-' || k AS run_id, error_3d_m * {factor} AS error_3d_m",
    "station_fixes": "run_id || '-' || k AS run_id, error_3d_m * {factor} AS error_3d_m, "
    "x_m + 40 * (k % 40) AS x_m, y_m + 40 * (k // 40 % 40) AS y_m",
    "resections": "run_id || '-' || k AS run_id",
}
"""What differs in the copies of each table."""
_COPY = "INSERT INTO {table} SELECT x.* REPLACE ({changes}) FROM {table} AS x, range(1, $n) AS c(k)"
_SURVEYS = """
INSERT INTO surveys BY NAME SELECT 'load-test-' || k AS survey_id, 'load-test-' || k AS name,
    0.03 AS tolerance_m, now() AS created_at FROM range($n_surveys) AS c(k)
"""
_KEEP = "DELETE FROM resections WHERE n_marks != 2 OR resection_method != 'free_station'"
_SIZES = "SELECT (SELECT count(*) FROM stops), (SELECT count(*) FROM marker_fits)"
_ADDRESSES = (
    "/",
    "/live",
    *(f"/surveys/load-test-7{tab}" for tab in ("", "/stops", "/logs")),
    "/api/v1/figures/solution.json?survey=load-test-7",
    "/accuracy",
    *(
        f"/api/v1/figures/{name}.json"
        for name in ("distance", "count", "incidence", "distribution", "surveys", "map", "angle")
    ),
    "/api/v1/accuracy/limits",
    "/api/v1/tables/centres.json?sort=-error_3d_m",
    "/api/v1/tables/stops.json?sort=-error_max_m",
    "/surveys/load-test-7/accuracy",
    "/api/v1/figures/distance.json?survey=load-test-7",
    "/api/v1/figures/map.json?survey=load-test-7",
)


def make(source: Path, target: Path, n_stops: int) -> tuple[int, int]:
    """Copy a database and fill it with copies of its rows; return its stops and centres.

    Parameters
    ----------
    source : Path
        Data folder of a service that does not run.
    target : Path
        New data folder.
    n_stops : int
        Number of stops at least.

    Returns
    -------
    tuple of int
        Rows of ``stops`` and of ``marker_fits``.
    """
    target.mkdir(parents=True)
    shutil.copy(source / DATABASE, target / DATABASE)
    with duckdb.connect(str(target / DATABASE), config={"memory_limit": "3GB"}) as connection:
        connection.execute(_KEEP)
        ((n_own, _),) = connection.execute(_SIZES).fetchall()
        numbers = {"n": -(-n_stops // n_own), "n_surveys": _N_SURVEYS}
        connection.execute(_SURVEYS, {"n_surveys": _N_SURVEYS})
        for table, changes in _COPIES.items():
            changed = changes.format(factor=_FACTOR)
            used = numbers if "$n_surveys" in changed else {"n": numbers["n"]}
            connection.execute(_COPY.format(table=table, changes=changed), used)
        connection.execute("CHECKPOINT")
        ((n_stops, n_centres),) = connection.execute(_SIZES).fetchall()
    return n_stops, n_centres


def timed(address: str) -> list[tuple[str, float, int]]:
    """Return how long each page, figure and table of a service takes [s], and its size [bytes]."""
    found = []
    with httpx.Client(base_url=address, timeout=300.0) as client:
        for path in _ADDRESSES:
            begin = perf_counter()
            response = client.get(path)
            response.raise_for_status()
            found.append((path, perf_counter() - begin, len(response.content)))
    return found


def main() -> None:
    """Make the database, or time a service on it."""
    parser = argparse.ArgumentParser(description="A load test of pages; its rows are no results.")
    parser.add_argument("source", type=Path, nargs="?")
    parser.add_argument("target", type=Path, nargs="?")
    parser.add_argument("--stops", type=int, default=35_000)
    parser.add_argument("--time", metavar="URL")
    chosen = parser.parse_args()
    if chosen.time:
        for path, seconds, size in timed(chosen.time):
            print(f"{seconds:8.2f} s {size:>10,} B  {path}")  # noqa: T201  # a script
    elif chosen.target is None:
        parser.error("give DATA and OUT, or --time URL")
    else:
        n_stops, n_centres = make(chosen.source, chosen.target, chosen.stops)
        print(f"{n_stops:,} stops, {n_centres:,} centres")  # noqa: T201  # a script


if __name__ == "__main__":
    main()
