"""The templates and their filters: formats of numbers, units, instants and JSON."""

from __future__ import annotations

import json
import math
import re
from datetime import UTC, datetime
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from plotly.io.json import to_json_plotly

from spheremark.web import assets, glossary, theme

_MM = 1e3  # [mm/m]
_UNKNOWN = "\N{EN DASH}"
_HEAD = re.compile(r"(>?)\s*(.*?)\s*(\[.*\])?")
_ENDINGS = {
    "_deg_per_s": "deg/s",
    "_deg": "deg",
    "_rpm": "rpm",
    "_hz": "Hz",
    "_bytes": "B",
    "_s": "s",
    "_m": "m",
}


@cache
def environment() -> Environment:
    """Return the templates with their filters."""
    made = Environment(
        loader=PackageLoader("spheremark.web"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters.update(
        metres=metres,
        mm=lambda value, digits=1: number(None if value is None else value * _MM, digits),
        mm_by=_mm_by,
        degrees_by=lambda value, sigma: number(value, _digits(sigma)),
        signed_mm=lambda value: signed(value * _MM, 1),
        degrees=lambda value: number(math.degrees(value), 2),
        fixed=number,
        mib=lambda value: number(None if value is None else value / 2**20, 1),
        moment=_moment,
        json_block=json_block,
        figure_block=lambda figure: _as_block(str(to_json_plotly(figure.to_plotly_json()))),
        method=lambda name: theme.method_style(name).label,
        heading=heading,
        term=glossary.term,
    )
    made.globals.update(assets=assets, heads_of=heads_of, zip=zip)
    return made


def render(template: str, **context: Any) -> str:
    """Render a template."""
    return environment().get_template(template).render(**context)


def json_block(value: Any) -> Markup:
    """Return a value as JSON for a script element."""
    return _as_block(json.dumps(value))


def _as_block(text: str) -> Markup:
    """Mark JSON as safe after escaping what could end its element."""
    return Markup(text.replace("<", "\\u003c").replace("&", "\\u0026"))


def heading(name: str) -> str:
    """Return the name of a column or key as a heading, with its unit in brackets."""
    for ending, unit in _ENDINGS.items():
        if name.endswith(ending):
            return f"{_words(name.removesuffix(ending))} [{unit}]"
    return _words(name)


def _words(name: str) -> str:
    """Return a name as words, the first with a capital."""
    words = name.removeprefix("n_").removeprefix("has_").replace("_", " ")
    return words[:1].upper() + words[1:]


def heads_of(text: str) -> list[tuple[str, str, bool]]:
    """Return the heads of a table, ``Mark | >x [m]``: name, unit, and whether numbers follow."""
    found = [_HEAD.fullmatch(part.strip()) for part in text.split("|")]
    return [(one[2], one[3] or "", bool(one[1])) for one in found if one]


def metres(value: float | None, sigma: float | None = None) -> str:
    """Format a coordinate to millimetres, or to the first digit of a smaller sigma."""
    return number(value, max(3, min(5, _digits(sigma))))


def _digits(sigma: float | None) -> int:
    """Return the decimals that reach the first digit of a sigma; 3 without one."""
    return 3 if not sigma else max(0, math.ceil(-math.log10(sigma)))


def _mm_by(value: float | None) -> str:
    """Format a length in millimetres; two decimals below one millimetre, so that none is zero."""
    if value is None or not math.isfinite(value):
        return _UNKNOWN
    size = abs(value * _MM)
    return number(value * _MM, 2 if size < 0.995 else 1)


def signed(value: float, decimals: int = 2) -> str:
    """Format a number with its sign, a true minus; a dash for an unknown one."""
    if not math.isfinite(value):
        return _UNKNOWN
    return f"{value:+z.{decimals}f}".replace("-", "\N{MINUS SIGN}")


def number(value: float | None, decimals: int = 2) -> str:
    """Format a number; a dash for an unknown one."""
    if value is None or not math.isfinite(value):
        return _UNKNOWN
    return f"{value:z.{decimals}f}"


def _moment(value: datetime | None) -> str:
    """Format an instant in UTC."""
    return _UNKNOWN if value is None else f"{value.astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC"
