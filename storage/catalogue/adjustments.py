"""Adjusted networks as Arrow tables, named and shaped like the tables of the database.

Rows come from the job; here are their columns, and their errors against truth. A free network has
its own place and heading: it is moved onto the truth before it is compared.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pyarrow as pa

from spheremark.pipelines.geometry import rigid, rot_z, transform, yaw_pitch_roll
from spheremark.pipelines.model import Array, Truth
from spheremark.storage.catalogue.rows import Row, table_of

_TEXT, _REAL, _WHOLE, _TRUTH_VALUE = pa.string(), pa.float64(), pa.int32(), pa.bool_()
_REALS, _TEXTS = pa.list_(_REAL), pa.list_(_TEXT)
_PLACE = dict.fromkeys(("x_m", "y_m", "z_m"), _REAL)
_COV = dict.fromkeys([f"cov_{axes}_m2" for axes in ("xx", "xy", "xz", "yy", "yz", "zz")], _REAL)
_ELLIPSE = dict.fromkeys(
    (
        "ellipse_major_m",
        "ellipse_minor_m",
        "ellipse_bearing_deg",
        "ellipse_major_95_m",
        "ellipse_minor_95_m",
    ),
    _REAL,
)
_SEEN = {"n_observations": _WHOLE, "mean_redundancy": _REAL}
_ERROR = dict.fromkeys(("error_x_m", "error_y_m", "error_z_m"), _REAL)
_ID = {"adjustment_id": _TEXT}

SCHEMAS: Mapping[str, Mapping[str, pa.DataType]] = {
    "adjustments": {
        **_ID,
        **dict.fromkeys(("job_id", "survey_id"), _TEXT),
        **dict.fromkeys(("n_stations", "n_marks", "dof"), _WHOLE),
        "sigma0": _REAL,
        "passes_global_test": _TRUTH_VALUE,
        "finished_at": pa.timestamp("us", "UTC"),
        "status": _TEXT,
        "warnings": _TEXTS,
        **dict.fromkeys(("datum", "datum_text", "fit_method"), _TEXT),
        **dict.fromkeys(("n_control_marks", "n_observations", "n_unknowns"), _WHOLE),
        **dict.fromkeys(("n_left_out", "n_refused"), _WHOLE),
        **dict.fromkeys(("vtpv", "vtpv_limit", "test_level", "w_limit"), _REAL),
        **dict.fromkeys(
            [f"variance_factor_{kind}" for kind in ("centres", "gravity", "control")], _REAL
        ),
        **dict.fromkeys(("range_bias_m", "sigma_range_bias_m"), _REAL),
        **dict.fromkeys(("rig_digest", "config", "config_digest", "code_version"), _TEXT),
        "duration_s": _REAL,
    },
    "adjusted_stations": {
        **_ID,
        **dict.fromkeys(("station", "stop", "run_id", "recording_id", "rig_digest"), _TEXT),
        **_PLACE,
        "yaw_deg": _REAL,
        "rotation": _REALS,
        **_COV,
        "cov_motion": _REALS,
        **dict.fromkeys(("sigma_3d_m", "sigma_yaw_deg"), _REAL),
        **_ELLIPSE,
        **_SEEN,
        **_ERROR,
        **dict.fromkeys(("error_yaw_deg", "error_3d_m"), _REAL),
    },
    "adjusted_marks": {
        **_ID,
        "mark": _TEXT,
        "is_control": _TRUTH_VALUE,
        **dict.fromkeys(("status", "reason"), _TEXT),
        **_PLACE,
        **_COV,
        "sigma_3d_m": _REAL,
        **_ELLIPSE,
        **_SEEN,
        **_ERROR,
        "error_3d_m": _REAL,
    },
    "adjusted_observations": {
        **_ID,
        **dict.fromkeys(("kind", "station", "marker", "mark"), _TEXT),
        "used": _TRUTH_VALUE,
        "reason": _TEXT,
        **dict.fromkeys(("residual_x_m", "residual_y_m", "residual_z_m"), _REAL),
        **dict.fromkeys(("residual_x_deg", "residual_y_deg", "redundancy", "w"), _REAL),
        **dict.fromkeys(("minimal_detectable_bias_m", "minimal_detectable_bias_deg"), _REAL),
        "external_reliability_station_m": _REAL,
        "external_reliability_mark_m": _REAL,
    },
    "refused_stations": {**_ID, **dict.fromkeys(("station", "code", "reason"), _TEXT)},
    "control_checks": {
        **_ID,
        "mark": _TEXT,
        "n_observations": _WHOLE,
        **dict.fromkeys([f"difference_{axis}_m" for axis in ("x", "y", "z", "3d")], _REAL),
        **dict.fromkeys([f"sigma_{axis}_m" for axis in ("x", "y", "z", "3d")], _REAL),
    },
    "repeated_stops": {
        **_ID,
        **dict.fromkeys(("station", "again"), _TEXT),
        "n_marks": _WHOLE,
        **dict.fromkeys([f"apart_{axis}_m" for axis in ("x", "y", "z", "3d")], _REAL),
        **dict.fromkeys(("difference_rms_m", "predicted_rms_m"), _REAL),
    },
}
"""Columns of each table, in the order of the database."""

_NEAR = 0.15  # [m] how far an adjusted mark may be from the true one that it stands for


def tables(adjustment_id: str, rows: Mapping[str, Sequence[Row]]) -> dict[str, pa.Table]:
    """Put the rows of an adjustment into tables.

    Parameters
    ----------
    adjustment_id : str
        Names its rows in every table.
    rows : mapping of str to sequence of dict
        Rows by table; a table that is not named has none.

    Returns
    -------
    dict of str to Table
        One table for each of ``SCHEMAS``, without errors.
    """
    return {
        name: table_of(
            columns, [{"adjustment_id": adjustment_id} | row for row in rows.get(name, ())]
        )
        for name, columns in SCHEMAS.items()
    }


def with_errors(known: Mapping[str, pa.Table], truth: Truth | None) -> dict[str, pa.Table]:
    """Compute the errors of adjusted networks against a truth.

    Notes
    -----
    A free network is turned about the vertical and shifted so that the sum of squares over its
    stations and marks is least; it is not tilted, because its levelling is part of what it claims.
    """
    out = dict(known)
    if not {"adjustments", "adjusted_stations", "adjusted_marks"} <= set(known):
        return out
    stations = known["adjusted_stations"].to_pylist()
    marks = known["adjusted_marks"].to_pylist()
    for row in known["adjustments"].to_pylist():
        own = [
            [one for one in rows if one["adjustment_id"] == row["adjustment_id"]]
            for rows in (stations, marks)
        ]
        _compare(own[0], own[1], truth, is_free=row["datum"] == "free")
    out["adjusted_stations"] = table_of(SCHEMAS["adjusted_stations"], stations)
    out["adjusted_marks"] = table_of(SCHEMAS["adjusted_marks"], marks)
    return out


def _compare(stations: list[Row], marks: list[Row], truth: Truth | None, *, is_free: bool) -> None:
    """Fill in the errors of the rows of one network."""
    for row in (*stations, *marks):
        row.update({name: None for name in row if name.startswith("error_")})
    if truth is None:
        return
    poses = {stop.name: stop.T_site_base for stop in truth.stops}
    known = [row for row in stations if row["stop"] in poses]
    p_true = np.array([poses[row["stop"]][:3, 3] for row in known]).reshape(-1, 3)
    T = _laid_on(p_true, _places(known)) if is_free else np.eye(4)
    if T is None:
        return
    near, p_near = _near(marks, T, truth)
    if is_free:
        T = _laid_on(np.vstack([p_true, p_near]), _places([*known, *near]))
    if T is None:
        return
    turned = float(np.degrees(np.arctan2(T[1, 0], T[0, 0])))
    for row, p in zip((*known, *near), np.vstack([p_true, p_near]), strict=True):
        row.update(_errors(transform(T, _places([row]))[0] - p))
    for row in known:
        true_yaw = np.degrees(yaw_pitch_roll(poses[row["stop"]][:3, :3])[0])
        row["error_yaw_deg"] = (row["yaw_deg"] + turned - true_yaw + 180.0) % 360.0 - 180.0


def _near(marks: list[Row], T: Array, truth: Truth) -> tuple[list[Row], Array]:
    """Return the marks that stand, moved by T, beside a true one, and where that is."""
    if not marks or not truth.marks.names:
        return [], np.zeros((0, 3))
    gaps = np.linalg.norm(transform(T, _places(marks))[:, None] - truth.marks.p_site[None], axis=2)
    nearest = gaps.argmin(axis=1)
    close = gaps[np.arange(len(marks)), nearest] < _NEAR
    return [row for row, is_close in zip(marks, close, strict=True) if is_close], (
        truth.marks.p_site[nearest[close]]
    )


def _laid_on(p_true: Array, p: Array) -> Array | None:
    """Return the turn about the vertical and the shift that lay points on others; None of one."""
    if len(p) < 2:
        return None
    middle, true_middle = p.mean(axis=0), p_true.mean(axis=0)
    a, b = p - middle, p_true - true_middle
    yaw = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a[:, :2] * b[:, :2]))
    R = rot_z(float(yaw))
    return rigid(R, true_middle - R @ middle)


def _places(rows: Sequence[Row]) -> Array:
    """Return the coordinates of rows, (n, 3) [m]."""
    return np.array([[row["x_m"], row["y_m"], row["z_m"]] for row in rows]).reshape(-1, 3)


def _errors(error: Array) -> Row:
    """Return an error as columns."""
    return {**dict(zip(_ERROR, error, strict=True)), "error_3d_m": np.linalg.norm(error)}
