"""What the routes of results over a whole survey share: parts of lists, single ones, files."""

from __future__ import annotations

import json
from typing import Annotated, Any

from fastapi import Path, Response
from pydantic import BaseModel, ConfigDict, Field

from spheremark.pipelines.errors import NotFoundError
from spheremark.service.http.api.models import Listing, Strict
from spheremark.service.http.state import Service

_DOCUMENT = "SELECT media_type, text FROM documents WHERE result_id = $id AND name = $name"
_NAMES = "SELECT name FROM documents WHERE result_id = $id ORDER BY name"
_JSON = ("config", "covariance")  # columns that hold JSON

FileName = Annotated[str, Path(description="Name of a file, as the result lists it.")]


class ResultFilter(Strict):
    """Which results are wanted."""

    survey: str | None = Field(default=None, description="Id or name of a survey.")
    after: int = Field(default=0, ge=0, le=10**15, description="The 'next' of the part before.")
    limit: int = Field(default=100, ge=1, le=1000, description="Items in one part.")


class Result(BaseModel):
    """A row of the database, columns as they are named and documented there."""

    model_config = ConfigDict(extra="allow")

    survey: str
    job_id: str
    config_digest: str
    code_version: str


class ResultDetail(Result):
    """A row with what belongs to it."""

    files: list[str] = Field(description="Names of the files that it can be downloaded as.")


def listed(service: Service, sql: str, wanted: ResultFilter) -> Listing[Result]:
    """Return a part of the results that are wanted."""
    survey = wanted.survey and service.catalogue.get_survey(wanted.survey).survey_id
    rows = service.catalogue.rows(
        sql, {"survey": survey, "after": wanted.after, "n": wanted.limit + 1}
    )
    end = wanted.after + wanted.limit
    return Listing(
        items=[Result.model_validate(_readable(row)) for row in rows[: wanted.limit]],
        next=str(end) if len(rows) > wanted.limit else None,
    )


def detailed(service: Service, sql: str, parts: dict[str, str], key: str) -> ResultDetail:
    """Return one result with the rows that belong to it, and the names of its files."""
    rows = service.catalogue.rows(sql, {"id": key})
    if not rows:
        raise NotFoundError(f"There is no result {key!r} of this kind.")
    found: dict[str, Any] = _readable(rows[0])
    found |= {name: service.catalogue.rows(part, {"id": key}) for name, part in parts.items()}
    names = [row["name"] for row in service.catalogue.rows(_NAMES, {"id": key})]
    return ResultDetail.model_validate(found | {"files": names})


def document(service: Service, key: str, name: str) -> Response:
    """Return a file of a result, to be saved under its name."""
    found = service.catalogue.rows(_DOCUMENT, {"id": key, "name": name})
    if not found:
        raise NotFoundError(f"There is no file {name!r} of a result {key!r}.")
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return Response(found[0]["text"], media_type=found[0]["media_type"], headers=headers)


def _readable(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row with its JSON as values."""
    return {key: json.loads(value) if key in _JSON else value for key, value in row.items()}
