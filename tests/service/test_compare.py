"""Two results side by side, by their address: runs, networks, rigs, methods and plans."""

from datetime import timedelta

import pytest
from fastapi.testclient import TestClient

from spheremark.service.http.app import create_app
from spheremark.service.settings import Settings
from spheremark.storage.catalogue.catalogue import Catalogue
from tests.surveyed import NOW, fill

HTML = {"accept": "text/html"}


@pytest.fixture(scope="module")
def client(tmp_path_factory, scheduler):
    data = tmp_path_factory.mktemp("data")
    with Catalogue(data / "spheremark.duckdb", snapshots=data / "snapshots") as catalogue:
        fill(catalogue, data / "clouds", "field", n_stops=7)
        fill(catalogue, data / "clouds", "again", n_stops=1, at=NOW + timedelta(days=1))
    with TestClient(create_app(Settings(data=data, scheduler=scheduler))) as client:
        yield client


def compare(client, a, b):
    response = client.get("/api/v1/compare", params={"a": a, "b": b})
    assert response.status_code == 200, response.text[-2000:]
    assert client.get("/compare", params={"a": a, "b": b}, headers=HTML).status_code == 200
    return response.json()


def runs(client):
    return [f"run:{one['run_id']}" for one in client.get("/api/v1/runs").json()["items"]]


def test_a_run_does_not_differ_from_itself(client):
    run = runs(client)[0]
    found = compare(client, run, run)
    assert found["rows"]
    assert all(row["difference_3d_m"] == 0.0 and not row["is_significant"] for row in found["rows"])
    assert found["settings"] == []


def test_runs_of_one_stop_differ_by_what_their_covariances_allow(client):
    ids = client.get("/api/v1/runs").json()["items"]
    names = {one["run_id"]: one for one in ids}
    stops = {
        run: client.get("/api/v1/station-fixes", params={"run": run}).json()["items"][0]["stop"]
        for run in names
    }
    one, other = [f"run:{run}" for run, stop in stops.items() if stop == "lane3-stop1"]
    found = compare(client, one, other)
    assert {row["name"] for row in found["rows"]} == {
        "lane3-stop1, along beam",
        "lane3-stop1, paper",
    }
    assert "common points differ by" in found["summary"]


def test_methods_are_compared_stop_by_stop(client):
    found = compare(client, "method:field/along_beam", "method:field/paper")
    assert len(found["rows"]) == 7
    assert all(row["difference_m"] > 0.01 for row in found["rows"])
    assert "95 % confidence" in found["summary"]


@pytest.mark.parametrize(
    ("a", "b", "status"),
    [
        ("run:none", "run:none", 422),
        ("network:none", "network:none", 422),
        ("rig:none", "rig:none", 422),
        ("plan:none", "plan:none", 422),
        ("method:field/none", "method:field/paper", 422),
        ("nothing", "run:x", 400),
        ("run:x", "plan:y", 400),
    ],
)
def test_what_cannot_be_compared_is_refused(client, a, b, status):
    response = client.get("/api/v1/compare", params={"a": a, "b": b})
    assert response.status_code == status
    assert response.json()["detail"]


def test_the_page_offers_what_there_is(client):
    text = client.get("/compare", headers=HTML).text
    assert "method:field/along_beam" in text
    assert "Nothing chosen yet" in text


def test_results_of_a_deleted_survey_are_not_offered(client):
    (run,) = client.get("/api/v1/runs", params={"survey": "again"}).json()["items"]
    assert ">again</a>" in client.get("/live", headers=HTML).text
    key = client.delete("/api/v1/surveys/again").json()["survey_id"]
    assert run["run_id"] not in client.get("/compare", headers=HTML).text
    assert f"(deleted {key})" not in client.get("/live", headers=HTML).text
    client.post(f"/api/v1/surveys/{key}/restoration").raise_for_status()
    assert run["run_id"] in client.get("/compare", headers=HTML).text
