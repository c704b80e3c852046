"""The study reproduced into a folder: a page, tables as CSV, figures as JSON.

Hides how simulation, real scans and pages fit together. Nothing of a real scan is copied: what
comes out of it are a noise and the residuals of a fit.
"""

from __future__ import annotations

import csv
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plotly.io.json import to_json_plotly

from spheremark.pipelines import published as study
from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.error_model import Bound
from spheremark.pipelines.errors import NotFoundError
from spheremark.pipelines.evaluation.reproduction import (
    CENTRE,
    CENTRE_REAL,
    DISTANCES,
    DISTANCES_REAL,
    LANE_2,
    OURS,
    PAPER,
    AngleLimit,
    RangeNoise,
    Reading,
    Reproduction,
    Table2Row,
    Table3Row,
    Table4Row,
    angle_experiment,
    findings,
    models_of_icp,
    plan,
    range_noise,
    readings,
    reproduce,
    table_2,
    table_4,
)
from spheremark.pipelines.evaluation.reproduction.included_angle import CIRCLES
from spheremark.pipelines.model import RING_UNKNOWN, Column, Index, Levelling, StitchedCloud
from spheremark.pipelines.scan.rigs import vlp16
from spheremark.pipelines.sphere import fit_markers
from spheremark.pipelines.survey import Progress
from spheremark.service.provenance import code_version
from spheremark.storage.imports.reference_scans import read_packets, read_points
from spheremark.web import assets
from spheremark.web.pages.reproduction import ReproductionPage, panels, reproduction_page
from spheremark.web.pages.statements import Statement
from spheremark.web.theme import coloured

Plain = dict[str, Any]

_REAL_RADIUS = 0.30  # [m] of the sphere in the real scans
_REAL_NEAR = 5.0  # [m]; the real sphere stands nearer
_UPRIGHT = 0.1  # [rad]; how far from upright a LiDAR on a tripod may lean
_SIMULATED, _REAL = "simulated", "real VLP-16"


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish:
    """What to reproduce: how much of it, from which seed, beside which real scans."""

    seed: int = 0
    is_quick: bool = False
    real: Path | None = None
    tolerance: float = study.TOLERANCE


@dataclass(frozen=True, slots=True, kw_only=True)
class Real:
    """What was measured in real scans: noise by sensor, and one row for each sphere."""

    noises: Mapping[str, RangeNoise] = field(default_factory=dict)
    spheres: Sequence[Plain] = ()


def run(folder: Path, wish: Wish, progress: Progress) -> Plain:
    """Simulate, fit, and write the page with its tables and figures; return the statements."""
    config = SurveyConfig.from_mapping(
        {"tolerance": wish.tolerance, "fitting": {"methods": [OURS, PAPER]}}
    )
    real = _real(wish.real, config) if wish.real else None
    made = reproduce(plan(wish.seed, is_quick=wish.is_quick), config, progress=progress)
    page = page_of(made, wish, real)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "index.html").write_text(reproduction_page(page), "utf-8")
    shutil.copyfile(assets.plotly_script(), folder / assets.plotly_script().name)
    _write_figures(folder / "figures", page)
    _write_tables(folder, made, page)
    return _report(folder, made, page)


def page_of(made: Reproduction, wish: Wish, real: Real | None = None) -> ReproductionPage:
    """Put everything into the shape of the page."""
    real = real or Real()
    return ReproductionPage(
        tolerance_m=made.config.tolerance,
        scans=[asdict(scan) for scan in made.scans],
        statements=_statements(made, wish.seed),
        table_2=table_2(made),
        table_4=table_4(made),
        readings=readings(made),
        angles=angle_experiment(made.config.tolerance, np.random.default_rng(wish.seed)),
        icp=models_of_icp(made),
        example=made.example,
        centre=_columns(made, made.series(CENTRE)),
        lane=_columns(made, made.series(LANE_2)),
        distances=_columns(made, made.series(DISTANCES)),
        real=_columns(made, made.series(DISTANCES_REAL)),
        noises={_SIMULATED: made.noise, **real.noises},
        spheres=[_simulated_spheres(made), *real.spheres],
        code_version=code_version(),
        config_digest=made.config.digest,
        seed=wish.seed,
    )


