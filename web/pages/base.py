"""What all pages share: the frame, panels of figures, and the page of an error."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import plotly.graph_objects as go

from spheremark.web.templating import render

Row = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """The frame of every page: all surveys, and the present one."""

    surveys: tuple[str, ...] = ()
    survey: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """A figure with its caption."""

    name: str
    figure: go.Figure
    caption: str
    kind: str = ""

    @property
    def title(self) -> str:
        """The title of the figure."""
        return str(self.figure.layout.title.text)


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorPage:
    """The page of an error."""

    frame: Frame
    status: int
    title: str
    detail: str
    code: str


def error_page(page: ErrorPage) -> str:
    """Return the page of an error."""
    return render("error.html", page, here="")
