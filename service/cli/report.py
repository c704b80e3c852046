"""``spheremark report``: the results of a survey, to be printed and signed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spheremark.service.cli.terminal import err
from spheremark.service.cli.terminal import settings as read_settings

_ENDINGS = (".pdf", ".html")


def report(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SURVEY|FILE", help="Name of a survey, or JSON of `spheremark adjust --json`."
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", dir_okay=False, help="File to write: .pdf or .html.")
    ] = Path("report.pdf"),
    adjustment: Annotated[
        str | None, typer.Option(help="Id of an adjustment of the survey; the newest by default.")
    ] = None,
    data: Annotated[Path | None, typer.Option(file_okay=False, help="Data folder.")] = None,
    url: Annotated[
        str | None, typer.Option("--url", "--server", help="Address of a running service.")
    ] = None,
) -> None:
    """Write the report of a survey, to be printed and signed (PDF or HTML)."""
    from spheremark.pipelines.errors import InputError
    from spheremark.service.cli.source import Source

    if output.suffix not in _ENDINGS:
        raise InputError(f"{output.name} must end in one of {', '.join(_ENDINGS)}.")
    if Path(source).is_file():
        _of_file(Path(source), output)
    else:
        settings = read_settings(**({"data": data} if data else {}))
        Source(settings, url, folder=data).report(source, output, adjustment)
    err.print(f"The report is in {output}.", highlight=False, markup=False)


def _of_file(source: Path, output: Path) -> None:
    """Write the report of a network in a file."""
    from spheremark.service.serialise.survey_report import report_of_document
    from spheremark.web.pages.report import report_html, report_pdf

    made = report_of_document(source.read_text("utf-8"), source.name)
    text = report_pdf(made) if output.suffix == ".pdf" else report_html(made).encode()
    output.write_bytes(text)
