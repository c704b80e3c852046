"""Queries by address: formats, parameters, and names under which they are kept."""

import io
import json
import threading
import time
from contextlib import contextmanager

import pandas as pd
import pyarrow as pa
import pytest
import uvicorn
from fastapi.testclient import TestClient
from pyarrow import ipc, parquet

from spheremark.service.client import Client
from spheremark.service.http.app import create_app
from spheremark.service.settings import Settings
from spheremark.storage.catalogue.catalogue import Catalogue
from tests.service.test_commands import run
from tests.surveyed import fill

API = "/api/v1/sql"
SQL = """
SELECT 1::SMALLINT AS n, 0.5 AS x, 'a' AS name, TIMESTAMP '2026-01-02 03:04:05.5' AS t,
    TIMESTAMPTZ '2026-01-02 03:04:05+00' AS z, [1, 2] AS l, DATE '2026-01-02' AS d,
    NULL::DOUBLE AS gone
"""
HOST = "http://127.0.0.1:8000"


@pytest.fixture(scope="module")
def client(tmp_path_factory, scheduler):
    data = tmp_path_factory.mktemp("data")
    with Catalogue(data / "spheremark.duckdb", snapshots=data / "snapshots") as catalogue:
        fill(catalogue, data / "clouds", "field", n_stops=2)
    with TestClient(create_app(Settings(data=data, scheduler=scheduler)), base_url=HOST) as one:
        yield one


@contextmanager
def served(app):
    """Serve an application on a port of its own."""
    server = uvicorn.Server(uvicorn.Config(app, port=0, log_level="error"))
    thread = threading.Thread(target=server.run)
    thread.start()
    while thread.is_alive() and not server.started:
        time.sleep(0.05)
    yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    server.should_exit = True
    thread.join(timeout=120)


def get(client, status=200, **query):
    """Run a query of an address."""
    response = client.get(API, params=query)
    assert response.status_code == status, response.text
    return response


def test_an_address_gives_parquet_with_the_types_of_the_columns(client):
    table = parquet.read_table(io.BytesIO(get(client, q=SQL, format="parquet").content))
    assert table.schema.field("n").type == pa.int16()
    assert table.schema.field("t").type == pa.timestamp("us")
    assert table.schema.field("z").type == pa.timestamp("us", "UTC")
    row = table.to_pylist()[0]
    assert row["t"].microsecond == 500_000
    assert (row["l"], row["d"], row["gone"]) == ("[1, 2]", "2026-01-02", None)
    assert table.schema.metadata[b"truncated"] == b"false"


def test_arrow_csv_and_json_have_the_same_rows(client):
    sql = "SELECT stop, sigma_3d_m FROM latest_station_fixes ORDER BY ALL"
    arrow = ipc.open_stream(get(client, q=sql, format="arrow").content).read_all().to_pylist()
    csv = pd.read_csv(io.StringIO(get(client, q=sql, format="csv").text)).to_dict("records")
    plain = [
        dict(zip(("stop", "sigma_3d_m"), row, strict=True))
        for row in get(client, q=sql).json()["rows"]
    ]
    assert plain == arrow
    assert csv == [pytest.approx(row) for row in arrow]


def test_an_empty_result_has_its_columns(client):
    found = get(client, q="SELECT stop FROM stops WHERE false", format="parquet")
    assert parquet.read_table(io.BytesIO(found.content)).column_names == ["stop"]


def test_a_file_says_that_it_was_cut(client):
    found = get(client, q="SELECT * FROM range(20000)", format="parquet")
    assert found.headers["x-truncated"] == "true"
    table = parquet.read_table(io.BytesIO(found.content))
    assert table.schema.metadata[b"truncated"] == b"true"
    assert table.num_rows == int(found.headers["x-row-limit"])


