import csv
import io
import json
import os
import subprocess
import time
import xml.etree.ElementTree as ET

import numpy as np
import pytest
import rasterio
from fastapi.testclient import TestClient
from rasterio.transform import Affine

from spheremark.service.http.api.plan_models import MappedEvaluation
from spheremark.service.http.app import create_app
from spheremark.service.planning.predictions import Predictions
from spheremark.service.planning.searches import Searches
from spheremark.service.settings import Settings
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.files import free_bytes
from spheremark.web.pages.planner import _sheet_map
from tests.surveyed import fill

MARKS = [
    {"name": "A", "x_m": 6.5, "y_m": 0.5, "pole_height_m": 1.0},
    {"name": "B", "x_m": -1.0, "y_m": 6.5, "pole_height_m": 1.0},
    {"name": "C", "x_m": -6.5, "y_m": -3.0, "pole_height_m": 1.0},
]


@pytest.fixture(scope="module")
def client(tmp_path_factory, scheduler):
    data = tmp_path_factory.mktemp("data")
    with Catalogue(data / "spheremark.duckdb", snapshots=data / "snapshots") as catalogue:
        fill(catalogue, data / "clouds", "field", n_stops=2)
    with TestClient(
        create_app(Settings(data=data, scheduler=scheduler)), base_url="http://127.0.0.1:8000"
    ) as client:
        yield client


def evaluated(client, **plan):
    response = client.post(
        "/api/v1/plans/evaluate", json={"marks": MARKS, "model": "sensor", **plan}
    )
    response.raise_for_status()
    return response.json()


def searched(client, **kind):
    """Start a search and return it at its end."""
    begun = client.post("/api/v1/plans/searches", json=kind)
    assert begun.status_code == 202, begun.text
    for _ in range(600):
        found = client.get(begun.headers["Location"]).json()
        if found["status"] != "running":
            return found
        time.sleep(0.2)
    raise AssertionError("The search does not end.")


def refused(client, path="/api/v1/plans/evaluate", **plan):
    response = client.post(path, json={"marks": MARKS, "model": "sensor", **plan})
    assert response.status_code in (400, 404, 422), response.text
    return response.json()["detail"]


def terrain(tmp_path, heights, cell=0.5):
    path = tmp_path / "hill.tif"
    shape = {"height": heights.shape[0], "width": heights.shape[1], "count": 1, "dtype": "float32"}
    place = Affine(cell, 0.0, 0.0, 0.0, -cell, cell * heights.shape[0])
    with rasterio.open(path, "w", driver="GTiff", transform=place, nodata=-9999.0, **shape) as file:
        file.write(heights.astype(np.float32), 1)
    return path


def test_marks_of_a_response_give_the_same_response(client):
    first = evaluated(client)
    again = evaluated(
        client, marks=[{k: m[k] for k in ("name", "position_m")} for m in first["marks"]]
    )
    assert again["stops"] == first["stops"]
    assert len(first["stops"]) == 35
    assert all(0 < stop["sigma_3d_m"] < 0.03 for stop in first["stops"])


def test_a_moved_mark_is_evaluated_like_a_new_one(client):
    evaluated(client)
    moved = evaluated(client, marks=[{**MARKS[0], "x_m": 7.5}, *MARKS[1:]])
    fresh = evaluated(client, marks=[*MARKS[1:], {**MARKS[0], "x_m": 7.5}])
    assert [s["sigma_3d_m"] for s in moved["stops"]] == pytest.approx(
        [s["sigma_3d_m"] for s in fresh["stops"]], rel=1e-9
    )


def test_evaluations_are_as_documented(client):
    """The other routes check their responses themselves; a map is too large for that."""
    response = evaluated(client, field_cells=6, marks=[MARKS[0]])
    found = MappedEvaluation.model_validate(response)
    assert found.stops[0].sigma_3d_m is None
    assert found.model_dump(mode="json") == response


def test_the_interface_describes_what_every_route_of_plans_gives(client):
    interface = client.get("/api/v1/openapi.json").json()
    routes = {path: one for path, one in interface["paths"].items() if "/plans" in path}
    assert len(routes) == 10
    for path, methods in routes.items():
        for method in methods.values():
            codes = {"200", "201", "202"} & set(method["responses"])
            assert codes, path
            for code in codes:
                schema = method["responses"][code]["content"]["application/json"]["schema"]
                described = interface["components"]["schemas"][schema["$ref"].rsplit("/", 1)[-1]]
                assert described["properties"], path
                assert not described.get("additionalProperties"), path


