"""Adjusted networks as Arrow tables, named and shaped like the tables of the database.

Rows come from the job; here are their columns, and their errors against truth. A free network has
its own place and heading: it is moved onto the truth before it is compared.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pyarrow as pa

from spheremark.pipelines.geometry import rigid, rot_z, transform, yaw_pitch_roll
from spheremark.pipelines.model import Array, Truth
from spheremark.storage.catalogue.rows import ERROR, Row, named, places
from spheremark.storage.catalogue.schema import table_of

TABLES = (
    "adjustments",
    "adjusted_stations",
    "adjusted_marks",
    "adjusted_observations",
    "refused_stations",
    "control_checks",
    "repeated_stops",
    "mark_decisions",
    "mark_evidence",
)
"""Tables of an adjusted network."""

_NEAR = 0.15  # [m] how far an adjusted mark may be from the true one that it stands for


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
    out["adjusted_stations"] = table_of("adjusted_stations", stations)
    out["adjusted_marks"] = table_of("adjusted_marks", marks)
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
    T = _laid_on(p_true, places(known)) if is_free else np.eye(4)
    if T is None:
        return
    near, p_near = _near(marks, T, truth)
    if is_free:
        T = _laid_on(np.vstack([p_true, p_near]), places([*known, *near]))
    if T is None:
        return
    turned = float(np.degrees(np.arctan2(T[1, 0], T[0, 0])))
    for row, p in zip((*known, *near), np.vstack([p_true, p_near]), strict=True):
        row.update(_errors(transform(T, places([row]))[0] - p))
    for row in known:
        true_yaw = np.degrees(yaw_pitch_roll(poses[row["stop"]][:3, :3])[0])
        row["error_yaw_deg"] = (row["yaw_deg"] + turned - true_yaw + 180.0) % 360.0 - 180.0


def _near(marks: list[Row], T: Array, truth: Truth) -> tuple[list[Row], Array]:
    """Return the marks that stand, moved by T, beside a true one, and where that is."""
    if not marks or not truth.marks.names:
        return [], np.zeros((0, 3))
    gaps = np.linalg.norm(transform(T, places(marks))[:, None] - truth.marks.p_site[None], axis=2)
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


def _errors(error: Array) -> Row:
    """Return an error as columns."""
    return {**named(ERROR, error), "error_3d_m": np.linalg.norm(error)}