def _statements(made: Reproduction, seed: int) -> tuple[Statement, ...]:
    """Say what each method keeps in each place."""
    return tuple(
        Statement(
            method=one.method,
            place=one.place,
            model=one.model,
            p95=one.limits["p95"],
            mean=one.limits["mean"],
        )
        for one in findings(made, np.random.default_rng(seed))
    )


def _columns(made: Reproduction, scans: Index) -> dict[str, NDArray[Any]]:
    """Return the centres of some scans by both methods, named as the database names them."""
    centres = made.centres
    keep = centres.of(OURS, scans) | centres.of(PAPER, scans)
    own = [made.scans[i] for i in centres.scans[keep]]
    marks = np.array(centres.marks, dtype=object)[keep]
    return {
        "stop": np.array([scan.stop for scan in own], dtype=object),
        "series": np.array([scan.series for scan in own], dtype=object),
        "world": np.array([scan.seed for scan in own]),
        "turn_s": np.array([scan.turn for scan in own]),
        "fit_method": np.array(centres.methods, dtype=object)[keep],
        "marker": marks,
        "mark": marks,
        "status": np.full(len(own), "ok", dtype=object),
        "reason": np.full(len(own), "", dtype=object),
        "range_m": centres.ranges[keep],
        "n_points": centres.n_points[keep].astype(np.int64),
        "incidence_deg": np.degrees(centres.incidences[keep]),
        "sigma_3d_m": centres.sigma_3d[keep],
        "rms_m": centres.rms[keep],
        "error_towards_m": centres.error_station[keep, 0],
        "error_left_m": centres.error_station[keep, 1],
        "error_up_m": centres.error_station[keep, 2],
        "error_3d_m": centres.error_3d[keep],
    }


def _simulated_spheres(made: Reproduction) -> Plain:
    """Return what the fits of the simulated spheres leave, as one row beside the real ones."""
    keep = made.centres.of(OURS, made.series(CENTRE_REAL))
    return {
        "name": f"{int(keep.sum())} simulated, median",
        "radius_m": made.config.marker_radius,
        "range_m": float(np.median(made.centres.ranges[keep])),
        "n_points": float(np.median(made.centres.n_points[keep])),
        "rms_m": float(np.median(made.centres.rms[keep])),
    }


def _real(folder: Path, config: SurveyConfig) -> Real:
    """Measure the real scans of a folder: packets (.bin) for noise, points (.xyz) with a sphere."""
    packets = sorted(folder.glob("vlp16_packets/*.bin"))
    points = sorted(folder.glob("vlp16_spheres/*.xyz"))
    if not packets and not points:
        raise NotFoundError(
            f"{folder} holds no real scans; vlp16_packets/*.bin or vlp16_spheres/*.xyz is expected."
        )
    noises = {}
    for path in packets[:1]:
        shots = read_packets(path)
        noises[_REAL] = range_noise(shots.ranges, shots.rings, shots.offsets_ns, shots.intensities)
    spheres = [_real_sphere(path.stem, read_points(path), config) for path in points]
    return Real(noises=noises, spheres=spheres)


def _real_sphere(name: str, p: Column, config: SurveyConfig) -> Plain:
    """Fit the sphere of one real scan, the best seen that stands near; NaN where none is found."""
    cloud = _upright_cloud(name, p)
    found = extract(cloud, config.extraction, _REAL_RADIUS)
    fits = fit_markers(OURS, cloud, found, config.fitting, _REAL_RADIUS).fits
    near = [fit for fit in fits if fit.mean_range < _REAL_NEAR]
    best = max(near, key=lambda fit: fit.n_points, default=None)
    return {
        "name": f"real VLP-16, {name}" + ("" if best else ": no sphere found"),
        "radius_m": _REAL_RADIUS,
        "range_m": best.mean_range if best else np.nan,
        "n_points": float(best.n_points) if best else np.nan,
        "rms_m": best.rms if best else np.nan,
    }


