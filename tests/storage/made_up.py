"""One stop of a made-up survey with every kind of result, exact but for a known shift."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np

from spheremark.pipelines.config import ResectionConfig, SurveyConfig
from spheremark.pipelines.geometry import levelling_rotation, rigid, rot_x, rot_y, rot_z, skew
from spheremark.pipelines.model import (
    Exclusion,
    Levelling,
    MarkerFits,
    NoFix,
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
from spheremark.storage.catalogue.results import RunInfo, tables
from tests.synthetic import field, marker_fit

ROLL, PITCH, YAW = 0.02, -0.03, 0.7
SHIFT_BASE = np.array([0.003, -0.002, 0.004])  # error of every centre of the first method [m]
SHIFT_SITE = np.array([0.006, 0.002, -0.003])  # error of the station [m]
P_SITE = np.array([1.5, -2.0, 0.8])
TURN = np.radians(0.5)  # error of the heading
MARKS = field(np.random.default_rng(5), 6)
LEVELLING = Levelling(roll=ROLL, pitch=PITCH, sigma=0.003, is_measured=True)
T_SITE_BASE = rigid(rot_z(YAW) @ rot_y(PITCH) @ rot_x(ROLL), P_SITE)


def truth(*stops):
    """The truth of stops of these names, all at the same place."""
    return Truth(
        marks=MARKS,
        stops=tuple(StopTruth(name=name, T_site_base=T_SITE_BASE.copy()) for name in stops),
        rig=tilted_vlp16("true", (0.05, 0.01)),
        about={"seed": 7, "scenario": "made-up"},
    )


def cloud(name, rng, n=4000):
    """Returns all about, and ten on each marker."""
    centres = (MARKS.p_site - P_SITE) @ T_SITE_BASE[:3, :3]
    p_base = np.concatenate(
        [
            rng.uniform(-12, 12, (n, 3)),
            np.repeat(centres, 10, 0) + rng.uniform(-0.05, 0.05, (60, 3)),
        ]
    )
    p_base = p_base[rng.permutation(len(p_base))].astype(np.float32)
    n = len(p_base)
    return StitchedCloud(
        p_base=p_base,
        gimbal_angles=np.zeros(n, np.float32),
        intensities=rng.uniform(0, 255, n).astype(np.float32),
        rings=np.zeros(n, np.uint8),
        times=np.linspace(0, 13, n, dtype=np.float32),
        levelling=LEVELLING,
        rig=tilted_vlp16("nominal", (0.05, 0.0)),
        coverage=2 * np.pi,
        duration=13.2,
        name=name,
        notes=("The log has no rings.",),
    )


def fits(method, shift, points, rng):
    """One fit of each mark, and a false one far from all marks."""
    centres = (MARKS.p_site - P_SITE) @ T_SITE_BASE[:3, :3]
    root = rng.normal(size=(len(centres), 3, 3)) * 1e-3
    cov = root @ root.transpose(0, 2, 1) + 1e-6 * np.eye(3)
    found = []
    for i, (centre, one) in enumerate(zip(centres, cov, strict=True), start=1):
        members = np.flatnonzero(np.linalg.norm(points - centre, axis=1) < 0.1)
        used, rejected = members[:-2], members[-2:]
        residuals = rng.normal(size=len(used)) * 0.01
        fit = marker_fit(centre + shift, one, f"M{i:02d}")
        known = {"used": used, "rejected": rejected, "residuals": residuals}
        found.append(
            replace(fit, method=method, sigma_range_shared=7e-4, sigma_height_shared=3e-4, **known)
        )
    false = marker_fit(np.array([0.0, 0.0, 9.0]), np.eye(3) * 1e-4, f"M{len(centres) + 1:02d}")
    found.append(
        replace(
            false, method=method, radius_free=np.nan, sigma_radius_free=np.nan,
            used=np.zeros(0, np.intp), residuals=np.zeros(0),
            status=Status.WEAK, reason="Few points.",
        )
    )  # fmt: skip
    rejected = (Rejection(p_base=np.array([3.0, 0.0, 1.0]), n_points=9, reason="A pole."),)
    return MarkerFits(method=method, fits=tuple(found), rejected=rejected, levelling=LEVELLING)


def fix(rng):
    """A station that uses all marks but the last, in another order than the fits."""
    root = rng.normal(size=(6, 6)) * 1e-3
    matches = np.array([[4, 4], [0, 0], [1, 1], [2, 2], [3, 3]])
    J = np.hstack([-skew(P_SITE + SHIFT_SITE), np.eye(3)])
    return StationFix(
        method="free_station",
        T_site_station=rigid(rot_z(YAW + TURN), P_SITE + SHIFT_SITE),
        cov_T_site_station=root @ root.T,
        cov_p_site=J @ root @ root.T @ J.T,
        matches=matches,
        residuals_site=rng.normal(size=(5, 3)) * 1e-3,
        redundancies=rng.uniform(1, 3, 5),
        w_statistics=np.array([1.0, np.nan, 2.0, 0.5, 3.0]),
        detectable_biases=np.array([0.01, np.inf, 0.02, 0.03, 0.04]),
        external_reliabilities=np.array([0.001, np.inf, 0.002, 0.003, 0.004]),
        dof=11,
        sigma0=np.nan,
        passes_global_test=True,
        included_angles=np.radians([12.0, 170.0]),
        status=Status.OK,
        reason="",
        excluded=(Exclusion(fit=5, reason="Fails the w-test."),),
    )


def stop(name="L1S1", seed=3):
    """A stop with two fitting methods, of which the second one could not be positioned."""
    rng = np.random.default_rng(seed)
    points = cloud(name, rng)
    pairs = SubsetFixes(
        method="free_station",
        marks=np.array([[0, 1], [0, 2]]),
        included_angles=np.radians([[32.0, 32.0], [75.0, 75.0]]),
        included_angles_horizontal=np.radians([[29.0, 29.0], [74.0, 74.0]]),
        p_site=np.array([P_SITE + np.array([0.01, 0, 0]), [np.nan] * 3]),
        sigma_horizontal=np.array([0.015, np.nan]),
        sigma_3d=np.array([0.02, np.nan]),
    )
    triples = SubsetFixes(
        method="free_station",
        marks=np.array([[0, 1, 2]]),
        included_angles=np.radians([[32.0, 107.0]]),
        included_angles_horizontal=np.radians([[29.0, 103.0]]),
        p_site=np.array([P_SITE + np.array([0.003, 0.004, 0.012])]),
        sigma_horizontal=np.array([0.006]),
        sigma_3d=np.array([0.013]),
    )
    found = {
        "along_beam": fits("along_beam", SHIFT_BASE, points.p_base, rng),
        "paper": fits("paper", 5 * SHIFT_BASE, points.p_base, rng),
    }
    station = fix(rng)
    no = NoFix(method="free_station", code="solve.no_match", reason="No match.")
    return StopResult(
        name=name,
        cloud=points,
        fits=found,
        fixes={("along_beam", "free_station"): station, ("paper", "free_station"): no},
        subsets={("along_beam", "free_station"): (pairs, triples)},
        quality={
            ("along_beam", "free_station"): station_quality(
                station, found["along_beam"], MARKS, ResectionConfig()
            )
        },
        timings={"stitching": 0.1},
    )


def run(run_id="run1", job_id="job1", survey_id="survey1", recording_id="0" * 64, **changes):
    """What the run was."""
    known = {
        "run_id": run_id, "job_id": job_id, "survey_id": survey_id, "recording_id": recording_id,
        "config": SurveyConfig(), "code_version": "0.1.0", "duration": 1.5,
        "finished_at": datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC), "peak_memory_bytes": 123_456_789,
    }  # fmt: skip
    return RunInfo(**{**known, **changes})


def made_tables(known_truth=None, **changes):
    """The tables of a run of one stop."""
    return tables(run(**changes), (stop(),), marks=MARKS, truth=known_truth)


def R_station_base():
    """The levelling of every stop here."""
    return levelling_rotation(LEVELLING)
