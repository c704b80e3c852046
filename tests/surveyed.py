"""A surveyed field for tests of pages: known errors, put through the real catalogue."""

import hashlib
from datetime import UTC, datetime, timedelta
from itertools import combinations
from pathlib import Path

import numpy as np

from spheremark.pipelines.config import ResectionConfig, SurveyConfig
from spheremark.pipelines.geometry import (
    exp_motion,
    included_angle,
    inverse,
    rigid,
    rot_z,
    skew,
    transform,
)
from spheremark.pipelines.model import (
    ControlMarks,
    Levelling,
    MarkerFit,
    MarkerFits,
    Rejection,
    StationFix,
    Status,
    StitchedCloud,
    StopResult,
    StopTruth,
    SubsetFixes,
    Truth,
)
from spheremark.pipelines.positioning.quality_control import station_quality
from spheremark.pipelines.scan.rigs import tilted_vlp16
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.catalogue.results import RunInfo, tables
from spheremark.storage.clouds.stop import write_cloud
from spheremark.storage.recordings import Preflight, TopicReport

RADIUS = 0.1
NOISE = {"along_beam": 0.02, "paper": 0.02}  # [m] of one range
OFFSET = {"along_beam": 0.0, "paper": -0.022}  # [m] towards the scanner
NOW = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)


def marks(n=14):
    """Return control marks in a ring."""
    azimuths = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False) + 0.15 * np.sin(np.arange(n))
    ranges = np.linspace(6.84, 9.34, n)[(5 * np.arange(n)) % n]
    p = np.column_stack(
        [ranges * np.cos(azimuths), ranges * np.sin(azimuths), 0.6 + 0.06 * np.arange(n)]
    )
    names = tuple(f"S{i + 1:02d}" for i in range(n))
    return ControlMarks(names=names, p_site=p, cov_p_site=np.tile(1e-6 * np.eye(3), (n, 1, 1)))


def stop(name, p_site, control, rng, n_ground=4000):
    """Return one stop as the pipeline would give it, and its truth."""
    truth = StopTruth(name=name, T_site_base=rigid(rot_z(0.3), p_site))
    centres = transform(inverse(truth.T_site_base), control.p_site)
    members, cloud = _cloud(name, centres, rng, n_ground)
    fits = {method: _fits(method, centres, members, cloud, rng) for method in NOISE}
    fixes = {(m, "free_station"): _fix(truth, control, fits[m], rng) for m in fits}
    subsets = {(m, "free_station"): _subsets(truth, centres, m, rng) for m in fits}
    result = StopResult(
        name=name,
        cloud=cloud,
        fits=fits,
        fixes=fixes,
        subsets=subsets,
        quality={
            (m, "free_station"): station_quality(
                fixes[m, "free_station"], fits[m], control, ResectionConfig()
            )
            for m in fits
        },
        timings={"stitch": 0.4},
    )
    return result, truth


def _cloud(name, centres, rng, n_ground):
    """Return a flat ground and spheres seen from the origin, and which returns are whose."""
    ground = np.column_stack([rng.uniform(-14, 14, (n_ground, 2)), np.full(n_ground, -1.0)])
    points, members = [ground], []
    for centre in centres:
        n = int(6000 / (centre @ centre))
        towards = -centre / np.linalg.norm(centre) + 0.6 * rng.normal(size=(n, 3))
        facing = RADIUS * towards / np.linalg.norm(towards, axis=1, keepdims=True)
        start = sum(map(len, points))
        members.append(np.arange(start, start + n))
        points.append(centre + facing)
    p = np.concatenate(points).astype(np.float32)
    n = len(p)
    cloud = StitchedCloud(
        p_base=p,
        gimbal_angles=np.arctan2(p[:, 1], p[:, 0]).astype(np.float32),
        intensities=np.full(n, 60.0, np.float32),
        rings=(np.arange(n) % 16).astype(np.uint8),
        times=np.linspace(0.0, 13.2, n, dtype=np.float32),
        levelling=Levelling(roll=0.0, pitch=0.0, sigma=0.003, is_measured=True),
        rig=tilted_vlp16("bench", (0.03, -0.02)),
        coverage=2.0 * np.pi,
        duration=13.2,
        name=name,
    )
    return members, cloud


def _fits(method, centres, members, cloud, rng):
    """Return fits whose errors are as large as their covariances say, and the paper's bias."""
    found = []
    for i, (centre, own) in enumerate(zip(centres, members, strict=True), start=1):
        sigma = NOISE[method] / np.sqrt(len(own))
        weak = len(own) < 50
        away = centre / np.linalg.norm(centre)
        found.append(
            MarkerFit(
                name=f"M{i:02d}",
                p_base=centre + OFFSET[method] * away + rng.normal(scale=sigma, size=3),
                cov_p_base=sigma**2 * np.eye(3),
                method=method,
                status=Status.WEAK if weak else Status.OK,
                reason="Fewer than 50 returns." if weak else "",
                radius=RADIUS,
                radius_free=RADIUS + rng.normal(scale=0.002),
                sigma_radius_free=0.002,
                mean_range=float(np.linalg.norm(centre)),
                mean_intensity=60.0,
                used=own.copy(),
                rejected=own[:3].copy(),
                residuals=rng.normal(scale=0.02, size=len(own)),
                sigma0=1.0,
                n_rings=9,
                coverage=0.8,
            )
        )
    rock = Rejection(p_base=np.array([3.0, 2.0, -0.8]), n_points=40, reason="Not round: a rock.")
    return MarkerFits(method=method, fits=tuple(found), rejected=(rock,), levelling=cloud.levelling)


