"""The JSON of ``spheremark process``: results as plain values, every number with its unit.

A public interface: names, frames and signs as in CONVENTIONS.md; what is unknown is null.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from spheremark.pipelines.accuracy import UNMATCHED, marker_errors, station_error
from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.errors import SolveError
from spheremark.pipelines.geometry import levelling_rotation, yaw_pitch_roll
from spheremark.pipelines.model import (
    Array,
    ControlMarks,
    Levelling,
    MarkerFit,
    MarkerFits,
    NoFix,
    Rig,
    ScanLog,
    StationFix,
    StopResult,
    StopTruth,
    Truth,
)
from spheremark.pipelines.positioning.quality_control import (
    check_distances,
    dilution_of_precision,
    leave_each_out,
)
from spheremark.pipelines.scan.rigs import rig_digest, rig_to_mapping
from spheremark.pipelines.survey import Progress, process
from spheremark.storage.catalogue.results import ellipse
from spheremark.storage.recordings import read_log

Frame = Literal["station", "base"]
Plain = dict[str, Any]

NO_CONTROL = "No control marks were given: there are centres, but no position."


@dataclass(frozen=True, slots=True, kw_only=True)
class Inputs:
    """What a log is processed with, and in which frame its centres are wanted.

    Truth, if given, adds errors to the answer and changes nothing else.
    """

    config: SurveyConfig
    rig: Rig | None = None
    marks: ControlMarks | None = None
    truth: Truth | None = None
    frame: Frame = "station"


def answer_log(path: Path, inputs: Inputs, progress: Progress) -> Plain:
    """Process a log and return all that it gave."""
    progress(0.0, f"Reading {path.name}")
    logs = [read_log(path)]
    about = _about(logs[0])
    stops = process(  # which lets the log go once it is stitched: nobody else may hold it
        logs.pop(), config=inputs.config, rig=inputs.rig, marks=inputs.marks, progress=progress
    )
    return survey_answer(about, stops, inputs)


def _about(log: ScanLog) -> Plain:
    """Return what one remembers of a log."""
    return {"name": log.origin.name, "sha256": log.origin.digest, "notes": list(log.notes)}


def survey_answer(about: Plain, stops: Sequence[StopResult], inputs: Inputs) -> Plain:
    """Return all that one log gave."""
    return {
        "log": about,
        "rig": _rig(stops[0].cloud.rig),
        "config": inputs.config.to_mapping() | {"digest": inputs.config.digest},
        "stops": [stop_answer(stop, inputs) for stop in stops],
    }


def stop_answer(stop: StopResult, inputs: Inputs) -> Plain:
    """Return all that one stop gave."""
    frame, truth = inputs.frame, inputs.truth
    poses = {one.name: one for one in truth.stops} if truth else {}
    pose = poses.get(stop.name)
    R_frame_base = _rotation_to(frame, stop.cloud.levelling)
    stations = [
        _station(method, stop, fix, inputs, pose) for (method, _), fix in stop.fixes.items()
    ]
    first = stations[0] if stations else {"reason": NO_CONTROL}
    answer: Plain = {
        "name": stop.name,
        "frame": frame,
        "markers": [
            marker
            for method in stop.fits
            for marker in _markers(stop, method, R_frame_base, truth, pose)
        ],
        "rejected": _rejected(stop, R_frame_base),
        "station": first if "position_m" in first else None,
        "stations": stations,
        "distances": _distances(stop, inputs),
        "levelling": _levelling(stop.cloud.levelling),
        "sigma_heading_rad": stop.cloud.rig.sigma_heading,
        "scan": {
            "n_returns": len(stop.cloud.p_base),
            "coverage_deg": math.degrees(stop.cloud.coverage),
            "duration_s": stop.cloud.duration,
            "notes": list(stop.cloud.notes),
        },
        "tolerance_m": inputs.config.tolerance,
        "timings_s": dict(stop.timings),
    }
    if answer["station"] is None:
        answer["reason"] = first["reason"]
    return answer


def _markers(
    stop: StopResult,
    method: str,
    R_frame_base: Array,
    truth: Truth | None,
    pose: StopTruth | None,
) -> list[Plain]:
    """Return the markers of one fitting method."""
    fits, sigma_heading = stop.fits[method], stop.cloud.rig.sigma_heading
    answers = [_marker(fit, R_frame_base, sigma_heading) for fit in fits.fits]
    if truth is not None and pose is not None:
        errors = marker_errors(fits, pose, truth.marks)
        for answer, mark, error in zip(answers, errors.marks, errors.error_3d, strict=True):
            answer["true_mark"] = None if mark == UNMATCHED else truth.marks.names[mark]
            answer["error_3d_m"] = _number(error)
    return answers


def _marker(fit: MarkerFit, R_frame_base: Array, sigma_heading: float) -> Plain:
    """Return one marker."""
    cov_base = fit.cov_with_heading(sigma_heading)
    return {
        "id": fit.name,
        "status": str(fit.status),
        "reason": fit.reason,
        "method": fit.method,
        "centre_m": _numbers(R_frame_base @ fit.p_base),
        "covariance_m2": _numbers(R_frame_base @ cov_base @ R_frame_base.T),
        "sigma_3d_m": _number(math.sqrt(np.trace(cov_base))),
        "range_m": _number(fit.mean_range),
        "n_points": fit.n_points,
        "n_rejected": len(fit.rejected),
        "n_rings": fit.n_rings,
        "coverage": _number(fit.coverage),
        "incidence_deg": _number(math.degrees(fit.incidence)),
        "variant": fit.variant,
        "rms_m": _number(fit.rms),
        "sigma0": _number(fit.sigma0),
        "radius_m": fit.radius,
        "radius_free_m": _number(fit.radius_free),
        "sigma_radius_free_m": _number(fit.sigma_radius_free),
        "mean_intensity": _number(fit.mean_intensity),
    }


def _rejected(stop: StopResult, R_frame_base: Array) -> list[Plain]:
    """Return what looked like a marker at first, each group once."""
    answers: dict[tuple[object, ...], Plain] = {}
    for fits in stop.fits.values():
        for rejection in fits.rejected:
            centre = _numbers(R_frame_base @ rejection.p_base)
            answer = {
                "centre_m": centre,
                "reason": rejection.reason,
                "n_points": rejection.n_points,
            }
            answers.setdefault((*centre, rejection.reason), answer)
    return list(answers.values())


def _station(
    fit_method: str,
    stop: StopResult,
    fix: StationFix | NoFix,
    inputs: Inputs,
    pose: StopTruth | None,
) -> Plain:
    """Return the station by one fitting and one resection method, or why there is none."""
    fits, marks = stop.fits[fit_method], inputs.marks
    methods = {"method": fix.method, "fit_method": fit_method}
    if isinstance(fix, NoFix) or marks is None:
        reason, code = (fix.reason, fix.code) if isinstance(fix, NoFix) else (NO_CONTROL, "")
        return {"status": "failed", "reason": reason, "code": code, **methods}
    yaw, _, _ = yaw_pitch_roll(fix.T_site_station[:3, :3])
    low, high = np.degrees(fix.included_angles)
    answer: Plain = {
        "status": str(fix.status),
        "reason": fix.reason,
        **methods,
        "position_m": _numbers(fix.p_site),
        "rotation": _numbers(fix.T_site_station[:3, :3]),
        "yaw_deg": math.degrees(yaw),
        "sigma_yaw_deg": math.degrees(fix.sigma_yaw),
        "covariance": _numbers(fix.cov_T_site_station),
        "position_covariance_m2": _numbers(fix.cov_p_site),
        "sigma_3d_m": _number(fix.sigma_3d),
        **{key: float(value) for key, value in ellipse(fix.cov_p_site[:2, :2]).items()},
        "dop": _number(dilution_of_precision(fix, marks)),
        "sigma_levelling_rad": stop.cloud.levelling.sigma,
        "dof": fix.dof,
        "sigma0_a_priori": 1.0,
        "sigma0": _number(fix.sigma0),
        "passes_global_test": fix.passes_global_test,
        "included_angle_min_deg": _number(low),
        "included_angle_max_deg": _number(high),
        "matches": _matches(fix, fits, marks),
        "residuals_m": _numbers(fix.residuals_site),
        "without_each": _without_each(fix, fits, marks, inputs.config),
        "excluded": [
            {"marker": fits.fits[one.fit].name, "reason": one.reason} for one in fix.excluded
        ],
    }
    if pose is not None:
        error = station_error(fix, pose)
        answer["error_3d_m"] = error.error_3d
        answer["error_yaw_deg"] = math.degrees(error.error_yaw)
    return answer


def _matches(fix: StationFix, fits: MarkerFits, marks: ControlMarks) -> list[Plain]:
    """Return which marker was taken for which mark, with residual and reliability."""
    return [
        {
            "marker": fits.fits[fit].name,
            "mark": marks.names[mark],
            "residual_m": _numbers(fix.residuals_site[i]),
            "redundancy": _number(fix.redundancies[i]),
            "w": _number(fix.w_statistics[i]),
            "minimal_detectable_bias_m": _number(fix.detectable_biases[i]),
            "external_reliability_m": _number(fix.external_reliabilities[i]),
        }
        for i, (fit, mark) in enumerate(fix.matches)
    ]


def _without_each(
    fix: StationFix, fits: MarkerFits, marks: ControlMarks, config: SurveyConfig
) -> list[Plain]:
    """Return the station without each of its markers, and each mark as the others predict it."""
    if fix.method != "free_station":
        return []
    omissions = leave_each_out(fix, fits, marks, config.resection)
    sigmas = np.sqrt(np.diagonal(omissions.cov_predictions, axis1=1, axis2=2))
    return [
        {
            "marker": fits.fits[fit].name,
            "mark": marks.names[mark],
            "station_shift_m": _numbers(shift),
            "station_shift_3d_m": _number(float(np.linalg.norm(shift))),
            "mark_predicted_minus_given_m": _numbers(off),
            "sigma_predicted_minus_given_m": _numbers(sigma),
        }
        for (fit, mark), shift, off, sigma in zip(
            fix.matches, omissions.shifts, omissions.predictions, sigmas, strict=False
        )
    ]


def _distances(stop: StopResult, inputs: Inputs) -> Plain | None:
    """Return the distances between marks in this scan against the control; null without any."""
    found, marks = next(iter(stop.fits.values())), inputs.marks
    if marks is None or len(found.fits) < 2 or len(marks.names) < 2:
        return None
    config = inputs.config
    try:
        checks = check_distances(found, marks, config.resection, config.tolerance)
    except SolveError as error:
        return {"reason": str(error), "n": 0, "n_off": 0, "suspects": [], "pairs": []}
    columns = (checks.fits, checks.marks, checks.measured, checks.given, checks.sigmas)
    pairs = [
        {
            "markers": [found.fits[fit].name for fit in fits],
            "marks": [marks.names[mark] for mark in places],
            "measured_m": float(measured),
            "given_m": float(given),
            "residual_m": float(measured - given),
            "sigma_m": float(sigma),
            "is_off": bool(is_off),
        }
        for fits, places, measured, given, sigma, is_off in zip(
            *columns, checks.is_off, strict=True
        )
    ]
    return {
        "reason": "",
        "n": len(pairs),
        "n_off": int(checks.is_off.sum()),
        "suspects": [marks.names[mark] for mark in checks.suspects],
        "pairs": pairs,
    }


def _levelling(levelling: Levelling) -> Plain:
    """Return how the base leans."""
    return {
        "roll_deg": math.degrees(levelling.roll),
        "pitch_deg": math.degrees(levelling.pitch),
        "sigma_levelling_rad": levelling.sigma,
        "is_measured": levelling.is_measured,
    }


def _rig(rig: Rig) -> Plain:
    """Return the rig that was used, with its digest."""
    return rig_to_mapping(rig) | {"digest": rig_digest(rig)}


def _rotation_to(frame: Frame, levelling: Levelling) -> Array:
    """Return the rotation from the base frame to the frame that was asked for."""
    return levelling_rotation(levelling) if frame == "station" else np.eye(3)


def _number(value: float) -> float | None:
    """Return a number, or null where JSON has none for it."""
    return float(value) if math.isfinite(value) else None


def _numbers(values: ArrayLike) -> Any:
    """Return an array as nested lists, with null where JSON has no number."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 0:
        return _number(float(array))
    return [_numbers(part) for part in array]
