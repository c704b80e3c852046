"""The page that compares two results."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query
from fastapi.responses import HTMLResponse

from spheremark.service.http.pages.frame import frame_of
from spheremark.service.http.state import Current
from spheremark.service.serialise.comparison import KINDS, choices, compared
from spheremark.web.pages.compare import compare_page

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

Name = Annotated[str, Query(max_length=500)]


@router.get("/compare")
def compare(service: Current, a: Name = "", b: Name = "") -> str:
    """Show two results side by side, or what can be compared."""
    found = compared(service.catalogue, a, b) if a and b else None
    labels = {name: kind.label for name, kind in KINDS.items()}
    return compare_page(frame_of(service), found, labels, choices(service.catalogue), a, b)
