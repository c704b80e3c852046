"""The JSON of a network as rows of the database."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

Row = dict[str, Any]

_AXES = ("x", "y", "z")
_COV = [
    (axes, "xyz".index(axes[0]), "xyz".index(axes[1]))
    for axes in ("xx", "xy", "xz", "yy", "yz", "zz")
]


def network_rows(network: Row, sources: Mapping[str, Row]) -> dict[str, list[Row]]:
    """Return the rows of a network by table, without the columns of its job.

    ``sources`` gives for each station the stop and the run of its centres.
    """
    seen = [row for row in network["observations"] if row["used"]]
    return {
        "adjustments": [_adjustment(network, sources)],
        "adjusted_stations": [
            sources[row["name"]]
            | _placed(row, row["position_covariance_m2"])
            | _mean_redundancy(seen, "station", row["name"])
            | {
                "yaw_deg": row["yaw_deg"],
                "sigma_yaw_deg": row["sigma_yaw_deg"],
                "rotation": [value for line in row["rotation"] for value in line],
                "cov_motion": [value for line in row["covariance"] for value in line],
            }
            for row in network["stations"]
        ],
        "adjusted_marks": [
            {"mark": row["name"]}
            | {key: row[key] for key in ("is_control", "status", "reason")}
            | _placed(row, row["covariance_m2"])
            | _mean_redundancy(seen, "mark", row["name"])
            for row in network["marks"]
        ],
        "adjusted_observations": list(_observations(network)),
        "refused_stations": network["refused"],
        "control_checks": list(_checks(network)),
        "repeated_stops": list(_repeats(network)),
        "mark_decisions": [_decision(one) for one in network["evidence"]],
        "mark_evidence": [
            {"mark": one["mark"], **row} for one in network["evidence"] for row in one["stations"]
        ],
    }


def _decision(one: Row) -> Row:
    """Return the decision on a mark, with the number of stations by finding."""
    findings = [row["finding"] for row in one["stations"]]
    kinds = ("marker", "possible", "refused", "nothing", "hidden")
    return {
        **{key: value for key, value in one.items() if key not in ("stations", "position_m")},
        **{f"{axis}_m": value for axis, value in zip(_AXES, one["position_m"], strict=True)},
        **{f"n_{kind}": findings.count(kind) for kind in kinds},
    }


def _adjustment(network: Row, sources: Mapping[str, Row]) -> Row:
    """Return the row of the adjustment as a whole."""
    bias = network["range_bias"] or {}
    rigs = {sources[row["name"]]["rig_digest"] for row in network["stations"]}
    return {
        **{key: network[key] for key in ("status", "warnings", "dof", "sigma0")},
        **{key: network[key] for key in ("n_observations", "n_unknowns", "passes_global_test")},
        "n_stations": len(network["stations"]),
        "n_marks": len(network["marks"]),
        "n_left_out": len(network["excluded"]),
        "n_refused": len(network["refused"]),
        "n_control_marks": len(network["datum"]["control_marks"]),
        "datum": network["datum"]["kind"],
        "datum_text": network["datum"]["text"],
        "fit_method": network["method"],
        "vtpv": network["global_test"]["vtpv"],
        "vtpv_limit": network["global_test"]["limit"],
        "test_level": network["global_test"]["level"],
        "w_limit": network["critical_w"],
        **{f"variance_factor_{key}": value for key, value in network["variance_factors"].items()},
        "range_bias_m": bias.get("value_m"),
        "sigma_range_bias_m": bias.get("sigma_m"),
        "rig_digest": next(iter(rigs)) if len(rigs) == 1 else None,
    }


def _placed(row: Row, cov: Sequence[Sequence[float]]) -> Row:
    """Return place, covariance, ellipses and counts of a station or a mark."""
    kept = ("sigma_3d_m", "n_observations", *(key for key in row if key.startswith("ellipse_")))
    return {
        **{f"{axis}_m": value for axis, value in zip(_AXES, row["position_m"], strict=True)},
        **{f"cov_{axes}_m2": cov[i][k] for axes, i, k in _COV},
        **{key: row[key] for key in kept},
    }


def _mean_redundancy(observations: Sequence[Row], key: str, name: str) -> Row:
    """Return the mean redundancy of the centres of a station or a mark."""
    own = [row["redundancy"] for row in observations if row[key] == name]
    known = [value for value in own if value is not None]
    return {"mean_redundancy": sum(known) / len(known) if known else None}


def _observations(network: Row) -> Iterator[Row]:
    """Yield the row of each centre, levelling and control mark, used or not."""
    reasons = {
        (one["kind"], one["station"], one["marker"] or one["mark"]): one
        for one in network["excluded"]
    }

    def tested(kind: str, row: Row) -> Row:
        own = row.get("marker") or (row.get("mark") if kind == "control" else None)
        left = reasons.pop((kind, row.get("station"), own), None)
        left = left or reasons.pop((kind, row.get("station"), row.get("mark")), None)
        reason = "" if row["used"] else (left or {}).get("reason", "Left out.")
        names = {key: row.get(key) for key in ("station", "marker", "mark")}
        return names | {"kind": kind, "used": row["used"], "reason": reason} | _tests(row)

    yield from (tested("centre", row) for row in network["observations"])
    yield from (tested("gravity", row) for row in network["gravity"])
    yield from (tested("control", row) for row in network["control"])
    for (kind, station, _), one in reasons.items():
        yield {
            "kind": kind,
            "station": station,
            "marker": one["marker"],
            "mark": one["mark"],
            "used": False,
            "reason": one["reason"],
        }


def _tests(row: Row) -> Row:
    """Return residuals and reliability of an observation, angles in degrees."""
    found = {key: row[key] for key in ("redundancy", "w")}
    for key in ("external_reliability_station_m", "external_reliability_mark_m"):
        found[key] = row.get(key)
    if "residual_rad" in row:
        bias = row["minimal_detectable_bias_rad"]
        residual = zip(_AXES, row["residual_rad"], strict=False)
        return found | {
            **{f"residual_{axis}_deg": math.degrees(value) for axis, value in residual},
            "minimal_detectable_bias_deg": None if bias is None else math.degrees(bias),
        }
    residual = zip(_AXES, row["residual_m"], strict=True)
    return found | {
        **{f"residual_{axis}_m": value for axis, value in residual},
        "minimal_detectable_bias_m": row["minimal_detectable_bias_m"],
    }


def _checks(network: Row) -> Iterator[Row]:
    """Yield, for each control mark, where all else puts it, minus where it was given."""
    counts = {one["name"]: one["n_observations"] for one in network["marks"]}
    for row in network["control"]:
        if row["predicted_minus_given_m"] is None:
            continue
        yield {"mark": row["mark"], "n_observations": counts[row["mark"]]} | {
            f"{name}_{axis}_m": value
            for name, key in (
                ("difference", "predicted_minus_given_m"),
                ("sigma", "sigma_predicted_minus_given_m"),
            )
            for axis, value in zip((*_AXES, "3d"), (*row[key], math.hypot(*row[key])), strict=True)
        }


def _repeats(network: Row) -> Iterator[Row]:
    """Yield the stations that stand at one place."""
    for one in network["repeated_stops"]:
        station, again = one["stations"]
        yield {"station": station, "again": again} | {
            **{f"apart_{axis}_m": value for axis, value in zip(_AXES, one["apart_m"], strict=True)},
            **{key: one[key] for key in ("apart_3d_m", "n_marks")},
            **{key: one[key] for key in ("difference_rms_m", "predicted_rms_m")},
        }
