"""Routes of results: runs, sphere centres and stations, as rows of the database."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Query
from pydantic import Field

from spheremark.pipelines.errors import NotFoundError
from spheremark.service.http.api.models import Listing, Row, Run, Strict
from spheremark.service.http.state import Current, Service

router = APIRouter(tags=["results"])

_FILTERS = """
WHERE ($survey::VARCHAR IS NULL OR s.survey_id = $survey OR s.name = $survey)
    AND ($run::VARCHAR IS NULL OR x.run_id = $run)
    AND ($stop::VARCHAR IS NULL OR x.stop = $stop)
    AND ($fit_method::VARCHAR IS NULL OR x.fit_method = $fit_method)
    AND ($status::VARCHAR IS NULL OR x.status = $status)
    AND ($run::VARCHAR IS NOT NULL OR NOT $latest OR x.run_id IN (SELECT run_id FROM latest_runs))
"""
_FITS = (
    """
SELECT concat_ws('~', x.run_id, x.stop, x.fit_method, x.marker) AS id,
    s.name AS survey, r.recording_id, x.*
FROM marker_fits AS x JOIN runs AS r USING (run_id) JOIN surveys AS s USING (survey_id)
"""
    + _FILTERS
    + "ORDER BY r.finished_at, x.run_id, x.stop, x.fit_method, x.marker LIMIT $n OFFSET $after"
)
_FIXES = (
    """
SELECT concat_ws('~', x.run_id, x.stop, x.fit_method, x.resection_method) AS id,
    s.name AS survey, r.recording_id, x.*
FROM station_fixes AS x JOIN runs AS r USING (run_id) JOIN surveys AS s USING (survey_id)
"""
    + _FILTERS
    + "ORDER BY r.finished_at, x.run_id, x.stop, x.fit_method, x.resection_method "
    "LIMIT $n OFFSET $after"
)
_FIT = """
SELECT $id AS id, s.name AS survey, r.recording_id, x.*
FROM marker_fits AS x JOIN runs AS r USING (run_id) JOIN surveys AS s USING (survey_id)
WHERE concat_ws('~', x.run_id, x.stop, x.fit_method, x.marker) = $id
"""
_FIX = """
SELECT $id AS id, s.name AS survey, r.recording_id, x.*
FROM station_fixes AS x JOIN runs AS r USING (run_id) JOIN surveys AS s USING (survey_id)
WHERE concat_ws('~', x.run_id, x.stop, x.fit_method, x.resection_method) = $id
"""
_OBSERVATIONS = """
SELECT * FROM observations WHERE concat_ws('~', run_id, stop, fit_method, resection_method) = $id
ORDER BY marker
"""

RowId = Annotated[str, Path(description="Id of the row, as the list gives it.")]


class RowFilter(Strict):
    """Which rows of a list of results are wanted."""

    survey: str | None = Field(default=None, description="Id or name of a survey.")
    run: str | None = Field(default=None, description="Id of a run, even if a newer one exists.")
    stop: str | None = Field(default=None, description="Name of a stop.")
    fit_method: str | None = Field(default=None, description="Fitting method.")
    status: str | None = Field(default=None, description="ok, weak, or failed for a station.")
    latest: bool = Field(default=True, description="Only the newest run of each log.")
    after: int = Field(default=0, ge=0, description="The 'next' of the part before.")
    limit: int = Field(default=100, ge=1, le=1000, description="Items in one part.")


class RunFilter(Strict):
    """Which runs are wanted."""

    survey: str | None = Field(default=None, description="Id or name of a survey.")
    recording: str | None = Field(default=None, description="Id of a recording.")
    job: str | None = Field(default=None, description="Id of a job.")
    after: str | None = Field(default=None, description="The 'next' of the part before.")
    limit: int = Field(default=100, ge=1, le=1000, description="Items in one part.")


@router.get("/runs", name="list_runs")
def list_runs(wanted: Annotated[RunFilter, Query()], service: Current) -> Listing[Run]:
    """List runs, newest first."""
    page = service.catalogue.list_runs(
        survey=wanted.survey,
        recording_id=wanted.recording,
        job_id=wanted.job,
        after=wanted.after,
        limit=wanted.limit,
    )
    return Listing(items=[Run.of(record) for record in page.items], next=page.next)


@router.get("/runs/{run}", name="get_run")
def get_run(run: Annotated[str, Path(description="Id of the run.")], service: Current) -> Run:
    """Return a run."""
    return Run.of(service.catalogue.get_run(run))


@router.get("/marker-fits", name="list_marker_fits")
def list_marker_fits(wanted: Annotated[RowFilter, Query()], service: Current) -> Listing[Row]:
    """List sphere centres in the station frame: one per stop, marker and fitting method."""
    return _list(service, _FITS, wanted)


@router.get("/marker-fits/{row:path}", name="get_marker_fit")
def get_marker_fit(row: RowId, service: Current) -> Row:
    """Return one sphere centre."""
    return _one(service, _FIT, row, "marker fit")


@router.get("/station-fixes", name="list_station_fixes")
def list_station_fixes(wanted: Annotated[RowFilter, Query()], service: Current) -> Listing[Row]:
    """List stations in the site frame: one per stop, fitting and resection method."""
    return _list(service, _FIXES, wanted)


@router.get("/station-fixes/{row:path}", name="get_station_fix")
def get_station_fix(row: RowId, service: Current) -> Row:
    """Return one station with its observations: residuals, redundancy, reliability."""
    fix = _one(service, _FIX, row, "station fix")
    observations = service.catalogue.rows(_OBSERVATIONS, {"id": row})
    return Row.model_validate(fix.model_dump() | {"observations": observations})


def _list(service: Service, sql: str, wanted: RowFilter) -> Listing[Row]:
    """Return a part of the rows that are wanted."""
    rows = service.catalogue.rows(
        sql, wanted.model_dump(exclude={"limit"}) | {"n": wanted.limit + 1}
    )
    end = wanted.after + wanted.limit
    return Listing(
        items=[Row.model_validate(row) for row in rows[: wanted.limit]],
        next=str(end) if len(rows) > wanted.limit else None,
    )


def _one(service: Service, sql: str, row: str, what: str) -> Row:
    """Return the row with an id."""
    rows = service.catalogue.rows(sql, {"id": row})
    if not rows:
        raise NotFoundError(f"There is no {what} {row!r}.")
    return Row.model_validate(rows[0])