def test_the_map_agrees_with_a_stop_that_stands_on_it(client):
    field = evaluated(client, field_cells=21)["field"]
    i, j = 10, 10
    place = {"name": "here", "x_m": field["x_m"][i], "y_m": field["y_m"][j]}
    (stop,) = evaluated(client, stops=[place])["stops"]
    assert field["sigma_3d_m"][j][i] == pytest.approx(stop["sigma_3d_m"], abs=1e-6)
    assert field["n_seen"][j][i] == len(stop["visible_marks"])


def test_a_plan_comes_as_csv_and_as_points_to_stake_out(client):
    def file(kind):
        return client.post(
            "/api/v1/plans/evaluate", json={"marks": MARKS}, headers={"Accept": kind}
        )

    rows = list(csv.DictReader(io.StringIO(file("text/csv").text)))
    assert [row["kind"] for row in rows].count("mark") == 3
    assert float(rows[0]["z_m"]) == pytest.approx(float(rows[0]["ground_m"]) + 1.0)
    place = [float(rows[0][f"{axis}_m"]) for axis in "xyz"]
    root = ET.fromstring(file("application/xml").text)
    first = next(one for one in root.iter() if one.tag.endswith("CgPoint"))
    assert [float(one) for one in first.text.split()] == pytest.approx(
        [place[1], place[0], place[2]], abs=1e-5
    )
    assert file("image/vnd.dxf").text.endswith("EOF\n")


def test_a_plan_is_geojson_only_where_the_site_has_an_origin(client):
    kind = {"Accept": "application/geo+json"}
    url, plan = "/api/v1/plans/evaluate", {"marks": MARKS}
    refused = client.post(url, json=plan, headers=kind)
    assert refused.status_code == 400
    assert "LON,LAT" in refused.json()["detail"]
    found = client.post(url, json=plan, headers=kind, params={"origin": "16.37,48.21"})
    (longitude, latitude) = found.json()["features"][0]["geometry"]["coordinates"]
    assert abs(longitude - 16.37) < 1e-3
    assert abs(latitude - 48.21) < 1e-3


def test_optimised_marks_are_better_than_those_one_began_with(client):
    plan = {"marks": MARKS, "model": "sensor", "n_marks": 3, "is_robust": False}
    best = client.post("/api/v1/plans/optimise", json=plan).json()
    assert len(best["marks"]) == 3
    assert best["worst_sigma_3d_m"] < evaluated(client)["worst_sigma_3d_m"]
    keep = [{key: mark[key] for key in ("name", "position_m")} for mark in best["marks"]]
    assert evaluated(client, marks=keep)["stops"] == best["stops"]


def test_random_plans_use_the_speeds_of_the_scans(client):
    """Coarser steps put fewer lines on spheres: larger errors of the model, fewer that pass."""
    trial = {"n_arrangements": 2_000, "error_per_axis_m": None, "model": "sensor"}

    def passed(**speeds):
        response = client.post("/api/v1/plans/random", json={**trial, **speeds})
        response.raise_for_status()
        return response.json()["pass_rate_in_window"]

    speeds = {"tolerance_m": 0.002, "step_deg": 4.0, "rest_revolutions": 1}
    assert passed(tolerance_m=0.002) > passed(**speeds) + 0.05
    query = {"n_arrangements": 2_000, "error_per_axis_mm": 0, "step_deg": 4, "rest_revolutions": 1}
    speeds = {"step_deg": 4, "rest_revolutions": 1}
    searched(client, random={"n_arrangements": 2_000, "error_per_axis_m": None, **speeds})
    page = client.get("/plan/random", params=query).text
    assert 'name="step_deg" type="number" step="any" value="4"' in page
    assert "Rests every 4 deg" in page
    assert "turn" in refused(client, "/api/v1/plans/random", marks=None, turn_s=-1)


def test_what_cannot_be_is_refused_before_it_is_searched(client):
    wanted = {"marks": [], "tolerance_m": 3e-4}
    for method in ("free_station", "paper"):
        said = refused(client, "/api/v1/plans/optimise", method=method, **wanted)
        assert "wherever they stood" in said
        assert "Ask for a larger tolerance" in said


