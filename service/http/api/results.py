"""Routes of results as rows of the database: runs, centres, stations, networks, calibrations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal, TypeVar

from fastapi import APIRouter, Path, Query, Response
from fastapi.responses import FileResponse
from pydantic import AfterValidator, Field

from spheremark.pipelines.errors import NotFoundError
from spheremark.pipelines.sphere import METHODS
from spheremark.service.http.api import rows
from spheremark.service.http.api.models import Listing, Run, Strict
from spheremark.service.http.api.rows import FileName, Plain, ResultFilter, listing_of
from spheremark.service.http.state import Current, Service
from spheremark.service.serialise.models import CalibrationDocument, NetworkDocument

router = APIRouter()
_Route = TypeVar("_Route", bound=Callable[..., Any])

_FILTERS = """
WHERE ($survey::VARCHAR IS NULL OR s.survey_id = $survey OR s.name = $survey)
    AND ($run::VARCHAR IS NULL OR x.run_id = $run)
    AND ($stop::VARCHAR IS NULL OR x.stop = $stop)
    AND ($fit_method::VARCHAR IS NULL OR x.fit_method = $fit_method)
    AND ($status::VARCHAR IS NULL OR x.status = $status)
    AND ($run::VARCHAR IS NOT NULL OR NOT $latest OR x.run_id IN (SELECT run_id FROM latest_runs))
