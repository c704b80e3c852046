"""The 3-D view of stops in one frame."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query
from fastapi.responses import HTMLResponse

from spheremark.service.http.pages.frame import frame_of
from spheremark.service.http.state import Current
from spheremark.storage.catalogue.rows import natural
from spheremark.web.pages.clouds import cloud_page

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

_STOPS = """
SELECT x.stop FROM stops AS x JOIN latest_runs AS r USING (run_id)
WHERE r.survey_id = $id GROUP BY x.stop ORDER BY {natural} LIMIT 500
""".replace("{natural}", natural("x.stop"))
_METHODS = """
SELECT DISTINCT fit_method FROM latest_marker_fits WHERE survey_id = $id
ORDER BY fit_method != 'along_beam', fit_method
"""


@router.get("/surveys/{name:path}/cloud")
def cloud(
    name: str,
    service: Current,
    stop: Annotated[list[str] | None, Query()] = None,
    method: Annotated[str, Query()] = "",
    colour: Annotated[str, Query()] = "",
) -> str:
    """Show the clouds of a survey, of all stops or of those chosen."""
    record = service.catalogue.get_survey(name)
    key = {"id": record.survey_id}
    methods = [one["fit_method"] for one in service.catalogue.rows(_METHODS, key)]
    return cloud_page(
        frame_of(service, record.name, "site"),
        method if method in methods else next(iter(methods), "along_beam"),
        [one for one in stop or () if one],
        stops=[one["stop"] for one in service.catalogue.rows(_STOPS, key)],
        methods=methods,
        colour=colour,
    )