def test_scans_that_would_take_days_are_refused(client):
    assert "1,001.0 hours" in refused(client, step_deg=0.01, rest_revolutions=1000)
    assert "hours" in refused(client, step_deg=1e-9)


def test_terrains_without_a_sensible_grid_are_refused(client):
    def said(cellsize):
        text = f"ncols 3\nnrows 3\nxllcorner 0\nyllcorner 0\ncellsize {cellsize}\n" + 3 * "1 2 3\n"
        response = client.post("/api/v1/terrains?name=grid.asc", content=text.encode())
        assert response.status_code == 400
        return response.json()["detail"]

    assert "1e+06 m wide" in said(1e6)
    assert "even grid" in said("nan")


def test_areas_keep_marks_out_and_are_kept_with_a_plan(client):
    left = [[-30, -30], [0, -30], [0, 30], [-30, 30]]
    plan = {"marks": MARKS, "model": "sensor", "keep_out_m": [left]}
    best = client.post("/api/v1/plans/optimise", json={**plan, "n_marks": 3}).json()
    assert all(mark["position_m"][0] >= 0 for mark in best["marks"])
    more = client.post("/api/v1/plans/suggest", json=plan).json()
    assert more["position_m"][0] >= 0
    kept = client.post("/api/v1/plans", json={**plan, "name": "fenced"}).json()
    page = client.get(f"/plan/{kept['placement_id']}").text
    assert "keep=-30%2C-30%3B0%2C-30%3B0%2C30%3B-30%2C30" in page
    assert "keep_out_m" in refused(client, "/api/v1/plans/optimise", keep_out_m=[left[:2]])


def test_one_more_mark_is_suggested_that_helps(client):
    answer = client.post("/api/v1/plans/suggest", json={"marks": MARKS, "model": "sensor"}).json()
    assert answer["worst_sigma_3d_m"] < answer["worst_sigma_3d_before_m"]


def test_a_stored_plan_stands_beside_its_results(client):
    kept = client.post("/api/v1/plans", json={"marks": MARKS, "name": "first", "survey": "field"})
    assert kept.status_code == 201
    found = client.get(kept.headers["Location"]).json()
    listed = client.get("/api/v1/plans", params={"survey": "field"}).json()["items"]
    assert {key: found[key] for key in listed[0]} == listed[0]
    surveyed = [stop for stop in found["stops"] if stop["run_id"]]
    assert {stop["stop"] for stop in surveyed} == {"lane3-stop1", "lane3-stop2"}
    fix = client.get("/api/v1/station-fixes", params={"fit_method": "along_beam"}).json()["items"]
    errors = {
        row["stop"]: row["error_3d_m"] for row in fix if row["resection_method"] == "free_station"
    }
    assert {stop["stop"]: stop["error_3d_m"] for stop in surveyed} == pytest.approx(errors)
    sql = "SELECT count(*), count(error_3d_m) FROM placements WHERE name = 'first'"
    answer = client.get("/api/v1/sql", params={"q": sql}).json()
    assert answer.get("rows") == [[35, 2]], answer
    page = client.get(f"/plan/{found['placement_id']}").text
    assert "Promised and achieved" in page
    assert "first" in client.get("/plan").text


def test_an_uploaded_terrain_can_be_planned_on(client, tmp_path):
    x = np.linspace(-1, 1, 61)
    path = terrain(tmp_path, 8.0 * np.exp(-40 * (x[:, None] ** 2 + x[None] ** 2)))  # a hill between
    body = path.read_bytes()
    made = client.post("/api/v1/terrains", params={"name": "hill.tif"}, content=body)
    assert made.status_code == 201, made.text
    key = made.json()["key"]
    assert key in [one["key"] for one in client.get("/api/v1/plans/sites").json()["items"]]
    places = [("E", 24.0, 15.0), ("N", 15.0, 24.0)]
    marks = [{"name": n, "x_m": px, "y_m": py, "pole_height_m": 1.0} for n, px, py in places]
    stops = [{"name": "west", "x_m": 6.0, "y_m": 15.0}]
    (stop,) = evaluated(client, site=key, marks=marks, stops=stops)["stops"]
    assert stop["visible_marks"] == ["N"]  # the hill hides the eastern one
    assert stop["sigma_3d_m"] is None
    assert stop["reason"]