def _upright_cloud(name: str, p: Column) -> StitchedCloud:
    """Return a single scan of a LiDAR that stands upright as a stitched cloud."""
    n = len(p)
    return StitchedCloud(
        p_base=p,
        gimbal_angles=np.zeros(n, np.float32),
        intensities=np.full(n, 100.0, np.float32),
        rings=np.full(n, RING_UNKNOWN, np.uint8),
        times=np.zeros(n, np.float32),
        levelling=Levelling(roll=0.0, pitch=0.0, sigma=_UPRIGHT, is_measured=False),
        rig=vlp16("upright", np.eye(4)),
        coverage=2.0 * np.pi,
        duration=0.1,
        name=name,
    )


def _write_figures(folder: Path, page: ReproductionPage) -> None:
    """Write each figure as Plotly's JSON, in the colours of the light theme."""
    folder.mkdir(exist_ok=True)
    for panel in panels(page):
        figure = coloured(panel.figure.to_plotly_json(), assets.tokens("light"))
        (folder / f"{panel.name}.json").write_text(str(to_json_plotly(figure)), "utf-8")


def _write_tables(folder: Path, made: Reproduction, page: ReproductionPage) -> None:
    """Write the tables of the study, the statements and all centres as CSV."""
    _write(folder / "table2.csv", [_row_2(row) for row in page.table_2])
    _write(folder / "table4.csv", [_row_4(row) for row in page.table_4])
    _write(folder / "table3.csv", [_row_3(row) for row in page.angles.rows])
    _write(folder / "angle_limits.csv", [_limit(one) for one in page.angles.limits])
    _write(folder / "readings.csv", [_reading(one) for one in page.readings])
    _write(folder / "statements.csv", [_statement(one) for one in page.statements])
    everything = _columns(made, np.arange(len(made.scans)))
    rows = zip(*(column.tolist() for column in everything.values()), strict=True)
    _write(folder / "centres.csv", [dict(zip(everything, row, strict=True)) for row in rows])


def _row_2(row: Table2Row) -> Plain:
    """Return one row of Table 2 as plain values."""
    found: Plain = {
        "distance_m": row.distance,
        "study_n_points": row.published_n_points,
        "study_error_3d_m": row.published_error,
    }
    for method, errors in row.errors.items():
        found[f"{method}_n_points_mean"] = row.n_points[method]
        found[f"{method}_error_3d_mean_m"] = errors.mean
        found[f"{method}_error_3d_max_m"] = errors.largest
        found[f"{method}_n"] = errors.n
    return found | {
        "paper_minus_study_m": row.errors[PAPER].mean - row.published_error,
    }


def _row_3(row: Table3Row) -> Plain:
    """Return one row of Table 3 as plain values."""
    errors = {f"{_key(name)}_error_m": error for name, error in row.errors.items()}
    return {
        "included_angle_deg": round(float(np.degrees(row.included_angle)), 2),
        "study_error_m": row.published,
        **errors,
        "three_circles_minus_study_m": row.errors[CIRCLES] - row.published,
    }


def _limit(one: AngleLimit) -> Plain:
    """Return the angles that keep the tolerance for one sigma as plain values."""
    return {
        "sigma_axis_m": one.sigma,
        "two_centres_from_deg": float(np.degrees(one.least)),
        "two_circles_from_deg": float(np.degrees(one.least_circles)),
        "two_circles_to_deg": float(np.degrees(one.widest_circles)),
        "two_centres_error_horizontal_rms_m": one.rms,
    }


def _reading(one: Reading) -> Plain:
    """Return one reading of the study's method as plain values."""
    return {
        "series": one.series,
        "fit_method": one.method,
        "n": one.errors.n,
        "n_points_mean": one.n_points,
        "error_3d_mean_m": one.errors.mean,
        "error_3d_min_m": one.least,
        "error_3d_max_m": one.errors.largest,
        "bias_beyond_m": float(one.bias_station[0]),
        "bias_up_m": float(one.bias_station[2]),
    }


def _key(name: str) -> str:
    """Return a name as part of a column's."""
    return name.replace(" ", "_")


