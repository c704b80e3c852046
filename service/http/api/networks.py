"""Routes of adjusted networks: rows of the database, and files."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Query, Response

from spheremark.service.http.api.listings import (
    FileName,
    Result,
    ResultDetail,
    ResultFilter,
    detailed,
    document,
    listed,
)
from spheremark.service.http.api.models import Listing
from spheremark.service.http.state import Current

router = APIRouter(prefix="/adjustments", tags=["adjustments"])

AdjustmentId = Annotated[str, Path(description="Id of the adjustment.")]

_LIST = """
SELECT s.name AS survey, x.* FROM adjustments AS x JOIN surveys AS s USING (survey_id)
WHERE ($survey::VARCHAR IS NULL OR s.survey_id = $survey)
ORDER BY x.finished_at DESC, x.adjustment_id LIMIT $n OFFSET $after
"""
_ONE = """
SELECT s.name AS survey, x.* FROM adjustments AS x JOIN surveys AS s USING (survey_id)
WHERE x.adjustment_id = $id
"""
_PARTS = {
    "stations": "SELECT * FROM adjusted_stations WHERE adjustment_id = $id ORDER BY station",
    "marks": "SELECT * FROM adjusted_marks WHERE adjustment_id = $id ORDER BY mark",
    "control_checks": "SELECT * FROM control_checks WHERE adjustment_id = $id ORDER BY mark",
    "repeated_stops": "SELECT * FROM repeated_stops WHERE adjustment_id = $id ORDER BY ALL",
    "refused": "SELECT * FROM refused_stations WHERE adjustment_id = $id ORDER BY station",
}


@router.get("", name="list_adjustments")
def list_adjustments(wanted: Annotated[ResultFilter, Query()], service: Current) -> Listing[Result]:
    """List adjusted networks, newest first."""
    return listed(service, _LIST, wanted)


@router.get("/{adjustment}", name="get_adjustment")
def get_adjustment(adjustment: AdjustmentId, service: Current) -> ResultDetail:
    """Return a network with its stations, marks, and control marks left out in turn."""
    return detailed(service, _ONE, _PARTS, adjustment)


@router.get("/{adjustment}/files/{name}", name="download_adjustment", response_class=Response)
def download_adjustment(adjustment: AdjustmentId, name: FileName, service: Current) -> Response:
    """Return a network as a file: JSON, report, CSV or GNU Gama XML."""
    return document(service, adjustment, name)
