"""The stops of a survey in one frame: a cloud of the whole site, and a model of its ground.

Shared by the job and the command: clouds with their poses, one by one, to files.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spheremark.pipelines.errors import ConfigError, InputError, NotFoundError
from spheremark.pipelines.geometry import rot_x, rot_y
from spheremark.pipelines.ground_model import (
    ElevationConfig,
    ElevationModel,
    StationPose,
    Terrain,
    pose_of_points,
    poses_of_network,
    station_points,
)
from spheremark.pipelines.progress import Progress, part_of
from spheremark.storage.clouds.site import CloudExtent, E57File, LazFile

if TYPE_CHECKING:
    from spheremark.pipelines.config import SurveyConfig
    from spheremark.pipelines.model import ControlMarks, Rig, ScanLog, StitchedCloud
    from spheremark.pipelines.network import Network
    from spheremark.storage.recordings import LogFile

KINDS = ("laz", "e57", "geotiff")
ENDINGS = {"laz": ".laz", "e57": ".e57", "geotiff": ".tif"}
MEDIA_TYPES = {
    "laz": "application/vnd.laszip",
    "e57": "model/e57",
    "geotiff": "image/tiff",
}

Stops = Iterable[tuple["StitchedCloud", StationPose]]


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteRequest:
    """Target of each file, reach of the cloud and edge of its voxels [m]."""

    targets: Mapping[str, Path]
    elevation: ElevationConfig = field(default_factory=ElevationConfig)
    range_max: float = 30.0
    voxel: float = 0.0
    software: str = "spheremark"
    made: datetime = field(default_factory=lambda: datetime.now(UTC))

    def __post_init__(self) -> None:
        unknown = set(self.targets) - set(KINDS)
        if unknown or not self.targets:
            raise ConfigError(f"Name one or more of {', '.join(KINDS)}, and nothing else.")
        for path in self.targets.values():
            if not path.parent.is_dir():
                raise InputError(f"There is no folder {path.parent} for {path.name}; make it.")


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """The extent of each cloud written, and the model of the ground if it was requested."""

    clouds: Mapping[str, CloudExtent]
    model: ElevationModel | None
    n_stations: int


def make_site(stops: Stops, poses: Sequence[StationPose], request: SiteRequest) -> Site:
    """Write the requested files, all or none; one stop at a time is in memory."""
    with _completed(request.targets) as parts:
        return _make_site(stops, poses, replace(request, targets=parts))


@contextmanager
def _completed(targets: Mapping[str, Path]) -> Iterator[Mapping[str, Path]]:
    """Yield paths beside the targets; complete files move there, others are removed."""
    parts = {
        kind: path.with_name(f".{secrets.token_hex(4)}.part{path.suffix}")
        for kind, path in targets.items()
    }
    try:
        yield parts
        for kind, part in parts.items():
            part.replace(targets[kind])
    finally:
        for part in parts.values():
            part.unlink(missing_ok=True)


def _make_site(stops: Stops, poses: Sequence[StationPose], request: SiteRequest) -> Site:
    """Write the requested files."""
    from spheremark.storage.exports.ground_model import write_geotiff

    terrain = Terrain(poses, request.elevation) if "geotiff" in request.targets else None
    n = 0
    with ExitStack() as stack:
        files = {kind: stack.enter_context(closing(file)) for kind, file in _opened(request)}
        for cloud, pose in stops:
            n += 1
            if files:
                points = station_points(
                    cloud, pose, range_max=request.range_max, voxel=request.voxel
                )
                for file in files.values():
                    file.add(points)
            if terrain is not None:
                terrain.add(cloud, pose)
        clouds = {kind: file.finish() for kind, file in files.items()}
    model = None if terrain is None else terrain.model()
    if model is not None:
        write_geotiff(model, request.targets["geotiff"], software=request.software)
    return Site(clouds=clouds, model=model, n_stations=n)


def _opened(request: SiteRequest) -> Iterator[tuple[str, LazFile | E57File]]:
    """Open the requested files of clouds."""
    if target := request.targets.get("laz"):
        yield "laz", LazFile(target, software=request.software, made=request.made)
    if target := request.targets.get("e57"):
        yield "e57", E57File(target, software=request.software, made=request.made)


def stitched(
    logs: Iterable[ScanLog],
    config: SurveyConfig,
    rig_of: Callable[[str], Rig | None],
    poses: Mapping[str, StationPose],
) -> Iterator[tuple[StitchedCloud, StationPose]]:
    """Yield the cloud of each stop that has a pose, with it."""
    from spheremark.pipelines.scan.stitching import choose_rig, split_stops, stitch

    for log in logs:
        for stop in split_stops(log, config.stitching):
            pose = poses.get(stop.origin.name)
            if pose is not None:
                rig = choose_rig(stop, rig_of(stop.origin.name))
                yield stitch(stop, rig, config.stitching), pose


def of_logs(
    logs: Sequence[LogFile],
    marks: ControlMarks | None,
    rig: Rig | None,
    config: SurveyConfig,
    request: SiteRequest,
    progress: Progress,
) -> tuple[Site, Network]:
    """Adjust the stations of logs and write the requested files; logs that fail are refused."""
    from spheremark.service.log_files import adjust_scans, read_scans

    book = read_scans(logs, config, rig, part_of(progress, 0.0, 0.5))
    result = adjust_scans(book, marks, config)
    poses = {pose.name: pose for pose in poses_of_network(result)}
    refused = {one.station for one in book.refused}
    good = [file for file in logs if file.path.stem not in refused]

    def read() -> Iterator[ScanLog]:
        for i, file in enumerate(good):
            progress(0.5 + 0.5 * i / len(good), f"Adding {file.path.stem} to the site")
            yield file.read()

    stops = stitched(read(), config, lambda _name: rig, poses)
    site = make_site(stops, tuple(poses.values()), request)
    return site, result.network


def serialise_site(site: Site, request: SiteRequest, network: Network) -> dict[str, Any]:
    """Return what was made, by the poses of a network, as plain values."""
    plain: dict[str, Any] = {
        "poses": "free" if network.is_free else "control",
        "n_stations": site.n_stations,
        "refused": [
            {"station": one.station, "code": one.code, "reason": one.reason}
            for one in network.refused
        ],
        "files": [],
    }
    for kind, extent in site.clouds.items():
        path = request.targets[kind]
        plain["files"].append({"kind": kind, "path": str(path), **extent_row(extent)})
    if site.model is not None:
        path = request.targets["geotiff"]
        plain["files"].append({"kind": "geotiff", "path": str(path), **model_row(site.model)})
    return plain


def extent_row(extent: CloudExtent) -> dict[str, Any]:
    """Return the extent of a cloud as plain values."""
    low, high = extent.bounds
    return {
        "n_points": extent.n_points,
        **{f"min_{axis}_m": float(low[i]) for i, axis in enumerate("xyz")},
        **{f"max_{axis}_m": float(high[i]) for i, axis in enumerate("xyz")},
    }


def model_row(model: ElevationModel) -> dict[str, Any]:
    """Return the extent of a model of the ground as plain values."""
    rows, columns = model.heights.shape
    west, south = (float(value) for value in model.corner)
    return {
        "n_points": int(model.counts.sum()),
        "min_x_m": west,
        "min_y_m": south,
        "min_z_m": float(np.nanmin(model.heights)),
        "max_x_m": west + columns * model.cell,
        "max_y_m": south + rows * model.cell,
        "max_z_m": float(np.nanmax(model.heights)),
        "cell_m": model.cell,
        "share_known": model.share_known,
        "sigma_median_m": float(np.nanmedian(model.sigmas)),
    }


def elevation_of(options: Mapping[str, Any]) -> ElevationConfig:
    """Return the configuration of the ground model of a job's options."""
    return ElevationConfig(
        cell=options["cell_m"], range_max=options["ground_range_m"], gap_max=options["gap_m"]
    )


def options_text(options: Mapping[str, Any]) -> str:
    """Return options as canonical text."""
    return json.dumps(dict(options), sort_keys=True, separators=(",", ":"))


def pose_from_row(name: str, row: Mapping[str, Any]) -> StationPose:
    """Return the pose of a row of stations."""
    T = np.eye(4)
    T[:3, :3] = np.reshape(row["rotation"], (3, 3))
    T[:3, 3] = [row[f"{axis}_m"] for axis in "xyz"]
    cov = np.reshape(np.asarray(row["cov_motion"], dtype=np.float64), (6, 6)).copy()
    up = np.array([0.0, 0.0, 1.0])
    axis = up if row["is_by_distances"] else rot_y(row["pitch"]) @ rot_x(row["roll"]) @ up
    return pose_of_points(name, T, cov, (row["sigma_heading"], axis))


def require_poses(poses: Mapping[Any, StationPose]) -> None:
    """Refuse a survey whose stations have no poses."""
    if not poses:
        raise NotFoundError(
            "No station of these logs has a pose: adjust the survey's stations first, or give it "
            "control marks and process its logs."
        )
