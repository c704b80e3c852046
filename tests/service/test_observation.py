"""What an operator sees: ids, lines of the log, and metrics."""

import io
import json
import logging

import pytest
from fastapi.testclient import TestClient
from prometheus_client.parser import text_string_to_metric_families

from spheremark.service import logs
from spheremark.service.http.app import create_app
from spheremark.service.settings import Settings


@pytest.fixture
def log():
    """Return what is logged as JSON from here on."""
    text = io.StringIO()
    handler = logging.StreamHandler(text)
    handler.setFormatter(logs._Json())
    logging.getLogger("spheremark").addHandler(handler)
    yield lambda: [json.loads(line) for line in text.getvalue().splitlines()]
    logging.getLogger("spheremark").removeHandler(handler)


@pytest.fixture(scope="module")
def client(tmp_path_factory, scheduler):
    data = tmp_path_factory.mktemp("data")
    settings = Settings(data=data, scheduler=scheduler, log_format="json", sql_seconds=0.3)
    app = create_app(settings)
    with TestClient(app, base_url="http://127.0.0.1", raise_server_exceptions=False) as client:
        yield client


def metrics(client):
    """Return all samples by name and labels."""
    answer = client.get("/metrics")
    assert answer.headers["content-type"].startswith("text/plain; version=")
    families = text_string_to_metric_families(answer.text)
    samples = [one for family in families for one in family.samples]
    return {(one.name, *sorted(one.labels.items())): one.value for one in samples}


def test_every_request_has_an_id_in_its_response_and_its_line(client, log):
    answer = client.get("/api/v1/surveys?token=private", headers={"X-Request-Id": "of-the-proxy"})
    assert answer.headers["x-request-id"] == "of-the-proxy"
    other = client.get("/nowhere", headers={"X-Request-Id": "not an id\x7f"})
    assert len(other.headers["x-request-id"]) == 16
    first, second = [line for line in log() if "path" in line]
    assert (first["request"], first["path"], first["status"]) == (
        *("of-the-proxy", "/api/v1/surveys"), 422,
    )  # fmt: skip
    assert "private" not in str(first)
    assert second["request"] == other.headers["x-request-id"]


def test_each_5xx_is_logged_with_its_reason_and_id(client, log):
    endless = "SELECT sum(hash(a.range * b.range)) FROM range(1000000000) a, range(1000000) b"
    late = client.post("/api/v1/sql", json={"sql": endless})
    service, client.app.state.service = client.app.state.service, None
    broken = client.get("/api/v1/surveys")
    client.app.state.service = service
    assert (late.status_code, broken.status_code) == (504, 500)
    reasons = {line["request"]: line for line in log() if line["level"] == "error"}
    assert "time limit" in reasons[late.headers["x-request-id"]]["message"]
    assert "AttributeError" in reasons[broken.headers["x-request-id"]]["traceback"]


def test_metrics_count_responses_by_route_and_show_the_parts(client):
    def count(found, status):
        return sum(
            value
            for (name, *labels), value in found.items()
            if name == "spheremark_responses_total"
            and ("route", "get_survey") in labels
            and ("status", status) in labels
        )

    before = metrics(client)
    for name in ("a", "b", "c"):
        client.get(f"/api/v1/surveys/{name}")
    found = metrics(client)
    assert count(found, "404") - count(before, "404") == 3
    assert found["spheremark_jobs", ("state", "running")] == 0
    assert found["spheremark_requests_in_place", ("kind", "queries")] == 0
    assert found["spheremark_workers",] in (0, 1)
    assert found["process_resident_memory_bytes",] > 1e6


def test_a_job_is_named_in_its_lines():
    record = logging.makeLogRecord({"msg": "Job ended: %s", "args": ("failed",), "job": "ab12"})
    assert json.loads(logs._Json().format(record))["job"] == "ab12"
    assert logs._Text("%(message)s").format(record).endswith("Job ended: failed [job ab12]")
