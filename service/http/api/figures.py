"""Routes of figures and tables by address: drawn, as data, and as the query that made them."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Path, Query, Response
from plotly.io.json import to_json_plotly
from pydantic import BaseModel, Field

from spheremark.pipelines.config import RESECTION_METHODS
from spheremark.service.http import figures
from spheremark.service.http.api.models import Strict
from spheremark.service.http.state import Current, Service
from spheremark.storage.catalogue.accuracy import Selection

router = APIRouter(tags=["figures"])

ResectionName = Literal[RESECTION_METHODS]  # type: ignore[valid-type]  # the list is a constant


class Form(StrEnum):
    """What an address gives."""

    JSON = "json"
    CSV = "csv"
    PARQUET = "parquet"
    SQL = "sql"


class SelectionQuery(Strict):
    """Which results are aggregated; what is not given does not restrict."""

    survey: list[str] = Field(default=[], max_length=1000, description="Names or ids of surveys.")
    method: list[str] = Field(default=[], max_length=20, description="Fitting methods.")
    stop: str = Field(default="", description="Name of a stop.")
    status: Literal["", "ok", "weak"] = Field(default="", description="ok or weak.")
    range_from_m: float = Field(default=0.0, ge=0, description="Least distance [m].")
    range_to_m: float = Field(default=1e9, ge=0, description="Greatest distance [m].")
    count_from: float = Field(default=0.0, ge=0, description="Fewest returns.")
    count_to: float = Field(default=1e12, ge=0, description="Most returns.")
    incidence_from_deg: float = Field(default=0.0, ge=0, description="Least incidence [deg].")
    incidence_to_deg: float = Field(default=180.0, ge=0, description="Greatest incidence [deg].")
    tolerance_m: float = Field(
        default=0.03, gt=0, le=1, description="Tolerance of several surveys [m]; one has its own."
    )
    marks: Literal["2", "3"] = Field(default="2", description="Marks of a station in 'angle'.")
    resection: ResectionName = Field(
        default="free_station", description="How a station is positioned from its marks."
    )
    axes: Literal["linear", "log"] = Field(default="linear", description="Axis of the errors.")

    def selection(self) -> Selection:
        """Return the selection."""
        names = set(Selection.__slots__) - {"surveys", "methods", "n_marks"}
        return Selection(
            surveys=tuple(self.survey),
            methods=tuple(self.method),
            n_marks=int(self.marks),
            **self.model_dump(include=names),
        )


class PageQuery(SelectionQuery):
    """Which part of a table, and in which order."""

    sort: str = Field(default="", max_length=80, description="Column; '-' before it: descending.")
    after: int = Field(default=0, ge=0, le=10**9, description="The 'next' of the part before.")
    limit: int = Field(default=50, ge=1, le=figures.ROWS_MAX, description="Rows in one part.")


class FigureDocument(BaseModel):
    """A figure as Plotly draws it; ``ids`` of its traces are the links of their points."""

    title: str
    caption: str
    n_rows: int = Field(description="Rows behind the figure: bins, not centres.")
    figure: dict[str, Any]


class TablePage(BaseModel):
    """A part of a table."""

    items: list[dict[str, Any]]
    next: str | None = Field(default=None, description="Pass it as 'after' for what follows.")
    n_all: int = Field(description="Rows of the whole table.")


class LimitsList(BaseModel):
    """How far the tolerance is kept, by method."""

    items: list[dict[str, Any]]
    tolerance_m: float
    has_errors: bool = Field(description="False without truth: sigmas are predictions.")


FigureName = Annotated[str, Path(description="distance, count, incidence, angle, map and so on.")]
FormName = Annotated[Form, Path(description="json, csv, parquet or sql.")]
_FILES: dict[str, Any] = {media: {} for form, media in figures.MEDIA.items() if form != "json"}


def _chosen(query: Annotated[SelectionQuery, Query()], service: Current) -> figures.Chosen:
    """Return the selection of an address."""
    return figures.choose(service, query.selection(), is_log=query.axes == "log")


ChosenRows = Annotated[figures.Chosen, Depends(_chosen)]


@router.get(
    "/figures/{figure}.{form}",
    name="get_figure",
    response_model=FigureDocument,
    responses={200: {"content": _FILES}},
)
def get_figure(figure: FigureName, form: FormName, chosen: ChosenRows, service: Current) -> Any:
    """Return a figure over surveys: drawn, its data as a file, or the query behind it."""
    return _figure(service, figure, form, chosen)


@router.get(
    "/surveys/{survey}/figures/{figure}.{form}",
    name="get_survey_figure",
    response_model=FigureDocument,
    responses={200: {"content": _FILES}},
)
def get_survey_figure(
    survey: Annotated[str, Path(description="Id or name of the survey.")],
    figure: FigureName,
    form: FormName,
    query: Annotated[SelectionQuery, Query()],
    service: Current,
) -> Any:
    """Return a figure of one survey."""
    query = query.model_copy(update={"survey": [survey]})
    chosen = figures.choose(service, query.selection(), is_log=query.axes == "log")
    return _figure(service, figure, form, chosen)


@router.get("/accuracy/limits", name="get_limits", response_model=LimitsList)
def get_limits(chosen: ChosenRows, service: Current) -> Any:
    """Return the greatest distance that keeps the tolerance by method, with its confidence."""
    return {
        "items": service.catalogue.computed(
            ("limits", repr(chosen)), lambda: figures.limits_of(service, chosen)
        ),
        "tolerance_m": chosen.selection.tolerance_m,
        "has_errors": chosen.values["is_error"],
    }


@router.get(
    "/tables/{table}.{form}",
    name="get_table",
    response_model=TablePage,
    responses={200: {"content": _FILES}},
)
def get_table(
    table: Annotated[str, Path(description="centres, stops or surveys.")],
    form: FormName,
    query: Annotated[PageQuery, Query()],
    service: Current,
) -> Any:
    """Return a part of a table in any order: as JSON with links, or as a file of many rows."""
    chosen = figures.choose(service, query.selection())
    if form is Form.SQL:
        return Response(figures.table_sql(table, chosen), media_type=figures.MEDIA[form])
    is_limited = "limit" in query.model_fields_set or form is Form.JSON
    limit = query.limit if is_limited else figures.ROWS_MAX
    found = figures.page_of(service, table, chosen, query.sort, query.after, limit)
    n_all = figures.count_of(service, table, chosen)
    end = query.after + found.num_rows
    following = str(end) if end < n_all else None
    if form is not Form.JSON:
        headers = {"X-Total-Rows": str(n_all)} | ({"X-Next": following} if following else {})
        return _file(figures.as_file(found, form), table, form, headers)
    rows = figures.with_links(found.to_pylist())
    return {"items": rows, "next": following, "n_all": n_all}


def _figure(service: Service, name: str, form: Form, chosen: figures.Chosen) -> Response:
    """Return a figure in a form."""
    if form is Form.SQL:
        return Response(figures.figure_sql(name, chosen), media_type=figures.MEDIA[form])
    if form is Form.JSON:
        text = service.catalogue.computed(
            ("figure", name, repr(chosen)),
            lambda: to_json_plotly(figures.figure_of(service, name, chosen)),
        )
        return Response(text, media_type=figures.MEDIA[form])
    return _file(figures.as_file(figures.data_of(service, name, chosen), form), name, form, {})


def _file(content: bytes, name: str, form: Form, headers: dict[str, str]) -> Response:
    """Return a file to be saved under a name."""
    headers = headers | {"Content-Disposition": f'attachment; filename="{name}.{form}"'}
    return Response(content, media_type=figures.MEDIA[form], headers=headers)
