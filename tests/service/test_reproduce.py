import csv
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rich.console import Console

from spheremark.pipelines.errors import NotFoundError
from spheremark.pipelines.evaluation.reproduction.plan import OURS, PAPER
from spheremark.pipelines.published import TABLE_2
from spheremark.service.bench.reproduce import (
    ReproductionOptions,
    _report,
    page_of,
    reproduce,
    reproduction_tables,
)
from spheremark.service.cli.render import print_tables
from spheremark.web import assets, theme
from spheremark.web.pages import reproduction as drawing
from tests.reproduced import reproduction

MM = 1e-9  # [mm]; figures only scale
STUDY = (
    "figure3", "figure4", "figure8-distance", "figure8-count", "figure9", "figure10", "figure11",
)  # fmt: skip
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def page():
    return page_of(reproduction(), 3)


@pytest.fixture(scope="module")
def panels(page):
    return {panel.name: panel for panel in drawing.panels(page)}


def test_all_figures_of_the_study_are_there_once(panels):
    assert set(STUDY) <= set(panels)


def test_every_axis_has_a_title_with_its_unit(panels):
    for panel in panels.values():
        layout = panel.figure.layout
        for axis in [layout.xaxis, layout.yaxis]:
            assert re.search(r"\[\w+\]|Returns on|Stop|Reflectivity", axis.title.text), panel.name


def test_figure_8_has_both_methods_and_the_published_points(panels):
    names = {trace.name for trace in panels["figure8-distance"].figure.data}
    labels = {theme.method_style(method).label for method in (OURS, PAPER)}
    assert labels | {"study, Table 2"} <= names


def test_the_cut_takes_points_from_the_second_half_only(page, panels):
    data = panels["figure9"].figure.data
    lost = [len(trace.x) for trace in data if trace.name == "lost to the cut"]
    kept = [len(trace.x) for trace in data if trace.name == "kept"]
    n_left = int(page.example.is_left.sum())
    assert kept == [n_left, n_left]
    assert lost == [len(page.example.is_left) - n_left, 0]


def test_spheres_are_drawn_where_the_methods_put_them(page, panels):
    outlines = {
        t.name.partition(":")[0]: t for t in panels["figure3"].figure.data if t.mode == "lines"
    }
    for method, label in (("paper", "hemisphere"), ("paper_sphere", "full sphere")):
        centre = page.example.centres_station[method] * 1e3
        middle = [(np.max(outlines[label].x) + np.min(outlines[label].x)) / 2]
        assert_allclose(middle, centre[[0]], atol=0.1)


def test_lines_of_count_are_means_over_the_spheres_at_one_distance(page, panels):
    line = next(t for t in panels["turns"].figure.data if t.name == theme.method_style(PAPER).label)
    level = page.distances
    own = (level["fit_method"] == PAPER) & (level["range_m"] == 5.0)
    means = [1e3 * level["error_3d_m"][own & (level["turn_s"] == t)].mean() for t in (6.6, 13.2)]
    assert_allclose(line.y, means, rtol=0, atol=MM)


def test_the_page_stands_alone(page):
    text = drawing.reproduction_page(page)
    loaded = re.findall(r'(?:src|href)="([^"#]+)"|url\("?([^")]+)', text)
    assert {a or b[:5] for a, b in loaded} == {assets.plotly_script().name, "data:"}
    assert not re.search(r"https?://(?!www\.w3\.org)", text)
    for block in re.findall(r'<script type="application/json"[^>]*>(.*?)</script>', text, re.S):
        assert json.loads(block)["data"]


def test_the_page_has_the_published_table_and_what_was_found_beside_it(page):
    text = drawing.reproduction_page(page)
    for error in TABLE_2.errors_3d:
        assert f">{1e3 * error:.1f}<" in text
    assert f"{page.table_2[0]['paper_error_3d_mean_m'] * 1e3:.1f}" in text
    assert "the study, as published" in text


def test_the_report_is_a_table_and_json(page, tmp_path):
    report = _report(tmp_path, reproduction(), page)
    json.dumps(report, allow_nan=False)
    out = Console(record=True, width=160)
    print_tables(out, reproduction_tables(report))
    text = out.export_text()
    for word in ("6.84", "165.05", "lane2-stop7", "to 30 m", str(tmp_path / "index.html")):
        assert word in text
    assert f"{1e3 * report['table2'][0]['paper_minus_study_m']:+.1f}" in text


def test_inlined_scripts_and_styles_cannot_end_their_element():
    assert "</" not in assets.inline_styles()
    for name in ("theme.js", "figures.js"):
        assert "</script" not in assets.inline_script(name).lower()


def test_a_portable_figure_has_colours_and_no_names_of_variables(panels):
    for mode in ("light", "dark"):
        plain = panels["figure8-count"].figure.to_plotly_json()
        assert "var(--" not in str(theme.coloured(plain, assets.tokens(mode)))
    assert assets.tokens("light")["--ours"] != assets.tokens("dark")["--ours"]


def test_a_folder_without_real_scans_is_refused_before_anything_is_simulated(tmp_path):
    with pytest.raises(NotFoundError, match=r"holds no real scans; vlp16_packets/\*\.bin"):
        reproduce(tmp_path / "out", ReproductionOptions(real=tmp_path), lambda _share, _what: None)
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_the_command_writes_page_tables_and_figures_and_says_the_same_as_json(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "spheremark.service.cli", "reproduce", tmp_path / "out",
         "--quick", "--json"],
        capture_output=True, text=True, check=True, cwd=ROOT,
    )  # fmt: skip
    report = json.loads(done.stdout)
    assert [row["distance_m"] for row in report["table2"]] == TABLE_2.ranges.tolist()
    assert len(report["table4"]) == 7
    ours = [one for one in report["statements"] if one["fit_method"] == OURS]
    kept_to = re.match(r"≥ ([\d.]+) m", ours[0]["said"]["distance"])
    assert kept_to
    assert float(kept_to[1]) >= 9.0  # the farthest of the study's spheres
    assert abs(report["table2_paper_minus_study_m"]) < 0.005
    assert report["table3_rms_from_study_m"] < 0.003
    with (tmp_path / "out/table2.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert float(rows[0]["paper_error_3d_mean_m"]) == pytest.approx(
        report["table2"][0]["paper_error_3d_mean_m"], abs=1e-5
    )
    figures = {path.stem for path in (tmp_path / "out/figures").glob("*.json")}
    assert set(STUDY) <= figures
    drawn_in_chromium(tmp_path / "out/index.html")


def drawn_in_chromium(page):
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path="/usr/bin/chromium", args=["--no-sandbox"]
        )
        tab = browser.new_page()
        problems = []
        tab.on("pageerror", lambda error: problems.append(str(error)))
        tab.on(
            "request",
            lambda request: problems.append(request.url) if "http" in request.url[:5] else None,
        )
        tab.goto(page.as_uri())
        tab.wait_for_function(
            "[...document.querySelectorAll('[data-figure]')].every((one) => one.dataset.drawn)"
        )
        assert tab.locator("[data-figure]").count() == 12
        assert tab.evaluate("document.fonts.check('16px \"IBM Plex Sans\"')")
        browser.close()
    assert not problems
