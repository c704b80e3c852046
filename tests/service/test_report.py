"""Reports to be signed: of a network, of stations alone, of a file; as PDF, HTML and a page."""

import json
import re

import pytest
from fastapi.testclient import TestClient

from spheremark.service.http.app import create_app
from spheremark.service.settings import Settings
from spheremark.storage.catalogue.catalogue import Catalogue
from tests.service.test_commands import run
from tests.surveyed import fill

API = "/api/v1/surveys"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a data folder with a survey of two stations and one without control and results."""
    data = tmp_path_factory.mktemp("data")
    with Catalogue(data / "spheremark.duckdb", snapshots=data / "snapshots") as catalogue:
        fill(catalogue, data / "clouds", "field", n_stops=2)
        catalogue.create_survey("empty & <b>")
    return data


@pytest.fixture(scope="module")
def client(folder, scheduler):
    with TestClient(
        create_app(Settings(data=folder, scheduler=scheduler)), base_url="http://127.0.0.1:8000"
    ) as one:
        yield one


def test_stations_alone_are_reported_with_what_is_missing(client):
    text = client.get(f"{API}/field/report.html").text
    assert "Station report" in text
    assert "No network" in text
    assert "lane3-stop1" in text
    assert text.count("<svg") == 1
    assert "http" not in re.sub(r'xmlns="[^"]+"', "", text.partition("<body>")[2])


def test_a_survey_without_results_has_a_report_that_says_so(client):
    (survey,) = [one for one in client.get(API).json()["items"] if "empty" in one["name"]]
    text = client.get(f"{API}/{survey['survey_id']}/report.html").text
    assert "Not accepted." in text
    assert "No stations" in text
    assert "No control marks" in text
    assert "&lt;b&gt;" in text
    assert client.get(f"{API}/{survey['survey_id']}/report.pdf").content.startswith(b"%PDF-")


def test_the_pdf_is_of_the_kind_for_archives(client):
    response = client.get(f"{API}/field/report.pdf")
    assert response.headers["content-type"] == "application/pdf"
    assert b"pdfaid:part" in response.content
    assert len(response.content) < 2_000_000


def test_names_are_text_in_the_pdf_and_never_markup(client):
    """A name of control characters, which no font has, is refused; no name is run as Typst."""
    for name, status in (('#panic("run") $x$ *b* @c', 200), ("a\x01b", 400)):
        marks = f"mark,x_m,y_m,z_m\n{name.replace(chr(34), chr(39))},0,0,1\nB,1,0,1\nC,0,1,1\n"
        address = f"{API}/names-{status}"
        kind = {"Content-Type": "text/csv"}
        client.put(f"{address}/control", content=marks, headers=kind).raise_for_status()
        response = client.get(f"{address}/report.pdf")
        assert response.status_code == status, response.text
        assert client.get(f"{address}/report.html").status_code == 200
    assert "take the report as HTML" in response.json()["detail"]


def test_the_page_has_the_same_report_and_links_to_its_files(client):
    text = client.get("/surveys/field/report").text
    (address,) = re.findall(r'href="(/api/v1/surveys/\w+/report\.pdf)"', text)
    assert client.get(address).status_code == 200
    assert "Surveyed by" in text


def test_an_adjustment_that_there_is_not_is_refused(client):
    response = client.get(f"{API}/field/report.pdf", params={"adjustment": "none"})
    assert response.status_code == 404
    assert "none" in response.json()["detail"]


def test_the_command_writes_a_report_of_a_folder(tmp_path):
    folder, target = tmp_path / "data", tmp_path / "field.html"
    folder.mkdir()
    with Catalogue(folder / "spheremark.duckdb", snapshots=folder / "snapshots") as catalogue:
        fill(catalogue, folder / "clouds", "field", n_stops=1)
    run("report", "field", "--data", folder, "-o", target)
    assert "Station report" in target.read_text()


def test_the_command_names_a_file_that_is_no_network(tmp_path):
    wrong = tmp_path / "marks.json"
    wrong.write_text(json.dumps({"marks": []}))
    done = run("report", wrong, "-o", tmp_path / "a.pdf", code=1)
    assert "marks.json is not the JSON of a network" in " ".join(done.stderr.split())
