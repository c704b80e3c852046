"""The interface for programs, under ``/api/v1``: routes by what they are about.

Every handler parses, makes one call and returns; requests and responses are in ``models`` and
``rows``.
"""

from fastapi import APIRouter

from spheremark.service.http.api import (
    audit,
    figures,
    jobs,
    plans,
    problems,
    recordings,
    results,
    rigs,
    sql,
    surveys,
    uploads,
)
from spheremark.service.http.api import sites as products

router = APIRouter()
for part in (
    *(surveys, recordings, uploads, jobs, results),
    *(products, rigs, plans, sql, figures, audit, problems),
):
    router.include_router(part.router)
