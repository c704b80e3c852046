"""The map of a report as SVG: stations, marks, lines of sight, and 95 % ellipses to one scale."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any
from xml.sax.saxutils import escape

Place = Mapping[str, Any]

_WIDTH, _MOST_HEIGHT, _MARGIN = 720.0, 620.0, 46.0
_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_LEAST_ACROSS = 1.0  # [m] of a map of one point
_ELLIPSE_SHARE = 0.03  # of the map's width that the largest ellipse takes
_INK, _FAINT, _STATION = "#1a2026", "#b4bbb9", "#1767a8"


def report_map(places: Sequence[Place], lines: Sequence[tuple[str, str]]) -> str:
    """Draw a map; x to the right, y up.

    Parameters
    ----------
    places : sequence of mapping
        ``name``, ``kind`` (station, control or mark), ``x_m``, ``y_m``, and of an ellipse of 95 %
        ``major_m``, ``minor_m`` and ``bearing_deg`` (from y towards x), or None.
    lines : sequence of pair of str
        Names of places that an observation connects.

    Returns
    -------
    str
        An SVG element; empty without places.
    """
    if not places:
        return ""
    xs, ys = [one["x_m"] for one in places], [one["y_m"] for one in places]
    across = max(max(xs) - min(xs), _LEAST_ACROSS)
    up = max(max(ys) - min(ys), _LEAST_ACROSS / 2)
    scale = min((_WIDTH - 2 * _MARGIN) / across, (_MOST_HEIGHT - 2 * _MARGIN) / up)
    height = up * scale + 2 * _MARGIN + 30
    left = (_WIDTH - across * scale) / 2

    at = {
        (one["kind"] == "station", one["name"]): (
            left + (one["x_m"] - min(xs)) * scale,
            _MARGIN + (max(ys) - one["y_m"]) * scale,
        )
        for one in places
    }
    widest = max((one["major_m"] or 0.0 for one in places), default=0.0)
    factor = _round(_ELLIPSE_SHARE * _WIDTH / (widest * scale)) if widest else 0.0
    parts = [_line(at[True, a], at[False, b]) for a, b in lines if (False, b) in at]
    for i, one in enumerate(places):
        x, y = at[one["kind"] == "station", one["name"]]
        parts += [_ellipse(one, x, y, factor * scale), _symbol(one["kind"], x, y)]
        below = 20 if one["kind"] == "station" and i % 2 else -8  # neighbours in turn
        parts.append(_text(x + 4, y + below, one["name"]))
    parts += _legend(scale, factor, height)
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH:g} {height:.0f}" '
    style = 'role="img" aria-label="Map of stations and marks" font-family="IBM Plex Sans">'
    return "\n".join([head + style, *parts, "</svg>"])


def _round(value: float) -> float:
    """Return the greatest 1, 2 or 5 times a power of ten that is not above a value."""
    power = 10.0 ** math.floor(math.log10(value))
    return power * max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9))


def _line(a: tuple[float, float], b: tuple[float, float]) -> str:
    """Draw a line of sight."""
    ends = f'x1="{a[0]:.1f}" y1="{a[1]:.1f}" x2="{b[0]:.1f}" y2="{b[1]:.1f}"'
    return f'<line {ends} stroke="{_FAINT}" stroke-width="0.5"/>'


def _symbol(kind: str, x: float, y: float) -> str:
    """Draw a station as a dot, a control mark as a triangle, another mark as a ring."""
    if kind == "station":
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.4" fill="{_STATION}"/>'
    if kind == "control":
        corners = f"{x:.1f},{y - 6:.1f} {x - 5.2:.1f},{y + 3:.1f} {x + 5.2:.1f},{y + 3:.1f}"
        return f'<polygon points="{corners}" fill="white" stroke="{_INK}" stroke-width="1.3"/>'
    circle = f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4"'
    return f'{circle} fill="white" stroke="{_INK}" stroke-width="1.3"/>'


def _ellipse(one: Place, x: float, y: float, scale: float) -> str:
    """Draw an ellipse; its bearing counts from y towards x."""
    if not one["major_m"] or not scale:
        return ""
    axes = f'rx="{one["major_m"] * scale:.2f}" ry="{one["minor_m"] * scale:.2f}"'
    turn = f'transform="translate({x:.1f} {y:.1f}) rotate({one["bearing_deg"] - 90:.1f})"'
    return f'<ellipse {axes} {turn} fill="none" stroke="{_STATION}" stroke-width="1"/>'


def _text(x: float, y: float, text: str, size: float = 12.0) -> str:
    """Draw a text."""
    place = f'x="{x:.1f}" y="{y:.1f}" font-size="{size}"'
    shown = escape(_NOT_XML.sub("\ufffd", text))
    halo = 'stroke="white" stroke-width="3" paint-order="stroke"'  # over lines of sight
    return f'<text {place} fill="{_INK}" {halo}>{shown}</text>'


def _legend(scale: float, factor: float, height: float) -> list[str]:
    """Draw the scale of lengths, the scale of ellipses, and the direction of y."""
    length = _round(140.0 / scale)
    y, x = height - 16, _MARGIN
    bar = f'<path d="M{x} {y - 4}v4h{length * scale:.1f}v-4" fill="none" stroke="{_INK}"/>'
    arrow = f'<path d="M{_WIDTH - 30} 44v-28m-5 9l5 -9l5 9" fill="none" stroke="{_INK}"/>'
    text = f"{length:g} m"
    if factor:
        text += f"; ellipses of 95 % drawn {factor:g} times as large"
    kinds = "dot: station, triangle: control, ring: mark"
    return [
        bar,
        arrow,
        _text(_WIDTH - 34, 58, "y"),
        _text(x + length * scale + 8, y, text),
        _text(_WIDTH - 300, y, kinds),
    ]
