"""Jobs of the kind ``site``: all stops of a survey in one frame, as clouds and as ground.

Poses are those of the survey's chosen solution.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from spheremark.pipelines.scan.rigs import rig_from_mapping
from spheremark.service.jobs.specification import JobResult, JobSpecification, Options
from spheremark.service.provenance import code_version

if TYPE_CHECKING:
    import pyarrow as pa

    from spheremark.pipelines.ground_model import StationPose
    from spheremark.pipelines.model import Rig, StitchedCloud
    from spheremark.pipelines.survey import Progress
    from spheremark.service.jobs.site import SiteRequest
    from spheremark.storage.catalogue.catalogue import Catalogue

Row = dict[str, Any]
Key = tuple[str, str]  # recording and stop

_POSES = """
SELECT c.recording_id, stop, c.rig_digest, x_m, y_m, z_m, rotation, cov_motion, adjustment_id,
    radians(sqrt(s.sigma_heading_deg ^ 2 + s.sigma_clock_deg ^ 2)) AS sigma_heading,
    adjustment_id IS NULL AND c.resection_method <> 'free_station' AS is_by_distances,
    radians(s.roll_deg) AS roll, radians(s.pitch_deg) AS pitch,
    CASE solution WHEN 'network with control' THEN 'control' WHEN 'free network' THEN 'free'
        ELSE 'fixes' END AS poses
FROM chosen_stations AS c JOIN stops AS s USING (run_id, stop)
WHERE survey_id = $survey ORDER BY station
"""
_RIGS = "SELECT rig_digest, rig FROM rigs WHERE list_contains($digests::VARCHAR[], rig_digest)"


class SiteOptions(Options):
    """Options of the products of a site."""

    cell_m: float = Field(default=0.25, ge=0.05, le=10, description="Edge of a cell [m].")
    ground_range_m: float = Field(
        default=15.0, ge=1, le=100, description="How far from a station ground is used [m]."
    )
    gap_m: float = Field(
        default=0.0, ge=0, le=10, description="Holes of the ground up to this are filled in [m]."
    )
    range_m: float = Field(
        default=30.0, gt=0, le=1000, description="How far the cloud reaches [m]."
    )
    voxel_m: float = Field(
        default=0.0,
        ge=0,
        le=100,
        description="A stop keeps one return in cubes of this edge [m]; 0: all.",
    )
    clouds: bool = Field(default=True, description="Make the clouds, beside the ground.")


def gather(catalogue: Catalogue, spec: JobSpecification) -> Mapping[str, pa.Table]:
    """Return the poses of the survey's stations and the rigs that they were computed with."""
    poses = catalogue.table(_POSES, {"survey": spec.survey_id})
    digests = sorted({digest for digest in poses.column("rig_digest").to_pylist() if digest})
    return {"poses": poses, "rigs": catalogue.table(_RIGS, {"digests": digests})}


def handle(spec: JobSpecification, progress: Progress) -> JobResult:
    """Make the products of a site."""
    from spheremark.service.jobs.site import ENDINGS, KINDS, make_site
    from spheremark.storage.catalogue.schema import tables_of
    from spheremark.storage.files import keep_file
    from spheremark.storage.scratch import remove_abandoned, scratch

    remove_abandoned()
    own = {key: spec.options[key] for key in SiteOptions.model_fields if key in spec.options}
    options = SiteOptions.model_validate(own).model_dump()
    rows = {(row["recording_id"], row["stop"]): row for row in spec.known["poses"].to_pylist()}
    poses = _poses(spec, rows)
    with scratch() as folder:
        kinds = KINDS if options["clouds"] else ("geotiff",)
        request = _request({k: folder / f"site{ENDINGS[k]}" for k in kinds}, options)
        stops = _stops(spec, rows, poses, progress)
        site = make_site(stops, tuple(poses.values()), request)
        progress(0.95, "Keeping the files")
        kept = {kind: keep_file(path, spec.clouds_url) for kind, path in request.targets.items()}
    made = _rows(site, kept, _common(spec, options, next(iter(rows.values())), site.n_stations))
    found = {recording for recording, _ in poses}
    missing = [log.name for log in spec.logs if log.recording_id not in found]
    rows_made = tables_of(("site_products",), {"site_products": made})
    return JobResult(tables=rows_made, message=_summary(made, missing))


