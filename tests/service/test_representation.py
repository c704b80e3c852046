"""What every GET has beside its content: a HEAD, an entity tag where it is JSON, compression."""

import gzip

import pytest

from spheremark.service.http.security import HEADERS

TUS = {"Tus-Resumable": "1.0.0"}


@pytest.fixture(scope="module")
def survey(site):
    site.survey("quarry")
    return "quarry"


def addresses(site):
    """Every address of a GET without parameters in its path."""
    paths = site.client.get("/api/v1/openapi.json").json()["paths"]
    plain = [path for path, found in paths.items() if "get" in found and "{" not in path]
    return [*plain, "/", "/healthz", "/readyz", "/metrics", "/login", "/static/site.css"]


def test_every_get_has_a_head_with_its_headers_and_no_content(site):
    found = addresses(site)
    assert len(found) > 15
    for path in found:
        head = site.client.head(path)
        assert head.content == b""
        if path.endswith("/events"):
            assert head.status_code == 200
            continue
        get = site.client.get(path)
        assert head.status_code == get.status_code, path
        assert head.headers["content-type"] == get.headers["content-type"], path
        assert {name.lower() for name in HEADERS} <= set(head.headers)


def test_a_head_of_what_is_not_there_or_takes_none_is_refused(site):
    assert site.client.head("/api/v1/surveys/unknown").status_code == 404
    assert site.client.head("/api/v1/rigs").status_code == 405
    assert site.client.head(f"/api/v1/uploads/{'0' * 32}", headers=TUS).status_code == 404


def test_json_that_has_not_changed_is_not_sent_again(site, survey):
    first = site.client.get(f"/api/v1/surveys/{survey}")
    tag = first.headers["etag"]
    again = site.client.get(f"/api/v1/surveys/{survey}", headers={"If-None-Match": f'"x", {tag}'})
    assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", tag)
    assert again.headers["x-content-type-options"] == "nosniff"
    assert site.client.head(f"/api/v1/surveys/{survey}").headers["etag"] == tag
    site.client.post("/api/v1/surveys", json={"name": "other"}).raise_for_status()
    listed = site.client.get("/api/v1/surveys")
    site.client.post("/api/v1/surveys", json={"name": "third"}).raise_for_status()
    stale = {"If-None-Match": listed.headers["etag"]}
    assert site.client.get("/api/v1/surveys", headers=stale).status_code == 200


def test_text_is_packed_and_logs_are_not(site):
    for path in ("/", "/api/v1/openapi.json", "/static/site.css"):
        plain = site.client.get(path, headers={"Accept-Encoding": "identity"})
        assert "content-encoding" not in plain.headers
        with site.client.stream("GET", path, headers={"Accept-Encoding": "gzip"}) as packed:
            raw = b"".join(packed.iter_raw())
        assert packed.headers["content-encoding"] == "gzip", path
        assert "Accept-Encoding" in packed.headers["vary"]
        assert len(raw) < 0.5 * len(plain.content)
        assert len(gzip.decompress(raw)) == len(plain.content)
    made = site.upload().json()["recording_id"]
    log = site.client.get(f"/api/v1/recordings/{made}/file", headers={"Accept-Encoding": "gzip"})
    assert log.headers["content-type"] == "application/vnd.mcap"
    assert "content-encoding" not in log.headers


def test_an_event_stream_is_never_packed(site):
    head = site.client.head("/api/v1/jobs/events", headers={"Accept-Encoding": "gzip"})
    assert head.headers["content-type"].startswith("text/event-stream")
    assert "content-encoding" not in head.headers
