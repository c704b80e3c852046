"""The study reproduced into a folder: a page, tables as CSV, figures as JSON.

Nothing of a real scan is copied: only a noise and the residuals of a fit are reported.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plotly.io.json import to_json_plotly

from spheremark.pipelines import published as study
from spheremark.pipelines.accuracy.error_model import Bound
from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.errors import NotFoundError
from spheremark.pipelines.evaluation.experiment import Column, Plain, Progress, Table, to_json
from spheremark.pipelines.evaluation.reproduction.included_angle import angle_experiment
from spheremark.pipelines.evaluation.reproduction.noise import RangeNoise, range_noise
from spheremark.pipelines.evaluation.reproduction.plan import (
    CENTRE,
    CENTRE_REAL,
    DISTANCES,
    DISTANCES_REAL,
    LANE_2,
    OURS,
    PAPER,
    plan,
)
from spheremark.pipelines.evaluation.reproduction.scans import Reproduction, reproduction
from spheremark.pipelines.evaluation.reproduction.tables import study_tables
from spheremark.pipelines.model import RING_UNKNOWN, Levelling, StitchedCloud
from spheremark.pipelines.model import Column as Points
from spheremark.pipelines.scan.rigs import vlp16
from spheremark.pipelines.sphere import fit_markers
from spheremark.service.provenance import code_version
from spheremark.storage.exports.reports import write_csv, write_pages
from spheremark.storage.imports.reference_scans import read_packets, read_points
from spheremark.web import assets
from spheremark.web.pages.reproduction import ReproductionPage, panels, reproduction_page
from spheremark.web.pages.statements import Statement
from spheremark.web.theme import coloured

_REAL_RADIUS = 0.30  # [m] of the sphere in the real scans
_REAL_NEAR = 5.0  # [m]; the real sphere stands nearer
_UPRIGHT = 0.1  # [rad]; how far from upright a LiDAR on a tripod may lean
_SIMULATED, _REAL = "simulated", "real VLP-16"


@dataclass(frozen=True, slots=True, kw_only=True)
class ReproductionOptions:
    """How much is reproduced, from which seed, and a folder of real scans to set beside."""

    seed: int = 0
    is_quick: bool = False
    real: Path | None = None
    tolerance: float = study.TOLERANCE


@dataclass(frozen=True, slots=True, kw_only=True)
class RealScans:
    """Results from real scans: noise by sensor, and one row for each sphere."""

    noises: Mapping[str, RangeNoise] = field(default_factory=dict)
    spheres: Sequence[Plain] = ()


def reproduce(folder: Path, options: ReproductionOptions, progress: Progress) -> Plain:
    """Simulate, fit, and write the page with its tables and figures; return the report."""
    config = SurveyConfig.from_mapping(
        {"tolerance": options.tolerance, "fitting": {"methods": [OURS, PAPER]}}
    )
    real = _real_scans(options.real, config) if options.real else RealScans()
    scans = plan(options.seed, is_quick=options.is_quick)
    made = reproduction(scans, config).run(progress)
    page = page_of(made, options.seed, real)
    figures = {f"figures/{panel.name}.json": _portable(panel.figure) for panel in panels(page)}
    write_pages(
        folder, {"index.html": reproduction_page(page), **figures}, [assets.plotly_script()]
    )
    for name, rows in _csv_tables(made, page).items():
        write_csv(folder / f"{name}.csv", [_rounded(row) for row in rows])
    return _report(folder, made, page)


def page_of(made: Reproduction, seed: int, real: RealScans | None = None) -> ReproductionPage:
    """Put a reproduction into the form of the page."""
    real = real or RealScans()
    tables = study_tables(made, np.random.default_rng(seed))
    return ReproductionPage(
        tolerance_m=made.config.tolerance,
        scans=[asdict(scan) for scan in made.scans],
        statements=tuple(
            Statement(
                method=one.method,
                place=one.place,
                model=one.model,
                p95=one.limits["p95"],
                mean=one.limits["mean"],
            )
            for one in tables.findings
        ),
        table_2=tables.table_2,
        table_4=tables.table_4,
        readings=tables.readings,
        angles=angle_experiment(made.config.tolerance, np.random.default_rng(seed)),
        icp=tables.icp,
        example=made.example,
        centre=_columns(made, CENTRE),
        lane=_columns(made, LANE_2),
        distances=_columns(made, DISTANCES),
        real=_columns(made, DISTANCES_REAL),
        noises={_SIMULATED: made.noise, **real.noises},
        spheres=[_simulated_spheres(made), *real.spheres],
        code_version=code_version(),
        config_digest=made.config.digest,
        seed=seed,
    )


def _columns(made: Reproduction, *series: str) -> dict[str, NDArray[Any]]:
    """Return the centres of some series by ours and by the study's method."""
    keep = made.of(OURS, *series) | made.of(PAPER, *series)
    return {key: column[keep] for key, column in made.centres.items() if key != "scan"}