def test_a_file_that_is_no_terrain_is_refused_and_not_kept(client):
    for name, body in (("hill.tif", b"no raster"), ("hill.txt", b"1 2 3")):
        answer = client.post("/api/v1/terrains", params={"name": name}, content=body)
        assert answer.status_code in (400, 415, 422), answer.text
        assert name in answer.json()["detail"] or "tif" in answer.json()["detail"]
        assert "/" not in answer.json()["detail"]  # of folders of the service nothing is told
    assert not [s for s in client.get("/api/v1/plans/sites").json()["items"] if "txt" in s["name"]]


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"marks": [{**MARKS[0], "pole_height_m": -0.5}]}, "under the ground"),
        ({"marks": [{**MARKS[0], "x_m": 1e4}]}, "off the terrain"),
        ({"marks": [{**MARKS[0], "pole_height_m": 1e300}]}, "above the ground"),
        ({"marks": [{"name": "A", "position_m": [5.0, 5.0, "nan"]}]}, "above the ground"),
        ({"stops": [{"name": "far", "x_m": 500.0, "y_m": 0.0}]}, "off the terrain"),
        ({"site": "nowhere"}, "There is no field"),
        ({"site": "terrain:" + 64 * "0"}, "There is no terrain"),
        ({"marks": [MARKS[0], MARKS[0]]}, "needs a name of its own"),
        ({"stops": []}, "no stop"),
        ({"turn_s": 0.001}, "turn"),
        ({"step_deg": -1.0}, "step"),
    ],
)
def test_what_cannot_be_planned_is_refused_with_the_reason(client, wrong, said):
    assert said in refused(client, **wrong)


def test_random_plans_come_as_json_and_as_a_page(client):
    wanted = {"n_arrangements": 3000, "n_marks_max": 5, "distance_max_m": 7.5}
    query = {**wanted, "error_per_axis_mm": 17, "seed": ""}
    assert "data-search-request" in client.get("/plan/random", params=query).text
    answer = client.post("/api/v1/plans/random", json=wanted).json()
    assert [row["n_marks"] for row in answer["by_number_of_marks"]] == [3, 4, 5]
    assert answer["pass_rate_in_window"] > answer["pass_rate_outside"]
    found = searched(client, random=wanted)
    assert found["random"] == answer
    page = client.get("/plan/random", params=query).text
    assert f"{100 * answer['pass_rate_in_window']:.1f}<small>%" in page
    ours = client.post("/api/v1/plans/random", json={**wanted, "error_per_axis_m": None}).json()
    assert ours["pass_rate"] > 0.99


def test_limits_of_random_marks_are_those_of_the_survey_that_is_named(client):
    client.post("/api/v1/surveys", json={"name": "bare"})
    wanted = {"n_arrangements": 100, "n_marks_max": 5, "tolerance_m": 0.05}
    sources = [
        client.post("/api/v1/plans/random", json={**wanted, "model": model}).json()["limits"]
        for model in ("auto", "survey:field", "survey:bare")
    ]
    assert [one["angle_source"] == "study" for one in sources] == [False, False, True]


def test_impossible_random_plans_are_refused_on_the_page(client):
    for wrong, said in (
        ({"n_marks_min": "two"}, "n_marks_min"),
        ({"tolerance_mm": "wide"}, "is not a number"),
        ({"angle_min_deg": 170, "angle_max_deg": 20}, "must ascend"),
    ):
        answer = client.get("/plan/random", params=wrong)
        assert answer.status_code == 400
        assert said in answer.text


STOPS = [{"name": "A", "x_m": 0.0, "y_m": 0.0}, {"name": "B", "x_m": 3.0, "y_m": 1.0}]
SMALL = {"model": "sensor", "stops": STOPS, "rules": {"spacing_m": 2.5}}


