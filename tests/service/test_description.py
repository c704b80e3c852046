"""The description of the interface: examples that its own schemas accept, problems as such."""

import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import jsonschema
import pytest

from spheremark.service.http.app import create_app
from spheremark.service.settings import Settings

DESCRIPTION = create_app(Settings()).openapi()
OPERATIONS = {
    one["operationId"]: one for path in DESCRIPTION["paths"].values() for one in path.values()
}
PROBLEM = "application/problem+json"


def valid(value, schema):
    """Check a value against a schema of the description."""
    whole = schema | {"components": DESCRIPTION["components"]}
    jsonschema.Draft202012Validator(whole).validate(value)


def contents(operation):
    """Return every body of an operation, by where it is."""
    found = {("request", kind): one for kind, one in body_of(operation).items()}
    for status, response in operation["responses"].items():
        found |= {(status, kind): one for kind, one in response.get("content", {}).items()}
        found |= {(status, name): one for name, one in response.get("headers", {}).items()}
    return found


def body_of(operation):
    """Return the bodies that an operation takes."""
    return operation.get("requestBody", {}).get("content", {})


def test_the_first_requests_may_come_at_once():
    before = sys.getswitchinterval()
    app, start = create_app(Settings()), threading.Barrier(8, timeout=60)

    def described():
        start.wait()
        return app.openapi()

    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(8) as threads:
            found = [one.result() for one in [threads.submit(described) for _ in range(8)]]
    finally:
        sys.setswitchinterval(before)
    assert all(one == DESCRIPTION for one in found)


@pytest.mark.parametrize("name", OPERATIONS)
def test_every_operation_has_examples_that_its_models_accept(name):
    operation = OPERATIONS[name]
    parameters = [one for one in operation.get("parameters", ()) if "example" in one]
    examples = {key: one for key, one in contents(operation).items() if "example" in one}
    own = {key: one for key, one in examples.items() if key[1] != PROBLEM}
    assert own or parameters, "an example of a body or of a parameter"
    for one in [*parameters, *examples.values()]:
        valid(one["example"], one.get("schema", {}))


@pytest.mark.parametrize("name", OPERATIONS)
def test_what_must_be_sent_has_an_example(name):
    operation = OPERATIONS[name]
    required = [one for one in operation.get("parameters", ()) if one.get("required")]
    assert [one["name"] for one in required if "example" not in one] == []
    for kind, body in body_of(operation).items():
        assert kind != "application/json" or "example" in body


def test_every_operation_describes_its_problems_as_such():
    for operation in OPERATIONS.values():
        assert list(operation["responses"]["default"]["content"]) == [PROBLEM]
