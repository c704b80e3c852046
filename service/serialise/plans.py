"""The JSON of plans: evaluations as plain values, every number with its unit.

A public interface of ``spheremark plan`` and of ``/api/v1/plans``: what is unknown is null.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from spheremark.pipelines.placement import (
    Arrangement,
    CentreModel,
    Evaluation,
    FieldMap,
    Site,
    Stops,
)

Plain = dict[str, Any]


def evaluation_json(site: Site, model: CentreModel, found: Evaluation) -> Plain:
    """Return what an arrangement promises."""
    worst = int(np.argmax(np.where(np.isfinite(found.sigma_3d), found.sigma_3d, np.inf)))
    return {
        "site": {"name": site.name},
        "method": found.requirement.method,
        "tolerance_m": found.requirement.tolerance,
        "model": model_json(model),
        "marks": marks_json(site, found.marks),
        "stops": [stop_json(found, i) for i in range(len(found.stops.names))],
        "worst_stop": found.stops.names[worst],
        "worst_sigma_3d_m": _number(found.worst_sigma_3d),
        "worst_probability_within_tolerance": found.worst_probability,
        "keeps_tolerance_95": bool(found.worst_probability >= 0.95),
    }


def marks_json(site: Site, marks: Arrangement) -> list[Plain]:
    """Return marks with the ground under them and the poles that they need."""
    ground = site.ground_at(marks.p_site)
    return [
        {
            "name": name,
            "position_m": _numbers(p),
            "ground_m": _number(z),
            "pole_height_m": _number(p[2] - z),
        }
        for name, p, z in zip(marks.names, marks.p_site, ground, strict=True)
    ]


def stop_json(found: Evaluation, i: int) -> Plain:
    """Return what an arrangement promises at one stop."""
    marks = found.marks.names
    low, high = np.degrees(found.angles[i])
    has_angle = found.n_used[i] >= 2
    return {
        "name": found.stops.names[i],
        "position_m": _numbers(found.stops.p_site[i]),
        "sigma_3d_m": _number(found.sigma_3d[i]),
        "probability_within_tolerance": float(found.probability[i]),
        "covariance_m2": _numbers(found.cov_p_site[i]),
        "visible_marks": [marks[k] for k in np.flatnonzero(found.is_seen[i])],
        "n_used": int(found.n_used[i]),
        "included_angle_min_deg": _number(low) if has_angle else None,
        "included_angle_max_deg": _number(high) if has_angle else None,
        "dop": _number(found.dop[i]),
        "dof": int(found.dof[i]),
        "reason": found.reasons[i],
        "marks": [_sighting(found, i, k) for k in range(len(marks))],
    }


def _sighting(found: Evaluation, i: int, k: int) -> Plain:
    """Return what one mark does for one stop."""
    return {
        "name": found.marks.names[k],
        "is_seen": bool(found.is_seen[i, k]),
        "visible_share": float(found.shares[i, k]),
        "surface_behind_m": _number(found.gaps[i, k]),
        "range_m": float(found.ranges[i, k]),
        "n_points": float(found.n_points[i, k]),
        "redundancy": float(found.redundancies[i, k]),
        "minimal_detectable_bias_m": _number(found.detectable_biases[i, k]),
        "external_reliability_m": _number(found.external_reliabilities[i, k]),
    }


def map_json(field: FieldMap) -> Plain:
    """Return what an arrangement promises on a grid of places, rows along y."""
    return {
        "x_m": _numbers(field.xs),
        "y_m": _numbers(field.ys),
        "sigma_3d_m": _rounded(field.sigma_3d, 6),
        "probability_within_tolerance": _rounded(field.probability, 5),
        "n_seen": field.n_seen.tolist(),
    }


def site_json(site: Site, stops: Stops, marks: Arrangement, *, n_across: int) -> Plain:
    """Return a field to plan on: its ground, thinned, and what one may begin with."""
    step = max(1, math.ceil(max(site.ground.shape) / n_across))
    return {
        "name": site.name,
        "extent_m": [float(v) for v in (site.xs[0], site.ys[0], site.xs[-1], site.ys[-1])],
        "pole_heights_m": list(site.pole_heights),
        "marker_radius_m": site.marker_radius,
        "mast_m": site.mast,
        "keep_out_m": [_numbers(polygon) for polygon in site.keep_out],
        "ground": {
            "x_m": _numbers(site.xs[::step]),
            "y_m": _numbers(site.ys[::step]),
            "ground_m": _rounded(site.ground[::step, ::step], 3),
        },
        "stops": [
            {"name": name, "position_m": _numbers(p)}
            for name, p in zip(stops.names, stops.p_site, strict=True)
        ],
        "marks": marks_json(site, marks),
    }


def model_json(model: CentreModel) -> Plain:
    """Return which model of centres predicted, and which rows it came from."""
    origin = model.provenance
    return {
        "version": model.version,
        "source": origin.source,
        "n_rows": origin.n_rows,
        "n_stops": origin.n_stops,
        "surveys": list(origin.surveys),
        "fit_method": origin.fit_method or None,
        "newest": origin.newest or None,
        "text": model_text(model),
        "warning": model.sensor.warning or None,
    }


def model_text(model: CentreModel) -> str:
    """Say in a sentence or two where the accuracy of centres comes from."""
    origin = model.provenance
    if origin.source == "sensor":
        text = "Accuracy of centres from the sensor."
    else:
        text = (
            f"Accuracy of centres from {origin.n_rows:,} fits at {origin.n_stops} stops of "
            f"{', '.join(origin.surveys)}."
        )
    return " ".join(part for part in (text, origin.note, model.sensor.warning) if part)


_COLUMNS = (
    "kind",
    "name",
    "x_m",
    "y_m",
    "z_m",
    "ground_m",
    "pole_height_m",
    "sigma_3d_m",
    "probability_within_tolerance",
    "n_used",
)


def to_csv(answer: Mapping[str, Any]) -> str:
    """Return marks to stake out, and what each stop may expect, as one table."""
    text = io.StringIO()
    writer = csv.DictWriter(text, _COLUMNS, restval="", lineterminator="\n", extrasaction="ignore")
    writer.writeheader()
    for kind, rows in (("mark", answer["marks"]), ("stop", answer["stops"])):
        for row in rows:
            place = dict(zip(("x_m", "y_m", "z_m"), row["position_m"], strict=True))
            writer.writerow({"kind": kind, **_short({**row, **place})})
    return text.getvalue()


def _short(row: Plain) -> Plain:
    """Return a row with lengths to the micrometre, and probabilities as long as they are."""
    return {
        key: round(value, 6) if key.endswith("_m") and isinstance(value, float) else value
        for key, value in row.items()
    }


def to_geojson(answer: Mapping[str, Any]) -> Plain:
    """Return marks and stops of an answer as GeoJSON, in metres of the site frame."""
    features = [
        _feature("mark", one, ("name", "ground_m", "pole_height_m")) for one in answer["marks"]
    ]
    features += [
        _feature("stop", one, ("name", "sigma_3d_m", "probability_within_tolerance", "n_used"))
        for one in answer["stops"]
    ]
    return {"type": "FeatureCollection", "features": features}


def _feature(kind: str, one: Mapping[str, Any], names: Sequence[str]) -> Plain:
    """Return one point."""
    return {
        "type": "Feature",
        "geometry": {"type": "Point", "coordinates": one["position_m"]},
        "properties": {"kind": kind, **{name: one[name] for name in names}},
    }


def _number(value: float) -> float | None:
    """Return a number, or null where JSON has none for it."""
    return float(value) if math.isfinite(value) else None


def _numbers(values: ArrayLike) -> Any:
    """Return an array as nested lists, with null where JSON has no number."""
    array = np.asarray(values, dtype=np.float64)
    return array.tolist() if np.isfinite(array).all() else _with_nulls(array)


def _rounded(grid: np.ndarray, digits: int) -> Any:
    """Return a grid with as many digits as anybody reads."""
    return _with_nulls(np.round(grid, digits))


def _with_nulls(array: np.ndarray) -> Any:
    """Return an array as nested lists, with null where JSON has no number."""
    values = array.astype(object)
    values[~np.isfinite(array)] = None
    return values.tolist()
