"""Centres of earlier runs as values again, so that they need not be fitted twice.

Rows hold no returns and residuals: a centre from a row has none.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
import pyarrow as pa

from spheremark.pipelines.geometry import levelling_rotation
from spheremark.pipelines.model import (
    Array,
    Levelling,
    MarkerFit,
    MarkerFits,
    Optics,
    Rejection,
    Status,
)
from spheremark.storage.catalogue.rows import Row, places

_COV = ("xx", "xy", "xz", "xy", "yy", "yz", "xz", "yz", "zz")
_NO_ROWS, _NO_NUMBERS = np.zeros(0, dtype=np.intp), np.zeros(0)
CENTRES = ("stops", "marker_fits", "possible_fits", "group_likelihoods", "rejections")
"""Tables that hold the centres of runs, and what else stood there."""


def read_centres(
    tables: Mapping[str, pa.Table], run_id: str, method: str
) -> Iterator[tuple[str, MarkerFits]]:
    """Yield the centres of each stop of a run by one method.

    Parameters
    ----------
    tables : mapping of str to Table
        Rows of ``CENTRES`` of some runs.
    run_id : str
        The run.
    method : str
        Fitting method.

    Yields
    ------
    str, MarkerFits
        Name of the stop, and centres in the base frame in the order of their names, with
        covariances without levelling and heading, as a fit gives them. Possible markers count
        among the refused groups, beside their centres.
    """
    rows = {
        name: [
            row
            for row in table.to_pylist()
            if row["run_id"] == run_id and row.get("fit_method", method) == method
        ]
        for name, table in tables.items()
    }
    for stop in rows["stops"]:
        levelling = levelling_of(stop)
        own = {
            name: [row for row in of_run if row["stop"] == stop["stop"]]
            for name, of_run in rows.items()
        }
        compared = own["group_likelihoods"]
        logs = {row["marker"]: np.array(row["log_likelihoods"]) for row in compared}
        fits, possible = (
            tuple(
                replace(_fit(row, levelling), log_likelihoods=logs.get(row["marker"], _NO_NUMBERS))
                for row in sorted(own[name], key=lambda row: int(row["marker"][1:]))
            )
            for name in ("marker_fits", "possible_fits")
        )
        others = [row for row in compared if row["marker"] is None] + [
            row for row in own["rejections"] if row["probability"] is None
        ]
        yield (
            stop["stop"],
            MarkerFits(
                method=method,
                fits=fits,
                rejected=tuple(_group(row, levelling) for row in others),
                levelling=levelling,
                possible_fits=possible,
            ),
        )


def _group(row: Row, levelling: Levelling) -> Rejection:
    """Return a group that is no marker."""
    return Rejection(
        p_base=levelling_rotation(levelling).T @ places([row])[0],
        n_points=row["n_points"],
        reason=row["reason"],
        log_likelihoods=np.array(row.get("log_likelihoods") or _NO_NUMBERS),
    )


def levelling_of(row: Row) -> Levelling:
    """Return the levelling of a stop from its row."""
    angles = {
        name: float(np.radians(row[f"{name}_deg"]))
        for name in ("roll", "pitch", "sigma_heading", "sigma_clock")
    }
    sigma = float(np.radians(row["sigma_levelling_deg"]))
    return Levelling(sigma=sigma, is_measured=True, **angles)


def _fit(row: Row, levelling: Levelling) -> MarkerFit:
    """Return a centre without levelling, and without the covariance of the heading."""
    R = levelling_rotation(levelling)
    p_base = R.T @ places([row])[0]
    return MarkerFit(
        name=row["marker"],
        p_base=p_base,
        cov_p_base=_without_heading(R.T @ _cov(row) @ R, p_base, levelling.sigma_heading),
        method=row["fit_method"],
        status=Status(row["status"]),
        reason=row["reason"],
        radius=row["radius_m"],
        radius_free=_number(row["radius_free_m"]),
        sigma_radius_free=_number(row["sigma_radius_free_m"]),
        mean_range=row["range_m"],
        mean_intensity=_number(row.get("mean_intensity")),
        used=_NO_ROWS,
        rejected=_NO_ROWS,
        residuals=np.zeros(0),
        sigma0=_number(row["sigma0"]),
        n_rings=row["n_rings"],
        coverage=_number(row.get("coverage")),
        incidence=np.radians(_number(row.get("incidence_deg"))),
        variant=row.get("variant") or "",
        sigma_range_shared=_number(row["sigma_range_shared_m"]),
        sigma_height_shared=row["sigma_height_shared_m"] or 0.0,
        optics=_optics(row["optics"]),
        range_by_optics=np.array(row["range_by_optics_m"] or np.zeros(3)),
        probability=_number(row["probability"]),
        hypothesis=row["hypothesis"],
    )


def _optics(numbers: list[float] | None) -> Optics | None:
    """Return what a scan shows of its beams."""
    if numbers is None:
        return None
    estimates, weights, prior, profile = np.split(np.array(numbers), [3, 12, 15])
    return Optics(
        estimates=estimates,
        weights=weights.reshape(3, 3),
        sigmas_prior=prior,
        sigmas_profile=profile,
    )


def _cov(row: Row) -> Array:
    """Return the covariance of a row, (3, 3) [m^2]."""
    return np.array([_number(row[f"cov_{axes}_m2"]) for axes in _COV]).reshape(3, 3)


def _without_heading(cov: Array, p_base: Array, sigma_heading: float) -> Array:
    """Return a covariance without the part of the heading of the stop [rad]."""
    sideways = np.array([-p_base[1], p_base[0], 0.0])
    return cov - sigma_heading**2 * np.outer(sideways, sideways)


def _number(value: float | None) -> float:
    """Return a number; what is NULL is NaN."""
    return np.nan if value is None else float(value)
