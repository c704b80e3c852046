"""The page that shows two results side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from spheremark.web.figures.compare import difference_figure
from spheremark.web.pages.base import Frame, Panel, Row
from spheremark.web.templating import render

_CAPTION = "Length of each difference, B minus A; chance alone exceeds the bar in 5 % of cases."


def compare_page(
    frame: Frame,
    found: Mapping[str, Any] | None,
    labels: Mapping[str, str],
    choices: Mapping[str, Sequence[Row]],
    a: str,
    b: str,
) -> str:
    """Return the page; without two results it only offers them."""
    panel = None
    if found and found["kind"] in ("run", "network") and found["rows"]:
        panel = Panel("differences", difference_figure(found["rows"]), _CAPTION)
    return render(
        "compare.html",
        frame=frame,
        found=found,
        labels=labels,
        choices=choices,
        a=a,
        b=b,
        kind=(a or b).partition(":")[0],
        panel=panel,
    )
