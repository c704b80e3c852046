"""A survey's report: as a page, as HTML in one file, and as PDF."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib import resources
from typing import Any

import typst
from markupsafe import Markup

from spheremark.web.figures.report_map import report_map
from spheremark.web.pages.base import Frame
from spheremark.web.templating import render


def report_page(frame: Frame, report: Mapping[str, Any], address: str, query: str = "") -> str:
    """Return the report as a page; its files are at an address with .pdf and .html behind."""
    values = _drawn(report) | {"map": Markup(_drawn(report)["map"])}
    return render("report.html", frame=frame, report=values, address=address, query=query)


def report_html(report: Mapping[str, Any]) -> str:
    """Return the report as HTML in one file."""
    values = _drawn(report) | {"map": Markup(_drawn(report)["map"])}
    return render("report.html", frame=None, report=values)


def report_pdf(report: Mapping[str, Any]) -> bytes:
    """Return the report as PDF/A-2u, which is made for keeping."""
    template = resources.files("spheremark.web").joinpath("templates/report.typ").read_bytes()
    return bytes(
        typst.compile(
            template,
            sys_inputs={"report": json.dumps(_drawn(report))},
            pdf_standards=["a-2u"],
            ignore_system_fonts=True,
        )
    )


def _drawn(report: Mapping[str, Any]) -> dict[str, Any]:
    """Return a report with its map."""
    lines = [(station, mark) for station, mark in report["lines"]]
    about = dict(report["about"])
    origin = dict(report["digests"])
    return {
        **report,
        "map": report_map(report["places"], lines),
        "name": about.get("Survey") or about["File"],
        "origin": f"{origin['Software']}, {origin['Report written']}",
    }