def _simulated_spheres(made: Reproduction) -> Plain:
    """Return the residuals of the simulated spheres as one row beside the real ones."""
    keep = made.of(OURS, CENTRE_REAL)
    medians = {
        key: float(np.median(made.centres[key][keep])) for key in ("range_m", "n_points", "rms_m")
    }
    name = f"{int(keep.sum())} simulated, median"
    return {"name": name, "radius_m": made.config.marker_radius, **medians}


def _real_scans(folder: Path, config: SurveyConfig) -> RealScans:
    """Measure the real scans of a folder: packets (.bin) for noise, points (.xyz) with a sphere."""
    packets = sorted(folder.glob("vlp16_packets/*.bin"))
    points = sorted(folder.glob("vlp16_spheres/*.xyz"))
    if not packets and not points:
        raise NotFoundError(
            f"{folder} holds no real scans; vlp16_packets/*.bin or vlp16_spheres/*.xyz is expected."
        )
    noises = {}
    for path in packets[:1]:
        pulses = read_packets(path)
        noises[_REAL] = range_noise(
            pulses.ranges, pulses.rings, pulses.offsets_ns, pulses.intensities
        )
    spheres = [_real_sphere(path.stem, read_points(path), config) for path in points]
    return RealScans(noises=noises, spheres=spheres)


def _real_sphere(name: str, p: Points, config: SurveyConfig) -> Plain:
    """Fit the sphere of one real scan, the near one with most returns; NaN where none is found."""
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


def _upright_cloud(name: str, p: Points) -> StitchedCloud:
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


def _portable(figure: Any) -> str:
    """Return a figure as Plotly's JSON, in the colours of the light theme."""
    return str(to_json_plotly(coloured(figure.to_plotly_json(), assets.tokens("light"))))


def _csv_tables(made: Reproduction, page: ReproductionPage) -> dict[str, Sequence[Plain]]:
    """Return the tables of the study, the statements and all centres, by name."""
    everything = _columns(made, *{scan.series for scan in made.scans})
    centres = zip(*(column.tolist() for column in everything.values()), strict=True)
    return {
        "table2": page.table_2,
        "table4": page.table_4,
        "table3": page.angles.rows,
        "angle_limits": page.angles.limits,
        "readings": page.readings,
        "statements": [_statement(one) for one in page.statements],
        "centres": [dict(zip(everything, row, strict=True)) for row in centres],
    }


def _statement(one: Statement) -> Plain:
    """Return one statement with its model as plain values."""
    assert one.p95 is not None
    assert one.mean is not None
    assert one.model is not None
    found: Plain = {"place": one.place, "fit_method": one.method}
    for name, limits in (("p95", one.p95), ("mean", one.mean)):
        found |= _bound(f"{name}_distance", limits.greatest_distance, "_m")
        found |= _bound(f"{name}_n_points", limits.smallest_count, "")
    for term in ("distance", "count", "incidence"):
        found[f"power_of_{term}"] = one.model.exponent(term)
        found[f"sigma_power_of_{term}"] = one.model.sigma(term)
    return found | {"typical_error_m": one.model.typical, "n_errors": one.model.n}


def _bound(name: str, bound: Bound, unit: str) -> Plain:
    """Return a bound with its interval as plain values."""
    values = {"": bound.value, "_low": bound.low, "_high": bound.high}
    return {f"{name}{part}{unit}": value for part, value in values.items()}


def _rounded(row: Plain) -> Plain:
    """Return a row for CSV: numbers to a hundredth of a millimetre, empty where unknown."""
    return {
        key: value
        if not isinstance(value, float)
        else round(value, 5)
        if np.isfinite(value)
        else ("" if np.isnan(value) else "inf")
        for key, value in row.items()
    }


