"""The JSON of ``spheremark adjust``: a network as plain values.

A public interface: names, frames and signs as in CONVENTIONS.md; what is unknown is null.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from spheremark.pipelines.calibration import Calibration
from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.geometry import yaw_pitch_roll
from spheremark.pipelines.network import (
    AdjustedNetwork,
    BlockTests,
    MarkEvidence,
    NetworkErrors,
    Repeat,
)
from spheremark.service.serialise.calibration import serialise_calibration
from spheremark.service.serialise.plain import Plain, ellipse_fields, number, numbers

_JOINT = 50  # marks whose joint covariance is in the JSON
_FREE = (
    "Free network: the levelled stations give the vertical; place and heading are those of the "
    "first station, and inner constraints over all marks give the covariances of least trace."
)


def serialise_network(
    result: AdjustedNetwork,
    config: SurveyConfig,
    *,
    rig: Calibration | None = None,
    uncalibrated: str = "",
) -> Plain:
    """Return a network, with the rig adjusted with it or the reason why there is none."""
    network, warnings = result.network, list(result.warnings)
    if uncalibrated:
        warnings.append(f"The rig could not be calibrated and stays as it was: {uncalibrated}")
    if not result.passes_global_test and rig is None:
        warnings.append("A wrong rig can be the cause: adjust it together with the stations.")
    return {
        "status": "weak" if warnings else "ok",
        "warnings": warnings,
        "datum": _datum(result),
        "method": config.fitting.methods[0],
        "config": config.to_mapping() | {"digest": config.digest},
        "stations": _stations(result),
        "marks": _marks(result),
        "observations": [_observation(result, i) for i in range(len(network.sightings))],
        "gravity": _blocks(result.gravity, network.stations, "station", "rad"),
        "control": _control(result),
        "evidence": [_evidence(one, network.marks) for one in network.evidence],
        "repeated_stops": [_repeat(network.stations, one) for one in result.repeats],
        "calibration": None if rig is None else serialise_calibration(rig),
        "shared_unknowns": _shared(result),
        "station_heights": _heights(result),
        "marks_covariance_m2": _joint(result),
        "excluded": _excluded(result),
        "refused": [
            {"station": one.station, "code": one.code, "reason": one.reason}
            for one in network.refused
        ],
        "n_observations": result.n_observations,
        "n_unknowns": result.n_unknowns,
        "dof": result.dof,
        "sigma0_a_priori": 1.0,
        "sigma0": number(result.sigma0),
        "passes_global_test": result.passes_global_test,
        "global_test": {
            "vtpv": result.vtpv,
            "limit": result.limit_vtpv,
            "level": config.resection.test_level,
        },
        "variance_factors": dict(
            zip(
                ("centres", "gravity", "control"),
                (number(value) for value in result.variance_factors),
                strict=True,
            )
        ),
        "critical_w": result.critical_w,
        "range_bias": _range_bias(result),
    }


def serialise_network_errors(
    result: AdjustedNetwork, errors: NetworkErrors, names: Sequence[str]
) -> Plain:
    """Return the errors of a network against the true marks of those names."""
    network = result.network
    return {
        "rms_marks_m": errors.rms_marks,
        "rms_stations_m": errors.rms_stations,
        "nees_per_dof_marks": number(errors.nees_marks),
        "nees_per_dof_stations": number(errors.nees_stations),
        "n_false_marks": int(np.sum(errors.marks < 0)),
        "marks": [
            {
                "name": name,
                "true_mark": None if place < 0 else names[place],
                "error_m": None if place < 0 else numbers(error),
            }
            for name, place, error in zip(
                network.marks, errors.marks, errors.error_marks, strict=True
            )
        ],
        "stations": [
            {"name": name, "error_m": numbers(error) if is_known else None}
            for name, is_known, error in zip(
                network.stations, errors.stations, errors.error_stations, strict=True
            )
        ],
    }


def _excluded(result: AdjustedNetwork) -> list[Plain]:
    """Return what was left out, and why."""
    return [
        {
            "kind": one.kind,
            "station": one.station or None,
            "marker": one.marker or None,
            "mark": one.mark or None,
            "reason": one.reason,
        }
        for one in result.left_out
    ]


def _shared(result: AdjustedNetwork) -> list[Plain]:
    """Return what all stations share: range bias and, in a calibration, corrections of the rig."""
    sigmas, shared = np.sqrt(np.diag(result.cov_shared)), result.network.shared
    rows = zip(shared.names, result.shared, sigmas, result.shared_redundancies, strict=True)
    return [
        {"name": name, "value": float(value), "sigma": float(sigma), "redundancy": float(r)}
        for name, value, sigma, r in rows
    ]


def _heights(result: AdjustedNetwork) -> list[Plain]:
    """Return what the centres of each station are too high in the mean, where their fits say so."""
    network, columns = result.network, (result.heights, result.sigma_heights)
    rows = zip(network.stations, network.sigma_heights, *columns, strict=True)
    return [
        {
            "station": name,
            "value_m": float(value * size),
            "sigma_m": float(sigma * size),
            "sigma_a_priori_m": float(size),
            "redundancy": float(1.0 - sigma**2),
        }
        for name, size, value, sigma in rows
        if size
    ]


def _joint(result: AdjustedNetwork) -> Any:
    """Return the joint covariance of all marks; null where there are very many."""
    return numbers(result.cov_p_site) if len(result.p_site) <= _JOINT else None


def _control(result: AdjustedNetwork) -> list[Plain]:
    """Return the control marks, each also as all else predicts it."""
    network = result.network
    rows = _blocks(result.control, [network.marks[m] for m in network.controls], "mark", "m")
    for i, row in enumerate(rows):
        off = result.control_predictions[i]
        sigmas = np.sqrt(np.diag(result.cov_control_predictions[i]))
        is_predicted = bool(np.isfinite(off[0]))
        row["predicted_minus_given_m"] = numbers(off) if is_predicted else None
        row["sigma_predicted_minus_given_m"] = numbers(sigmas) if is_predicted else None
    return rows


def _evidence(one: MarkEvidence, marks: Sequence[str]) -> Plain:
    """Return what all stations say of a mark; ``marks`` are those of the network."""
    return {
        "mark": one.mark,
        "is_used": one.mark in marks,
        "decision": one.decision.value,
        "probability": one.probability,
        "decoy": one.decoy,
        "hypothesis": one.hypothesis,
        "log_odds_prior": one.log_odds_prior,
        "log_odds_radius": one.log_odds_radius,
        "log_odds": one.log_odds,
        "position_m": numbers(one.p_site),
        "stations": [
            {
                "station": station.station,
                "marker": station.marker,
                "finding": station.finding.value,
                "range_m": station.range,
                "log_odds": station.log_odds,
                "reason": station.reason,
            }
            for station in one.stations
        ],
    }


def _repeat(names: Sequence[str], repeat: Repeat) -> Plain:
    """Return two stations that stand at one place."""
    return {
        "stations": [names[i] for i in repeat.stations],
        "apart_m": numbers(repeat.apart),
        "apart_3d_m": float(np.linalg.norm(repeat.apart)),
        "n_marks": repeat.n_marks,
        "difference_rms_m": repeat.rms,
        "predicted_rms_m": repeat.predicted_rms,
    }


def _range_bias(result: AdjustedNetwork) -> Plain | None:
    """Return what all ranges are too long; null where the network has no such unknown."""
    prior = result.network.sigma_range
    if prior == 0.0:
        return None
    return {
        "value_m": result.range_bias,
        "sigma_m": result.sigma_range_bias,
        "sigma_a_priori_m": prior,
        "redundancy": 1.0 - (result.sigma_range_bias / prior) ** 2,
    }


def _datum(result: AdjustedNetwork) -> Plain:
    """Return what place and heading of the network rest on."""
    network = result.network
    if network.is_free:
        return {"kind": "free", "defect": 4, "text": _FREE, "control_marks": []}
    used = result.used[len(network.sightings) + len(network.stations) :]
    names = [network.marks[m] for m, is_used in zip(network.controls, used, strict=True) if is_used]
    text = f"{len(names)} control marks, weighted by their sigmas (exact ones: 0.01 mm)."
    return {"kind": "control", "defect": 0, "text": text, "control_marks": names}


def _stations(result: AdjustedNetwork) -> list[Plain]:
    """Return the stations."""
    counts = np.bincount(result.sightings_used[:, 0], minlength=len(result.network.stations))
    return [
        {
            "name": name,
            "position_m": numbers(T[:3, 3]),
            "rotation": numbers(T[:3, :3]),
            "yaw_deg": math.degrees(yaw_pitch_roll(T[:3, :3])[0]),
            "sigma_yaw_deg": math.degrees(math.sqrt(cov_motion[2, 2])),
            "covariance": numbers(cov_motion),
            "position_covariance_m2": numbers(cov),
            "sigma_3d_m": float(np.sqrt(np.trace(cov))),
            **ellipse_fields(ellipse),
            "n_observations": int(count),
        }
        for name, T, cov_motion, cov, ellipse, count in zip(
            result.network.stations,
            result.T_site_station,
            result.cov_T_site_station,
            result.station_covariances,
            result.station_ellipses,
            counts,
            strict=True,
        )
    ]


def _marks(result: AdjustedNetwork) -> list[Plain]:
    """Return the marks."""
    counts = np.bincount(result.sightings_used[:, 1], minlength=len(result.network.marks))
    covariances, ellipses = result.mark_covariances, result.mark_ellipses
    return [
        {
            "name": name,
            "is_control": i in result.network.controls,
            "status": "weak" if result.mark_weaknesses[i] else "ok",
            "reason": result.mark_weaknesses[i],
            "position_m": numbers(result.p_site[i]),
            "covariance_m2": numbers(covariances[i]),
            "sigma_3d_m": float(np.sqrt(np.trace(covariances[i]))),
            **ellipse_fields(ellipses[i]),
            "n_observations": int(counts[i]),
        }
        for i, name in enumerate(result.network.marks)
    ]


def _observation(result: AdjustedNetwork, i: int) -> Plain:
    """Return one observed centre."""
    network = result.network
    station, mark = network.sightings[i]
    return {
        "station": network.stations[station],
        "marker": network.markers[i],
        "mark": network.marks[mark],
        "used": bool(result.used[i]),
        "residual_m": numbers(result.centres.residuals[i]),
        "redundancy": number(result.centres.redundancies[i]),
        "w": number(result.centres.w_statistics[i]),
        "minimal_detectable_bias_m": number(result.centres.detectable_biases[i]),
        "external_reliability_station_m": number(result.station_shifts[i]),
        "external_reliability_mark_m": number(result.mark_shifts[i]),
    }


def _blocks(tests: BlockTests, names: Sequence[str], kind: str, unit: str) -> list[Plain]:
    """Return the tests of gravity or control."""
    return [
        {
            kind: name,
            "used": bool(np.isfinite(tests.redundancies[i])),
            f"residual_{unit}": numbers(tests.residuals[i]),
            "redundancy": number(tests.redundancies[i]),
            "w": number(tests.w_statistics[i]),
            f"minimal_detectable_bias_{unit}": number(tests.detectable_biases[i]),
        }
        for i, name in enumerate(names)
    ]
