"""Routes of what is made of a whole survey: clouds in the site frame, elevation models."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import Annotated

from fastapi import APIRouter, Path
from fastapi.responses import StreamingResponse
from pydantic import BaseModel, ConfigDict, Field

from spheremark.pipelines.errors import NotFoundError
from spheremark.service.http.api.models import Listing
from spheremark.service.http.api.surveys import Key
from spheremark.service.http.state import Current, Service
from spheremark.service.jobs.site import ENDINGS, MEDIA_TYPES
from spheremark.storage.files import read_file

router = APIRouter(tags=["products"])

_LIST = """
SELECT * FROM site_products WHERE survey_id = $id ORDER BY finished_at DESC, product_id, kind
"""
_FILE = """
SELECT p.*, s.name AS survey FROM site_products AS p JOIN surveys AS s USING (survey_id)
WHERE p.product_id = $id AND p.kind = $kind
"""


class ProductKind(StrEnum):
    """What a file is."""

    LAZ = "laz"
    E57 = "e57"
    GEOTIFF = "geotiff"


class Product(BaseModel):
    """A file made of all stops of a survey."""

    model_config = ConfigDict(extra="ignore")

    product_id: str = Field(description="The same for all files of one job.")
    job_id: str
    kind: ProductKind
    file: str = Field(description="Where the file can be read.")
    sha256: str
    size_bytes: int
    n_points: int
    n_stations: int
    poses: str = Field(description="control or free (an adjustment), or fixes.")
    adjustment_id: str | None
    min_x_m: float
    min_y_m: float
    min_z_m: float
    max_x_m: float
    max_y_m: float
    max_z_m: float
    cell_m: float | None = Field(description="Edge of a cell of an elevation model.")
    share_known: float | None
    sigma_median_m: float | None
    config_digest: str
    code_version: str
    finished_at: datetime


ProductId = Annotated[str, Path(description="Id of the products of a job.")]


@router.get("/surveys/{survey}/products", name="list_products")
def list_products(survey: Key, service: Current) -> Listing[Product]:
    """List the files made of all stops of a survey, newest first."""
    return Listing(items=products_of(service, survey), next=None)


def products_of(service: Service, survey: str) -> list[Product]:
    """Return the files made of a survey, newest first."""
    found = service.catalogue.get_survey(survey)
    rows = service.catalogue.rows(_LIST, {"id": found.survey_id})
    return [
        Product.model_validate(
            row | {"file": f"/api/v1/products/{row['product_id']}/{row['kind']}"}
        )
        for row in rows
    ]


@router.get(
    "/products/{product}/{kind}",
    name="download_product",
    response_class=StreamingResponse,
    responses={200: {"content": {one: {} for one in MEDIA_TYPES.values()}}},
)
def download_product(product: ProductId, kind: ProductKind, service: Current) -> StreamingResponse:
    """Return a file, to be saved."""
    rows = service.catalogue.rows(_FILE, {"id": product, "kind": kind.value})
    if not rows:
        raise NotFoundError(f"There is no {kind.value} of a product {product!r}.")
    safe = "".join(
        c if c.isascii() and (c.isalnum() or c in "-_.") else "-" for c in rows[0]["survey"]
    )
    blocks = read_file(rows[0]["url"])
    first = next(blocks, b"")  # a missing file is an error before the response begins

    def body() -> object:
        yield first
        yield from blocks

    return StreamingResponse(
        body(),  # type: ignore[arg-type]
        media_type=MEDIA_TYPES[kind.value],
        headers={
            "Content-Disposition": f'attachment; filename="{safe}{ENDINGS[kind.value]}"',
            "Content-Length": str(rows[0]["size_bytes"]),
        },
    )
