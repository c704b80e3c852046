"""Addresses of the things that figures and tables show; a dot, a row and an ellipse share one."""

from __future__ import annotations

from urllib.parse import quote, urlencode

_ROWS = "SELECT * FROM {table} WHERE {where} ORDER BY ALL"


def survey_url(survey: str, tab: str = "") -> str:
    """Return the address of a survey, or of one of its tabs."""
    return f"/surveys/{quote(survey, safe='')}" + (f"/{tab}" if tab else "")


def stop_url(survey: str, stop: str, method: str = "", marker: str = "") -> str:
    """Return the address of a stop; with a marker, of that marker in it."""
    query = {"method": method, "marker": marker}
    chosen = urlencode({name: value for name, value in query.items() if value})
    return f"{survey_url(survey)}/stops/{quote(stop, safe='')}" + (f"?{chosen}" if chosen else "")


def query_text(table: str, **where: str) -> str:
    """Return the query of the rows behind a figure, for a person to run."""
    conditions = [
        f"{name} = '{value.replace(chr(39), 2 * chr(39))}'" for name, value in where.items()
    ]
    return _ROWS.format(table=table, where=" AND ".join(conditions))


def filter_link(**values: object) -> str:
    """Return a link that changes filters of the page that it is on."""
    return f"?{urlencode(values)}"