def test_a_search_gives_what_its_evaluation_gives_and_has_a_page(client):
    wanted = {**SMALL, "n_marks": 4, "objective": "mean", "cost_per_mark": 2, "marks": MARKS}
    found = searched(client, optimise={**wanted, "keep_marks": True, "occlusion": 0.1})
    plan = found["optimised"]
    assert found["progress_percent"] == 100
    assert plan["optimum"]["worst_sigma_3d_bound_m"] < plan["mean_sigma_3d_m"]
    assert plan["optimum"]["cost"] == 8
    names = {mark["name"]: mark["position_m"][:2] for mark in plan["marks"]}
    assert [names[mark["name"]] for mark in MARKS] == [[mark["x_m"], mark["y_m"]] for mark in MARKS]
    again = evaluated(client, stops=STOPS, marks=plan["marks"], occlusion=0.1)
    assert again["stops"] == plan["stops"]
    assert again["worst_sigma_3d_after_loss_m"] == plan["worst_sigma_3d_after_loss_m"]
    page = client.get(f"/plan/search/{found['search_id']}").text
    assert "Open in the planner" in page
    assert "Field sheet" in page
    assert found["search_id"] in [
        one["search_id"] for one in client.get("/api/v1/plans/searches").json()["items"]
    ]


def test_more_marks_and_no_weight_of_a_loss_are_better_at_the_worst_stop(client):
    wanted = {**SMALL, "n_marks": 4, "numbers": [4, 6], "loss_weights": [0.0, 1.0]}
    found = searched(client, trade_off={**wanted, "cost_per_metre": 1.0})["trade_off"]
    few, many = found["by_number"]
    assert many["worst_sigma_3d_m"] < few["worst_sigma_3d_m"]
    ignored, alone = found["by_loss_weight"]
    assert ignored["worst_sigma_3d_m"] <= alone["worst_sigma_3d_m"]
    assert alone["worst_sigma_3d_after_loss_m"] <= ignored["worst_sigma_3d_after_loss_m"]
    assert found["cheapest"] in (4, 6)


def test_a_search_that_is_dismissed_ends_and_says_so(client):
    body = {"trade_off": {"model": "sensor", "numbers": list(range(8, 20))}}
    begun = client.post("/api/v1/plans/searches", json=body).json()
    address = f"/api/v1/plans/searches/{begun['search_id']}"
    assert client.delete(address).json()["status"] == "dismissed"
    assert client.delete(address).status_code == 409
    assert client.get("/plan/search/" + begun["search_id"]).status_code == 200


def test_what_no_search_can_do_is_refused_or_fails_with_the_reason(client):
    for wrong in ({}, {"optimise": {}, "random": {}}, {"optimise": {"n_marks": 1}}):
        assert client.post("/api/v1/plans/searches", json=wrong).status_code == 422
    assert client.get("/api/v1/plans/searches/0123456789abcdef").status_code == 404
    failed = searched(client, optimise={**SMALL, "tolerance_m": 2e-5})
    assert failed["status"] == "failed"
    assert "Ask for a larger tolerance" in failed["error_reason"]


def test_a_goal_that_is_out_of_reach_after_a_loss_is_told_and_the_rest_optimised(client):
    wanted = {**SMALL, "tolerance_m": 0.0042, "most": 3}
    found = searched(client, optimise=wanted)
    assert found["status"] == "successful", found["error_reason"]
    quality = found["optimised"]["optimum"]
    assert not quality["keeps_tolerance"]
    assert "after the loss of any one" in quality["unreachable"]
    assert found["optimised"]["keeps_tolerance_95"]


def test_stops_may_move_to_better_places_and_marks_end_up_beside_theirs(client):
    rules = {"spacing_m": 2.5, "placement_m": 0.2}
    wanted = {**SMALL, "rules": rules, "n_marks": 3}
    still = searched(client, optimise=wanted)["optimised"]
    moved = searched(client, optimise={**wanted, "stop_reach_m": 1.0})["optimised"]
    assert moved["worst_sigma_3d_m"] < still["worst_sigma_3d_m"]
    for stop, given in zip(moved["stops"], STOPS, strict=True):
        off = np.array(stop["position_m"][:2]) - [given["x_m"], given["y_m"]]
        assert np.hypot(*off) <= 1.0 + 1e-3
    assert still["optimum"]["worst_sigma_3d_as_placed_m"] > still["worst_sigma_3d_m"]


def test_the_map_of_a_mark_shows_from_where_it_is_found(client):
    field = evaluated(client, field_cells=21, viewshed_of="A")["field"]
    assert 1 in np.unique(field["viewshed"])
    assert (np.array(field["viewshed"]) <= np.array(field["n_seen"])).all()


def test_the_field_sheet_of_an_address_holds_coordinates_and_distances(client):
    query = {"a": "A:6.5,0.5,1;B:-1,6.5,1;C:-6.5,-3,1", "model": "sensor"}
    query["stops"] = "S1:0.5,0.5;S2:3,1"
    page = client.get("/plan/sheet", params=query).text
    for text in ("Field sheet: 3 marks", "6.000", "90.0", "Stake-out"):
        assert text in page
    assert client.get("/plan/sheet").status_code == 400


