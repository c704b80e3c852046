"""The interface for programs, under ``/api/v1``: routes by what they are about.

Every handler parses, makes one call and returns; requests and responses are in ``models`` and
``rows``.
"""

from functools import cache

from fastapi import APIRouter, Depends, FastAPI, Request
from fastapi.exceptions import RequestValidationError

from spheremark.service.http.api import (
    audit,
    clouds,
    compare,
    figures,
    jobs,
    plans,
    problems,
    recordings,
    reports,
    results,
    rigs,
    sql,
    surveys,
    uploads,
)
from spheremark.service.http.api import sites as products


def _require_known_parameters(request: Request) -> None:
    """Refuse parameters of the query that the operation does not describe."""
    known = _parameters(request.app).get(request.scope["route"].name)
    if known is None:  # the operation has no description
        return
    unknown = [name for name in request.query_params if name not in known]
    if unknown:
        text = f"this operation has {', '.join(sorted(known)) or 'no parameters'}"
        found = [{"type": "extra_forbidden", "loc": ("query", one), "msg": text} for one in unknown]
        raise RequestValidationError(found)


@cache
def _parameters(app: FastAPI) -> dict[str, set[str]]:
    """Return the names of the parameters that the query of each operation may have."""
    operations = [one for path in app.openapi()["paths"].values() for one in path.values()]
    found = ((each["operationId"], each.get("parameters", ())) for each in operations)
    return {key: {one["name"] for one in many if one["in"] == "query"} for key, many in found}


router = APIRouter(dependencies=[Depends(_require_known_parameters)])
for part in (
    *(surveys, reports, recordings, uploads, jobs, results),
    *(products, rigs, plans, sql, figures, compare, clouds, audit, problems),
):
    router.include_router(part.router)
