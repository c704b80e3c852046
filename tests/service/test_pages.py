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

WICKED = "<script>alert('x')<script> & \"more\" ?#%"
HTML = {"accept": "text/html"}


@pytest.fixture(scope="module")
def client(tmp_path_factory, scheduler):
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
    with TestClient(create_app(Settings(data=data, scheduler=scheduler))) as client:
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
    assert "control met to" in text
    assert "/new" in text


def test_a_survey_opens_with_its_decision_and_one_solution(client):
    text = page(client, "/surveys/field")
    sentence = re.search(r"<h2>(\d[^<]+)</h2>", text)[1]
    assert re.fullmatch(
        r"2 stations, \d\.\d mm \(3-D sigma, RMS\), control met to \d+\.\d mm \(largest\): .*",
        sentence,
    )
    result = client.get("/api/v1/surveys/field/result").json()
    assert result["sentence"] == sentence
    assert result["solution"] == "single stations"
    for one in result["checks"]:
        assert one["n"] > 0
        assert one["ratio_low"] < 1 < one["ratio_high"]
    for name in ("solution", "heights"):
        assert f'data-source="/api/v1/figures/{name}.json?survey=field"' in text
    assert "paper&#39;s method" not in text


@pytest.mark.parametrize("tab", ["stops", "network", "rig", "site", "accuracy", "logs"])
def test_each_tab_of_a_survey_has_an_address(client, tab):
    for survey in ("field", "bare", "empty"):
        text = page(client, f"/surveys/{survey}/{tab}")
        assert f'href="/surveys/{survey}/{tab}" aria-current="page"' in text


@pytest.mark.parametrize("tab", ["", "/stops", "/logs"])
def test_a_part_of_a_tab_beyond_any_is_refused(client, tab):
    response = client.get(f"/surveys/field{tab}?after={2**63}", headers=HTML)
    assert response.status_code == 422
    assert "after" in response.text


def test_a_survey_is_renamed_deleted_and_restored_with_its_results(client):
    client.post("/api/v1/surveys", json={"name": "doubtful"}).raise_for_status()
    changed = {"name": "certain", "tolerance_m": 0.01}
    survey = client.patch("/api/v1/surveys/doubtful", json=changed).json()
    assert (survey["name"], survey["tolerance_m"]) == ("certain", 0.01)
    assert client.patch("/api/v1/surveys/certain", json={"name": "field"}).status_code == 409
    key = client.delete("/api/v1/surveys/certain").json()["survey_id"]
    assert client.get("/api/v1/surveys/certain").status_code == 404
    assert client.get(f"/surveys/{key}", headers=HTML).status_code == 404
    assert "certain" in page(client, "/")
    client.post("/api/v1/surveys", json={"name": "certain"}).raise_for_status()
    restored = client.post(f"/api/v1/surveys/{key}/restoration").json()
    assert restored["name"] == f"certain ({key})"
    assert client.post(f"/api/v1/surveys/{key}/restoration").status_code == 404


def test_the_form_of_a_survey_has_its_tolerance_whole(client):
    survey = {"name": "fine", "tolerance_m": 0.0125}
    client.post("/api/v1/surveys", json=survey).raise_for_status()
    assert 'name="tolerance_mm" min="0.1" max="1000" step="any" required value="12.5"' in page(
        client, "/surveys/fine/logs"
    )
    client.delete("/api/v1/surveys/fine").raise_for_status()


@pytest.mark.parametrize("name", ["%00", "a" * 300, "..%2f..%2fassets.py", "/etc/passwd"])
def test_the_guide_has_no_file_from_elsewhere(client, name, tmp_path, monkeypatch):
    site = tmp_path / "site"
    site.mkdir()
    (site / "index.html").write_text("the guide")
    monkeypatch.setattr(assets, "guide_folder", lambda: site)
    assert page(client, "/guide/") == "the guide"
    response = client.get(f"/guide/{name}")
    assert (response.status_code, "/guide/" in response.json()["detail"]) == (404, True)


def test_a_guide_that_is_not_built_is_shown_from_its_text(client, monkeypatch):
    missing = assets.guide_folder().parent / "missing"
    monkeypatch.setattr(assets, "guide_folder", lambda: missing)
    links = set(re.findall(r'href="(/(?:guide|glossary)[^"#]*)', page(client, "/guide")))
    assert "/guide/first-survey" in links
    for link in links:
        text = page(client, link)
        links_on = re.findall(r'href="(/guide[^"]*)"', text)
        assert {one.partition("#")[0] for one in links_on} <= {*links, "/guide"}
        assert not re.search(r"\{(toctree|include|eval-rst)\}|\.md[)\"]", text)
    assert 'id="the-report"' in page(client, "/guide/reading")
    assert client.get("/guide/none").status_code == 404


def test_a_log_that_is_removed_takes_its_results_and_brings_them_back(client):
    before = client.get("/api/v1/station-fixes?survey=twins").json()["items"]
    recording = before[0]["recording_id"]
    address = f"/api/v1/surveys/twins/recordings/{recording}"
    assert client.delete(address).json()["n_recordings"] == 1
    assert client.delete(address).status_code == 404
    fewer = client.get("/api/v1/station-fixes?survey=twins").json()["items"]
    assert {row["recording_id"] for row in fewer} == {row["recording_id"] for row in before} - {
        recording
    }
    client.put(address).raise_for_status()
    assert client.get("/api/v1/station-fixes?survey=twins").json()["items"] == before


def test_control_is_read_in_other_units_and_axes_before_it_is_stored(client):
    client.post("/api/v1/surveys", json={"name": "feet"}).raise_for_status()
    table, kind = "A,10,20,3\nB,30,40,5\nC,0,7,1", {"content-type": "text/csv"}
    query = "unit=ft&axes=neu&sigma_m=0.002&target_height_m=1"
    address = "/api/v1/surveys/feet/control"
    found = client.post(f"{address}/preview?{query}", content=table, headers=kind).json()["marks"]
    assert found[0]["x_m"] == pytest.approx(20 * 0.3048)
    assert found[0]["z_m"] == pytest.approx(3 * 0.3048 + 1)
    assert found[0]["sigma_x_m"] == pytest.approx(0.002)
    assert client.get(address).json()["marks"] == []
    assert client.put(f"{address}?{query}", content=table, headers=kind).json()["marks"] == found
    assert client.delete(address).json()["n_control_marks"] == 0


def test_without_truth_nothing_is_called_an_error(client):
    survey = link(page(client, "/"), '/surveys/%3C[^"]+')
    assert "Truth is not known" in page(client, f"{survey}/accuracy")
    text = page(client, survey)
    assert "error against truth" not in text
    assert "residual" in text


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
    assert "/surveys/bare/logs" in text
    assert "survey=bare&amp;process=true" in page(client, "/surveys/bare/logs")


def test_a_survey_whose_only_job_failed_offers_work_on_its_log(client):
    text = page(client, "/surveys/empty")
    assert "No results yet" in text
    assert "1 log belongs to this survey" in text
    text = page(client, "/surveys/empty/logs")
    assert "Process those without results" in text
    assert "No marker &lt;b&gt;here&lt;/b&gt;." in text


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
