"""Routes of the 3-D view: scenes of stops, and clouds in levels of detail."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Response
from pydantic import BaseModel, Field

from spheremark.service.http.clouds import cloud_of, scene_of
from spheremark.service.http.state import Current
from spheremark.storage.clouds.octree import node_bytes

router = APIRouter(tags=["clouds"])

_FOREVER = {"Cache-Control": "private, max-age=31536000, immutable"}
Run = Annotated[str, Query(max_length=200, description="Id of the run.")]
Stop = Annotated[str, Query(max_length=500, description="Name of the stop.")]


class SceneDocument(BaseModel):
    """Stops of a survey in one frame, with spheres and refused groups in their station frames."""

    survey: str
    method: str
    poses: str = Field(description="Which solution the poses are from.")
    n_stops: int = Field(description="Stops of the survey; a scene holds the first of them.")
    stops: list[dict[str, Any]]
    spheres: list[dict[str, Any]]
    refused: list[dict[str, Any]]


class OctreeIndex(BaseModel):
    """A cloud in levels of detail: a cube, and the points of its nodes by key."""

    version: int
    n_points: int
    n_returns: int
    origin_m: list[float]
    edge_m: float
    cells: int
    names: list[str]
    fit_method: str
    nodes: dict[str, dict[str, int]]


@router.get("/surveys/{survey}/scene", name="get_scene")
def get_scene(
    survey: Annotated[str, Path(description="Id or name of the survey.")],
    service: Current,
    stop: Annotated[list[str], Query(max_length=60, description="Names of stops; all.")] = [],  # noqa: B006  # FastAPI copies it
    method: Annotated[str, Query(max_length=80, description="Fitting method.")] = "along_beam",
) -> SceneDocument:
    """Return stops with their poses, spheres and refused groups."""
    return SceneDocument.model_validate(scene_of(service, survey, stop, method))


@router.get("/clouds/octree", name="get_octree")
def get_octree(run: Run, stop: Stop, service: Current, response: Response) -> OctreeIndex:
    """Return the index of the cloud of a stop; the first request makes it."""
    response.headers.update(_FOREVER)
    return OctreeIndex.model_validate(cloud_of(service, run, stop).index)


@router.get(
    "/clouds/octree/{node}",
    name="get_octree_node",
    response_class=Response,
    responses={200: {"content": {"application/octet-stream": {}}}},
)
def get_octree_node(
    node: Annotated[str, Path(pattern="^r[0-7]{0,8}$", description="Key of the node.")],
    run: Run,
    stop: Stop,
    service: Current,
) -> Response:
    """Return the points of a node: positions, residuals, intensities and markers in turn."""
    content = node_bytes(cloud_of(service, run, stop), node)
    return Response(content, media_type="application/octet-stream", headers=_FOREVER)
