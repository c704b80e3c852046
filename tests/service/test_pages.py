"""Pages over a small survey in a real catalogue, as a browser would ask for them."""

import re
from datetime import timedelta

import pytest
from fastapi.testclient import TestClient

from spheremark.service.http.app import create_app
from spheremark.service.settings import Settings
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.web import assets
from tests.surveyed import NOW, fill

WICKED = "<script>alert('x')</script> & \"more\""
HTML = {"accept": "text/html"}


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    data = tmp_path_factory.mktemp("data")
    with Catalogue(data / "spheremark.duckdb", snapshots=data / "snapshots") as catalogue:
        fill(catalogue, data / "clouds", WICKED, n_stops=1, with_truth=False, lane="a/b<i>")
        fill(catalogue, data / "clouds", "field", n_stops=2, at=NOW + timedelta(days=1))
        twins = {"with_truth": False, "all_called": "scan", "at": NOW - timedelta(days=1)}
        fill(catalogue, data / "clouds", "twins", n_stops=2, **twins)
        catalogue.create_survey("bare")
        catalogue.create_survey("empty")
        recording = catalogue.list_recordings().items[0].recording_id
        job = catalogue.create_job("process", survey="empty", recording_id=recording, config={})
        catalogue.start_job(job.job_id)
        catalogue.fail_job(job.job_id, code="solve.no_markers", reason="No marker <b>here</b>.")
    with TestClient(create_app(Settings(data=data, workers=1))) as client:
        yield client


def page(client, path):
    response = client.get(path, headers=HTML)
    assert response.status_code == 200, response.text[-2000:]
    assert response.headers["content-type"].startswith("text/html")
    return response.text


def link(text, pattern):
    return re.search(f'href="({pattern})"', text)[1].replace("&amp;", "&")


def test_the_overview_lists_surveys_and_recordings_and_says_how_to_upload(client):
    text = page(client, "/")
    assert "lane3-stop2" in text
    assert "curl -X POST" in text
    assert "http://testserver/api/v1/recordings" in text
    assert "mm RMS error" in text


def test_a_dashboard_has_all_its_figures(client):
    text = page(client, "/surveys/field")
    for name in ("distance", "count", "map", "angle", "lane"):
        assert f'id="figure-{name}"' in text
    assert "28 of 28 within 30 mm" in text


def test_a_filter_in_the_address_narrows_the_dashboard(client):
    text = page(client, "/surveys/field?stop=lane3-stop2&method=along_beam")
    assert "14 of 14 within 30 mm" in text
    assert "paper&#39;s method" not in text.split('class="readouts"')[1]


def test_a_filter_that_nothing_passes_says_what_to_do(client):
    text = page(client, "/surveys/field?range_from_m=90")
    assert "No fit passes these filters" in text
    assert 'id="figure-distance"' not in text


def test_a_filter_that_cannot_be_read_is_a_clear_refusal(client):
    response = client.get("/surveys/field?range_from_m=near", headers=HTML)
    assert response.status_code == 400
    assert "range_from_m is &#39;near&#39;" in response.text


def test_without_truth_nothing_is_called_an_error(client):
    text = page(client, link(page(client, "/"), '/surveys/%3C[^"]+'))
    assert "Predicted sigma of sphere centres" in text
    assert "truth not known" in text
    assert "RMS error" not in text


def test_names_are_escaped_wherever_they_stand(client):
    survey = link(page(client, "/"), '/surveys/%3C[^"]+')
    stop = link(page(client, survey), '/surveys/%3C[^"]+/stops/[^"]+')
    for path in ("/", "/jobs", "/sql", survey, stop):
        text = page(client, path)
        assert "<script>alert" not in text
        assert "<i>" not in text
        assert "&lt;script&gt;alert" in text