def _report(folder: Path, made: Reproduction, page: ReproductionPage) -> Plain:
    """Return the tables and statements of a reproduction for JSON."""
    published = study.TABLE_2.errors_3d
    paper = float(np.nanmean([row["paper_error_3d_mean_m"] for row in page.table_2]))
    report: Plain = to_json(
        {
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
            "table2": page.table_2,
            "table2_paper_minus_study_m": paper - float(published.mean()),
            "readings": page.readings,
            "table3": page.angles.rows,
            "table3_rms_from_study_m": page.angles.rms_from_published,
            "angle_limits": page.angles.limits,
            "table4": page.table_4,
            "statements": [_statement(one) | {"said": _words(one)} for one in page.statements],
            "icp_models": {name: asdict(errors) for name, errors in page.icp.items()},
            "range_noise_m": {name: one.sigmas.tolist() for name, one in page.noises.items()},
            "spheres": page.spheres,
        }
    )
    return report


def _words(one: Statement) -> dict[str, str]:
    """Return the limits of a statement in words."""
    return {
        "distance": one.distance,
        "count": one.count,
        "mean_distance": one.mean_distance,
        "mean_count": one.mean_count,
    }


_TABLE_2 = (
    Column("distance_m", "distance", "m", ".2f"),
    Column("study_n_points", "study: returns", "", "d"),
    Column.mm("study_error_3d_m", "error"),
    Column("paper_n_points_mean", "paper: returns", "", ".0f"),
    Column.mm("paper_error_3d_mean_m", "error"),
    Column("paper_minus_study_m", "- study", "mm", "+.1f"),
    Column("along_beam_n_points_mean", "along_beam: returns", "", ".0f"),
    Column.mm("along_beam_error_3d_mean_m", "error"),
)
_TABLE_3 = (
    Column("included_angle_deg", "angle", "deg", ".2f"),
    Column.mm("study_error_m", "study"),
    Column.mm("three_circles_error_m", "circles"),
    Column("three_circles_minus_study_m", "- study", "mm", "+.1f"),
    Column.mm("two_centres_error_m", "free station: two"),
    Column.mm("three_centres_error_m", "three"),
)
_TABLE_4 = (
    Column("stop", "stop"),
    Column.mm("paper_error_3d_mean_m", "paper"),
    Column.mm("along_beam_error_3d_mean_m", "along_beam"),
)
_STATEMENTS = (
    Column("place", "where"),
    Column("fit_method", "method"),
    Column(lambda row: row["said"]["distance"], "p95: distance", "", ">"),
    Column(lambda row: row["said"]["count"], "p95: returns", "", ">"),
    Column(lambda row: row["said"]["mean_distance"], "mean: distance", "", ">"),
    Column(lambda row: row["said"]["mean_count"], "mean: returns", "", ">"),
)


def reproduction_tables(report: Plain) -> tuple[Table, ...]:
    """Return the study's tables again, and the limits that keep the tolerance."""
    published = report["study"]
    mean = f"{1e3 * published['table2_error_3d_mean_m']:.1f} mm"
    low, high = (1e3 * error for error in published["table2_error_3d_range_m"])
    return (
        Table(
            title="Table 2: centres by distance; mean errors over the simulated worlds",
            columns=_TABLE_2,
            rows=report["table2"],
            notes=(
                f"Mean of the paper's method minus the study's {mean}: "
                f"{1e3 * report['table2_paper_minus_study_m']:+.1f} mm, with the noise and the cut "
                "that the page names",
            ),
        ),
        Table(
            title="Table 3: the station by included angle, 17 mm granted to each axis of each mark",
            columns=_TABLE_3,
            rows=report["table3"],
        ),
        Table(
            title="Table 4: mean error of the centres at each stop of lane 2",
            columns=_TABLE_4,
            rows=report["table4"],
        ),
        Table(
            title=f"Limits that keep {1e3 * report['tolerance_m']:g} mm (95 % confidence); the "
            f"study's, by its mean of {mean} ({low:.1f} to {high:.1f}): up to "
            f"{published['greatest_distance_m']:g} m and from {published['smallest_count']} "
            "returns",
            columns=_STATEMENTS,
            rows=report["statements"],
            notes=(f"{report['n_scans']} scans, seed {report['seed']}. Page: {report['page']}",),
        ),
    )
