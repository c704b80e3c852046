"""The interface for programs, under ``/api/v1``: routes by what they are about.

Every handler parses, makes one call and answers; what it may answer is in ``models``.
"""

from fastapi import APIRouter

from service.api import (
    adjustments,
    calibrations,
    jobs,
    plans,
    problems,
    products,
    recordings,
    results,
    rigs,
    sql,
    surveys,
)

router = APIRouter()
for part in (
    *(surveys, recordings, jobs, results, adjustments, calibrations),
    *(products, rigs, plans, sql, problems),
):
    router.include_router(part.router)