def test_parameters_of_an_address_are_values_and_no_sql(client):
    text = "x'); DROP TABLE runs; --"
    rows = get(client, q="SELECT $a AS a, $b + 1 AS b", p=[f"a={text}", "b=2.5"]).json()["rows"]
    assert rows == [[text, 3.5]]
    assert get(client, 422, q="SELECT 1", name="both").json()["code"] == "input.validation"
    assert "name=value" in get(client, 400, q="SELECT $a", p="a").json()["detail"]
    deep = "[" * 6000  # more than a parser of JSON descends
    assert get(client, q="SELECT $a AS a", p=f"a={deep}").json()["rows"] == [[deep]]


def test_more_parameters_than_a_query_has_are_refused(client):
    given = [f"a{i}={i}" for i in range(51)]
    assert get(client, 422, q="SELECT 1", p=given).json()["code"] == "input.validation"
    kept = {"sql": "SELECT $kept", "parameters": {"kept": 0}}
    client.put("/api/v1/queries/one more", json=kept).raise_for_status()
    refused = get(client, 422, name="one more", p=given[:50]).json()
    assert refused["errors"][0]["field"] == "query.parameters"
    client.delete("/api/v1/queries/one more").raise_for_status()


@pytest.mark.parametrize("instant", ["290000-01-01", "infinity", "0044-03-15 (BC)"])
def test_an_instant_that_files_do_not_have_is_refused_with_its_column(client, instant):
    sql = f"SELECT '{instant}'::TIMESTAMP AS t"
    assert "'t'" in get(client, 400, q=sql, format="parquet").json()["detail"]
    assert get(client, q=sql, format="csv").text.startswith("t")


def test_a_query_that_is_kept_is_shared_by_its_name(client):
    sql = "SELECT stop FROM latest_station_fixes WHERE sigma_3d_m > $least ORDER BY ALL"
    kept = client.put(
        "/api/v1/queries/Weak stations", json={"sql": sql, "parameters": {"least": 0}}
    )
    assert kept.json()["parameters"] == {"least": 0}
    assert len(get(client, name="Weak stations").json()["rows"]) > 0
    assert get(client, name="Weak stations", p="least=10").json()["rows"] == []
    names = [one["name"] for one in client.get("/api/v1/queries").json()["items"]]
    assert names == ["Weak stations"]
    page = client.get("/sql", params={"name": "Weak stations"}).text
    assert "latest_station_fixes WHERE sigma_3d_m &gt; $least" in page
    assert client.delete("/api/v1/queries/Weak stations").status_code == 204
    assert get(client, 422, name="Weak stations").json()["code"] == "input.unknown"


def test_the_client_takes_parameters(client):
    found = Client(http=client).query("SELECT $a::INT AS a", a=7)
    assert found["a"].tolist() == [7]


def test_explain_gives_the_plan(client):
    found = get(client, q="EXPLAIN SELECT stop FROM stops WHERE n_returns > 3").json()
    assert "stops" in found["rows"][0][-1]


def test_a_folder_in_use_offers_the_service_that_has_it(tmp_path):
    with Catalogue(tmp_path / "spheremark.duckdb", snapshots=tmp_path / "snapshots"):
        done = run("query", "SELECT 1", "--data", tmp_path, code=1, SPHEREMARK_PORT="1")
    assert "--server" in done.stderr


def test_an_error_names_the_file(tmp_path):
    log = tmp_path / "bad.mcap"
    log.write_bytes(b"no log at all" * 9)
    assert "bad.mcap" in run("process", log, code=1).stderr
    assert "bad.mcap" in run("adjust", log, code=1).stderr


def test_jobs_of_a_service_are_listed_and_followed(tmp_path, scheduler):
    with Catalogue(tmp_path / "spheremark.duckdb", snapshots=tmp_path / "snapshots") as catalogue:
        fill(catalogue, tmp_path / "clouds", "field", n_stops=1)
    app = create_app(Settings(data=tmp_path, scheduler=scheduler))
    with served(app) as address:
        listed = run("jobs", "--server", address)
        assert "process lane3-stop1" in listed.stdout
        assert max(map(len, listed.stdout.splitlines())) <= 80
        (job,) = json.loads(run("jobs", "--follow", "--json", "--server", address).stdout)
        assert job["status"] == "successful"
        assert "one is expected" in run("jobs", "zz", "--server", address, code=1).stderr
