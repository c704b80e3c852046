"""The interface for programs, under ``/api/v1``: routes by what they are about.

Every handler parses, makes one call and returns; requests and responses are in ``models`` and
``rows``.
"""

from fastapi import APIRouter, Depends, Request
from fastapi.dependencies.utils import get_flat_params
from fastapi.exceptions import RequestValidationError
from fastapi.params import Cookie, Header, Path
from fastapi.routing import APIRoute

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
    known = _parameters(request.scope["route"])
    unknown = [name for name in request.query_params if name not in known]
    if unknown:
        text = f"this operation has {', '.join(sorted(known)) or 'no parameters'}"
        found = [{"type": "extra_forbidden", "loc": ("query", one), "msg": text} for one in unknown]
        raise RequestValidationError(found)


def _parameters(route: APIRoute) -> set[str]:
    """Return the names of the parameters that the query of an operation may have."""
    found = get_flat_params(route.dependant)  # fields of a model have no class that says `Query`
    return {one.alias for one in found if not isinstance(one.field_info, (Path, Header, Cookie))}


router = APIRouter(dependencies=[Depends(_require_known_parameters)])
for part in (
    *(surveys, reports, recordings, uploads, jobs, results),
    *(products, rigs, plans, sql, figures, compare, clouds, audit, problems),
):
    router.include_router(part.router)