def _poses(spec: JobSpecification, rows: Mapping[Key, Row]) -> dict[Key, StationPose]:
    """Return the poses of the stations of the job's logs."""
    from spheremark.service.jobs.site import pose_from_row, require_poses

    recordings = {log.recording_id for log in spec.logs}
    poses = {key: pose_from_row(key[1], row) for key, row in rows.items() if key[0] in recordings}
    require_poses(poses)
    return poses


def _request(targets: Mapping[str, Path], options: Row) -> SiteRequest:
    """Return the request for a site."""
    from spheremark.service.jobs.site import SiteRequest, elevation_of

    return SiteRequest(
        targets=targets,
        elevation=elevation_of(options),
        range_max=options["range_m"],
        voxel=options["voxel_m"],
        software=f"spheremark {code_version()}",
    )


def _stops(
    spec: JobSpecification,
    rows: Mapping[Key, Row],
    poses: Mapping[Key, StationPose],
    progress: Progress,
) -> Iterator[tuple[StitchedCloud, StationPose]]:
    """Yield the stops that have poses, log by log."""
    from spheremark.service.jobs.site import stitched

    rigs = {
        row["rig_digest"]: rig_from_mapping(json.loads(row["rig"]))
        for row in spec.known["rigs"].to_pylist()
    }
    for i, log in enumerate(spec.logs):
        progress(0.95 * i / len(spec.logs), f"Adding {log.name} to the site")
        own = {stop: pose for (key, stop), pose in poses.items() if key == log.recording_id}
        if own:
            read = log.read()

            def rig_of(stop: str, key: str = log.recording_id) -> Rig | None:
                return rigs.get(rows[key, stop]["rig_digest"], spec.rig)

            yield from stitched((read,), spec.config, rig_of, own)


def _common(spec: JobSpecification, options: Row, source: Row, n_stations: int) -> Row:
    """Return the columns that all products of a job share."""
    from spheremark.service.jobs.site import options_text

    text = f"{spec.config.text}\n{options_text(options)}"
    return {
        "product_id": spec.result_id,
        "job_id": spec.job_id,
        "survey_id": spec.survey_id,
        "n_stations": n_stations,
        "poses": source["poses"],
        "adjustment_id": source["adjustment_id"],
        "config_digest": hashlib.sha256(text.encode()).hexdigest()[:16],
        "code_version": code_version(),
        "finished_at": datetime.now(UTC),
    }


def _rows(site: Any, kept: Mapping[str, Any], common: Row) -> list[Row]:
    """Return the rows of the products."""
    from spheremark.service.jobs.site import extent_row, model_row

    about = {kind: extent_row(extent) for kind, extent in site.clouds.items()}
    about["geotiff"] = model_row(site.model)
    return [
        {
            **common,
            "kind": kind,
            "url": file.url,
            "sha256": file.sha256,
            "size_bytes": file.size,
            **about[kind],
        }
        for kind, file in kept.items()
    ]


def _summary(rows: list[Row], missing: list[str]) -> str:
    """Return the products in sentences, and the logs without a pose."""
    ground = next(row for row in rows if row["kind"] == "geotiff")
    poses = {"fixes": "each station alone", "free": "a free network", "control": "a network"}
    text = (
        f"{ground['n_stations']} stations by the poses of {poses[ground['poses']]}: ground in "
        f"cells of {ground['cell_m']:g} m, {100 * ground['share_known']:.0f} % of them seen, "
        f"median sigma {1000 * ground['sigma_median_m']:.1f} mm."
    )
    if clouds := [row for row in rows if row["kind"] != "geotiff"]:
        text += f" Cloud of {clouds[0]['n_points']:,} returns."
    return f"{text} Without {', '.join(missing)}, of which there is no pose." if missing else text
