"""Stops in one frame: poses, spheres and refused groups, and clouds node by node."""

import pytest
from fastapi.testclient import TestClient

from spheremark.service.http.app import create_app
from spheremark.service.settings import Settings
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.clouds.octree import BYTES_PER_POINT
from tests.surveyed import fill, marks

HTML = {"accept": "text/html"}


@pytest.fixture(scope="module")
def client(tmp_path_factory, scheduler):
    data = tmp_path_factory.mktemp("data")
    with Catalogue(data / "spheremark.duckdb", snapshots=data / "snapshots") as catalogue:
        fill(catalogue, data / "clouds", "field", n_stops=2)
    with TestClient(create_app(Settings(data=data, scheduler=scheduler))) as client:
        yield client


@pytest.fixture(scope="module")
def scene(client):
    return client.get("/api/v1/surveys/field/scene").json()


def test_spheres_of_all_stops_meet_at_the_marks(scene):
    known = dict(zip(marks().names, marks().p_site, strict=True))
    assert len(scene["spheres"]) == 28
    for one in scene["spheres"]:
        stop = scene["stops"][one["place"]]
        rows = [stop["rotation"][i : i + 3] for i in (0, 3, 6)]
        p = [one[f"{axis}_m"] for axis in "xyz"]
        at = [
            sum(a * b for a, b in zip(row, p, strict=True)) + shift
            for row, shift in zip(rows, stop["position_m"], strict=True)
        ]
        assert at == pytest.approx(known[one["mark"]], abs=0.02)
        assert scene["refused"][0]["reason"] == "Not round: a rock."


def test_the_nodes_hold_all_points_of_the_cloud(client, scene):
    stop = scene["stops"][0]
    key = {"run": stop["run_id"], "stop": stop["stop"]}
    index = client.get("/api/v1/clouds/octree", params=key).json()
    assert index["n_returns"] == stop["n_returns"]
    n = 0
    for node in index["nodes"]:
        response = client.get(f"/api/v1/clouds/octree/{node}", params=key)
        assert "immutable" in response.headers["cache-control"]
        n += len(response.content)
    assert n == index["n_points"] * BYTES_PER_POINT


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("surveys/field/scene?stop=nowhere", 404),
        ("surveys/nothing/scene", 404),
        ("clouds/octree?run=x&stop=y", 422),
        ("clouds/octree/../x?run=x&stop=y", 404),
        ("clouds/octree/r9?run=x&stop=y", 422),
    ],
)
def test_what_is_not_there_is_refused(client, path, status):
    response = client.get(f"/api/v1/{path}")
    assert response.status_code == status


def test_the_page_names_its_scene(client):
    text = client.get("/surveys/field/cloud?stop=lane3-stop2", headers=HTML).text
    assert "/api/v1/surveys/field/scene?method=along_beam&amp;stop=lane3-stop2" in text