"""
_ROWS = """
SELECT {id} AS id, s.name AS survey, r.recording_id, x.*
FROM {table} AS x JOIN runs AS r USING (run_id) JOIN surveys AS s USING (survey_id)
"""
_LIST = _ROWS + _FILTERS + "ORDER BY r.finished_at, {order} LIMIT $n OFFSET $after"
_ONE = _ROWS + "WHERE {id} = $id"
_STOP = "SELECT stop FROM stops WHERE stop = $stop LIMIT 1"
_FIT = {
    "id": "concat_ws('~', x.run_id, x.stop, x.fit_method, x.marker)",
    "table": "marker_fits",
    "order": "x.run_id, x.stop, x.fit_method, x.marker",
}
_FIX = {
    "id": "concat_ws('~', x.run_id, x.stop, x.fit_method, x.resection_method)",
    "table": "station_fixes",
    "order": "x.run_id, x.stop, x.fit_method, x.resection_method",
}
_OBSERVATIONS = """
SELECT * FROM observations WHERE concat_ws('~', run_id, stop, fit_method, resection_method) = $id
ORDER BY marker
"""

_RESULTS = """
SELECT s.name AS survey, x.* FROM {table} AS x JOIN surveys AS s USING (survey_id)
WHERE ($survey::VARCHAR IS NULL OR s.survey_id = $survey)
ORDER BY x.finished_at DESC, x.{key} LIMIT $n OFFSET $after
"""
_RESULT = """
SELECT s.name AS survey, x.* FROM {table} AS x JOIN surveys AS s USING (survey_id)
WHERE x.{key} = $id
"""
_ADJUSTMENT = {"table": "adjustments", "key": "adjustment_id"}
_CALIBRATION = {"table": "calibrations", "key": "calibration_id"}
_ADJUSTMENT_PARTS = {
    "stations": "SELECT * FROM adjusted_stations WHERE adjustment_id = $id ORDER BY station",
    "marks": "SELECT * FROM adjusted_marks WHERE adjustment_id = $id ORDER BY mark",
    "control_checks": "SELECT * FROM control_checks WHERE adjustment_id = $id ORDER BY mark",
    "repeated_stops": "SELECT * FROM repeated_stops WHERE adjustment_id = $id ORDER BY ALL",
    "mark_decisions": "SELECT * FROM mark_decisions WHERE adjustment_id = $id ORDER BY mark",
    "mark_evidence": """
        SELECT * FROM mark_evidence WHERE adjustment_id = $id ORDER BY mark, station
    """,
    "refused": "SELECT * FROM refused_stations WHERE adjustment_id = $id ORDER BY station",
}
_CALIBRATION_PARTS = {
    "values": "SELECT * FROM calibrated_parameters WHERE calibration_id = $id ORDER BY place",
    "gaps": """
        SELECT * FROM calibration_gaps WHERE calibration_id = $id ORDER BY is_after, stop, marker
    """,
}

RowId = Annotated[str, Path(description="Id of the row, as the list gives it.")]
AdjustmentId = Annotated[str, Path(description="Id of the adjustment.")]
CalibrationId = Annotated[str, Path(description="Id of the calibration.")]


def _check_method(name: str) -> str:
    """Refuse the name of no fitting method."""
    if name not in METHODS:
        raise ValueError(f"{name!r} is no fitting method; there are {', '.join(METHODS)}")
    return name


FitMethod = Annotated[
    str, AfterValidator(_check_method), Field(json_schema_extra={"enum": [*METHODS]})
]


class RowFilter(rows.ResultFilter):
    """Which rows of a list of results are requested."""

    run: str | None = Field(default=None, description="Id of a run, even if a newer one exists.")
    stop: str | None = Field(default=None, description="Name of a stop.")
    fit_method: FitMethod | None = Field(default=None, description="Fitting method.")
    status: Literal["ok", "weak", "failed"] | None = Field(
        default=None, description="ok, weak, or failed for a station."
    )
    latest: bool = Field(default=True, description="Only the newest run of each log.")


class RunFilter(Strict):
    """Which runs are requested."""

    survey: str | None = Field(default=None, description="Id or name of a survey.")
    recording: str | None = Field(default=None, description="Id of a recording.")
    job: str | None = Field(default=None, description="Id of a job.")
    after: str | None = Field(default=None, description="The 'next' of the part before.")
    limit: int = Field(default=100, ge=1, le=1000, description="Items in one part.")


def _get(path: str, name: str, model: Any, tag: str = "results") -> Callable[[_Route], _Route]:
    """Return the decorator of a route to rows, whose model is known at run time only."""
    return router.get(path, name=name, tags=[tag], response_model=model)


def _download(path: str, name: str, model: Any, tag: str) -> Callable[[_Route], _Route]:
    """Return the decorator of a route to the files of a result, one of which is of a model."""
    file = {"content": {"application/octet-stream": {}}, "description": "The file."}
    responses: dict[int | str, dict[str, Any]] = {200: file | {"model": model}}
    return router.get(path, name=name, tags=[tag], response_class=Response, responses=responses)


@router.get("/runs", name="list_runs", tags=["results"])
def list_runs(chosen: Annotated[RunFilter, Query()], service: Current) -> Listing[Run]:
    """List runs, newest first."""
    if chosen.recording is not None:
        service.catalogue.get_recording(chosen.recording)
    if chosen.job is not None:
        service.catalogue.get_job(chosen.job)
    page = service.catalogue.list_runs(
        survey=chosen.survey,
        recording_id=chosen.recording,
        job_id=chosen.job,
        after=chosen.after,
        limit=chosen.limit,
    )
    return Listing(items=[Run.of(record) for record in page.items], next=page.next)


@router.get("/runs/{run}", name="get_run", tags=["results"])
def get_run(run: Annotated[str, Path(description="Id of the run.")], service: Current) -> Run:
    """Return a run."""
    return Run.of(service.catalogue.get_run(run))


@router.get(
    "/runs/{run}/result.mcap",
    name="download_result_log",
    tags=["results"],
    response_class=FileResponse,
    responses={200: {"content": {"application/vnd.mcap": {}}, "description": "The log."}},
)
def download_result_log(
    run: Annotated[str, Path(description="Id of the run.")], service: Current
) -> FileResponse:
    """Return spheres, clouds and poses of a run as MCAP, for viewers of the scan log."""
    found = service.catalogue.get_run(run)
    path = service.settings.data / "clouds" / f"{found.run_id}.mcap"
    if not path.is_file():
        raise NotFoundError(
            f"The run {run} has no log of its results; process its recording again for one."
        )
    return FileResponse(path, media_type="application/vnd.mcap", filename=f"result-{run}.mcap")


@_get("/marker-fits", "list_marker_fits", listing_of(rows.MarkerFit))
def list_marker_fits(chosen: Annotated[RowFilter, Query()], service: Current) -> Plain:
    """List sphere centres in the station frame: one per stop, marker and fitting method."""
    return _listed(service, _FIT, chosen)


@_get("/marker-fits/{row:path}", "get_marker_fit", rows.MarkerFit)
def get_marker_fit(row: RowId, service: Current) -> Plain:
    """Return one sphere centre."""
    return rows.one_of(service, _ONE.format(**_FIT), row, "marker fit")


@_get("/station-fixes", "list_station_fixes", listing_of(rows.StationFix))
def list_station_fixes(chosen: Annotated[RowFilter, Query()], service: Current) -> Plain:
    """List stations in the site frame: one per stop, fitting and resection method."""
    return _listed(service, _FIX, chosen)


@_get("/station-fixes/{row:path}", "get_station_fix", rows.StationFixDetail)
def get_station_fix(row: RowId, service: Current) -> Plain:
    """Return one station with its observations: residuals, redundancy, reliability."""
    fix = rows.one_of(service, _ONE.format(**_FIX), row, "station fix")
    return fix | {"observations": service.catalogue.rows(_OBSERVATIONS, {"id": row})}


@_get("/adjustments", "list_adjustments", listing_of(rows.Adjustment), "adjustments")
def list_adjustments(chosen: Annotated[ResultFilter, Query()], service: Current) -> Plain:
    """List adjusted networks, newest first."""
    return _results(service, _ADJUSTMENT, chosen)


@_get("/adjustments/{adjustment}", "get_adjustment", rows.AdjustmentDetail, "adjustments")
def get_adjustment(adjustment: AdjustmentId, service: Current) -> Plain:
    """Return a network with its stations, marks, and control marks left out in turn."""
    row = rows.one_of(service, _RESULT.format(**_ADJUSTMENT), adjustment, "adjustment")
    return rows.detailed(service, row, _ADJUSTMENT_PARTS, adjustment)


@_download(
    "/adjustments/{adjustment}/files/{name}", "download_adjustment", NetworkDocument, "adjustments"
)
def download_adjustment(adjustment: AdjustmentId, name: FileName, service: Current) -> Response:
    """Return a network as a file: JSON, report, CSV or GNU Gama XML."""
    return rows.document(service, adjustment, name)


@_get("/calibrations", "list_calibrations", listing_of(rows.Calibration), "calibrations")
def list_calibrations(chosen: Annotated[ResultFilter, Query()], service: Current) -> Plain:
    """List calibrations, newest first."""
    return _results(service, _CALIBRATION, chosen)


@_get("/calibrations/{calibration}", "get_calibration", rows.CalibrationDetail, "calibrations")
def get_calibration(calibration: CalibrationId, service: Current) -> Plain:
    """Return a calibration with each parameter before and after, and the gaps of the faces."""
    row = rows.one_of(service, _RESULT.format(**_CALIBRATION), calibration, "calibration")
    return rows.detailed(service, row, _CALIBRATION_PARTS, calibration)


@_download(
    "/calibrations/{calibration}/files/{name}",
    "download_calibration",
    CalibrationDocument,
    "calibrations",
)
def download_calibration(calibration: CalibrationId, name: FileName, service: Current) -> Response:
    """Return a calibration as a file: JSON, or the rig alone."""
    return rows.document(service, calibration, name)


def _listed(service: Service, table: dict[str, str], chosen: RowFilter) -> Plain:
    """Return a part of the rows of runs; refuse names that do not exist."""
    if chosen.survey is not None:
        service.catalogue.get_survey(chosen.survey)
    if chosen.run is not None:
        service.catalogue.get_run(chosen.run)
    if chosen.stop is not None and not service.catalogue.rows(_STOP, {"stop": chosen.stop}):
        raise NotFoundError(f"There are no results of a stop {chosen.stop!r}.")
    return rows.listed(service, _LIST.format(**table), chosen.model_dump())


def _results(service: Service, table: dict[str, str], chosen: ResultFilter) -> Plain:
    """Return a part of the results over a whole survey."""
    survey = chosen.survey and service.catalogue.get_survey(chosen.survey).survey_id
    return rows.listed(service, _RESULTS.format(**table), chosen.model_dump() | {"survey": survey})
