"""What every route does with what it should not get, and what every answer carries."""

import hashlib
import http.client
import socket
import threading
import time

import duckdb
import pytest
import uvicorn
from fastapi.testclient import TestClient

from spheremark.service.http.app import create_app
from spheremark.service.http.security import HEADERS, SecureHeaders, SecurityMiddleware
from spheremark.service.settings import Settings

DIGEST = "0" * 64
JSON = {"Content-Type": "application/json"}


def _nested(key, depth):
    """Return the JSON of a job, or of a rig, whose one value has so many brackets."""
    return _with(key, f'{{"a": {"[" * depth}{"]" * depth}}}')


def _with(key, value):
    """Return the JSON of a job with a value."""
    return f'{{"survey": "a", "recording": "{DIGEST}", "{key}": {value}}}'


WRONG = [  # method, path, arguments, status, code
    ("GET", "/api/v1/nowhere", {}, 404, "not_found"),
    ("PATCH", "/api/v1/surveys", {}, 405, "method_not_allowed"),
    ("POST", "/api/v1/surveys", {"json": {}}, 422, "input.validation"),
    ("POST", "/api/v1/surveys", {"json": {"name": "a", "nme": "b"}}, 422, "input.validation"),
    ("POST", "/api/v1/surveys", {"content": "{", "headers": JSON}, 400, "input.validation"),
    ("GET", "/api/v1/surveys?limit=0", {}, 422, "input.validation"),
    ("GET", "/api/v1/surveys?after=nonsense", {}, 400, "input"),
    ("GET", "/api/v1/surveys/nobody", {}, 404, "not_found"),
    ("PATCH", "/api/v1/surveys/nobody", {"json": {"name": "b"}}, 404, "not_found"),
    ("PATCH", "/api/v1/surveys/nobody", {"json": {"tolerance_m": 0}}, 422, "input.validation"),
    ("DELETE", "/api/v1/surveys/nobody", {}, 404, "not_found"),
    ("POST", "/api/v1/surveys/nobody/restoration", {}, 404, "not_found"),
    ("GET", "/api/v1/surveys/nobody/result", {}, 404, "not_found"),
    ("GET", "/api/v1/surveys/nobody/scene", {}, 404, "not_found"),
    ("GET", "/api/v1/accuracy/limits?survey=nobody", {}, 422, "input.unknown"),
    ("GET", "/api/v1/clouds/octree?run=none&stop=none", {}, 422, "input.unknown"),
    ("GET", "/api/v1/clouds/octree/0?run=none&stop=none", {}, 422, "input.validation"),
    ("GET", "/api/v1/figures/nothing.json", {}, 404, "not_found"),
    ("GET", "/api/v1/figures/distance.xml", {}, 422, "input.validation"),
    ("GET", "/api/v1/plans/searches?x=1", {}, 422, "input.validation"),
    ("GET", "/api/v1/plans/searches/none", {}, 404, "not_found"),
    ("GET", "/api/v1/queries?x=1", {}, 422, "input.validation"),
    ("GET", "/api/v1/queries/none", {}, 404, "not_found"),
    ("GET", "/api/v1/runs/none/result.mcap", {}, 404, "not_found"),
    ("GET", "/api/v1/surveys/nobody/figures/distance.json", {}, 404, "not_found"),
    ("GET", "/api/v1/surveys/nobody/report.html", {}, 404, "not_found"),
    ("GET", "/api/v1/surveys/nobody/report.pdf", {}, 404, "not_found"),
    ("GET", "/api/v1/tables/nothing.json", {}, 404, "not_found"),
    ("GET", "/api/v1/compare?a=run:none&b=run:none", {}, 422, "input.unknown"),
    ("PUT", "/api/v1/surveys/nobody/recordings/none", {}, 404, "not_found"),
    ("DELETE", "/api/v1/surveys/nobody/recordings/none", {}, 404, "not_found"),
    ("DELETE", "/api/v1/surveys/nobody/control", {}, 404, "not_found"),
    ("POST", "/api/v1/surveys/a/control/preview?unit=yard",
     {"content": "A,1,2,3", "headers": {"Content-Type": "text/csv"}}, 422, "input.validation"),
    ("POST", "/api/v1/surveys/a/control/preview",
     {"content": "A,1,2", "headers": {"Content-Type": "text/csv"}}, 400, "input.control"),
    ("GET", "/api/v1/surveys/nobody/control", {}, 404, "not_found"),
    ("PUT", "/api/v1/surveys/a/control", {"content": ""}, 400, "input.empty"),
    ("PUT", "/api/v1/surveys/a/control", {"content": "x", "headers": {"Content-Type": "a/b"}},
     415, "input.media_type"),
    ("PUT", "/api/v1/surveys/a/control",
     {"content": "mark,x_m,y_m,z_m\nA,1,2,three\n", "headers": {"Content-Type": "text/csv"}},
     400, "input.control"),
    ("PUT", "/api/v1/surveys/a/control", {"json": {"marks": [{"mark": "A"}]}},
     422, "input.validation"),
    ("PUT", "/api/v1/surveys/a/control",
     {"content": b"\xff\xfe", "headers": {"Content-Type": "text/csv"}}, 400, "input"),
    ("PUT", "/api/v1/surveys/nobody/truth", {"json": {"marks": 3}}, 400, "input.truth"),
    ("POST", "/api/v1/recordings", {"content": b"x"}, 422, "input.validation"),
    ("POST", "/api/v1/recordings?name=a", {"content": b"x"}, 415, "input.media_type"),
    ("POST", "/api/v1/recordings?name=a",
     {"content": b"", "headers": {"Content-Type": "application/vnd.mcap"}}, 400, "input.empty"),
    ("POST", "/api/v1/recordings?name=a&process=true",
     {"content": b"x", "headers": {"Content-Type": "application/vnd.mcap"}}, 400, "input"),
    ("POST", "/api/v1/recordings?name=a&survey=nobody",
     {"content": b"x", "headers": {"Content-Type": "application/vnd.mcap"}}, 422, "input.unknown"),
    ("POST", "/api/v1/uploads", {"headers": {"Upload-Length": "3"}}, 412, "input.tus_version"),
    ("DELETE", "/api/v1/uploads/none", {"headers": {"Tus-Resumable": "1.0.0"}}, 404, "not_found"),
    ("GET", f"/api/v1/recordings/{DIGEST}", {}, 404, "not_found"),
    ("GET", "/api/v1/recordings/short", {}, 422, "input.validation"),
    ("GET", f"/api/v1/recordings/{DIGEST}/preflight", {}, 404, "not_found"),
    ("GET", f"/api/v1/recordings/{DIGEST}/file", {}, 404, "not_found"),
    ("POST", "/api/v1/jobs", {"json": {"survey": "nobody", "recording": DIGEST}},
     422, "input.unknown"),
    ("POST", "/api/v1/jobs", {"json": {"kind": "magic", "survey": "a", "recording": DIGEST}},
     422, "input.validation"),
    ("POST", "/api/v1/jobs", {"json": {"survey": "a"}}, 422, "input.validation"),
    ("POST", "/api/v1/jobs",
     {"json": {"survey": "a", "recording": DIGEST, "recordings": [DIGEST]}},
     422, "input.validation"),
    ("POST", "/api/v1/jobs",
     {"json": {"kind": "adjust", "survey": "a", "recording": DIGEST, "recordings": [DIGEST]}},
     422, "input.validation"),
    ("POST", "/api/v1/jobs", {"content": _nested("rig", 900), "headers": JSON},
     422, "input.validation"),
    ("POST", "/api/v1/jobs", {"content": _nested("config", 900), "headers": JSON},
     422, "input.validation"),
    ("POST", "/api/v1/jobs", {"content": _nested("options", 10**6), "headers": JSON},
     400, "input.validation"),
    *(("POST", "/api/v1/jobs", {"content": _with(key, value), "headers": JSON},
       422, "input.validation")
      for key in ("rig", "config", "options")
      for value in (r'{"a": "\ud800"}', r'{"\udfff": 1}', f'{{"tolerance": {10**400}}}')),
    ("POST", "/api/v1/jobs", {"content": r'{"survey": "\ud800", "kind": "adjust"}',
                              "headers": JSON}, 422, "input.validation"),
    *(("PUT", "/api/v1/queries/odd",
       {"content": f'{{"sql": "SELECT 1", "parameters": {value}}}', "headers": JSON},
       422, "input.validation")
      for value in (r'{"a": "\ud800"}', r'{"\udfff": 1}', f'{{"a": {10**400}}}')),
    ("POST", "/api/v1/rigs", {"content": r'{"name": "\ud800"}'}, 400, "input.rig"),
    ("PUT", "/api/v1/surveys/nobody/truth", {"content": r'{"about": "\ud800"}', "headers": JSON},
     400, "input.truth"),
    ("POST", "/api/v1/rigs", {"content": ""}, 400, "input.empty"),
    ("POST", "/api/v1/rigs", {"json": {"name": "bench"}}, 400, "input.rig"),
    ("GET", "/api/v1/rigs/none", {}, 404, "not_found"),
    ("PUT", "/api/v1/surveys/nobody/rig", {"json": {"rig_digest": None}}, 404, "not_found"),
    ("PUT", "/api/v1/surveys/nobody/rig", {"json": {}}, 422, "input.validation"),
    ("GET", "/api/v1/adjustments?survey=a&colour=red", {}, 422, "input.validation"),
    ("GET", "/api/v1/adjustments?survey=nobody", {}, 422, "input.unknown"),
    ("GET", f"/api/v1/adjustments?after={10**30}", {}, 422, "input.validation"),
    ("GET", "/api/v1/adjustments/none", {}, 404, "not_found"),
    ("GET", "/api/v1/adjustments/none/files/report.txt", {}, 404, "not_found"),
    ("GET", "/api/v1/calibrations?limit=0", {}, 422, "input.validation"),
    ("GET", "/api/v1/calibrations/none", {}, 404, "not_found"),
    ("GET", "/api/v1/calibrations/none/files/rig.json", {}, 404, "not_found"),
    ("GET", "/api/v1/jobs?status=odd", {}, 422, "input.validation"),
    ("GET", "/api/v1/jobs/none", {}, 404, "not_found"),
    ("GET", "/api/v1/jobs/none/events", {}, 404, "not_found"),
    ("DELETE", "/api/v1/jobs/none", {}, 404, "not_found"),
    ("GET", "/api/v1/runs/none", {}, 404, "not_found"),
    ("GET", "/api/v1/runs?colour=red", {}, 422, "input.validation"),
    ("GET", "/api/v1/runs?job=none", {}, 422, "input.unknown"),
    ("GET", f"/api/v1/runs?recording={DIGEST}", {}, 422, "input.unknown"),
    ("GET", "/api/v1/jobs?survey=nobody", {}, 422, "input.unknown"),
    ("GET", f"/api/v1/jobs?recording={DIGEST}", {}, 422, "input.unknown"),
    ("GET", "/api/v1/export/coordinates.csv?survey=nobody", {}, 422, "input.unknown"),
    ("GET", "/api/v1/marker-fits?survey=nobody", {}, 422, "input.unknown"),
    ("GET", "/api/v1/marker-fits?status=bogus", {}, 422, "input.validation"),
    ("GET", "/api/v1/marker-fits?fit_method=bogus", {}, 422, "input.validation"),
    ("GET", "/api/v1/marker-fits?run=none", {}, 422, "input.unknown"),
    ("GET", "/api/v1/station-fixes?stop=nowhere", {}, 422, "input.unknown"),
    ("GET", "/api/v1/surveys?surveyy=a", {}, 422, "input.validation"),
    ("GET", "/api/v1/marker-fits/none", {}, 404, "not_found"),
    ("GET", "/api/v1/marker-fits?limit=1001", {}, 422, "input.validation"),
    ("GET", f"/api/v1/marker-fits?after={10**22}", {}, 422, "input.validation"),
    ("GET", "/api/v1/station-fixes?latest=perhaps", {}, 422, "input.validation"),
    ("GET", "/api/v1/station-fixes/none", {}, 404, "not_found"),
    ("POST", "/api/v1/sql", {"json": {"sql": "SELEKT 1"}}, 400, "query.rejected"),
    ("POST", "/api/v1/sql", {"json": {"sql": "DROP TABLE jobs"}}, 400, "query.rejected"),
    ("GET", "/api/v1/sql", {}, 422, "input.validation"),
    ("GET", "/api/v1/audit?limit=0", {}, 422, "input.validation"),
    ("GET", "/api/v1/export/coordinates.geojson", {}, 400, "input"),
    ("GET", "/api/v1/export/coordinates.shp", {}, 422, "input.validation"),
    ("GET", "/api/v1/export/coordinates.geojson?origin=here", {}, 400, "input"),
    ("POST", "/api/v1/sql", {"json": {"sql": "UPDATE EXTENSIONS"}}, 400, "query.rejected"),
    ("POST", "/api/v1/sql",
     {"json": {"sql": "SELECT (repeat('[', 9999) || repeat(']', 9999))::JSON"}},
     400, "query.rejected"),
    ("POST", "/api/v1/surveys",
     {"content": "[" * 10**6 + "]" * 10**6, "headers": {"Content-Type": "application/json"}},
     400, "input.validation"),
    ("POST", "/api/v1/rigs", {"content": '{"rig": ' * 900 + "1" + "}" * 900}, 400, "input.rig"),
    ("POST", "/api/v1/jobs",
     {"content": '{"survey": "a", "rig": ' + '{"rig": ' * 900 + "1" + "}" * 901,
      "headers": {"Content-Type": "application/json"}}, 422, "input.validation"),
    ("GET", "/api/v1/plans/sites/nowhere", {}, 404, "not_found"),
    ("POST", "/api/v1/plans/evaluate", {"json": {"marks": [{"name": "A"}]}},
     422, "input.validation"),
    ("POST", "/api/v1/plans/evaluate", {"json": {"model": "guess"}}, 400, "input"),
    ("POST", "/api/v1/plans/optimise", {"json": {"n_marks": 1}}, 422, "input.validation"),
    ("POST", "/api/v1/plans/optimise", {"json": {"n_marks": 3, "stops": []}}, 400, "input"),
    ("POST", "/api/v1/plans/suggest", {"json": {"colour": "red"}}, 422, "input.validation"),
    ("POST", "/api/v1/plans/suggest", {"json": {"stops": []}}, 400, "input"),
    ("POST", "/api/v1/plans/random", {"json": {"n_arrangements": 0}}, 422, "input.validation"),
    ("POST", "/api/v1/plans/random", {"json": {"n_marks_min": 2}}, 400, "input.config"),
    ("POST", "/api/v1/plans/random", {"json": {"fit_method": "guess"}}, 400, "input"),
    ("GET", "/api/v1/plans?survey=nobody", {}, 422, "input.unknown"),
    ("GET", "/api/v1/plans/sites/paper-field@" + 5000 * "9", {}, 404, "not_found"),
    ("POST", "/api/v1/plans", {"json": {"marks": []}}, 422, "input.validation"),
    ("GET", "/api/v1/plans/none", {}, 404, "not_found"),
    ("GET", "/api/v1/surveys/nobody/products", {}, 404, "not_found"),
    ("GET", "/api/v1/products/none/laz", {}, 404, "not_found"),
    ("POST", "/api/v1/terrains?name=hill.txt", {"content": b"1"}, 400, "input"),
    ("GET", "/api/v1/problems/none", {}, 404, "not_found"),
    ("POST", "/api/v1/sql", {"content": b"x" * (17 << 20)}, 413, "input.too_large"),
    ("POST", "/api/v1/sql", {"content": iter([b"x" * (9 << 20)] * 2)}, 413, "input.too_large"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("method", "path", "arguments", "status", "code"), WRONG, ids=lambda v: str(v)[:40]
)
def test_every_wrong_request_gets_the_one_shape(site, method, path, arguments, status, code):
    answer = site.client.request(method, path, **arguments)
    problem = answer.json()
    assert (answer.status_code, problem["code"]) == (status, code), problem
    assert answer.headers["content-type"] == "application/problem+json"
    assert {"type", "title", "status", "detail", "instance", "code"} <= set(problem)
    assert problem["status"] == status
    assert problem["detail"]
    assert site.client.get(problem["type"]).json()["code"] == code


def test_every_route_is_among_the_wrong_requests_or_takes_no_input(site):
    paths = site.client.get("/api/v1/openapi.json").json()["paths"]
    harmless = {"/config", "/problems", "/plans/sites", "/sql/schema", "/jobs/events",
                "/export/results.duckdb", "/export/coordinates.csv"}  # fmt: skip
    tried = [path.partition("?")[0].removeprefix("/api/v1").split("/")[1:] for _, path, *_ in WRONG]
    for path in {one.removeprefix("/api/v1") for one in paths} - harmless:
        parts = path.split("/")[1:]
        assert any(
            len(parts) == len(t) and all(a == b or "{" in a for a, b in zip(parts, t, strict=True))
            for t in tried
        ), path


def test_every_operation_takes_the_parameters_of_its_description_and_no_other(site):
    for path, operations in site.client.get("/api/v1/openapi.json").json()["paths"].items():
        for method, operation in operations.items():
            known = sorted(
                one["name"] for one in operation.get("parameters", ()) if one["in"] == "query"
            )
            url = path.replace("{figure}.{form}", "distance.json").replace("{kind}", "geojson")
            answer = site.client.request(method, url, params=dict.fromkeys((*known, "odd"), "1"))
            assert answer.status_code == 422, (method, path)
            if method != "head":  # which has no body
                wanted = f"query.odd: this operation has {', '.join(known) or 'no parameters'}"
                assert wanted in answer.json()["detail"].split("; "), (method, path, answer.text)


def test_operations_have_names_of_their_own(site):
    paths = site.client.get("/api/v1/openapi.json").json()["paths"]
    names = [one["operationId"] for path in paths.values() for one in path.values()]
    assert len(set(names)) == len(names) > 25


@pytest.mark.parametrize("path", ["/", "/healthz", "/api/v1/nowhere", "/api/v1/surveys"])
def test_every_answer_carries_the_policy(site, path):
    headers = site.client.get(path).headers
    policy = dict(part.split(" ", 1) for part in headers["content-security-policy"].split("; "))
    assert policy["default-src"] == "'none'"
    assert policy["script-src"] == "'self'"
    assert policy["frame-ancestors"] == "'none'"
    assert headers["x-content-type-options"] == "nosniff"


MALFORMED = [
    {"Host": "[::1"}, {"Host": "::1]"}, {"Host": "[::1]]"}, {"Host": "[localhost]"},
    {"Host": "[v1.x]:80"}, {"Host": "localhost:port"}, {"Host": "localhost:8000:8000"},
    {"Host": "elsewhere.example@localhost"}, {"Host": "localhost/static/"}, {"Host": "a b"},
    {"Host": "localhost?"}, {"Host": "localhost\\x"}, {"Host": "[" * 10_000},
    {"Origin": "http://["}, {"Origin": "http://[::1"}, {"Origin": "http://a/b"}, {"Origin": ""},
    {"Origin": "127.0.0.1:8000"}, {"Origin": "http://a b"}, {"Origin": "http://a@127.0.0.1"},
    {"Content-Length": "-1"}, {"Content-Length": "+1"}, {"Content-Length": "1_0"},
    {"Content-Length": "0x10"}, {"Content-Length": "9" * 5000}, {"Content-Length": "1,1"},
    {"Content-Length": b"\xb2"}, {"Content-Length": ""},
]  # fmt: skip


@pytest.mark.parametrize("headers", MALFORMED, ids=lambda h: str(h)[:40])
@pytest.mark.parametrize("method", ["GET", "POST"])
def test_a_malformed_header_is_refused_with_the_one_shape_and_the_policy(site, method, headers):
    answer = site.client.request(method, "/api/v1/surveys", headers=headers)
    assert (answer.status_code, answer.json()["code"]) == (400, "input.header"), answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    assert len(answer.text) < 1000
    for name, value in HEADERS.items():
        assert answer.headers[name] == value


def test_two_hosts_are_refused(site):
    headers = [("Host", "127.0.0.1:8000"), ("Host", "elsewhere.example")]
    answer = site.client.get("/api/v1/surveys", headers=headers)
    assert (answer.status_code, answer.json()["code"]) == (400, "input.header")


@pytest.mark.parametrize(
    "host", ["127.0.0.1", "localhost:1", "[::1]:8000", "[::ffff:127.0.0.1]", "LOCALHOST", "rover"]
)
def test_hosts_of_this_machine_are_answered(site, host):
    headers = {"Host": host, "Origin": f"http://{host}"}
    answer = site.client.post("/api/v1/surveys", headers=headers, json={})
    assert answer.json()["code"] == "input.validation"  # it passed the guard


@pytest.mark.parametrize("cookie", ['spheremark_token="\\', "=;=,\xff", "a[]=1; spheremark_token"])
def test_an_odd_cookie_is_no_token_and_no_failure(tmp_path, cookie, scheduler):
    settings = Settings(
        data=tmp_path, scheduler=scheduler, token="A-secret-of-32-characters-at-least"
    )
    guarded = SecureHeaders(
        SecurityMiddleware(None, settings)
    )  # what passes would fail at the call of None
    client = TestClient(guarded, base_url="http://127.0.0.1:8000")
    answer = client.get("/api/v1/surveys", headers={"Cookie": cookie.encode("latin-1")})
    assert (answer.status_code, answer.json()["code"]) == (401, "unauthorized")
    assert answer.headers["content-security-policy"] == HEADERS["Content-Security-Policy"]


def test_a_long_cookie_takes_no_long_time(tmp_path, scheduler):
    settings = Settings(
        data=tmp_path, scheduler=scheduler, token="A-secret-of-32-characters-at-least"
    )
    client = TestClient(SecureHeaders(SecurityMiddleware(None, settings)), "http://127.0.0.1:8000")
    begin = time.process_time()
    answer = client.get("/api/v1/surveys", headers={"Cookie": 'a="' + '\\"' * 60_000 + '"'})
    assert answer.status_code == 401
    assert time.process_time() - begin < 2.0  # quadratic parsing takes 8 s, linear 1 ms


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "https://elsewhere.example"},
        {"Origin": "null"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Host": "elsewhere.example"},
    ],
)
def test_another_site_cannot_change_anything(site, headers):
    answer = site.client.post("/api/v1/surveys", json={"name": "foreign"}, headers=headers)
    assert (answer.status_code, answer.json()["code"]) == (403, "forbidden")
    assert site.client.get("/api/v1/surveys/foreign").status_code == 404


