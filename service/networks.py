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

from pipelines.config import SurveyConfig
from pipelines.errors import SpheremarkError
from pipelines.geometry import yaw_pitch_roll
from pipelines.network import AdjustedNetwork, BlockTests, Refusal, adjust_network, assemble
from pipelines.survey import Progress, process
from pipelines.values import ControlMarks, MarkerFits, Rig
from storage.recordings import read_log
from storage.results import ellipse, marker_name

Plain = dict[str, Any]

_SCANS = 0.95  # share of the work that the scans take
_FREE = (
    "Free network: the levelled stations give the vertical; place and heading are those of the "
    "first station, and inner constraints over all marks give the covariances of least trace."
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Fieldbook:
    """The centres of each station that a survey's logs gave, and the stations that gave none."""

    scans: tuple[tuple[str, MarkerFits], ...]
    refused: tuple[Refusal, ...]


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
    log = read_log(path)
    for stop in process(log, config=config, rig=rig, progress=progress):
        yield stop.name, stop.fits[config.fitting.methods[0]]


def adjust_scans(
    book: Fieldbook, control: ControlMarks | None, config: SurveyConfig
) -> AdjustedNetwork:
    """Adjust all stations and marks together."""
    network = assemble(book.scans, control, config.resection)
    network = replace(network, refused=(*book.refused, *network.refused))
    return adjust_network(network, config.resection)


def network_answer(result: AdjustedNetwork, config: SurveyConfig) -> Plain:
    """Return a network as plain values."""
    network = result.network
    return {
        "status": "weak" if result.warnings else "ok",
        "warnings": list(result.warnings),
        "datum": _datum(result),
        "method": config.fitting.methods[0],
        "config": config.to_mapping() | {"digest": config.digest},
        "stations": [_station(result, i) for i in range(len(network.stations))],
        "marks": [_mark(result, i) for i in range(len(network.marks))],
        "observations": [_observation(result, i) for i in range(len(network.sightings))],
        "gravity": _blocks(result.gravity, network.stations, "station", "rad"),
        "control": _blocks(
            result.control, [network.marks[m] for m in network.controls], "mark", "m"
        ),
        "excluded": [
            {
                "kind": one.kind,
                "station": one.station or None,
                "marker": marker_name(one.fit) if one.fit >= 0 else None,
                "mark": one.mark or None,
                "reason": one.reason,
            }
            for one in result.left_out
        ],
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


def _n_observations(result: AdjustedNetwork) -> int:
    """Return the number of observed coordinates and angles that were used."""
    n, s = len(result.network.sightings), len(result.network.stations)
    centres, gravity, control = (int(part.sum()) for part in np.split(result.used, [n, n + s]))
    return 3 * centres + 2 * gravity + 3 * control + _n_biases(result)


def _n_biases(result: AdjustedNetwork) -> int:
    """Return the number of range biases, each an unknown and by its prior an observation."""
    return int(result.network.sigma_range > 0.0)


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
        "marker": marker_name(int(network.fits[i])),
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


def report(answer: Plain, title: str = "") -> str:
    """Return a network as a text that surveyors read, from its JSON."""
    parts = [
        *_summary(answer, title),
        *_coordinates("ADJUSTED STATIONS", answer["stations"]),
        *_coordinates("ADJUSTED MARKS (* control)", answer["marks"]),
        *_centres(answer),
        *_others(answer),
        *_not_used(answer),
    ]
    return "\n".join(parts) + "\n"


def _summary(answer: Plain, title: str) -> list[str]:
    """Return what the adjustment is and whether it holds."""
    test, factors = answer["global_test"], answer["variance_factors"]
    verdict = "passed" if answer["passes_global_test"] else "FAILED"
    lines = [
        f"NETWORK ADJUSTMENT{'  ' + title if title else ''}",
        "=" * 78,
        f"Stations                        {len(answer['stations']):8d}",
        f"Marks                           {len(answer['marks']):8d}",
        f"Observations (coordinates)      {answer['n_observations']:8d}",
        f"Unknowns                        {answer['n_unknowns']:8d}",
        f"Defect of the datum             {answer['datum']['defect']:8d}",
        f"Degrees of freedom              {answer['dof']:8d}",
        "",
        "Variance factor a priori           1.000",
        f"Variance factor a posteriori    {_fixed(_square(answer['sigma0']), 3, 8)}",
        f"Sigma0 a posteriori             {_fixed(answer['sigma0'], 3, 8)}",
        *(f"  of {kind:<8}                   {_fixed(factors[kind], 3, 8)}  (variance factor)"
          for kind in ("centres", "gravity", "control")),
        f"Global test (chi-square, one-sided, level {test['level']:g}): v'Pv = {test['vtpv']:.1f}, "
        f"limit {test['limit']:.1f}: {verdict}",
        f"Local test (w): limit {answer['critical_w']:.2f}",
        *_bias_line(answer["range_bias"]),
        f"Datum: {answer['datum']['text']}",
    ]  # fmt: skip
    return [*lines, *(f"WARNING: {one}" for one in answer["warnings"]), ""]


def _bias_line(bias: Plain | None) -> list[str]:
    """Return what all ranges are too long, if the network has it as an unknown."""
    if bias is None:
        return []
    value, sigma, prior = (1e3 * bias[k] for k in ("value_m", "sigma_m", "sigma_a_priori_m"))
    return [
        f"All ranges too long by {value:.2f} mm, sigma {sigma:.2f} mm (a priori {prior:.2f} mm)"
    ]


def _coordinates(title: str, rows: Sequence[Plain]) -> list[str]:
    """Return coordinates with sigmas and 95 % ellipses."""
    lines = [
        title,
        "-" * 78,
        f"{'Name':<14} {'X':>12} {'Y':>12} {'Z':>12} {'sX':>5} {'sY':>5} {'sZ':>5} {'a95':>6} "
        f"{'b95':>6} {'bearing':>7} {'seen':>4}",
        f"{'':<14} {'[m]':>12} {'[m]':>12} {'[m]':>12} {'[mm]':>5} {'[mm]':>5} {'[mm]':>5} "
        f"{'[mm]':>6} {'[mm]':>6} {'[deg]':>7}",
    ]
    for row in rows:
        name = row["name"] + ("*" if row.get("is_control") else "")
        x, y, z = row["position_m"]
        cov = row.get("position_covariance_m2") or row["covariance_m2"]
        sigmas = " ".join(f"{1e3 * math.sqrt(cov[k][k]):5.1f}" for k in range(3))
        a, b = 1e3 * row["ellipse_major_95_m"], 1e3 * row["ellipse_minor_95_m"]
        lines.append(
            f"{name:<14} {x:12.4f} {y:12.4f} {z:12.4f} {sigmas} {a:6.1f} {b:6.1f} "
            f"{row['ellipse_bearing_deg']:7.1f} {row['n_observations']:4d}"
        )
    return [*lines, ""]


def _centres(answer: Plain) -> list[str]:
    """Return observed centres with residuals and reliability, the worst first."""
    lines = [
        "OBSERVED CENTRES, largest w first (v observed - computed, r of 3, EX: shift by an MDB)",
        "-" * 78,
        f"{'Station':<14} {'Marker':<6} {'Mark':<8} {'vX':>6} {'vY':>6} {'vZ':>6} {'r':>5} "
        f"{'w':>5} {'MDB':>6} {'EX stn':>7} {'EX mark':>8}",
        f"{'':<30} {'[mm]':>6} {'[mm]':>6} {'[mm]':>6} {'':>5} {'':>5} {'[mm]':>6} {'[mm]':>7} "
        f"{'[mm]':>8}",
    ]
    rows = sorted(answer["observations"], key=lambda row: -(row["w"] or 0.0))
    for row in rows:
        v = " ".join(f"{1e3 * value:6.1f}" for value in row["residual_m"])
        reach = " ".join(
            _fixed(None if row[key] is None else 1e3 * row[key], 1, width)
            for key, width in (
                ("minimal_detectable_bias_m", 6),
                ("external_reliability_station_m", 7),
                ("external_reliability_mark_m", 8),
            )
        )
        lines.append(
            f"{row['station']:<14} {row['marker']:<6} {row['mark']:<8} {v} "
            f"{_fixed(row['redundancy'], 2, 5)} {_fixed(row['w'], 2, 5)} {reach}"
            f"{'' if row['used'] else '  left out'}"
        )
    return [*lines, ""]


def _others(answer: Plain) -> list[str]:
    """Return residuals of levelling and control."""
    lines = ["OBSERVED LEVELLING", "-" * 78, "Station          vX [deg]  vY [deg]     r     w"]
    for row in answer["gravity"]:
        v = " ".join(f"{math.degrees(value):9.3f}" for value in row["residual_rad"])
        lines.append(
            f"{row['station']:<14} {v} {_fixed(row['redundancy'], 2, 5)} {_fixed(row['w'], 2, 5)}"
        )
    if answer["control"]:
        lines += ["", "CONTROL MARKS", "-" * 78, "Mark            vX [mm]  vY [mm]  vZ [mm]     w"]
    for row in answer["control"]:
        v = " ".join(f"{1e3 * value:8.2f}" for value in row["residual_m"])
        lines.append(f"{row['mark']:<14} {v} {_fixed(row['w'], 2, 5)}")
    return [*lines, ""]


def _not_used(answer: Plain) -> list[str]:
    """Return what was left out, and why."""
    lines = ["NOT USED", "-" * 78]
    lines += [f"Station {one['station']}: {one['reason']}" for one in answer["refused"]]
    for one in answer["excluded"]:
        named = [one["station"], one["marker"], one["mark"]]
        what = " ".join(part for part in named if part)
        lines.append(f"{one['kind'].capitalize()} {what}: {one['reason']}")
    return lines if len(lines) > 2 else [*lines, "Nothing: all observations were used."]


def _part(progress: Progress, i: int, n: int) -> Progress:
    """Return the progress of log ``i`` of ``n`` as a share of the whole."""
    return lambda share, what: progress(_SCANS * (i + share) / n, what)


def _square(value: float | None) -> float | None:
    """Return the square of a number, if there is one."""
    return None if value is None else value**2


def _fixed(value: float | None, digits: int, width: int) -> str:
    """Return a number of fixed width, or a dash."""
    return f"{'-':>{width}}" if value is None else f"{value:{width}.{digits}f}"


def _number(value: float) -> float | None:
    """Return a number, or null where JSON has none for it."""
    return float(value) if math.isfinite(value) else None


def _numbers(values: ArrayLike) -> Any:
    """Return an array as nested lists."""
    return np.asarray(values, dtype=np.float64).tolist()
