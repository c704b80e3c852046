"""Tokens: who may do what, and what of it is kept."""

import json

import pytest
from fastapi.testclient import TestClient
from typer.testing import CliRunner

from spheremark.pipelines.errors import ConflictError, InputError, NotFoundError
from spheremark.service.cli.main import app
from spheremark.service.http.app import create_app
from spheremark.service.http.security import scope_of
from spheremark.service.settings import Settings
from spheremark.service.tokens import Scope, Tokens

OWN = "A-secret-of-32-characters-at-least"


def bearer(text):
    return {"Authorization": f"Bearer {text}"}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="module")
def texts(data):
    tokens = Tokens(data)
    return {scope: tokens.make(f"{scope} token", scope) for scope in Scope}


@pytest.fixture(scope="module")
def client(data, texts, scheduler):
    assert len(texts) == len(Scope)
    settings = Settings(data=data, scheduler=scheduler, host="0.0.0.0", token=OWN)
    with TestClient(create_app(settings), base_url="http://rover.example") as client:
        yield client


def test_only_what_is_open_answers_without_a_token(client):
    refused = client.get("/api/v1/surveys")
    assert (refused.status_code, refused.headers["www-authenticate"]) == (401, "Bearer")
    assert client.get("/api/v1/surveys", headers=bearer("wrong")).status_code == 401
    assert client.get("/healthz").status_code == 200


@pytest.mark.parametrize(
    ("scope", "read", "query", "write", "audit"),
    [("read", 200, 200, 403, 403), ("write", 200, 200, 201, 403), ("admin", 200, 200, 201, 200)],
)
def test_a_scope_allows_what_it_says(client, texts, scope, read, query, write, audit):
    headers = bearer(texts[scope])
    assert client.get("/api/v1/surveys", headers=headers).status_code == read
    sql = {"sql": "SELECT 1"}
    assert client.post("/api/v1/sql", json=sql, headers=headers).status_code == query
    new = {"name": f"by {scope}"}
    assert client.post("/api/v1/surveys", json=new, headers=headers).status_code == write
    assert client.get("/api/v1/audit", headers=headers).status_code == audit


def test_the_audit_log_names_the_token_of_what_was_written_and_no_secret(client, data, texts):
    client.post("/api/v1/surveys", json={"name": "noted"}, headers=bearer(texts["write"]))
    (newest, *_) = client.get("/api/v1/audit", headers=bearer(OWN)).json()["items"]
    assert (newest["token"], newest["path"]) == ("write token", "/api/v1/surveys")
    assert newest["status"] == 201
    kept = "".join(path.read_text("latin-1") for path in data.glob("*.json*"))
    assert not any(text in kept for text in (*texts.values(), OWN))
    assert all(path.stat().st_mode & 0o777 == 0o600 for path in data.glob("*.json*"))


def test_a_browser_logs_in_by_a_form_and_the_token_is_in_no_address(client, texts):
    assert "<form" in client.get("/login").text
    assert client.get(f"/login?token={texts['read']}").status_code == 400
    assert client.post("/login", data={"token": "wrong"}).status_code == 401
    come = client.post("/login", data={"token": texts["read"]}, follow_redirects=False)
    assert come.status_code == 303
    assert texts["read"] not in come.headers["set-cookie"]
    assert "HttpOnly" in come.headers["set-cookie"]
    assert client.get("/api/v1/surveys").status_code == 200
    assert client.post("/api/v1/surveys", json={"name": "x"}).status_code == 403
    client.cookies.clear()


def test_a_revoked_token_is_refused_at_once(client, data):
    text = Tokens(data).make("short-lived", Scope.READ)
    assert client.get("/api/v1/surveys", headers=bearer(text)).status_code == 200
    Tokens(data).revoke("short-lived")
    assert client.get("/api/v1/surveys", headers=bearer(text)).status_code == 401


def test_tokens_have_names_of_their_own(tmp_path):
    tokens = Tokens(tmp_path)
    first = tokens.make("rover", Scope.READ)
    assert len(first) > 40
    with pytest.raises(ConflictError):
        tokens.make("rover", Scope.READ)
    with pytest.raises(NotFoundError):
        tokens.revoke("other")


@pytest.mark.parametrize("name", [" ", "a\nb", 101 * "a"])
def test_a_name_that_cannot_be_read_is_refused(tmp_path, name):
    with pytest.raises(InputError, match="must have 1 to 100 printable characters"):
        Tokens(tmp_path).make(name, Scope.READ)


def test_the_command_makes_lists_and_revokes(tmp_path):
    run = CliRunner().invoke
    made = run(app, ["token", "create", "rover", "--scope", "read", "--data", str(tmp_path)])
    text = made.stdout.strip().splitlines()[0]
    assert Tokens(tmp_path).of_text(text).name == "rover"
    listed = json.loads(run(app, ["token", "list", "--json", "--data", str(tmp_path)]).stdout)
    assert [(one["name"], one["scope"]) for one in listed] == [("rover", "read")]
    assert text not in run(app, ["token", "list", "--data", str(tmp_path)]).stdout
    run(app, ["token", "revoke", "rover", "--data", str(tmp_path)])
    assert Tokens(tmp_path).all() == ()


def test_every_route_needs_the_scope_of_its_method(client):
    paths = client.get("/api/v1/openapi.json", headers=bearer(OWN)).json()["paths"]
    writing = {
        path
        for path, operations in paths.items()
        for method in operations
        if scope_of(method.upper(), path) is Scope.WRITE
    }
    assert "/api/v1/jobs" in writing
    assert "/api/v1/recordings" in writing
    assert "/api/v1/sql" not in writing
