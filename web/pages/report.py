"""A survey's report: as a page, as HTML in one file, and as PDF."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib import resources
from typing import Any

import typst
from markupsafe import Markup

from spheremark.pipelines.errors import InputError
from spheremark.web.figures.report_map import report_map
from spheremark.web.pages.base import Frame
from spheremark.web.templating import render

_NO_FONT = "could not be displayed"  # of Typst, where PDF/A is to have each character


def report_page(frame: Frame, report: Mapping[str, Any], address: str, query: str = "") -> str:
    """Return the report as a page; its files are at an address with .pdf and .html behind."""
    values = _drawn(report) | {"map": Markup(_drawn(report)["map"])}
    return render("report.html", frame=frame, report=values, address=address, query=query)


def report_html(report: Mapping[str, Any]) -> str:
    """Return the report as HTML in one file."""
    values = _drawn(report) | {"map": Markup(_drawn(report)["map"])}
    return render("report.html", frame=None, report=values)


def report_pdf(report: Mapping[str, Any]) -> bytes:
    """Return the report as PDF/A-2u, which is made for keeping; InputError without a font."""
    try:
        return _compiled(report, is_alone=True)
    except typst.TypstError as error:
        if _NO_FONT not in str(error):
            raise
    try:
        return _compiled(report, is_alone=False)
    except typst.TypstError as error:
        raise InputError(
            f"The PDF cannot be written: {error}. Install a font that has this character on the "
            "machine of the service, or take the report as HTML."
        ) from error


def _compiled(report: Mapping[str, Any], *, is_alone: bool) -> bytes:
    """Return the PDF, with the fonts of the template alone or with those of the machine, too."""
    template = resources.files("spheremark.web").joinpath("templates/report.typ").read_bytes()
    return bytes(
        typst.compile(
            template,
            sys_inputs={"report": json.dumps(_drawn(report))},
            pdf_standards=["a-2u"],
            ignore_system_fonts=is_alone,
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
