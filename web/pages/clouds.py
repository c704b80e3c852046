"""The page of the 3-D view; the scene loads by address."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from urllib.parse import quote, urlencode

from spheremark.web.pages.base import Frame
from spheremark.web.templating import render

COLOURS = ("height", "intensity", "residual", "stop")


def cloud_page(frame: Frame, method: str, chosen: Sequence[str], **more: Any) -> str:
    """Return the view of the chosen stops; of all where none is chosen.

    ``more`` are the names of all stops and methods, and what colours the points.
    """
    query = [("method", method), *(("stop", one) for one in chosen)]
    if more["colour"] not in COLOURS:
        more["colour"] = COLOURS[0]
    return render(
        "cloud.html",
        frame=frame,
        survey=frame.survey,
        chosen=chosen,
        method=method,
        colours=COLOURS,
        scene=f"/api/v1/surveys/{quote(frame.survey, safe='')}/scene?{urlencode(query)}",
        **more,
    )
