"""Reports of experiments as files."""

import csv

from spheremark.storage.exports.reports import keep_coverage, kept_coverage, write_csv, write_pages


def test_a_report_on_coverage_is_read_as_it_was_kept_with_its_rows_as_csv_beside_it(tmp_path):
    data = tmp_path / "data"
    released = kept_coverage(data)
    assert released["is_released"]
    assert released["n_stations"] == 15 * released["n_surveys"] > 300
    report = {
        "levels": [{"method": "network", "share": 0.5}],
        "curve": [{"method": "network", "share": 0.25}],
        "n_surveys": 2,
    }
    path = keep_coverage(report, data)
    assert kept_coverage(data) == report
    with path.with_suffix(".csv").open(newline="") as file:
        assert [row["share"] for row in csv.DictReader(file)] == ["0.5", "0.25"]


def test_pages_go_into_folders_of_their_own_with_copies_beside_them(tmp_path):
    script = tmp_path / "plot.js"
    script.write_text("draw()")
    write_pages(tmp_path / "out", {"index.html": "<p>±</p>", "figures/a.json": "{}"}, [script])
    assert (tmp_path / "out/index.html").read_text("utf-8") == "<p>±</p>"
    assert (tmp_path / "out/figures/a.json").read_text() == "{}"
    assert (tmp_path / "out/plot.js").read_text() == "draw()"


def test_a_csv_has_the_keys_of_its_rows_as_header(tmp_path):
    write_csv(tmp_path / "a.csv", [{"x_m": 1.5, "name": "a,b"}, {"x_m": "", "name": "c"}])
    with (tmp_path / "a.csv").open(newline="") as file:
        assert list(csv.DictReader(file)) == [
            {"x_m": "1.5", "name": "a,b"},
            {"x_m": "", "name": "c"},
        ]
