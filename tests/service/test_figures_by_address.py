"""Figures and tables by address: the same numbers drawn, as files, and as queries."""

import csv
import io
import json
from datetime import timedelta

import pyarrow.parquet as pq
import pytest
from fastapi.testclient import TestClient

from spheremark.service.http.app import create_app
from spheremark.service.settings import Settings
from spheremark.storage.catalogue.catalogue import Catalogue
from tests.surveyed import NOW, fill

FIGURES = (
    *("distance", "count", "incidence", "angle", "distribution", "surveys", "map"),
    *("solution", "heights"),
)
HTML = {"accept": "text/html"}


@pytest.fixture(scope="module")
def client(tmp_path_factory, scheduler):
    data = tmp_path_factory.mktemp("data")
    with Catalogue(data / "spheremark.duckdb", snapshots=data / "snapshots") as catalogue:
        fill(catalogue, data / "clouds", "a?b & c", n_stops=1, with_truth=False, lane="a/b<i>")
        fill(catalogue, data / "clouds", "field", n_stops=2, at=NOW + timedelta(days=1))
    with TestClient(create_app(Settings(data=data, scheduler=scheduler))) as client:
        yield client


def get(client, path, **query):
    response = client.get(f"/api/v1/{path}", params=query)
    assert response.status_code == 200, response.text[-2000:]
    return response


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_has_its_data_as_files_and_the_query_that_made_them(client, name):
    drawn = get(client, f"figures/{name}.json", survey="field").json()
    assert drawn["title"] in json.dumps(drawn["figure"])
    rows = list(
        csv.DictReader(io.StringIO(get(client, f"figures/{name}.csv", survey="field").text))
    )
    table = pq.read_table(
        io.BytesIO(get(client, f"figures/{name}.parquet", survey="field").content)
    )
    assert len(rows) == table.num_rows == drawn["n_rows"]
    sql = get(client, f"figures/{name}.sql", survey="field").text
    answer = client.post("/api/v1/sql", json={"sql": sql}).json()
    assert len(answer["rows"]) == drawn["n_rows"]


def test_medians_are_links_to_their_bins_and_dots_to_their_markers(client):
    drawn = get(client, "surveys/field/figures/distance.json").json()["figure"]["data"]
    links = [link for trace in drawn for link in trace.get("ids", ())]
    assert any(link.startswith("?range_from_m=") for link in links)
    dots = [link for link in links if link.startswith("/")]
    assert dots
    for link in dots[:3]:
        assert "marker=M" in link
        assert client.get(link, headers=HTML).status_code == 200


def test_rows_link_to_stops_whatever_their_names_are(client):
    rows = get(client, "tables/centres.json", survey="a?b & c").json()["items"]
    assert client.get(rows[0]["href"], headers=HTML).status_code == 200


def test_a_table_is_sorted_and_read_in_parts(client):
    first = get(client, "tables/centres.json", sort="-error_3d_m", limit=10).json()
    assert first["n_all"] == 84
    second = get(
        client, "tables/centres.json", sort="-error_3d_m", limit=10, after=first["next"]
    ).json()
    found = [row["error_3d_m"] for row in first["items"] + second["items"]]
    assert found == sorted(found, reverse=True)
    assert len({row["href"] for row in first["items"] + second["items"]}) == 20


@pytest.mark.parametrize("table", ["centres", "stops", "surveys"])
def test_a_table_as_a_file_has_all_its_rows(client, table):
    n_all = get(client, f"tables/{table}.json").json()["n_all"]
    rows = list(csv.DictReader(io.StringIO(get(client, f"tables/{table}.csv").text)))
    assert len(rows) == n_all
    sql = get(client, f"tables/{table}.sql").text
    answer = client.post("/api/v1/sql", json={"sql": sql}).json()
    assert len(answer["rows"]) == n_all
    table = pq.read_table(io.BytesIO(get(client, f"tables/{table}.parquet").content))
    assert [column["name"] for column in answer["columns"]] == table.column_names


def test_a_query_without_an_upper_limit_can_be_run(client):
    sql = get(client, "figures/distance.sql", survey="field", range_to_m="inf").text
    assert client.post("/api/v1/sql", json={"sql": sql}).json()["rows"]


def test_limits_hold_the_confidence_that_few_stops_cannot_give(client):
    body = get(client, "accuracy/limits", survey="field").json()
    ours = next(row for row in body["items"] if row["fit_method"] == "along_beam")
    assert ours["reach_m"] > 8.0
    assert ours["reach_confident_m"] == 0.0
    assert ours["n_stops"] < ours["n_stops_needed"]
    assert "±" not in ours["model"] or "to the power" in ours["model"]


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("figures/nothing.json", 404),
        ("figures/distance.json?survey=nothing", 404),
        ("figures/distance.txt", 422),
        ("figures/distance.json?status=bogus", 422),
        ("figures/distance.json?surveyy=field", 422),
        ("tables/nothing.json", 404),
        ("tables/centres.json?sort=nothing", 400),
    ],
)
def test_what_does_not_exist_is_refused_by_name(client, path, status):
    response = client.get(f"/api/v1/{path}")
    assert response.status_code == status
    assert response.json()["detail"]


@pytest.mark.parametrize("path", ["tables/nothing", "tables/distance", "figures/centres"])
@pytest.mark.parametrize("form", ["json", "sql"])
def test_a_figure_is_no_table_and_a_table_no_figure(client, path, form):
    response = client.get(f"/api/v1/{path}.{form}")
    kind, name = path.split("s/")
    assert response.status_code == 404
    assert f"There is no {kind} {name!r}" in response.json()["detail"]


@pytest.mark.parametrize("path", ["/accuracy", "/surveys/field/accuracy?range_from_m=5"])
def test_a_dashboard_holds_addresses_and_no_rows(client, path):
    response = client.get(path, headers=HTML)
    assert response.status_code == 200
    assert "/api/v1/figures/distance.json" in response.text
    assert len(response.content) < 20_000
