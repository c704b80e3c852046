"""The client for notebooks, against a service that runs."""

import httpx
import pytest

from spheremark import Client
from spheremark.pipelines.errors import InputError
from spheremark.service.client import RemoteError


@pytest.fixture
def client(site):
    return Client(http=site.client)


def test_an_uploaded_log_ends_as_rows_of_a_frame(client, site, tmp_path):
    marks = tmp_path / "marks.csv"
    marks.write_text(site.control)
    client.set_control("from-notebook", marks)
    job = client.wait(client.upload(site.stop.log, survey="from-notebook", name="stop 1"))
    assert job["status"] == "successful"
    markers, stations = client.markers("from-notebook"), client.stations("from-notebook")
    assert len(markers.query("fit_method == 'along_beam'")) >= 3
    assert (stations.sigma_3d_m < 0.03).any()
    assert set(markers.stop) == set(stations.stop)


def test_a_survey_is_made_for_a_log_that_is_only_kept(client, site):
    kept = client.upload(site.stop.log, survey="kept only", process=False)
    assert kept["job"] is None
    assert client.query("SELECT name FROM surveys").name.isin(["kept only"]).any()


def test_the_name_of_a_survey_may_hold_what_addresses_use(client, site, tmp_path):
    marks = tmp_path / "marks.csv"
    marks.write_text(site.control)
    name = "50 % of #3?"
    client.set_control(name, marks)
    client.upload(site.stop.log, survey=name, process=False)
    assert client.query("SELECT name FROM surveys").name.isin([name]).sum() == 1
    with pytest.raises(RemoteError, match="'/'"):
        client.upload(site.stop.log, survey="quarry/east", process=False)


def test_the_name_of_a_survey_is_no_sql(client):
    assert client.markers("x' OR survey IS NOT NULL --").empty


def test_a_cut_answer_warns(client):
    with pytest.warns(UserWarning, match="cut the result"):
        client.query("SELECT * FROM range(1000000)")


def test_a_failed_job_is_an_error_with_its_reason(client, site):
    client.upload(site.stop.log, survey="alone", process=False)
    job = client.start("adjust", "alone")
    with pytest.raises(RemoteError, match="failed"):
        client.wait(job)


def test_what_the_service_refuses_is_an_error_with_its_sentence(client):
    with pytest.raises(RemoteError, match="nope"):
        client.query("SELECT * FROM nope")


def test_a_log_that_is_not_there_is_refused(client, tmp_path):
    with pytest.raises(InputError, match="no log"):
        client.upload(tmp_path / "none.mcap", survey="s")


@pytest.mark.parametrize(
    "found",
    [
        {"text": "<h1>It works!</h1>"},
        {"json": ["no", "object"]},
        {"json": {"message": "ok"}},
        {"status_code": 502, "text": "<h1>Bad gateway</h1>"},
        {"status_code": 404, "json": {"error": "no such page"}},
        {"status_code": 500, "text": "no JSON", "headers": {"content-type": "application/json"}},
        {"status_code": 302, "headers": {"location": "/login"}},
    ],
)
def test_what_is_no_spheremark_is_said_so(stop, found, tmp_path):
    elsewhere = httpx.MockTransport(lambda _: httpx.Response(**{"status_code": 200} | found))
    one = Client(http=httpx.Client(transport=elsewhere, base_url="http://elsewhere"))
    for ask in (
        lambda: one.query("SELECT 1"),
        lambda: one.wait("0123"),
        lambda: one.wait(one.upload(stop.log, survey="quarry")),
        lambda: one.download("/export/results.duckdb", tmp_path / "results.duckdb"),
    ):
        with pytest.raises(RemoteError, match="http://elsewhere"):
            ask()
    assert not list(tmp_path.iterdir())


def test_a_log_that_is_only_kept_has_no_job_to_wait_for(client, site):
    with pytest.raises(InputError, match="no job"):
        client.wait(client.upload(site.stop.log, survey="kept only", process=False))


def test_where_no_service_answers_the_sentence_says_what_to_do():
    with pytest.raises(RemoteError, match="spheremark serve"), Client("http://127.0.0.1:9") as one:
        one.query("SELECT 1")
