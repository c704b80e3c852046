"""The client for notebooks, against a service that runs."""

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


def test_where_no_service_answers_the_sentence_says_what_to_do():
    with pytest.raises(RemoteError, match="spheremark serve"), Client("http://127.0.0.1:9") as one:
        one.query("SELECT 1")
