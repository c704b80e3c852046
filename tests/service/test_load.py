"""The load test of pages: its database is larger, and no page grows with it."""

from fastapi.testclient import TestClient

from spheremark.service.bench.load import make
from spheremark.service.http.app import create_app
from spheremark.service.settings import DATABASE, Settings
from spheremark.storage.catalogue.catalogue import Catalogue
from tests.surveyed import fill


def test_pages_of_many_stops_are_as_small_as_those_of_few(tmp_path, scheduler):
    source, target = tmp_path / "small", tmp_path / "large"
    with Catalogue(source / DATABASE, snapshots=source / "snapshots") as catalogue:
        fill(catalogue, source / "clouds", "field", n_stops=2)
    assert make(source, target, 2_000) == (2_000, 56_000)
    with TestClient(create_app(Settings(data=target, scheduler=scheduler))) as client:
        for path in ("/accuracy", "/surveys/load-test-7/accuracy", "/surveys/field/accuracy"):
            assert len(client.get(path, headers={"accept": "text/html"}).content) < 50_000
        for path in ("figures/distance.json", "figures/map.json", "tables/stops.json"):
            response = client.get(f"/api/v1/{path}")
            assert response.status_code == 200
            assert len(response.content) < 600_000
        assert client.get("/api/v1/tables/centres.json").json()["n_all"] == 56_000
