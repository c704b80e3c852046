"""What all pages share: the frame, panels of figures, and key numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple
from urllib.parse import urlencode

import plotly.graph_objects as go

Row = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """The frame of every page: all surveys, the present one, and its present tab."""

    surveys: tuple[str, ...] = ()
    survey: str = ""
    tab: str = ""


class Panel(NamedTuple):
    """A figure with its caption, and the query of its rows where there is one."""

    name: str
    figure: go.Figure
    caption: str
    kind: str = ""
    sql: str = ""

    @property
    def title(self) -> str:
        """The title of the figure."""
        return str(self.figure.layout.title.text)


class Place(NamedTuple):
    """Where a figure is drawn from its address."""

    name: str
    source: str
    kind: str = ""

    @classmethod
    def of(cls, name: str, survey: str, kind: str = "") -> Place:
        """Return the place of a figure of one survey."""
        return cls(name, f"/api/v1/figures/{name}.json?{urlencode({'survey': survey})}", kind)


class Part(NamedTuple):
    """A part of a long table: the place of its first row, its most rows, and all rows."""

    after: int
    n_most: int
    n_all: int


class Readout(NamedTuple):
    """A key number with its unit and a note."""

    label: str
    value: str
    unit: str
    note: str
    method: str = ""
