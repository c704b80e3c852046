"""The interface for programs, under ``/api/v1``: routes by what they are about.

Every handler parses, makes one call and answers; what it may answer is in ``models``.
"""

from fastapi import APIRouter

from spheremark.service.http.api import (
    calibrations,
    jobs,
    plans,
    problems,
    recordings,
    results,
    rigs,
    sql,
    surveys,
)
from spheremark.service.http.api import networks as adjustments
from spheremark.service.http.api import sites as products

router = APIRouter()
for part in (
    *(surveys, recordings, jobs, results, adjustments, calibrations),
    *(products, rigs, plans, sql, problems),
):
    router.include_router(part.router)
