"""Jobs of the kind ``calibrate``: the rig of some logs from the two faces of their spheres."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from spheremark.pipelines.model import Rig, ScanLog, marker_name
from spheremark.pipelines.progress import Progress, part_of
from spheremark.pipelines.scan.rigs import rig_digest, rig_to_mapping
from spheremark.service.jobs.specification import JobResult, JobSpecification

if TYPE_CHECKING:
    import pyarrow as pa

    from spheremark.pipelines.calibration import Calibration
    from spheremark.pipelines.calibration.agreement import FaceGaps

Row = dict[str, Any]

_ESTIMATE = 0.7  # share of the time that the estimate takes; comparing the faces takes the rest


@dataclass(frozen=True, slots=True)
class _Logs:
    """Logs that are read one by one in each pass of a calibration."""

    spec: JobSpecification

    def __iter__(self) -> Iterator[ScanLog]:
        for one, name in zip(self.spec.logs, self.spec.log_names, strict=True):
            yield one.read(name)


def logs_of(spec: JobSpecification) -> Iterable[ScanLog]:
    """Return the logs of a job; each iteration reads them again."""
    return _Logs(spec)


def handle(spec: JobSpecification, progress: Progress) -> JobResult:
    """Calibrate the rig of the logs of a job."""
    from spheremark.pipelines.calibration import calibrate
    from spheremark.storage.catalogue.products import documents

    start = perf_counter()
    found = calibrate(
        logs_of(spec),
        config=spec.config,
        rig=spec.rig,
        progress=part_of(progress, 0.0, _ESTIMATE),
    )
    tables, files, message = calibration_results(
        spec, found, part_of(progress, _ESTIMATE, 1.0), start
    )
    tables["documents"] = documents(spec.result_id, files)
    return JobResult(tables=tables, message=message)


def calibration_results(
    spec: JobSpecification, found: Calibration, progress: Progress, start: float
) -> tuple[dict[str, pa.Table], dict[str, str], str]:
    """Return the tables of a calibration, its files, and a sentence."""
    from spheremark.service.serialise.calibration import serialise_calibration
    from spheremark.storage.catalogue.schema import tables_of
    from spheremark.storage.catalogue.tables import CALIBRATION_TABLES
    from spheremark.storage.imports.survey_files import format_rig

    plain = serialise_calibration(found)
    gaps = [_gaps(spec, rig, _half(progress, i)) for i, rig in enumerate((found.start, found.rig))]
    rows = calibration_rows(plain, *gaps)
    rows["rigs"] = [_rig_row(rig) for rig in (found.start, found.rig)]
    rows["calibrations"][0] |= spec.columns(start)
    tables = tables_of(("rigs", *CALIBRATION_TABLES), rows, calibration_id=spec.result_id)
    files = {"calibration.json": json.dumps(plain), "rig.json": format_rig(found.rig)}
    return tables, files, _summary(plain, *gaps)


def _gaps(spec: JobSpecification, rig: Rig, progress: Callable[[float], None]) -> FaceGaps:
    """Compare the centres of the two faces with a rig."""
    from spheremark.pipelines.calibration.agreement import face_gaps
    from spheremark.pipelines.scan.stitching import split_stops

    def stops() -> Iterator[ScanLog]:
        for i, log in enumerate(logs_of(spec)):
            progress(i / len(spec.logs))
            yield from split_stops(log, spec.config.stitching)

    return face_gaps(stops(), rig, spec.config)


def _half(progress: Progress, i: int) -> Callable[[float], None]:
    """Return the progress of the comparison with the rig before (0) or after (1)."""
    what = f"Comparing the faces of the spheres {('before', 'after')[i]} the calibration"
    return lambda share: progress((i + share) / 2.0, what)


def calibration_rows(plain: Row, before: FaceGaps, after: FaceGaps) -> dict[str, list[Row]]:
    """Return the rows of a calibration by table, without the columns of its job."""
    held = [
        {
            "parameter": one["name"],
            "unit": "",
            "is_estimated": False,
            "reason": one["reason"],
        }
        for one in plain["not_separable"]
    ]
    estimated = [
        {
            "parameter": one["name"],
            "unit": one["unit"],
            "is_estimated": True,
            "start_value": one["start"],
            "estimate": one["estimate"],
            "sigma": one["sigma"],
            "reason": "",
        }
        for one in plain["parameters"]
    ]
    return {
        "calibrations": [_calibration(plain, before, after)],
        "calibrated_parameters": [
            {"place": place, **row} for place, row in enumerate((*estimated, *held))
        ],
        "calibration_gaps": [*_gap_rows(before, is_after=False), *_gap_rows(after, is_after=True)],
    }


def _calibration(plain: Row, before: FaceGaps, after: FaceGaps) -> Row:
    """Return the row of the calibration as a whole."""
    kept = ("rig_digest", "start_rig_digest", "stops", "n_spheres", "n_two_faced", "n_returns")
    return {
        **{key: plain[key] for key in kept},
        **{key: plain[key] for key in ("dof", "sigma0")},
        **{key: plain[key] for key in ("residual_rms_before_m", "residual_rms_after_m")},
        "parameters": [one["name"] for one in plain["parameters"]],
        "covariance": json.dumps(plain["covariance"]),
        "n_gaps": len(after.stops),
        "gap_rms_before_m": before.rms,
        "gap_rms_after_m": after.rms,
        "gap_sigma_after_m": after.sigma,
    }


def _gap_rows(gaps: FaceGaps, *, is_after: bool) -> Iterator[Row]:
    """Yield the gap between the faces of each sphere: along the line of sight, across it, up."""
    counts: dict[str, int] = {}
    azimuths = np.arctan2(gaps.p_base[:, 1], gaps.p_base[:, 0])
    for k in np.lexsort((azimuths, np.array(gaps.stops))):
        stop, p = gaps.stops[k], gaps.p_base[k]
        counts[stop] = counts.get(stop, 0) + 1
        sight = p / np.linalg.norm(p)
        across = np.array([-p[1], p[0], 0.0]) / np.hypot(p[0], p[1])
        ways = {"radial": sight, "across": across, "up": np.cross(sight, across)}
        yield {
            "is_after": is_after,
            "stop": stop,
            "marker": marker_name(counts[stop] - 1),
            "range_m": np.linalg.norm(p),
            "azimuth_deg": np.degrees(azimuths[k]),
            **{f"gap_{way}_m": axis @ gaps.gap_base[k] for way, axis in ways.items()},
            "gap_3d_m": np.linalg.norm(gaps.gap_base[k]),
            "sigma_3d_m": np.sqrt(np.trace(gaps.cov_gap_base[k])),
        }


def _rig_row(rig: Rig) -> Row:
    """Return the row of a rig."""
    text = json.dumps(rig_to_mapping(rig))
    return {"rig_digest": rig_digest(rig), "name": rig.name, "rig": text}


def _summary(plain: Row, before: FaceGaps, after: FaceGaps) -> str:
    """Return the results of a calibration in sentences, and what is not separable."""
    held = [one["name"].replace("_", " ") for one in plain["not_separable"]]
    n = len(plain["stops"])
    sentence = (
        f"{len(plain['parameters'])} parameters from {plain['n_two_faced']} spheres seen on both "
        f"faces in {n} scan{'' if n == 1 else 's'}: the faces "
        f"were {1000 * before.rms:.1f} mm apart and are {1000 * after.rms:.1f} mm (RMS)."
    )
    return f"{sentence} Not separable: {', '.join(held)}." if held else sentence
