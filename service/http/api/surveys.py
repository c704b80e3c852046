"""Routes of surveys: their control marks and, for comparison only, their truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
from fastapi import APIRouter, Depends, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from fastapi.responses import PlainTextResponse
from pydantic import Field, ValidationError

from spheremark.pipelines.errors import InputError, NotFoundError
from spheremark.pipelines.model import ControlMarks, Truth
from spheremark.service.errors import EmptyBodyError, MediaTypeError
from spheremark.service.http.api.models import (
    ChangedSurvey,
    ChosenRig,
    Control,
    DeletedSurvey,
    Listing,
    Mark,
    NewSurvey,
    Strict,
    Survey,
    SurveyResult,
    TruthSummary,
)
from spheremark.service.http.state import Current
from spheremark.service.http.uploads import media_type_of
from spheremark.service.serialise.solution import plain_result, survey_result
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.imports.survey_files import ControlLayout, format_control
from spheremark.storage.imports.uploads import control_of, truth_of

router = APIRouter(prefix="/surveys", tags=["surveys"])

RecordingId = Annotated[str, Path(description="Id of the recording.")]
Key = Annotated[str, Path(description="Id or name of the survey.")]
After = Annotated[str | None, Query(description="The 'next' of the part before.")]
Limit = Annotated[int, Query(ge=1, le=1000, description="Items in one part.")]


@dataclass(frozen=True, slots=True)
class Document:
    """A body that is a file: its media type and its text."""

    media_type: str
    text: str


async def document(request: Request) -> Document:
    """Read a body that is a file."""
    media_type = media_type_of(request.headers)
    body = await request.body()
    if not body.strip():
        raise EmptyBodyError("The body is empty; send the file itself as the body.")
    try:
        return Document(media_type, body.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InputError(f"The body is not UTF-8 text: {error}.") from error


def bodies(*media_types: str) -> dict[str, Any]:
    """Describe in OpenAPI a body that is a file of one of these types."""
    content = {
        one: {"schema": {"type": "object" if one == "application/json" else "string"}}
        for one in media_types
    }
    return {"requestBody": {"required": True, "content": content}}


File = Annotated[Document, Depends(document)]


class Layout(Strict):
    """How a table of control marks is laid out, where its header does not specify it."""

    axes: Literal["enu", "neu", "ned"] = Field(
        default="enu", description="Axes of three coordinates without names, or named x, y and z."
    )
    unit: Literal["m", "mm", "ft", "us-ft"] = Field(
        default="m", description="Unit of coordinates and their sigmas."
    )
    target_height_m: float = Field(
        default=0.0, gt=-100, lt=100, description="Height of the centres above the points [m]."
    )
    sigma_m: float = Field(
        default=0.0, ge=0, le=1, description="Sigma of coordinates whose sigma is missing or 0 [m]."
    )

    def layout(self) -> ControlLayout:
        """Return the layout as the reader takes it."""
        return ControlLayout(axes=self.axes, unit=self.unit, target_height=self.target_height_m)

    def with_sigma(self, marks: ControlMarks) -> ControlMarks:
        """Return marks whose missing sigmas are the given one."""
        missing = np.diagonal(marks.cov_p_site, axis1=1, axis2=2) == 0.0
        added = np.eye(3) * (self.sigma_m**2 * missing)[:, None, :]
        return replace(marks, cov_p_site=marks.cov_p_site + added)


@router.post("", status_code=201, name="create_survey")
def create_survey(new: NewSurvey, service: Current, response: Response) -> Survey:
    """Create a survey."""
    survey = service.catalogue.create_survey(new.name, tolerance=new.tolerance_m)
    response.headers["Location"] = f"/api/v1/surveys/{survey.survey_id}"
    return Survey.of(survey)


@router.get("", name="list_surveys")
def list_surveys(service: Current, after: After = None, limit: Limit = 100) -> Listing[Survey]:
    """List surveys, newest first."""
    page = service.catalogue.list_surveys(after=after, limit=limit)
    return Listing(items=[Survey.of(record) for record in page.items], next=page.next)


@router.get("/{survey}", name="get_survey")
def get_survey(survey: Key, service: Current) -> Survey:
    """Return a survey."""
    return Survey.of(service.catalogue.get_survey(survey))


@router.put(
    "/{survey}/control", name="put_control", openapi_extra=bodies("text/csv", "application/json")
)
async def put_control(
    survey: Key,
    file: File,
    layout: Annotated[Layout, Query()],
    request: Request,
    service: Current,
) -> Control:
    """Give a survey its control marks, as CSV or JSON; a survey of that name is made if missing."""
    marks = await service.readers.run(request, _read_control, file, layout)
    return await run_in_threadpool(_set_control, service.catalogue, survey, marks)


@router.delete("/{survey}/control", name="delete_control")
def delete_control(survey: Key, service: Current) -> Survey:
    """Take the control marks from a survey; its next adjustment is free."""
    service.catalogue.delete_control_marks(survey)
    return Survey.of(service.catalogue.get_survey(survey))


@router.post("/{survey}/control/preview", name="preview_control", openapi_extra=bodies("text/csv"))
async def preview_control(
    survey: Key,  # noqa: ARG001
    file: File,
    layout: Annotated[Layout, Query()],
    request: Request,
    service: Current,
) -> Control:
    """Read control marks as PUT would, and store nothing; the survey need not exist."""
    return Control.of(await service.readers.run(request, _read_control, file, layout))


@router.get(
    "/{survey}/control",
    name="get_control",
    response_model=Control,
    responses={200: {"content": {"text/csv": {}}}},
)
def get_control(survey: Key, request: Request, service: Current) -> Response | Control:
    """Return the control marks of a survey as JSON, or as CSV where the request accepts it."""
    marks = service.catalogue.control_marks(survey)
    if "text/csv" in request.headers.get("accept", "") and marks is not None:
        return PlainTextResponse(format_control(marks), media_type="text/csv")
    return Control.of(marks)


@router.get("/{survey}/result", name="get_result")
def get_result(survey: Key, service: Current) -> SurveyResult:
    """Return the chosen solution of a survey, the decision on it, and the checks behind that."""
    found = survey_result(service.catalogue, survey)
    return SurveyResult.model_validate(plain_result(found))


@router.patch("/{survey}", name="change_survey")
def change_survey(survey: Key, change: ChangedSurvey, service: Current) -> Survey:
    """Rename a survey, or set its tolerance."""
    record = service.catalogue.change_survey(survey, name=change.name, tolerance=change.tolerance_m)
    return Survey.of(record)


@router.delete("/{survey}", name="delete_survey")
def delete_survey(survey: Key, service: Current) -> DeletedSurvey:
    """Delete a survey with its results, until it is restored; its name becomes free."""
    survey_id = service.catalogue.delete_survey(survey)
    deleted = service.catalogue.deleted_surveys()
    row = next(one for one in deleted if one["survey_id"] == survey_id)
    return DeletedSurvey.model_validate(row)


@router.post("/{survey}/restoration", name="restore_survey")
def restore_survey(survey: Key, service: Current) -> Survey:
    """Restore a deleted survey, named by its id, with all its results."""
    return Survey.of(service.catalogue.restore_survey(survey))


@router.put("/{survey}/recordings/{recording}", name="assign_recording")
def assign_recording(survey: Key, recording: RecordingId, service: Current) -> Survey:
    """Assign a log to a survey, or put it back with its results after a removal."""
    service.catalogue.add_to_survey(survey, recording)
    return Survey.of(service.catalogue.get_survey(survey))


@router.delete("/{survey}/recordings/{recording}", name="remove_recording")
def remove_recording(survey: Key, recording: RecordingId, service: Current) -> Survey:
    """Take a log and its results out of a survey; assigning it again puts them back."""
    service.catalogue.remove_from_survey(survey, recording)
    return Survey.of(service.catalogue.get_survey(survey))


@router.put("/{survey}/rig", name="choose_rig")
def choose_rig(survey: Key, chosen: ChosenRig, service: Current) -> Survey:
    """Let later jobs of a survey use a rig where they name none."""
    return Survey.of(service.catalogue.choose_rig(survey, chosen.rig_digest))


@router.put("/{survey}/truth", name="put_truth", openapi_extra=bodies("application/json"))
async def put_truth(survey: Key, file: File, request: Request, service: Current) -> TruthSummary:
    """Give a survey its truth: for comparison only, no job ever sees it."""
    truth = await service.readers.run(request, truth_of, file.text)
    return await run_in_threadpool(_set_truth, service.catalogue, survey, truth)


def _set_truth(catalogue: Catalogue, survey: str, given: Truth) -> TruthSummary:
    """Store the truth of a survey; return how much of it there is now."""
    catalogue.put_truth(survey, given)
    truth = catalogue.truth(survey)
    n_marks, n_stops = (len(truth.marks.names), len(truth.stops)) if truth else (0, 0)
    return TruthSummary(n_marks=n_marks, n_stops=n_stops)


def _set_control(catalogue: Catalogue, survey: str, marks: ControlMarks) -> Control:
    """Store the control marks of a survey, which is made if it is missing."""
    try:
        catalogue.get_survey(survey)
    except NotFoundError:
        catalogue.create_survey(survey)
    catalogue.put_control_marks(survey, marks)
    return Control.of(catalogue.control_marks(survey))


def _read_control(file: Document, layout: Layout) -> ControlMarks:
    """Read control marks from CSV or JSON."""
    if file.media_type in ("text/csv", "text/plain", "application/csv"):
        return layout.with_sigma(control_of(file.text, layout.layout()))
    if file.media_type != "application/json":
        raise MediaTypeError(
            f"The body is {file.media_type or 'of no type'}; send text/csv or application/json."
        )
    try:
        marks = _to_marks(Control.model_validate_json(file.text).marks)
    except ValidationError as error:
        raise RequestValidationError(error.errors()) from error
    return control_of(format_control(marks))  # one set of checks for both forms


def _to_marks(marks: list[Mark]) -> ControlMarks:
    """Return marks of the wire as values."""
    sigmas = np.array([[m.sigma_x_m, m.sigma_y_m, m.sigma_z_m] for m in marks]).reshape(-1, 3)
    return ControlMarks(
        names=tuple(mark.mark for mark in marks),
        p_site=np.array([[m.x_m, m.y_m, m.z_m] for m in marks], dtype=np.float64).reshape(-1, 3),
        cov_p_site=np.eye(3) * np.square(sigmas)[:, None, :],
    )
