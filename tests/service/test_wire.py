"""What OpenAPI declares is what the routes return, and the columns of rows are those of tables."""

import pytest

from spheremark.service.http.api import rows
from spheremark.service.http.app import create_app
from spheremark.service.settings import Settings
from spheremark.storage.catalogue.catalogue import Catalogue

OF_TUS = {
    "tus-resumable", "tus-version", "tus-extension", "tus-max-size", "tus-checksum-algorithm",
    "location", "upload-offset", "upload-length", "upload-expires", "content-location", "link",
    "cache-control",
}  # fmt: skip
LABELS = {"id", "survey", "recording_id"}
TABLES = {
    rows.MarkerFit: "marker_fits",
    rows.StationFix: "station_fixes",
    rows.Adjustment: "adjustments",
    rows.Calibration: "calibrations",
}
PARTS = {
    rows.StationFixDetail: {"observations": "observations"},
    rows.AdjustmentDetail: {
        "stations": "adjusted_stations",
        "marks": "adjusted_marks",
        "control_checks": "control_checks",
        "repeated_stops": "repeated_stops",
        "mark_decisions": "mark_decisions",
        "mark_evidence": "mark_evidence",
        "refused": "refused_stations",
    },
    rows.CalibrationDetail: {"values": "calibrated_parameters", "gaps": "calibration_gaps"},
}


@pytest.fixture(scope="module")
def openapi():
    return create_app(Settings()).openapi()


@pytest.fixture(scope="module")
def columns(tmp_path_factory):
    folder = tmp_path_factory.mktemp("schema")
    with Catalogue(folder / "one.duckdb", snapshots=folder / "snapshots") as catalogue:
        return {
            table.name: [column.name for column in table.columns] for table in catalogue.schema()
        }


def successes(openapi):
    """Yield method, path and content of each successful response."""
    for path, operations in openapi["paths"].items():
        for method, operation in operations.items():
            found = [r for status, r in operation["responses"].items() if status.startswith("2")]
            if path.startswith("/api/v1/uploads"):
                continue  # answers of tus are headers alone, see below
            if "204" in operation["responses"]:
                continue  # nothing is returned
            yield method, path, {k: v for r in found for k, v in r.get("content", {}).items()}


def test_every_route_declares_what_it_returns(openapi):
    routes = list(successes(openapi))
    assert len(routes) > 40
    for method, path, content in routes:
        assert content, f"{method} {path} declares no response"
        declared = content.get("application/json", {"schema": {"$ref": "a file"}})
        assert "$ref" in declared["schema"], f"{method} {path} declares no model"


def declared(openapi, method, path, status):
    """Return the headers that a response is declared to have, in lower case."""
    answer = openapi["paths"][path][method]["responses"][str(status)]
    assert "content" not in answer
    return {name.lower() for name in answer["headers"]}


def test_resumable_uploads_have_the_headers_that_are_declared(openapi, site):
    one, tus = "/api/v1/uploads/{upload}", {"Tus-Resumable": "1.0.0"}
    log = site.stop.log.read_bytes()
    part = {**tus, "Content-Type": "application/offset+octet-stream"}
    begin = site.client.post("/api/v1/uploads", headers={**tus, "Upload-Length": str(len(log))})
    url, first = begin.headers["location"], {**part, "Upload-Offset": "0"}
    end = {**part, "Upload-Offset": str(len(log) // 2)}
    answers = [
        ("options", "/api/v1/uploads", site.client.options("/api/v1/uploads")),
        ("post", "/api/v1/uploads", begin),
        ("patch", one, site.client.patch(url, content=log[: len(log) // 2], headers=first)),
        ("head", one, site.client.head(url, headers=tus)),
        ("patch", one, site.client.patch(url, content=log[len(log) // 2 :], headers=end)),
    ]
    again = site.client.post("/api/v1/uploads", headers={**tus, "Upload-Length": "9"})
    ended = site.client.delete(again.headers["location"], headers=tus)
    found = set()
    for method, path, answer in [*answers, ("delete", one, ended)]:
        names = declared(openapi, method, path, answer.status_code)
        sent = {name for name in answer.headers if name in OF_TUS}
        assert sent <= names, (method, path)
        found |= {(method, path, name) for name in sent}
    for method, path in {(method, path) for method, path, _ in found}:
        operation = openapi["paths"][path][method]["responses"]
        (status,) = (key for key in operation if key.startswith("2"))
        always = declared(openapi, method, path, status) - {"link"}
        if path == "/api/v1/uploads" and method == "post":
            always -= {"upload-offset", "content-location"}  # without a body
        assert {name for m, p, name in found if (m, p) == (method, path)} == always
    for path in ("/api/v1/uploads", one):
        for operation in openapi["paths"][path].values():
            assert operation["responses"]["default"]["content"]


def test_no_declared_response_takes_just_any_key(openapi):
    schemas = openapi["components"]["schemas"]
    for method, path, content in successes(openapi):
        if "application/json" not in content:
            continue
        name = content["application/json"]["schema"]["$ref"].rpartition("/")[2]
        assert schemas[name]["properties"], f"{method} {path}: {name} declares no field"
        assert not schemas[name].get("additionalProperties"), f"{method} {path}: {name}"


@pytest.mark.parametrize("model", TABLES, ids=lambda model: model.__name__)
def test_rows_have_the_columns_of_their_table(model, columns):
    assert set(model.model_fields) - LABELS == set(columns[TABLES[model]]) - LABELS


@pytest.mark.parametrize("model", PARTS, ids=lambda model: model.__name__)
def test_rows_of_a_result_have_the_columns_of_their_tables(model, columns):
    for part, table in PARTS[model].items():
        (row,) = model.model_fields[part].annotation.__args__
        assert list(row.model_fields) == columns[table], part
