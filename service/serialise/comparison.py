"""Two results side by side: how they were made, their key numbers, and what they share."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from spheremark.pipelines.accuracy.comparison import (
    aligned,
    compare_numbers,
    compare_pairs,
    compare_points,
)
from spheremark.pipelines.errors import InputError, NotFoundError, TooFewObservationsError
from spheremark.pipelines.model import Array
from spheremark.storage.catalogue.catalogue import Catalogue
from spheremark.storage.catalogue.rows import COV, places
from spheremark.web.links import stop_url

Row = dict[str, Any]
ROWS_MAX = 500  # of one table: the largest differences
_MM = 1e3  # [mm/m]


class Kind(NamedTuple):
    """A kind of result that can be compared."""

    label: str
    choices: str
    compare: Callable[[Catalogue, str, str], Row]


_RUNS = """
SELECT r.run_id AS key, c.name || ', ' || s.name || ', '
    || strftime(r.finished_at, '%d %b %H:%M:%S') AS label
FROM runs AS r JOIN recordings AS c USING (recording_id) JOIN surveys AS s USING (survey_id)
WHERE survey_id NOT IN (SELECT survey_id FROM deleted_surveys)
ORDER BY r.finished_at DESC LIMIT 100
"""
_NETWORKS = """
SELECT a.adjustment_id AS key, s.name || ', ' || a.datum || ', '
    || strftime(a.finished_at, '%d %b %H:%M:%S') AS label
FROM adjustments AS a JOIN surveys AS s USING (survey_id)
WHERE survey_id NOT IN (SELECT survey_id FROM deleted_surveys) ORDER BY a.finished_at DESC LIMIT 100
"""
_RIGS = """
SELECT c.calibration_id AS key, s.name || ', ' || strftime(c.finished_at, '%d %b %H:%M:%S') AS label
FROM calibrations AS c JOIN surveys AS s USING (survey_id)
WHERE survey_id NOT IN (SELECT survey_id FROM deleted_surveys) ORDER BY c.finished_at DESC LIMIT 100
"""
_METHODS = """
SELECT DISTINCT s.name || '/' || f.fit_method AS key,
    s.name || ', ' || replace(f.fit_method, '_', ' ') AS label
FROM station_fixes AS f JOIN latest_runs AS r USING (run_id) JOIN surveys AS s USING (survey_id)
ORDER BY label LIMIT 100
"""
_PLANS = """
SELECT placement_id AS key, name || ', ' || n_marks || ' marks' AS label FROM plans
ORDER BY created_at DESC LIMIT 100
"""
_RUN = """
SELECT r.run_id, s.name AS survey, c.name AS recording, r.config, r.config_digest, r.code_version,
    r.rig_digest, r.finished_at, r.duration_s
FROM runs AS r JOIN surveys AS s USING (survey_id) JOIN recordings AS c USING (recording_id)
WHERE r.run_id = $id
"""
_RUN_FIXES = """
SELECT stop || ', ' || replace(fit_method, '_', ' ') AS name, stop, fit_method,
    x_m, y_m, z_m, {cov}, sigma_3d_m, error_3d_m
FROM station_fixes WHERE run_id = $id AND x_m IS NOT NULL
QUALIFY row_number() OVER (PARTITION BY stop, fit_method ORDER BY resection_method) = 1
ORDER BY name
""".format(cov=", ".join(COV))
_NETWORK = """
SELECT a.adjustment_id, s.name AS survey, a.datum, a.n_stations, a.n_marks, a.n_control_marks,
    a.dof, a.sigma0, a.passes_global_test, a.status, a.config, a.config_digest, a.code_version,
    a.rig_digest, a.finished_at
FROM adjustments AS a JOIN surveys AS s USING (survey_id) WHERE a.adjustment_id = $id
"""
_NETWORK_POINTS = """
SELECT station AS name, 'station' AS what, x_m, y_m, z_m, {cov}, sigma_3d_m, error_3d_m
FROM adjusted_stations WHERE adjustment_id = $id
UNION ALL
SELECT mark, 'mark', x_m, y_m, z_m, {cov}, sigma_3d_m, error_3d_m
FROM adjusted_marks WHERE adjustment_id = $id
ORDER BY what DESC, name
""".format(cov=", ".join(COV))
_RIG = """
SELECT c.calibration_id, s.name AS survey, len(c.stops) AS n_stops, c.n_spheres, c.sigma0,
    c.residual_rms_before_m, c.residual_rms_after_m, c.gap_rms_before_m, c.gap_rms_after_m,
    c.config, c.config_digest, c.code_version, c.rig_digest, c.finished_at
