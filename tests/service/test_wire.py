"""What OpenAPI declares is what the routes return, and the columns of rows are those of tables."""

import pytest

from spheremark.service.http.api import rows
from spheremark.service.http.app import create_app
from spheremark.service.settings import Settings
from spheremark.storage.catalogue.catalogue import Catalogue

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
                continue  # answers of tus are headers alone
            yield method, path, {k: v for r in found for k, v in r.get("content", {}).items()}


def test_every_route_declares_what_it_returns(openapi):
    routes = list(successes(openapi))
    assert len(routes) > 40
    for method, path, content in routes:
        assert content, f"{method} {path} declares no response"
        declared = content.get("application/json", {"schema": {"$ref": "a file"}})
        assert "$ref" in declared["schema"], f"{method} {path} declares no model"


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
