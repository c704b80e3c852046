"""Routes of rigs: mounting, laser table and offsets that jobs may name by their digest."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Request, Response
from fastapi.concurrency import run_in_threadpool

from spheremark.service.http.api.models import StoredRig
from spheremark.service.http.api.surveys import File, bodies
from spheremark.service.http.state import Current
from spheremark.storage.imports.uploads import rig_of

router = APIRouter(prefix="/rigs", tags=["rigs"])

RigDigest = Annotated[str, Path(description="Digest of the rig.")]


@router.post("", name="put_rig", status_code=201, openapi_extra=bodies("application/json"))
async def put_rig(file: File, request: Request, service: Current, response: Response) -> StoredRig:
    """Keep a rig file (JSON), so that jobs can name it; the same rig twice is one."""
    rig = await service.readers.run(request, rig_of, file.text)
    digest = await run_in_threadpool(service.catalogue.put_rig, rig)
    response.headers["Location"] = f"/api/v1/rigs/{digest}"
    return StoredRig.of(rig)


@router.get("/{rig}", name="get_rig")
def get_rig(rig: RigDigest, service: Current) -> StoredRig:
    """Return a rig; its ``rig`` is what a rig file holds."""
    return StoredRig.of(service.catalogue.get_rig(rig))
