"""Route of the audit log: who changed what, for those with the scope admin."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query
from pydantic import BaseModel, Field

from spheremark.service.http.api.models import Listing
from spheremark.service.http.state import Current
from spheremark.service.tokens import Audit

router = APIRouter(prefix="/audit", tags=["audit"])


class AuditEntry(BaseModel):
    """A request that wrote, or that was not allowed."""

    at: str = Field(description="Instant (UTC).")
    token: str = Field(description="Name of its token; empty without one.")
    method: str = Field(description="Method of HTTP.")
    path: str = Field(description="Its path, without the query.")
    status: int = Field(description="Status of the response.")
    client: str = Field(description="Address that it came from.")


@router.get("", name="list_audit")
def list_audit(
    service: Current,
    limit: Annotated[int, Query(ge=1, le=10_000, description="Entries.")] = 100,
) -> Listing[AuditEntry]:
    """List the newest requests that wrote, newest first."""
    entries = Audit(service.settings.data).last(limit)
    return Listing(items=[AuditEntry.model_validate(one) for one in entries])