FROM calibrations AS c JOIN surveys AS s USING (survey_id) WHERE c.calibration_id = $id
"""
_PARAMETERS = """
SELECT parameter AS name, unit, estimate, sigma FROM calibrated_parameters
WHERE calibration_id = $id AND is_estimated ORDER BY place
"""
_METHOD = """
SELECT m.run_id || m.stop AS key, m.stop, count(*) AS n, sqrt(avg(m.error_3d_m ^ 2)) AS error_m,
    sqrt(avg(m.sigma_3d_m ^ 2)) AS sigma_m
FROM marker_fits AS m JOIN latest_runs AS r USING (run_id) JOIN surveys AS s USING (survey_id)
WHERE s.name = $survey AND m.fit_method = $method GROUP BY m.run_id, m.stop
ORDER BY hash(m.run_id, m.stop) LIMIT 20000
"""
_PLAN = """
SELECT placement_id, name, site_name, resection_method, tolerance_m, n_marks, model_source,
    model_version, created_at AS finished_at
FROM plans WHERE placement_id = $id
"""
_PLANNED = """
SELECT stop AS name, sigma_3d_m, probability_within_tolerance AS probability, n_used
FROM planned_stops WHERE placement_id = $id ORDER BY place
"""


def compared(catalogue: Catalogue, a: str, b: str) -> Row:
    """Return two results side by side; each is named by its kind and key, ``run:0123``."""
    kinds = [one.partition(":")[0] for one in (a, b)]
    for kind, one in zip(kinds, (a, b), strict=True):
        if kind not in KINDS or ":" not in one:
            raise InputError(f"{one!r} is no result; write {', '.join(f'{k}:ID' for k in KINDS)}.")
    if kinds[0] != kinds[1]:
        raise InputError(f"{kinds[0]} and {kinds[1]} are compared; both must be of one kind.")
    keys = [one.partition(":")[2] for one in (a, b)]
    return {"kind": kinds[0], "a": a, "b": b} | KINDS[kinds[0]].compare(catalogue, *keys)


def choices(catalogue: Catalogue) -> dict[str, list[Row]]:
    """Return what can be compared, by kind, newest first."""
    return {name: catalogue.rows(kind.choices) for name, kind in KINDS.items()}


def _runs(catalogue: Catalogue, a: str, b: str) -> Row:
    """Compare the stations of two runs."""
    about = [_one(catalogue, _RUN, key, "run") for key in (a, b)]
    rows = [catalogue.rows(_RUN_FIXES, {"id": key}) for key in (a, b)]
    survey = about[0]["survey"]
    links = {one["name"]: stop_url(survey, one["stop"], one["fit_method"]) for one in rows[0]}
    return _made(about) | _points(rows, links, is_free=False)


def _networks(catalogue: Catalogue, a: str, b: str) -> Row:
    """Compare the stations and marks of two networks."""
    about = [_one(catalogue, _NETWORK, key, "network") for key in (a, b)]
    rows = [catalogue.rows(_NETWORK_POINTS, {"id": key}) for key in (a, b)]
    is_free = any(one["datum"] == "free" for one in about)
    return _made(about) | _points(rows, {}, is_free=is_free)


def _points(rows: Sequence[Sequence[Row]], links: Mapping[str, str], *, is_free: bool) -> Row:
    """Compare the points that two results share by name."""
    known = [{(one.get("what", ""), one["name"]): one for one in found} for found in rows]
    shared = [key for key in known[0] if key in known[1]]
    notes = [
        "Both results are taken as independent. Results of one log share its noise: their "
        "differences vary less, so that a significant one is significant all the more."
    ]
    if not shared:
        return {
            "rows": [],
            "notes": ["The results share no point of the same name."],
            "summary": "",
        }
    pair = [[part[key] for key in shared] for part in known]
    p = [places(part) for part in pair]
    if is_free:
        try:
            p[1] = aligned(*p)
        except TooFewObservationsError as error:
            return {"rows": [], "notes": [str(error)], "summary": ""}
        notes.append("A network is free: the second was moved onto the first, heading and place.")
    found = compare_points(p[0], _covariances(pair[0]), p[1], _covariances(pair[1]))
    lengths = np.linalg.norm(found.differences, axis=1)
    table = [
        {
            "name": shared[i][1],
            "what": shared[i][0],
            "href": links.get(shared[i][1], ""),
            **dict(zip(("dx_m", "dy_m", "dz_m"), found.differences[i].tolist(), strict=True)),
            "difference_3d_m": float(lengths[i]),
            "sigma_3d_m": float(found.sigmas[i]),
            "p_value": float(found.p_values[i]),
            "is_significant": bool(found.significant[i]),
            "error_a_m": pair[0][i]["error_3d_m"],
            "error_b_m": pair[1][i]["error_3d_m"],
        }
        for i in np.argsort(-lengths)[:ROWS_MAX]
    ]
    rms = float(np.sqrt(np.mean(lengths**2)))
    expected = float(np.sqrt(np.mean(found.sigmas**2)))
    only = [len(part) - len(shared) for part in known]
    return {
        "rows": table,
        "notes": notes,
        "summary": (
            f"{len(shared)} common points differ by {rms * _MM:.1f} mm RMS, largest "
            f"{lengths.max() * _MM:.1f} mm; sigmas of the differences are {expected * _MM:.1f} mm. "
            f"{int(found.significant.sum())} are significant (5 % for all together). "
            f"{only[0]} are only in A, {only[1]} only in B."
        ),
    }


def _rigs(catalogue: Catalogue, a: str, b: str) -> Row:
    """Compare the parameters of two calibrations."""
    about = [_one(catalogue, _RIG, key, "calibration") for key in (a, b)]
    known = [
        {one["name"]: one for one in catalogue.rows(_PARAMETERS, {"id": key})} for key in (a, b)
    ]
    names = [name for name in known[0] if name in known[1]]

    def column(i: int, what: str) -> Array:
        return np.array([known[i][name][what] for name in names], dtype=np.float64)

    found = compare_numbers(
        column(0, "estimate"), column(0, "sigma"), column(1, "estimate"), column(1, "sigma")
    )
    table = [
        {
            "name": name,
            "unit": known[0][name]["unit"],
            "a": known[0][name]["estimate"],
            "b": known[1][name]["estimate"],
            "difference": float(found[0][i]),
            "sigma": float(found[1][i]),
            "is_significant": bool(found[2][i]),
        }
        for i, name in enumerate(names)
    ]
    n = int(found[2].sum())
    summary = f"{len(names)} common parameters; {n} differ significantly (5 % for all together)."
    return _made(about) | {"rows": table, "notes": [], "summary": summary}


def _methods(catalogue: Catalogue, a: str, b: str) -> Row:
    """Compare two fitting methods stop by stop, by the RMS of their centres."""
    parts = [one.rpartition("/") for one in (a, b)]
    found = [
        catalogue.rows(_METHOD, {"survey": survey, "method": method}) for survey, _, method in parts
    ]
    for one, rows in zip((a, b), found, strict=True):
        if not rows:
            raise NotFoundError(f"There is no result of {one!r}; write SURVEY/METHOD.")
    is_error = all(row["error_m"] is not None for rows in found for row in rows)
    what = "error_m" if is_error else "sigma_m"
    known = [{row["key"]: row for row in rows} for rows in found]
    shared = [key for key in known[0] if key in known[1]]
    quality = "RMS error" if is_error else "predicted sigma"
    values = [np.array([part[key][what] for key in shared]) for part in known]
    order = np.argsort(-np.abs(values[1] - values[0]))[:ROWS_MAX]
    table = [
        {
            "name": known[0][shared[i]]["stop"],
            "href": stop_url(parts[0][0], known[0][shared[i]]["stop"], parts[0][2]),
            "a_m": float(values[0][i]),
            "b_m": float(values[1][i]),
            "difference_m": float(values[1][i] - values[0][i]),
        }
        for i in order
    ]
    try:
        test = compare_pairs(*values)
        difference = (
            f"{test.median * _MM:+.2f} mm ({test.low * _MM:+.2f} to {test.high * _MM:+.2f} with "
            f"95 % confidence), p = {test.p_value:.2g} by the signed-rank test"
        )
    except TooFewObservationsError as error:
        difference = f"not tested, {str(error).removesuffix('.')}"
    medians = [f"{np.median(one) * _MM:.1f}" if len(one) else "-" for one in values]
    sides = [{"survey": part[0], "method": part[2]} for part in parts]
    return {
        "about": _facts(sides),
        "settings": [],
        "rows": table,
        "notes": ["A row is a stop: the centres of a stop are dependent, stops are not."],
        "summary": (
            f"{quality} of the centres of a stop, median of {len(shared)} common stops: "
            f"{medians[0]} mm in A, {medians[1]} mm in B. Typical difference B minus A: "
            f"{difference}."
        ),
        "quality": quality,
    }


def _plans(catalogue: Catalogue, a: str, b: str) -> Row:
    """Compare the predictions of two stored plans at the stops that both have."""
    about = [_one(catalogue, _PLAN, key, "plan") for key in (a, b)]
    known = [{one["name"]: one for one in catalogue.rows(_PLANNED, {"id": key})} for key in (a, b)]
    names = [name for name in known[0] if name in known[1]]
    table = []
    for name in names:
        first, second = known[0][name], known[1][name]
        both = None not in (first["sigma_3d_m"], second["sigma_3d_m"])
        table.append(
            {
                "name": name,
                "a_m": first["sigma_3d_m"],
                "b_m": second["sigma_3d_m"],
                "difference_m": second["sigma_3d_m"] - first["sigma_3d_m"] if both else None,
                "probability_a": first["probability"],
                "probability_b": second["probability"],
            }
        )
    table.sort(key=lambda row: -abs(row["difference_m"] or 0.0))
    worst = [
        max((one["sigma_3d_m"] for one in part.values() if one["sigma_3d_m"]), default=np.nan)
        for part in known
    ]
    summary = (
        f"{len(names)} common stops. Worst predicted sigma {worst[0] * _MM:.2f} mm in A, "
        f"{worst[1] * _MM:.2f} mm in B."
    )
    notes = ["Predictions have no noise: a difference is that of the plans, if both use one model."]
    return _made(about) | {"rows": table[:ROWS_MAX], "notes": notes, "summary": summary}


def _one(catalogue: Catalogue, sql: str, key: str, what: str) -> Row:
    """Return the row of an id."""
    rows = catalogue.rows(sql, {"id": key})
    if not rows:
        raise NotFoundError(f"There is no {what} {key!r}.")
    return rows[0]


def _made(about: Sequence[Row]) -> Row:
    """Return how two results were made, with the settings that differ."""
    plain = [{name: value for name, value in one.items() if name != "config"} for one in about]
    configs = [_flat(json.loads(one["config"])) if one.get("config") else {} for one in about]
    names = sorted(set(configs[0]) | set(configs[1]))
    settings = [
        {"name": name, "a": configs[0].get(name), "b": configs[1].get(name)}
        for name in names
        if configs[0].get(name) != configs[1].get(name)
    ]
    return {"about": _facts(plain), "settings": settings}


def _facts(sides: Sequence[Row]) -> list[Row]:
    """Return the facts of two results as rows."""
    return [
        {
            "name": name,
            "a": sides[0][name],
            "b": sides[1][name],
            "is_same": sides[0][name] == sides[1][name],
        }
        for name in sides[0]
    ]


def _flat(config: Any, prefix: str = "") -> dict[str, Any]:
    """Return a configuration with the paths of its values as keys."""
    if not isinstance(config, dict):
        return {prefix.removesuffix("."): config}
    parts = [_flat(value, f"{prefix}{name}.") for name, value in config.items()]
    return {name: value for part in parts for name, value in part.items()}


def _covariances(rows: Sequence[Row]) -> Array:
    """Return the covariances of rows, (n, 3, 3) [m^2]."""
    upper = np.array([[row[name] for name in COV] for row in rows], dtype=np.float64)
    full = np.empty((len(rows), 3, 3))
    first, second = np.triu_indices(3)
    full[:, first, second] = upper
    full[:, second, first] = upper
    return full


KINDS: Mapping[str, Kind] = {
    "run": Kind("Runs", _RUNS, _runs),
    "network": Kind("Networks", _NETWORKS, _networks),
    "rig": Kind("Rigs", _RIGS, _rigs),
    "method": Kind("Methods", _METHODS, _methods),
    "plan": Kind("Plans", _PLANS, _plans),
}
"""What can be compared, by the prefix of its name in an address."""