def test_a_stop_shows_its_scan_markers_and_position(client):
    text = page(client, "/surveys/field/stops/lane3-stop1")
    assert 'id="figure-scene"' in text
    assert 'id="figure-residuals"' in text
    assert "Not round: a rock." in text
    assert "degrees of freedom" in text


@pytest.mark.parametrize("method", ["along_beam", "paper"])
def test_a_marker_can_be_seen_from_near_by_each_method(client, method):
    text = page(client, f"/surveys/field/stops/lane3-stop1?method={method}&marker=M03")
    assert 'id="figure-returns"' in text
    assert "Marker M03" in text


def test_logs_of_one_name_are_each_within_reach(client):
    newest = page(client, "/surveys/twins/stops/scan")
    assert "2 logs of this survey have a stop of this name" in newest
    places = set()
    for address in set(re.findall(r'href="(/surveys/twins/stops/scan\?[^"]+)"', newest)):
        text = page(client, address.replace("&amp;", "&"))
        places.add(round(float(re.search(r"<dt>x, site</dt><dd>([^<]+)", text)[1])))
    assert places == {-4, 4}
    assert "logs of this survey" not in page(client, "/surveys/field/stops/lane3-stop1")


def test_an_empty_survey_says_what_to_do(client):
    text = page(client, "/surveys/bare")
    assert "No results yet" in text
    assert "survey=bare&amp;process=true" in text


def test_a_survey_whose_only_job_failed_offers_work_on_its_log(client):
    text = page(client, "/surveys/empty")
    assert "No results yet" in text
    assert "1 log belongs to this survey" in text
    assert "Adjust all stations" in text


def test_jobs_show_why_they_failed(client):
    text = page(client, "/jobs")
    assert "No marker &lt;b&gt;here&lt;/b&gt;." in text
    failed = re.search(r'data-job="(\w+)" data-status="failed"', text)[1]
    assert "solve.no_markers" in page(client, f"/jobs/{failed}")


def test_a_recording_shows_its_preflight(client):
    text = page(client, link(page(client, "/"), "/recordings/[0-9a-f]{64}"))
    assert "/points" in text
    assert "SHA-256" in text


def test_the_sql_page_holds_its_query_its_limits_and_the_schema(client):
    text = page(client, "/sql?q=SELECT+1+%3C+2")
    assert "SELECT 1 &lt; 2</textarea>" in text
    assert "10,000 rows, 5 s, 512 MiB" in text
    assert "latest_marker_fits" in text
    assert re.search(r"range_m</button><span>m</span>", text)


@pytest.mark.parametrize(
    "path",
    ["/surveys/none", "/surveys/field/stops/none", "/jobs/none", "/recordings/none", "/nowhere"],
)
def test_what_is_not_there_is_a_page_that_says_so(client, path):
    response = client.get(path, headers=HTML)
    assert response.status_code == 404
    assert "Back to the overview" in response.text


def test_programs_get_problems_and_not_pages(client):
    response = client.get("/surveys/none")
    assert response.headers["content-type"] == "application/problem+json"


def test_plotly_comes_from_the_installed_package_and_may_be_kept(client):
    response = client.get(assets.plotly_url())
    assert response.content == assets.plotly_script().read_bytes()
    assert "immutable" in response.headers["cache-control"]


def test_every_file_that_a_page_loads_is_there(client):
    text = page(client, "/surveys/field") + page(client, "/sql") + page(client, "/")
    for path in set(re.findall(r'(?:src|href|data-bundle)="(/static/[^"]+)"', text)):
        assert client.get(path).status_code == 200, path


def test_the_policy_allows_no_script_of_a_page_itself(client):
    response = client.get("/", headers=HTML)
    assert "script-src 'self';" in response.headers["content-security-policy"]
    for path in ("/surveys/field", "/sql", "/jobs", "/"):
        scripts = re.findall(r"<script(?![^>]*\b(?:src=|application/json))", page(client, path))
        assert not scripts
        assert not re.search(r"\son\w+=", page(client, path).split("<script type")[0])