@pytest.mark.parametrize(("x", "y"), [(30_000.0, 5.0), (3.0, 1e6)])
def test_the_map_of_a_field_sheet_has_few_lines_however_long_a_field_is(x, y):
    places = [{"name": "A", "position_m": [0.0, 0.0]}, {"name": "B", "position_m": [x, y]}]
    found = _sheet_map({"marks": places, "stops": []})
    assert max(found["width"], found["height"]) == pytest.approx(640.0)
    assert 0 < len(found["lines"]) < 40


def test_a_stop_that_sees_nothing_says_so(client):
    answer = evaluated(client, marks=[])
    assert all(stop["sigma_3d_m"] is None and stop["reason"] for stop in answer["stops"])
    assert answer["worst_sigma_3d_m"] is None


def test_a_plan_that_takes_longer_than_its_request_waits_is_a_search_with_an_address(client):
    wanted = {**SMALL, "n_marks": 4, "is_robust": False}
    begun = client.post("/api/v1/plans/optimise", json=wanted, headers={"Prefer": "respond-async"})
    assert begun.status_code == 202
    assert begun.json()["search_id"] == begun.headers["Location"].rpartition("/")[2]
    for _ in range(600):
        found = client.get(begun.headers["Location"]).json()
        if found["status"] != "running":
            break
        time.sleep(0.2)
    assert found["optimised"] == client.post("/api/v1/plans/optimise", json=wanted).json()
    trial = {"n_arrangements": 100_000, "model": "sensor"}
    soon = client.post("/api/v1/plans/random", json=trial, headers={"Prefer": "wait=0"})
    assert soon.status_code == 202
    client.delete(soon.headers["Location"])


@pytest.fixture
def disk(tmp_path):
    """A data folder whose searches are on a disk of 1 MB."""
    searches = tmp_path / "searches"
    searches.mkdir()
    made = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", searches]
    if subprocess.run(made, capture_output=True, check=False).returncode:
        pytest.skip("NOT TESTED: a full disk; no file system can be mounted")
    yield tmp_path
    subprocess.run(["umount", "--lazy", searches], check=True)


def test_a_search_that_ends_on_a_full_disk_keeps_its_result(disk, scheduler):
    settings = Settings(data=disk, scheduler=scheduler)
    kind, filling = {"optimise": {**SMALL, "n_marks": 4}}, disk / "searches" / "filling"
    with TestClient(create_app(settings), base_url="http://127.0.0.1:8000") as client:
        begun = client.post("/api/v1/plans/searches", json=kind)
        with filling.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, free_bytes(filling))
        refused = client.post("/api/v1/plans/searches", json=kind)
        assert (refused.status_code, refused.json()["code"]) == (507, "storage.full")
        address, deadline = begun.headers["Location"], time.monotonic() + 120.0
        while (found := client.get(address).json())["status"] == "running":
            assert time.monotonic() < deadline
            time.sleep(0.2)
        assert (found["status"], found["error_reason"]) == ("successful", None)
        assert found["optimised"]
        ours = f"{found['search_id']}.json"
        left = {one.name for one in filling.parent.iterdir()}
        assert left - {ours.replace("json", "progress")} == {"filling", ours}
        filling.unlink()
        assert client.get(address).json() == found
    with TestClient(create_app(settings), base_url="http://127.0.0.1:8000") as client:
        assert client.get(address).json() == found


def test_a_damaged_search_is_kept_apart_and_an_interrupted_one_has_failed(tmp_path):
    searches = Searches(
        Predictions(n_processes=1, seconds=10.0, memory_bytes=2**30), tmp_path / "searches"
    )
    searches.open()
    (tmp_path / "searches" / "00000000000000aa.json").write_text("{")
    open_one = {"search_id": "00000000000000bb", "status": "running", "created_at": "2026-01-01"}
    (tmp_path / "searches" / "00000000000000bb.json").write_text(json.dumps(open_one))
    searches.open()
    assert (tmp_path / "searches" / "00000000000000aa.damaged").read_text() == "{"
    (found,) = searches.list()
    assert (found["status"], found["error_code"]) == ("failed", "interrupted")