def _row_4(row: Table4Row) -> Plain:
    """Return one row of Table 4 as plain values."""
    found: Plain = {"stop": row.stop, "n_marks": row.n_marks, "range_mean_m": row.mean_range}
    for method, errors in row.errors.items():
        found[f"{method}_n"] = errors.n
        found[f"{method}_error_3d_mean_m"] = errors.mean
        found[f"{method}_error_3d_p95_m"] = errors.p95
    return found


def _statement(one: Statement) -> Plain:
    """Return one statement with its model as plain values."""
    assert one.p95 is not None
    assert one.mean is not None
    assert one.model is not None
    found: Plain = {"place": one.place, "fit_method": one.method}
    for name, found_limits in (("p95", one.p95), ("mean", one.mean)):
        found |= _bound(f"{name}_distance", found_limits.greatest_distance, "_m")
        found |= _bound(f"{name}_n_points", found_limits.smallest_count, "")
    for term in ("distance", "count", "incidence"):
        found[f"power_of_{term}"] = one.model.exponent(term)
        found[f"sigma_power_of_{term}"] = one.model.sigma(term)
    return found | {"typical_error_m": one.model.typical, "n_errors": one.model.n}


def _bound(name: str, bound: Bound, unit: str) -> Plain:
    """Return a bound as plain values; what lies beyond the sample is null."""
    found = {"": bound.value, "_low": bound.low, "_high": bound.high}
    return {f"{name}{part}{unit}": value for part, value in found.items()}


def _write(path: Path, rows: Sequence[Plain]) -> None:
    """Write rows as CSV."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows({key: _plain(value) for key, value in row.items()} for row in rows)


def _plain(value: object) -> object:
    """Return a value of a table; numbers to a hundredth of a millimetre."""
    if isinstance(value, float):
        return round(value, 5) if np.isfinite(value) else ("" if np.isnan(value) else "inf")
    return value


def _report(folder: Path, made: Reproduction, page: ReproductionPage) -> Plain:
    """Return what the command prints."""
    published = study.TABLE_2.errors_3d
    return {
        "page": str(folder / "index.html"),
        "n_scans": len(made.scans),
        "seed": page.seed,
        "code_version": page.code_version,
        "config_digest": page.config_digest,
        "tolerance_m": page.tolerance_m,
        "study": {
            "greatest_distance_m": study.GREATEST_DISTANCE,
            "smallest_count": study.SMALLEST_COUNT,
            "table2_error_3d_mean_m": float(published.mean()),
            "table2_error_3d_range_m": [float(published.min()), float(published.max())],
        },
        "table2": _json(_row_2(row) for row in page.table_2),
        "table2_paper_minus_study_m": _difference(page.table_2),
        "readings": _json(_reading(one) for one in page.readings),
        "table3": _json(_row_3(row) for row in page.angles.rows),
        "table3_rms_from_study_m": page.angles.rms_from_published,
        "angle_limits": _json(_limit(one) for one in page.angles.limits),
        "table4": _json(_row_4(row) for row in page.table_4),
        "statements": _json(_statement(one) | {"said": _said(one)} for one in page.statements),
        "icp_models": {name: asdict(errors) for name, errors in page.icp.items()},
        "range_noise_m": {
            name: [None if np.isnan(s) else float(s) for s in noise.sigmas]
            for name, noise in page.noises.items()
        },
        "spheres": _json(dict(row) for row in page.spheres),
    }


def _difference(rows: Sequence[Table2Row]) -> float:
    """Return the mean of Table 2 by the study's method minus that which the study prints [m]."""
    ours = float(np.nanmean([row.errors[PAPER].mean for row in rows]))
    return ours - float(study.TABLE_2.errors_3d.mean())


def _said(one: Statement) -> dict[str, str]:
    """Return a statement as people read it."""
    return {
        "distance": one.distance,
        "count": one.count,
        "mean_distance": one.mean_distance,
        "mean_count": one.mean_count,
    }


def _json(rows: Iterable[Plain]) -> list[Plain]:
    """Return rows with null for what JSON has no number for."""
    return [
        {
            key: None if isinstance(value, float) and not np.isfinite(value) else value
            for key, value in row.items()
        }
        for row in rows
    ]
