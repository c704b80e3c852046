"""Routes of calibrations: rows of the database, and files."""

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

router = APIRouter(prefix="/calibrations", tags=["calibrations"])

CalibrationId = Annotated[str, Path(description="Id of the calibration.")]

_LIST = """
SELECT s.name AS survey, x.* FROM calibrations AS x JOIN surveys AS s USING (survey_id)
WHERE ($survey::VARCHAR IS NULL OR s.survey_id = $survey)
ORDER BY x.finished_at DESC, x.calibration_id LIMIT $n OFFSET $after
"""
_ONE = """
SELECT s.name AS survey, x.* FROM calibrations AS x JOIN surveys AS s USING (survey_id)
WHERE x.calibration_id = $id
"""
_PARTS = {
    "values": "SELECT * FROM calibrated_parameters WHERE calibration_id = $id ORDER BY place",
    "gaps": """
        SELECT * FROM calibration_gaps WHERE calibration_id = $id ORDER BY is_after, stop, marker
    """,
}


@router.get("", name="list_calibrations")
def list_calibrations(
    wanted: Annotated[ResultFilter, Query()], service: Current
) -> Listing[Result]:
    """List calibrations, newest first."""
    return listed(service, _LIST, wanted)


@router.get("/{calibration}", name="get_calibration")
def get_calibration(calibration: CalibrationId, service: Current) -> ResultDetail:
    """Return a calibration with each parameter before and after, and how the faces agree."""
    return detailed(service, _ONE, _PARTS, calibration)


@router.get("/{calibration}/files/{name}", name="download_calibration", response_class=Response)
def download_calibration(calibration: CalibrationId, name: FileName, service: Current) -> Response:
    """Return a calibration as a file: JSON, or the rig alone."""
    return document(service, calibration, name)
