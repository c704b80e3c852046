"""``spheremark adjust``: the logs of a survey to one network, as JSON and as a report.

The JSON is a public interface: names, frames and signs as in CONVENTIONS.md; what is unknown is
null. The report says the same in the order in which surveyors read.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from spheremark.pipelines.calibration import Calibration
from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.errors import RigError, SolveError, SpheremarkError
from spheremark.pipelines.geometry import yaw_pitch_roll
from spheremark.pipelines.model import ControlMarks, MarkerFits, Rig, Truth
from spheremark.pipelines.network import (
    AdjustedNetwork,
    BlockTests,
    Refusal,
    Repeat,
    adjust_network,
    assemble,
    compare,
    repeated_stops,
)
from spheremark.pipelines.survey import Progress, process
from spheremark.service.serialise.calibration import calibrate_logs, calibration_answer
from spheremark.service.serialise.network_report import report
from spheremark.storage.catalogue.results import ellipse
from spheremark.storage.recordings import read_log

__all__ = [
    "Fieldbook", "adjust_scans", "calibrated", "error_answer", "network_answer", "read_scans",
    "report", "with_calibration",
]  # fmt: skip

Plain = dict[str, Any]

_JOINT = 50  # marks whose joint covariance is in the JSON
_SCANS = 0.95  # share of the work that the scans take
_FREE = (
    "Free network: the levelled stations give the vertical; place and heading are those of the "
    "first station, and inner constraints over all marks give the covariances of least trace."
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Fieldbook:
    """The centres of each station that a survey's logs gave, and the stations that gave none.

    ``calibration`` is the rig from the same logs, if it was asked for; ``uncalibrated`` says why it
    could not be had.
    """

    scans: tuple[tuple[str, MarkerFits], ...]
    refused: tuple[Refusal, ...]
    calibration: Calibration | None = None
    uncalibrated: str = ""


def read_scans(
    logs: Sequence[Path], config: SurveyConfig, rig: Rig | None, progress: Progress
) -> Fieldbook:
    """Find the markers of each log; a log that gives none costs no other.

    Raises the error of the first log if all fail.
    """
    scans: list[tuple[str, MarkerFits]] = []
    refused: list[Refusal] = []
    first: SpheremarkError | None = None
    for i, log in enumerate(logs):
        try:
            scans += _scans(log, config, rig, _part(progress, i, len(logs)))
        except SpheremarkError as error:
            first = first or error
            refused.append(Refusal(station=log.stem, code=error.code, reason=str(error)))
    if not scans and first is not None:
        raise first
    return Fieldbook(scans=tuple(scans), refused=tuple(refused))


def _scans(
    path: Path, config: SurveyConfig, rig: Rig | None, progress: Progress
) -> Iterator[tuple[str, MarkerFits]]:
    """Give name and centres of each stop of a log."""
    for stop in process(read_log(path), config=config, rig=rig, progress=progress):
        yield stop.name, stop.fits[config.fitting.methods[0]]


def with_calibration(
    book: Fieldbook, logs: Sequence[Path], config: SurveyConfig, rig: Rig | None, progress: Progress
) -> Fieldbook:
    """Return a fieldbook with the rig from its logs, or why they do not tell it."""
    refused = {one.station for one in book.refused}
    good = [log for log in logs if log.stem not in refused]
    try:
        return replace(book, calibration=calibrate_logs(good, config, rig, progress))
    except (SolveError, RigError) as error:
        return replace(book, uncalibrated=str(error))


def adjust_scans(
    book: Fieldbook, control: ControlMarks | None, config: SurveyConfig
) -> AdjustedNetwork:
    """Adjust all stations and marks together, and the rig where the fieldbook has one."""
    network = assemble(book.scans, control, config.resection, book.calibration)
    network = replace(network, refused=(*book.refused, *network.refused))
    return adjust_network(network, config.resection)


def calibrated(result: AdjustedNetwork, calibration: Calibration) -> Calibration:
    """Return a calibration with what the network adds to it."""
    k = len(calibration.unknowns)
    return calibration.corrected(result.shared[:k], result.cov_shared[:k, :k])


def network_answer(
    result: AdjustedNetwork, config: SurveyConfig, book: Fieldbook | None = None
) -> Plain:
    """Return a network as plain values, with the rig that was adjusted with it."""
    network, warnings = result.network, list(result.warnings)
    calibration = None if book is None else book.calibration
    rig = None if calibration is None else calibrated(result, calibration)
    if book is not None and book.uncalibrated:
        warnings.append(f"The rig could not be calibrated and stays as it was: {book.uncalibrated}")
    if not result.passes_global_test and rig is None:
        warnings.append("A wrong rig can be the cause: adjust it together with the stations.")
    return {
        "status": "weak" if warnings else "ok",
        "warnings": warnings,
        "datum": _datum(result),
        "method": config.fitting.methods[0],
        "config": config.to_mapping() | {"digest": config.digest},
        "stations": [_station(result, i) for i in range(len(network.stations))],
        "marks": [_mark(result, i) for i in range(len(network.marks))],
        "observations": [_observation(result, i) for i in range(len(network.sightings))],
        "gravity": _blocks(result.gravity, network.stations, "station", "rad"),
        "control": _control(result),
        "repeated_stops": [_repeat(network.stations, one) for one in repeated_stops(result)],
        "calibration": None if rig is None else calibration_answer(rig),
        "shared_unknowns": _shared(result),
        "marks_covariance_m2": _joint(result),
        "excluded": _excluded(result),
        "refused": [
            {"station": one.station, "code": one.code, "reason": one.reason}
            for one in network.refused
        ],
        "n_observations": _n_observations(result),
        "n_unknowns": 6 * len(network.stations) + 3 * len(network.marks) + _n_biases(result),
        "dof": result.dof,
        "sigma0_a_priori": 1.0,
        "sigma0": _number(result.sigma0),
        "passes_global_test": result.passes_global_test,
        "global_test": {
            "vtpv": result.vtpv,
            "limit": result.limit_vtpv,
            "level": config.resection.test_level,
        },
        "variance_factors": dict(
            zip(
                ("centres", "gravity", "control"),
                (_number(value) for value in result.variance_factors),
                strict=True,
            )
        ),
        "critical_w": result.critical_w,
        "range_bias": _range_bias(result),
    }


def error_answer(result: AdjustedNetwork, truths: Sequence[Truth]) -> Plain:
    """Return the errors of a network against the truths of its logs, which share their marks."""
    stops = {stop.name: stop for truth in truths for stop in truth.stops}
    errors = compare(result, replace(truths[0], stops=tuple(stops.values())))
    network, names = result.network, truths[0].marks.names
    return {
        "rms_marks_m": errors.rms_marks,
        "rms_stations_m": errors.rms_stations,
        "nees_per_dof_marks": _number(errors.nees_marks),
        "nees_per_dof_stations": _number(errors.nees_stations),
        "n_false_marks": int(np.sum(errors.marks < 0)),
        "marks": [
            {
                "name": name,
                "true_mark": None if place < 0 else names[place],
                "error_m": None if place < 0 else _numbers(error),
            }
            for name, place, error in zip(
                network.marks, errors.marks, errors.error_marks, strict=True
            )
        ],
        "stations": [
            {"name": name, "error_m": _numbers(error) if is_known else None}
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


def _n_observations(result: AdjustedNetwork) -> int:
    """Return the number of observed coordinates and angles that were used."""
    n, s = len(result.network.sightings), len(result.network.stations)
    centres, gravity, control = (int(part.sum()) for part in np.split(result.used, [n, n + s]))
    return 3 * centres + 2 * gravity + 3 * control + _n_biases(result)


def _n_biases(result: AdjustedNetwork) -> int:
    """Return the number of shared unknowns, each by what was known of it an observation too."""
    return len(result.network.shared.names)


def _shared(result: AdjustedNetwork) -> list[Plain]:
    """Return what all stations share: range bias and, in a calibration, corrections of the rig."""
    sigmas, shared = np.sqrt(np.diag(result.cov_shared)), result.network.shared
    redundancies = 1.0 - np.diag(shared.weights @ result.cov_shared)
    rows = zip(shared.names, result.shared, sigmas, redundancies, strict=True)
    return [
        {"name": name, "value": float(value), "sigma": float(sigma), "redundancy": float(r)}
        for name, value, sigma, r in rows
    ]


def _joint(result: AdjustedNetwork) -> Any:
    """Return the joint covariance of all marks; null where there are very many."""
    return _numbers(result.cov_p_site) if len(result.p_site) <= _JOINT else None


def _control(result: AdjustedNetwork) -> list[Plain]:
    """Return the control marks, each also as all else predicts it."""
    network = result.network
    rows = _blocks(result.control, [network.marks[m] for m in network.controls], "mark", "m")
    for i, row in enumerate(rows):
        cov, is_told = result.cov_control_predictions[i], result.control_predictions[i, 0]
        told = bool(np.isfinite(is_told))
        sigmas = np.sqrt(np.diag(cov))
        off = _numbers(result.control_predictions[i])
        row["predicted_minus_given_m"] = off if told else None
        row["sigma_predicted_minus_given_m"] = _numbers(sigmas) if told else None
    return rows


def _repeat(names: Sequence[str], repeat: Repeat) -> Plain:
    """Return two stations that stand at one place."""
    return {
        "stations": [names[i] for i in repeat.stations],
        "apart_m": _numbers(repeat.apart),
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


def _station(result: AdjustedNetwork, i: int) -> Plain:
    """Return one station."""
    network, T, cov = result.network, result.T_site_station[i], result.station_covariances[i]
    own = network.sightings[:, 0] == i
    yaw, _, _ = yaw_pitch_roll(T[:3, :3])
    return {
        "name": network.stations[i],
        "position_m": _numbers(T[:3, 3]),
        "rotation": _numbers(T[:3, :3]),
        "yaw_deg": math.degrees(yaw),
        "sigma_yaw_deg": math.degrees(math.sqrt(result.cov_T_site_station[i, 2, 2])),
        "covariance": _numbers(result.cov_T_site_station[i]),
        "position_covariance_m2": _numbers(cov),
        "sigma_3d_m": float(np.sqrt(np.trace(cov))),
        **{key: float(value) for key, value in ellipse(cov[:2, :2]).items()},
        "n_observations": int(np.sum(own & result.used[: len(own)])),
    }


def _mark(result: AdjustedNetwork, i: int) -> Plain:
    """Return one mark."""
    network, cov = result.network, result.mark_covariances[i]
    own = network.sightings[:, 1] == i
    return {
        "name": network.marks[i],
        "is_control": i in network.controls,
        "status": "weak" if result.mark_weaknesses[i] else "ok",
        "reason": result.mark_weaknesses[i],
        "position_m": _numbers(result.p_site[i]),
        "covariance_m2": _numbers(cov),
        "sigma_3d_m": float(np.sqrt(np.trace(cov))),
        **{key: float(value) for key, value in ellipse(cov[:2, :2]).items()},
        "n_observations": int(np.sum(own & result.used[: len(own)])),
    }


def _observation(result: AdjustedNetwork, i: int) -> Plain:
    """Return one observed centre."""
    network = result.network
    station, mark = network.sightings[i]
    return {
        "station": network.stations[station],
        "marker": network.markers[i],
        "mark": network.marks[mark],
        "used": bool(result.used[i]),
        "residual_m": _numbers(result.centres.residuals[i]),
        "redundancy": _number(result.centres.redundancies[i]),
        "w": _number(result.centres.w_statistics[i]),
        "minimal_detectable_bias_m": _number(result.centres.detectable_biases[i]),
        "external_reliability_station_m": _number(result.station_shifts[i]),
        "external_reliability_mark_m": _number(result.mark_shifts[i]),
    }


def _blocks(tests: BlockTests, names: Sequence[str], kind: str, unit: str) -> list[Plain]:
    """Return the tests of gravity or control."""
    return [
        {
            kind: name,
            "used": bool(np.isfinite(tests.redundancies[i])),
            f"residual_{unit}": _numbers(tests.residuals[i]),
            "redundancy": _number(tests.redundancies[i]),
            "w": _number(tests.w_statistics[i]),
            f"minimal_detectable_bias_{unit}": _number(tests.detectable_biases[i]),
        }
        for i, name in enumerate(names)
    ]


def _part(progress: Progress, i: int, n: int) -> Progress:
    """Return the progress of log ``i`` of ``n`` as a share of the whole."""
    return lambda share, what: progress(_SCANS * (i + share) / n, what)


def _number(value: float) -> float | None:
    """Return a number, or null where JSON has none for it."""
    return float(value) if math.isfinite(value) else None


def _numbers(values: ArrayLike) -> Any:
    """Return an array as nested lists."""
    return np.asarray(values, dtype=np.float64).tolist()