def _fix(truth, control, fits, rng):
    """Return a station whose error is as large as its covariance says."""
    n = len(fits.fits)
    sigma = 0.002 if fits.method == "along_beam" else 0.006
    motion = np.concatenate([rng.normal(scale=2e-4, size=3), rng.normal(scale=sigma, size=3)])
    angles = included_angle(control.p_site[0] - truth.T_site_base[:3, 3], control.p_site[1:])
    T = exp_motion(motion) @ truth.T_site_base
    cov = np.diag([4e-8] * 3 + [sigma**2, 1.5 * sigma**2, 0.7 * sigma**2])
    J = np.hstack([-skew(T[:3, 3]), np.eye(3)])
    return StationFix(
        method="free_station",
        T_site_station=T,
        cov_T_site_station=cov,
        cov_p_site=J @ cov @ J.T,
        matches=np.column_stack([np.arange(n)] * 2),
        residuals_site=rng.normal(scale=sigma, size=(n, 3)),
        redundancies=np.full(n, 2.6),
        w_statistics=np.abs(rng.normal(size=n)),
        detectable_biases=np.full(n, 0.012),
        external_reliabilities=np.full(n, 0.002),
        dof=3 * n - 6,
        sigma0=1.02,
        passes_global_test=True,
        included_angles=np.array([angles.min(), angles.max()]),
        status=Status.OK,
        reason="",
    )


def _subsets(truth, centres, method, rng):
    """Return the station from each pair and each triple of marks."""
    return tuple(_subsets_of(size, truth, centres, method, rng) for size in (2, 3))


def _subsets_of(size, truth, centres, method, rng):
    chosen = np.array(list(combinations(range(len(centres)), size)))
    first, second = np.triu_indices(size, 1)
    angles = included_angle(centres[chosen[:, first]], centres[chosen[:, second]])
    spread = np.stack([angles.min(axis=1), angles.max(axis=1)], axis=1)
    sigma = 0.004 / np.sqrt(np.maximum(np.sin(spread[:, 1]), 0.05))
    errors = rng.normal(size=(len(chosen), 3)) * sigma[:, None]
    bias = 0.02 if method == "paper" else 0.0
    return SubsetFixes(
        method="free_station",
        marks=chosen,
        included_angles=spread,
        included_angles_horizontal=spread.copy(),
        p_site=truth.T_site_base[:3, 3] + errors + bias,
        sigma_horizontal=np.sqrt(2.0) * sigma,
        sigma_3d=np.sqrt(3.0) * sigma,
    )


def fill(
    catalogue: Catalogue,
    folder: Path,
    name: str,
    *,
    n_stops=3,
    with_truth=True,
    lane="lane3",
    at=NOW,
    all_called=None,
    n_ground=4000,
):
    """Put a survey with a lane of stops into a catalogue, one job for each."""
    rng, control = np.random.default_rng(7), marks()
    survey = catalogue.create_survey(name)
    catalogue.put_control_marks(name, control)
    places = np.column_stack([np.linspace(-4, 4, n_stops), np.full((n_stops, 2), [0.4, 1.1])])
    names = [all_called or f"{lane}-stop{i + 1}" for i in range(n_stops)]
    stops = [stop(*named, control, rng, n_ground) for named in zip(names, places, strict=True)]
    if with_truth:
        poses = tuple(pose for _, pose in stops)
        catalogue.put_truth(name, Truth(marks=control, stops=poses, rig=None))
    for i, (result, _) in enumerate(stops):
        moment = at + timedelta(minutes=i)
        _finish(catalogue, folder, survey.survey_id, moment, result, control)


def _finish(catalogue, folder, survey_id, moment, result, control):
    """Enter a recording and a successful job with its results."""
    digest = hashlib.sha256(f"{survey_id} {moment}".encode()).hexdigest()
    topic = {"topic": "/points", "schema": "sensor_msgs/msg/PointCloud2", "encoding": "cdr"}
    topic |= {"n_messages": 132, "rate_hz": 10.0, "longest_gap_s": 0.1}
    report = Preflight(verdict="ok", topics=(TopicReport(**topic),))
    catalogue.add_recording(
        digest,
        name=result.name,
        size_bytes=91_000_000,
        url="/nowhere.mcap",
        preflight=report.to_mapping(),
    )
    job = catalogue.create_job("process", survey=survey_id, recording_id=digest, config={})
    catalogue.start_job(job.job_id)
    run = RunInfo(
        run_id=f"run{job.job_id}",
        job_id=job.job_id,
        survey_id=survey_id,
        recording_id=digest,
        config=SurveyConfig(),
        code_version="0.1.0",
        finished_at=moment,
        duration=2.5,
    )
    n = len(result.cloud.p_base)
    n_max = n if n > 10**6 else 3000
    clouds = {result.name: write_cloud(result, str(folder), n_max=n_max)}
    catalogue.finish_job(job.job_id, tables(run, (result,), marks=control, clouds=clouds))
