"""The JSON of ``spheremark process``: results as plain values, every number with its unit.

A public interface: names, frames and signs as in CONVENTIONS.md; what is unknown is null.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import chain
from typing import Literal

import numpy as np

from spheremark.pipelines.accuracy.truth import UNMATCHED, MarkerErrors, StationError
from spheremark.pipelines.geometry import levelling_rotation
from spheremark.pipelines.model import (
    Array,
    ControlMarks,
    Levelling,
    MarkerFit,
    MarkerFits,
    NoFix,
    Omissions,
    Rejection,
    Rig,
    StationFix,
    StopResult,
    Truth,
)
from spheremark.pipelines.scan.rigs import rig_digest, rig_to_mapping
from spheremark.service.log_files import ProcessedLog
from spheremark.service.serialise.plain import Plain, ellipse_fields, number, numbers

Frame = Literal["station", "base"]

NO_CONTROL = "No control marks were given: there are centres, but no position."


def serialise_log(
    log: ProcessedLog, *, frame: Frame = "station", truth: Truth | None = None
) -> Plain:
    """Return all results of one log; the truth gives the names of true marks."""
    return {
        "log": {
            "name": log.origin.name,
            "sha256": log.origin.digest,
            "notes": list(log.notes),
        },
        "rig": _rig(log.stops[0].cloud.rig),
        "config": log.config.to_mapping() | {"digest": log.config.digest},
        "stops": [_stop(log, stop, frame, truth) for stop in log.stops],
    }


def serialise_spheres(fits: MarkerFits) -> Plain:
    """Return the spheres in the cloud of a single scan."""
    R = np.eye(3)
    return {
        "spheres": [_marker(fit, R, 0.0) for fit in fits.fits],
        "rejected": _groups(fits.rejected, R),
        "possible": _groups(fits.possible, R),
    }


def _stop(log: ProcessedLog, stop: StopResult, frame: Frame, truth: Truth | None) -> Plain:
    """Return all results of one stop."""
    cloud, errors = stop.cloud, log.errors.get(stop.name)
    R_frame_base = levelling_rotation(cloud.levelling) if frame == "station" else np.eye(3)
    stations = [
        _station(stop, methods, log.marks, errors.stations.get(methods) if errors else None)
        for methods in stop.fixes
    ]
    markers = []
    for method, fits in stop.fits.items():
        own = [_marker(fit, R_frame_base, stop.sigma_heading) for fit in fits.fits]
        if errors is not None and truth is not None:
            _add_errors(own, errors.markers[method], truth.marks)
        markers += own
    first = stations[0] if stations else {"reason": NO_CONTROL}
    plain: Plain = {
        "name": stop.name,
        "frame": frame,
        "markers": markers,
        "rejected": _groups(
            chain.from_iterable(fits.rejected for fits in stop.fits.values()), R_frame_base
        ),
        "possible": _groups(
            chain.from_iterable(fits.possible for fits in stop.fits.values()), R_frame_base
        ),
        "station": first if "position_m" in first else None,
        "stations": stations,
        "distances": _distances(stop, log.marks),
        "levelling": _levelling(cloud.levelling),
        "sigma_heading_rad": stop.sigma_heading,
        "scan": {
            "n_returns": len(cloud.p_base),
            "coverage_deg": math.degrees(cloud.coverage),
            "duration_s": cloud.duration,
            "notes": list(cloud.notes),
        },
        "tolerance_m": log.config.tolerance,
        "timings_s": dict(stop.timings),
    }
    if plain["station"] is None:
        plain["reason"] = first["reason"]
    return plain


def _add_errors(markers: list[Plain], errors: MarkerErrors, marks: ControlMarks) -> None:
    """Add true mark and error to the markers of one fitting method."""
    for marker, mark, error in zip(markers, errors.marks, errors.error_3d, strict=True):
        marker["true_mark"] = None if mark == UNMATCHED else marks.names[mark]
        marker["error_3d_m"] = number(error)


def _marker(fit: MarkerFit, R_frame_base: Array, sigma_heading: float) -> Plain:
    """Return one marker."""
    cov_base = fit.cov_with_heading(sigma_heading)
    return {
        "id": fit.name,
        "status": str(fit.status),
        "reason": fit.reason,
        "method": fit.method,
        "centre_m": numbers(R_frame_base @ fit.p_base),
        "covariance_m2": numbers(R_frame_base @ cov_base @ R_frame_base.T),
        "sigma_3d_m": number(math.sqrt(np.trace(cov_base))),
        "range_m": number(fit.mean_range),
        "n_points": fit.n_points,
        "n_rejected": len(fit.rejected),
        "n_rings": fit.n_rings,
        "coverage": number(fit.coverage),
        "incidence_deg": number(math.degrees(fit.incidence)),
        "variant": fit.variant,
        "rms_m": number(fit.rms),
        "sigma0": number(fit.sigma0),
        "radius_m": fit.radius,
        "radius_free_m": number(fit.radius_free),
        "sigma_radius_free_m": number(fit.sigma_radius_free),
        "mean_intensity": number(fit.mean_intensity),
        "probability": number(fit.probability),
        "hypothesis": fit.hypothesis,
    }


def _groups(found: Iterable[Rejection], R_frame_base: Array) -> list[Plain]:
    """Return groups of returns that are not used as markers, each once."""
    groups: dict[tuple[object, ...], Plain] = {}
    for one in found:
        centre = numbers(R_frame_base @ one.p_base)
        group = {
            "centre_m": centre,
            "reason": one.reason,
            "n_points": one.n_points,
            "probability": number(one.probability),
        }
        groups.setdefault((*centre, one.reason), group)
    return list(groups.values())


def _station(
    stop: StopResult,
    methods: tuple[str, str],
    marks: ControlMarks | None,
    error: StationError | None,
) -> Plain:
    """Return the station by one fitting and one resection method, or why there is none."""
    fix, fits = stop.fixes[methods], stop.fits[methods[0]]
    labels = {"method": fix.method, "fit_method": methods[0]}
    if isinstance(fix, NoFix) or marks is None:
        reason, code = (fix.reason, fix.code) if isinstance(fix, NoFix) else (NO_CONTROL, "")
        return {"status": "failed", "reason": reason, "code": code, **labels}
    quality = stop.quality[methods]
    low, high = np.degrees(fix.included_angles)
    plain: Plain = {
        "status": str(fix.status),
        "reason": fix.reason,
        **labels,
        "position_m": numbers(fix.p_site),
        "rotation": numbers(fix.T_site_station[:3, :3]),
        "yaw_deg": math.degrees(fix.yaw),
        "sigma_yaw_deg": math.degrees(fix.sigma_yaw),
        "covariance": numbers(fix.cov_T_site_station),
        "position_covariance_m2": numbers(fix.cov_p_site),
        "sigma_3d_m": number(fix.sigma_3d),
        **ellipse_fields(fix.ellipse),
        "dop": number(quality.dilution_of_precision),
        "sigma_levelling_rad": stop.cloud.levelling.sigma,
        "dof": fix.dof,
        "sigma0_a_priori": 1.0,
        "sigma0": number(fix.sigma0),
        "passes_global_test": fix.passes_global_test,
        "included_angle_min_deg": number(low),
        "included_angle_max_deg": number(high),
        "matches": _matches(fix, fits, marks),
        "residuals_m": numbers(fix.residuals_site),
        "without_each": _without_each(fix, quality.without_each, fits, marks),
        "excluded": [
            {"marker": fits.fits[one.fit].name, "reason": one.reason} for one in fix.excluded
        ],
    }
    if error is not None:
        plain["error_3d_m"] = error.error_3d
        plain["error_yaw_deg"] = math.degrees(error.error_yaw)
    return plain


def _matches(fix: StationFix, fits: MarkerFits, marks: ControlMarks) -> list[Plain]:
    """Return which marker was taken for which mark, with residual and reliability."""
    return [
        {
            "marker": fits.fits[fit].name,
            "mark": marks.names[mark],
            "residual_m": numbers(fix.residuals_site[i]),
            "redundancy": number(fix.redundancies[i]),
            "w": number(fix.w_statistics[i]),
            "minimal_detectable_bias_m": number(fix.detectable_biases[i]),
            "external_reliability_m": number(fix.external_reliabilities[i]),
        }
        for i, (fit, mark) in enumerate(fix.matches)
    ]


def _without_each(
    fix: StationFix, omissions: Omissions, fits: MarkerFits, marks: ControlMarks
) -> list[Plain]:
    """Return the station without each of its markers, and each mark as the others predict it."""
    columns = (omissions.shifts_site, omissions.predictions_site, omissions.sigma_predictions_site)
    return [
        {
            "marker": fits.fits[fit].name,
            "mark": marks.names[mark],
            "station_shift_m": numbers(shift),
            "station_shift_3d_m": number(float(np.linalg.norm(shift))),
            "mark_predicted_minus_given_m": numbers(off),
            "sigma_predicted_minus_given_m": numbers(sigma),
        }
        for (fit, mark), shift, off, sigma in zip(fix.matches, *columns, strict=False)
    ]


def _distances(stop: StopResult, marks: ControlMarks | None) -> Plain | None:
    """Return the distances between marks in this scan against the control; null without any."""
    checks, found = stop.distances, next(iter(stop.fits.values()))
    if checks is None or marks is None:
        return None
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
        "reason": checks.reason,
        "n": len(pairs),
        "n_off": int(checks.is_off.sum()),
        "suspects": [marks.names[mark] for mark in checks.suspects],
        "pairs": pairs,
    }


def _levelling(levelling: Levelling) -> Plain:
    """Return roll and pitch of the base."""
    return {
        "roll_deg": math.degrees(levelling.roll),
        "pitch_deg": math.degrees(levelling.pitch),
        "sigma_levelling_rad": levelling.sigma,
        "is_measured": levelling.is_measured,
    }


def _rig(rig: Rig) -> Plain:
    """Return the rig that was used, with its digest."""
    return rig_to_mapping(rig) | {"digest": rig_digest(rig)}
