"""Calibrations as Arrow tables, named and shaped like the tables of the database."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pyarrow as pa

from spheremark.storage.catalogue.rows import Row, table_of

_TEXT, _REAL, _WHOLE = pa.string(), pa.float64(), pa.int32()
_TEXTS = pa.list_(_TEXT)
_ID = {"calibration_id": _TEXT}

SCHEMAS: Mapping[str, Mapping[str, pa.DataType]] = {
    "calibrations": {
        **_ID,
        **dict.fromkeys(("job_id", "survey_id", "rig_digest"), _TEXT),
        "parameters": _TEXTS,
        "covariance": _TEXT,
        "finished_at": pa.timestamp("us", "UTC"),
        "start_rig_digest": _TEXT,
        "stops": _TEXTS,
        **dict.fromkeys(("n_spheres", "n_two_faced"), _WHOLE),
        "n_returns": pa.int64(),
        "dof": _WHOLE,
        **dict.fromkeys(("sigma0", "residual_rms_before_m", "residual_rms_after_m"), _REAL),
        "n_gaps": _WHOLE,
        **dict.fromkeys(("gap_rms_before_m", "gap_rms_after_m", "gap_sigma_after_m"), _REAL),
        **dict.fromkeys(("config", "config_digest", "code_version"), _TEXT),
        "duration_s": _REAL,
    },
    "calibrated_parameters": {
        **_ID,
        "place": _WHOLE,
        **dict.fromkeys(("parameter", "unit"), _TEXT),
        "is_estimated": pa.bool_(),
        **dict.fromkeys(("start_value", "estimate", "sigma"), _REAL),
        "reason": _TEXT,
    },
    "calibration_gaps": {
        **_ID,
        "is_after": pa.bool_(),
        **dict.fromkeys(("stop", "marker"), _TEXT),
        **dict.fromkeys(("range_m", "azimuth_deg"), _REAL),
        **dict.fromkeys([f"gap_{way}_m" for way in ("radial", "across", "up", "3d")], _REAL),
        "sigma_3d_m": _REAL,
    },
    "rigs": dict.fromkeys(("rig_digest", "name", "rig"), _TEXT),
}
"""Columns of each table, in the order of the database."""


def tables(calibration_id: str, rows: Mapping[str, Sequence[Row]]) -> dict[str, pa.Table]:
    """Put the rows of a calibration into tables.

    Parameters
    ----------
    calibration_id : str
        Names its rows in every table but ``rigs``.
    rows : mapping of str to sequence of dict
        Rows by table; a table that is not named has none.

    Returns
    -------
    dict of str to Table
        One table for each of ``SCHEMAS``.
    """
    return {
        name: table_of(
            columns, [{"calibration_id": calibration_id} | row for row in rows.get(name, ())]
        )
        for name, columns in SCHEMAS.items()
    }
