"""Every operation against requests that its description allows, and ones that it does not."""

import json
from functools import cache

import hypothesis
import pytest
import requests
import schemathesis
from fastapi.testclient import TestClient
from hypothesis import HealthCheck, Phase
from schemathesis.generation import GenerationMode

from spheremark.service.http.app import create_app
from spheremark.service.http.security import HEADERS
from spheremark.service.settings import Settings

CHECKS = [
    getattr(schemathesis.checks, name)
    for name in (
        "not_a_server_error",
        "status_code_conformance",
        "content_type_conformance",
        "response_schema_conformance",
    )
]
schemathesis.serializer.alias("application/offset+octet-stream", "application/octet-stream")
HOST = "http://127.0.0.1:8000"
N_REQUESTS = 15  # of each operation and mode
DESCRIPTION = create_app(Settings()).openapi()
OPERATIONS = [
    found.ok()
    for found in schemathesis.openapi.from_dict(DESCRIPTION).get_all_operations()
    if "text/event-stream" not in json.dumps(found.ok().definition.raw)  # they do not end
]
SEARCHES = [f"POST /api/v1/plans/{name}" for name in ("optimise", "random")]  # may take minutes
NO_WRONG = hypothesis.errors.Unsatisfiable  # every request of the operation is right


@pytest.fixture(scope="module")
def client(tmp_path_factory, scheduler):
    app = create_app(Settings(data=tmp_path_factory.mktemp("data"), scheduler=scheduler))
    with TestClient(app, base_url=HOST, raise_server_exceptions=False) as client:
        yield client


@pytest.fixture(scope="module")
def code_of(client):
    """Return the code that the page of a type of problem is about."""
    return cache(lambda page: client.get(page).json()["code"])


@pytest.mark.slow
@pytest.mark.parametrize("mode", [GenerationMode.POSITIVE, GenerationMode.NEGATIVE])
@pytest.mark.parametrize("operation", OPERATIONS, ids=lambda one: one.label)
def test_no_request_fails_the_service_or_gets_what_is_not_described(
    client, code_of, operation, mode
):
    @hypothesis.seed(2)
    @hypothesis.given(case=operation.as_strategy(generation_mode=mode))
    @hypothesis.settings(
        max_examples=N_REQUESTS,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    def check(case):
        arguments = case.as_transport_kwargs(base_url=HOST)
        arguments.pop("cookies", None)
        sent = requests.Request(**arguments).prepare()
        if operation.label in SEARCHES:
            # the first wait holds; without one, whatever else is preferred waits for 90 s
            sent.headers["Prefer"] = f"wait=2, {sent.headers.get('Prefer', '')}"
        hypothesis.assume(len(sent.url) < 60_000)  # the most that this client sends
        answer = client.request(
            sent.method, sent.url, content=sent.body, headers=dict(sent.headers)
        )
        for name, value in HEADERS.items():
            assert answer.headers[name] == value
        case.validate_response(answer, checks=CHECKS)
        if operation.label in SEARCHES and answer.status_code == 202:
            client.delete(answer.headers["Location"])
        if answer.status_code >= 400 and sent.method != "HEAD":  # which has no body
            problem = answer.json()
            assert code_of(problem["type"]) == problem["code"]

    try:
        check()
    except NO_WRONG:
        assert mode is GenerationMode.NEGATIVE


@pytest.mark.slow
def test_a_plan_that_is_found_while_its_request_waits_is_as_described(client):
    (operation,) = (one for one in OPERATIONS if one.label == SEARCHES[0])
    stops = [{"name": "A", "x_m": 0.0, "y_m": 0.0}, {"name": "B", "x_m": 3.0, "y_m": 1.0}]
    plan = {"model": "sensor", "stops": stops, "rules": {"spacing_m": 2.5}, "n_marks": 4}
    answer = client.post(operation.path, json=plan)
    assert answer.status_code == 200, answer.text
    case = operation.Case(body=plan, media_type="application/json")
    case.validate_response(answer, checks=CHECKS)
