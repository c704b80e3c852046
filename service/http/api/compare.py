"""The route that compares two results."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query
from pydantic import BaseModel, Field

from spheremark.service.http.state import Current
from spheremark.service.serialise.comparison import compared

router = APIRouter(tags=["results"])

Name = Annotated[
    str,
    Query(
        max_length=500,
        description="run:ID, network:ID, rig:ID, plan:ID or method:SURVEY/METHOD.",
    ),
]


class Comparison(BaseModel):
    """Two results side by side."""

    kind: str
    a: str
    b: str
    summary: str = Field(description="The difference and its significance, as a sentence.")
    notes: list[str]
    about: list[dict[str, Any]] = Field(description="How both were made.")
    settings: list[dict[str, Any]] = Field(default=[], description="Settings that differ.")
    rows: list[dict[str, Any]] = Field(description="What both share, largest difference first.")
    quality: str | None = Field(default=None, description="What the rows of methods hold.")


@router.get("/compare", name="compare", response_model=Comparison)
def compare(a: Name, b: Name, service: Current) -> Any:
    """Compare two results of one kind: differences B minus A with their significance."""
    return compared(service.catalogue, a, b)
