"""A network as a text report, from its JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence

from spheremark.service.serialise.plain import Plain


def report(network: Plain, title: str = "") -> str:
    """Return the report of a network, from its JSON."""
    parts = [
        *_summary(network, title),
        *_coordinates("ADJUSTED STATIONS", network["stations"]),
        *_coordinates("ADJUSTED MARKS (* control)", network["marks"]),
        *_centres(network),
        *_others(network),
        *_checks(network),
        *_rig(network["calibration"]),
        *_not_used(network),
    ]
    return "\n".join(parts) + "\n"


def _summary(network: Plain, title: str) -> list[str]:
    """Return what the adjustment is and whether it holds."""
    test, factors = network["global_test"], network["variance_factors"]
    verdict = "passed" if network["passes_global_test"] else "FAILED"
    lines = [
        f"NETWORK ADJUSTMENT{'  ' + title if title else ''}",
        "=" * 78,
        f"Stations                        {len(network['stations']):8d}",
        f"Marks                           {len(network['marks']):8d}",
        f"Observations (coordinates)      {network['n_observations']:8d}",
        f"Unknowns                        {network['n_unknowns']:8d}",
        f"Defect of the datum             {network['datum']['defect']:8d}",
        f"Degrees of freedom              {network['dof']:8d}",
        "",
        "Variance factor a priori           1.000",
        f"Variance factor a posteriori    {_fixed(_square(network['sigma0']), 3, 8)}",
        f"Sigma0 a posteriori             {_fixed(network['sigma0'], 3, 8)}",
        *(f"  of {kind:<8}                   {_fixed(factors[kind], 3, 8)}  (variance factor)"
          for kind in ("centres", "gravity", "control")),
        f"Global test (chi-square, one-sided, level {test['level']:g}): v'Pv = {test['vtpv']:.1f}, "
        f"limit {test['limit']:.1f}: {verdict}",
        f"Local test (w): limit {network['critical_w']:.2f}",
        *_bias_line(network["range_bias"]),
        f"Datum: {network['datum']['text']}",
    ]  # fmt: skip
    return [*lines, *(f"WARNING: {one}" for one in network["warnings"]), ""]


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


def _centres(network: Plain) -> list[str]:
    """Return observed centres with residuals and reliability, the worst first."""
    lines = [
        "OBSERVED CENTRES, largest w first (v observed - computed, r of 3, EX: shift by an MDB)",
        "-" * 78,
        f"{'Station':<14} {'Marker':<6} {'Mark':<8} {'vX':>6} {'vY':>6} {'vZ':>6} {'r':>5} "
        f"{'w':>5} {'MDB':>6} {'EX stn':>7} {'EX mark':>8}",
        f"{'':<30} {'[mm]':>6} {'[mm]':>6} {'[mm]':>6} {'':>5} {'':>5} {'[mm]':>6} {'[mm]':>7} "
        f"{'[mm]':>8}",
    ]
    rows = sorted(network["observations"], key=lambda row: -(row["w"] or 0.0))
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


def _others(network: Plain) -> list[str]:
    """Return residuals of levelling and control."""
    lines = ["OBSERVED LEVELLING", "-" * 78, "Station          vX [deg]  vY [deg]     r     w"]
    for row in network["gravity"]:
        v = " ".join(f"{math.degrees(value):9.3f}" for value in row["residual_rad"])
        lines.append(
            f"{row['station']:<14} {v} {_fixed(row['redundancy'], 2, 5)} {_fixed(row['w'], 2, 5)}"
        )
    if network["control"]:
        lines += ["", "CONTROL MARKS", "-" * 78, "Mark            vX [mm]  vY [mm]  vZ [mm]     w"]
    for row in network["control"]:
        v = " ".join(f"{1e3 * value:8.2f}" for value in row["residual_m"])
        lines.append(f"{row['mark']:<14} {v} {_fixed(row['w'], 2, 5)}")
    return [*lines, ""]


def _checks(network: Plain) -> list[str]:
    """Return what is known of the accuracy without truth."""
    lines = ["CHECKS WITHOUT TRUTH", "-" * 78]
    lines += [f"Mark {row['name']}: {row['reason']}" for row in network["marks"] if row["reason"]]
    for row in network["control"]:
        if row["predicted_minus_given_m"] is None:
            lines.append(f"Control {row['mark']} left out: nothing else determines it.")
            continue
        off = " ".join(f"{1e3 * value:7.2f}" for value in row["predicted_minus_given_m"])
        sigma = " ".join(f"{1e3 * value:6.2f}" for value in row["sigma_predicted_minus_given_m"])
        lines.append(f"Control {row['mark']} left out: predicted - given {off} mm, sigma {sigma}")
    for row in network["repeated_stops"]:
        lines.append(
            f"{' and '.join(row['stations'])}: {1e3 * row['apart_3d_m']:.1f} mm apart, centres of "
            f"{row['n_marks']} marks agree to {1e3 * row['difference_rms_m']:.2f} mm RMS "
            f"(predicted {1e3 * row['predicted_rms_m']:.2f})"
        )
    nothing = "No control mark and no repeated stop: the accuracy is known by sigmas only."
    return [*lines, *([nothing] if len(lines) == 2 else []), ""]


def _rig(calibration: Plain | None) -> list[str]:
    """Return the rig, if it was adjusted with the network."""
    if calibration is None:
        return []
    lines = ["RIG, ADJUSTED WITH THE NETWORK", "-" * 78]
    for row in calibration["parameters"]:
        numbers = " ".join(f"{row[key]:13.7f}" for key in ("start", "estimate", "sigma"))
        lines.append(f"{row['name']:<22} [{row['unit']:<3}] {numbers}")
    lines += [f"{one['name']}: {one['reason']}" for one in calibration["not_separable"]]
    return [*lines, ""]


def _not_used(network: Plain) -> list[str]:
    """Return what was left out, and why."""
    lines = ["NOT USED", "-" * 78]
    lines += [f"Station {one['station']}: {one['reason']}" for one in network["refused"]]
    for one in network["excluded"]:
        named = [one["station"], one["marker"], one["mark"]]
        what = " ".join(part for part in named if part)
        lines.append(f"{one['kind'].capitalize()} {what}: {one['reason']}")
    return lines if len(lines) > 2 else [*lines, "Nothing: all observations were used."]


def _square(value: float | None) -> float | None:
    """Return the square of a number, if there is one."""
    return None if value is None else value**2


def _fixed(value: float | None, digits: int, width: int) -> str:
    """Return a number of fixed width, or a dash."""
    return f"{'-':>{width}}" if value is None else f"{value:{width}.{digits}f}"