def test_a_page_of_this_service_may_change_things(site):
    headers = {"Origin": "http://127.0.0.1:8000", "Sec-Fetch-Site": "same-origin"}
    answer = site.client.post("/api/v1/surveys", json={"name": "own"}, headers=headers)
    assert answer.status_code == 201


def test_a_file_that_is_no_mcap_is_refused_and_kept_with_its_reason(site):
    body = b"this is no log"
    answer = site.upload(body, name="garbage")
    problem = answer.json()
    assert (answer.status_code, problem["code"]) == (422, "input.recording.not_mcap")
    digest = hashlib.sha256(body).hexdigest()
    assert problem["recording_id"] == digest
    kept = site.client.get(f"/api/v1/recordings/{digest}").json()
    assert (kept["verdict"], kept["name"]) == ("refused", "garbage")
    assert kept["preflight"]["reasons"]
    site.client.post("/api/v1/surveys", json={"name": "refusing"})
    job = site.client.post("/api/v1/jobs", json={"survey": "refusing", "recording": digest})
    assert (job.status_code, job.json()["code"]) == (422, "input.recording.not_mcap")


def test_a_log_that_breaks_off_is_refused_or_weak_but_never_ok(site):
    whole = site.stop.log.read_bytes()
    answer = site.upload(whole[: len(whole) // 2], name="half")
    assert answer.status_code == 422
    assert answer.json()["code"] == "input.recording.truncated"


def test_a_log_larger_than_the_limit_is_refused_by_its_header_and_leaves_nothing(
    tmp_path, scheduler
):
    settings = Settings(data=tmp_path, scheduler=scheduler, max_upload_bytes=1000)
    with TestClient(create_app(settings)) as client:
        kind = {"Content-Type": "application/octet-stream"}
        for body in (b"x" * 1001, iter([b"x" * 600] * 2)):
            answer = client.post("/api/v1/recordings?name=a", content=body, headers=kind)
            assert (answer.status_code, answer.json()["code"]) == (413, "input.too_large")
    assert not [path for path in (tmp_path / "recordings").rglob("*") if path.is_file()]


class Listening:
    """A guarded application that reads no body, behind a real socket."""

    def __init__(self, tmp_path):
        async def refuse(_scope, _receive, send):
            await send({"type": "http.response.start", "status": 404, "headers": []})
            await send({"type": "http.response.body", "body": b"{}"})

        guarded = SecurityMiddleware(refuse, Settings(data=tmp_path))
        self.server = uvicorn.Server(uvicorn.Config(guarded, port=0, log_level="critical"))
        self.thread = threading.Thread(target=self.server.run)

    def __enter__(self):
        self.thread.start()
        while not self.server.started:
            time.sleep(0.01)
        return self.server.servers[0].sockets[0].getsockname()[1]

    def __exit__(self, *_):
        self.server.should_exit = True
        self.thread.join()


@pytest.mark.parametrize(("path", "status"), [("/api/v1/plans", 413), ("/api/v1/recordings", 404)])
def test_a_refusal_is_read_by_a_sender_who_sends_all_before_reading(tmp_path, path, status):
    with Listening(tmp_path) as port:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
        connection.request("POST", path, b"x" * (64 << 20))
        assert connection.getresponse().status == status
        connection.close()


def test_a_sender_who_asks_first_is_refused_without_its_body(tmp_path):
    with Listening(tmp_path) as port, socket.create_connection(("127.0.0.1", port), 20) as line:
        head = f"POST /api/v1/plans HTTP/1.1\r\nHost: localhost\r\nContent-Length: {1 << 40}\r\n"
        line.sendall(f"{head}Expect: 100-continue\r\n\r\n".encode())
        assert line.recv(100).startswith(b"HTTP/1.1 413 ")


def test_control_marks_survive_the_way_there_and_back(site):
    site.survey("control")
    url = "/api/v1/surveys/control/control"
    first = site.client.get(url).json()
    assert len(first["marks"]) == 14
    site.client.put(url, json=first).raise_for_status()
    assert site.client.get(url).json() == first
    as_csv = site.client.get(url, headers={"Accept": "text/csv"}).text
    kind = {"Content-Type": "text/csv"}
    assert site.client.put(url, content=as_csv, headers=kind).json() == first


def test_lists_go_on_where_they_ended(site):
    for i in range(3):
        site.client.post("/api/v1/surveys", json={"name": f"listed {i}"})
    names, after = [], None
    while True:
        query = {"limit": 2} | ({"after": after} if after else {})
        part = site.client.get("/api/v1/surveys", params=query).json()
        names += [one["name"] for one in part["items"]]
        if (after := part["next"]) is None:
            break
    assert len(set(names)) == len(names)
    assert {f"listed {i}" for i in range(3)} <= set(names)


def test_sql_answers_in_json_and_csv_and_says_what_is_cut(site):
    sql = "SELECT range AS n, range / 2.0 AS half_m FROM range(20000)"
    answer = site.client.post("/api/v1/sql", json={"sql": sql}).json()
    assert answer["columns"][1] == {"name": "half_m", "type": "DOUBLE", "unit": "m"}
    assert (len(answer["rows"]), answer["row_limit"], answer["truncated"]) == (10000, 10000, True)
    kind = {"Accept": "text/csv"}
    text = site.client.post("/api/v1/sql", json={"sql": sql}, headers=kind)
    assert text.headers["x-truncated"] == "true"
    assert text.text.splitlines()[:2] == ["n,half_m", "0,0.0"]
    linked = site.client.get("/api/v1/sql", params={"q": "SELECT 1 AS one"}).json()
    assert linked["rows"] == [[1]]


def test_the_schema_names_every_column_with_its_unit(site):
    tables = {one["name"]: one for one in site.client.get("/api/v1/sql/schema").json()["items"]}
    units = {column["name"]: column["unit"] for column in tables["marker_fits"]["columns"]}
    assert units["range_m"] == "m"
    assert units["cov_xx_m2"] == "m²"
    assert tables["accuracy_by_stop"]["kind"] == "view"


def test_the_exported_database_opens_elsewhere(site, tmp_path):
    path = tmp_path / "results.duckdb"
    path.write_bytes(site.client.get("/api/v1/export/results.duckdb").content)
    site.client.post("/api/v1/surveys", json={"name": "later"})
    with duckdb.connect(str(path), read_only=True) as copy:
        assert copy.execute("SELECT count(*) FROM marker_fits").fetchall()[0][0] >= 0


def test_an_open_address_without_a_token_is_refused():
    with pytest.raises(ValueError, match="SPHEREMARK_TOKEN"):
        Settings(host="0.0.0.0")
    for weak in ("x", "short", 30 * "a"):
        with pytest.raises(ValueError, match="less than 128 bits"):
            Settings(token=weak)


def test_settings_come_from_the_environment_and_are_described(monkeypatch):
    monkeypatch.setenv("SPHEREMARK_PORT", "8111")
    assert Settings().port == 8111
    assert all(field.description for field in Settings.model_fields.values())


@pytest.mark.parametrize("path", ["/api/v1/surveys", "/"])
def test_an_unforeseen_error_tells_no_secrets_and_carries_the_policy(site, path):
    app = site.client.app
    quiet = TestClient(app, raise_server_exceptions=False, base_url="http://127.0.0.1:8000")
    catalogue, app.state.service = app.state.service, None
    try:
        answer = quiet.get(path, headers={"Accept": "text/html" if path == "/" else "*/*"})
    finally:
        app.state.service = catalogue
    assert answer.status_code == 500
    assert answer.headers["content-type"].startswith(
        "text/html" if path == "/" else "application/problem+json"
    )
    assert "internal" in answer.text
    assert "NoneType" not in answer.text
    for name, value in HEADERS.items():
        assert answer.headers[name] == value
