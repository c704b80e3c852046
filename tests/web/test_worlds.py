"""The page on random worlds from a report as the command keeps it."""

import re

import pytest

from spheremark.pipelines.evaluation.worlds import (
    CLASSES,
    Call,
    Centre,
    Score,
    Seen,
    report_of,
    tables,
)
from spheremark.web.pages.base import Frame
from spheremark.web.pages.worlds import curve_figure, worlds_page

FRAME = Frame()


@pytest.fixture
def report():
    centre = Centre("ok", 1e-6, 1e-6, 3.0, 3.0)
    seen = [Seen(CLASSES[0], ("ok",), "", centre), Seen(CLASSES[0], (), "it is a pole", None)]
    calls = [Call("ok", 0.9, 0, ""), Call("weak", 0.5, -1, "cube")]
    score = Score(4, "optics", seen, calls, ["cube", "tree"], None, "", 0.2)
    found = report_of([score], 4, ("Open3D",))
    about = {"code_version": "1", "made_at": "2026-01-01T00:00:00"}
    return found | about | {"tables": [one.to_texts() for one in tables(found)]}


def test_the_page_shows_every_table_and_the_curve(report):
    page = worlds_page(FRAME, report)
    assert len(re.findall("<table>", page)) == len(report["tables"])
    assert "it is a pole (1)" in page
    assert "cube" in page


def test_the_curve_marks_the_working_point(report):
    line, diamond = curve_figure(report).data
    assert list(line.y)[-1] == pytest.approx(50.0)
    assert diamond.y == (50.0,)


def test_reports_of_fewer_classes_of_markers_are_still_drawn(report):
    older = report | {"markers": report["markers"][:-1]}
    assert len(curve_figure(older).data) == len(curve_figure(report).data)


def test_without_a_report_the_page_names_the_command():
    assert "bench --worlds" in worlds_page(FRAME, None)
