"""Jobs of the kind ``calibrate``: the rig of some logs from the two faces of their spheres."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from spheremark.pipelines.model import Origin, Rig, ScanLog, marker_name
from spheremark.pipelines.scan.rigs import rig_digest, rig_to_mapping
from spheremark.service.jobs.specification import Order, Outcome
from spheremark.service.provenance import code_version

if TYPE_CHECKING:
    import pyarrow as pa

    from spheremark.pipelines.calibration import Calibration
    from spheremark.pipelines.calibration.agreement import FaceGaps
    from spheremark.pipelines.survey import Progress

Row = dict[str, Any]

_ESTIMATE = 0.7  # share of the work that the estimate takes; comparing the faces takes the rest


@dataclass(frozen=True, slots=True)
class _Logs:
    """Logs that are read anew each time: a calibration goes through them often, one by one."""

    order: Order

    def __iter__(self) -> Iterator[ScanLog]:
        from spheremark.storage.recordings import read_log

        for one, name in zip(self.order.logs, self.order.log_names, strict=True):
            log = read_log(one.url, digest=one.recording_id)
            yield replace(log, origin=Origin(name=name, digest=one.recording_id))


def logs_of(order: Order) -> Iterable[ScanLog]:
    """Return the logs of an order, to be gone through as often as one likes."""
    return _Logs(order)


def work(order: Order, progress: Progress) -> Outcome:
    """Calibrate the rig of the logs of an order."""
    from spheremark.pipelines.calibration import calibrate
    from spheremark.storage.catalogue.products import documents

    start = perf_counter()
    found = calibrate(
        logs_of(order),
        config=order.config,
        rig=order.rig,
        progress=lambda share, what: progress(_ESTIMATE * share, what),
    )
    tables, files, message = results(order, found, _part(progress, _ESTIMATE), start)
    tables["documents"] = documents(order.result_id, files)
    return Outcome(tables=tables, message=message)


def results(
    order: Order, found: Calibration, progress: Progress, start: float
) -> tuple[dict[str, pa.Table], dict[str, str], str]:
    """Return the tables of a calibration, its files, and a sentence."""
    from spheremark.service.serialise.calibration import serialise_calibration
    from spheremark.storage.catalogue import calibrations
    from spheremark.storage.imports.survey_files import format_rig

    answer = serialise_calibration(found)
    gaps = [_gaps(order, rig, _half(progress, i)) for i, rig in enumerate((found.start, found.rig))]
    rows = calibration_rows(answer, *gaps)
    rows["rigs"] = [_rig_row(rig) for rig in (found.start, found.rig)]
    rows["calibrations"][0] |= {
        "job_id": order.job_id,
        "survey_id": order.survey_id,
        "finished_at": datetime.now(UTC),
        "config": order.config.text,
        "config_digest": order.config.digest,
        "code_version": code_version(),
        "duration_s": perf_counter() - start,
    }
    tables = calibrations.tables(order.result_id, rows)
    files = {"calibration.json": json.dumps(answer), "rig.json": format_rig(found.rig)}
    return tables, files, _summary(answer, *gaps)


def _gaps(order: Order, rig: Rig, progress: Callable[[float], None]) -> FaceGaps:
    """Compare what the two faces show with a rig."""
    from spheremark.pipelines.calibration.agreement import face_gaps
    from spheremark.pipelines.scan.stitching import split_stops

    def stops() -> Iterator[ScanLog]:
        for i, log in enumerate(logs_of(order)):
            progress(i / len(order.logs))
            yield from split_stops(log, order.config.stitching)

    return face_gaps(stops(), rig, order.config)


def _half(progress: Progress, i: int) -> Callable[[float], None]:
    """Return the progress of the comparison with the rig before (0) or after (1)."""
    what = f"Comparing the faces of the spheres {('before', 'after')[i]} the calibration"
    return lambda share: progress((i + share) / 2.0, what)


def _part(progress: Progress, begin: float) -> Progress:
    """Return the progress of what is left of the work."""
    return lambda share, what: progress(begin + (1.0 - begin) * share, what)


def calibration_rows(answer: Row, before: FaceGaps, after: FaceGaps) -> dict[str, list[Row]]:
    """Return the rows of a calibration by table, without what names and made it."""
    held = [
        {
            "parameter": one["name"],
            "unit": "",
            "is_estimated": False,
            "reason": one["reason"],
        }
        for one in answer["not_separable"]
    ]
    told = [
        {
            "parameter": one["name"],
            "unit": one["unit"],
            "is_estimated": True,
            "start_value": one["start"],
            "estimate": one["estimate"],
            "sigma": one["sigma"],
            "reason": "",
        }
        for one in answer["parameters"]
    ]
    return {
        "calibrations": [_calibration(answer, before, after)],
        "calibrated_parameters": [
            {"place": place, **row} for place, row in enumerate((*told, *held))
        ],
        "calibration_gaps": [*_gap_rows(before, is_after=False), *_gap_rows(after, is_after=True)],
    }


def _calibration(answer: Row, before: FaceGaps, after: FaceGaps) -> Row:
    """Return the row of the calibration as a whole."""
    kept = ("rig_digest", "start_rig_digest", "stops", "n_spheres", "n_two_faced", "n_returns")
    return {
        **{key: answer[key] for key in kept},
        **{key: answer[key] for key in ("dof", "sigma0")},
        **{key: answer[key] for key in ("residual_rms_before_m", "residual_rms_after_m")},
        "parameters": [one["name"] for one in answer["parameters"]],
        "covariance": json.dumps(answer["covariance"]),
        "n_gaps": len(after.stops),
        "gap_rms_before_m": before.rms,
        "gap_rms_after_m": after.rms,
        "gap_sigma_after_m": after.sigma,
    }


def _gap_rows(gaps: FaceGaps, *, is_after: bool) -> Iterator[Row]:
    """Yield how far apart the faces put each sphere: along the sight, across it, up."""
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


def _summary(answer: Row, before: FaceGaps, after: FaceGaps) -> str:
    """Say in some sentences what a calibration gave, and what it could not tell."""
    held = [one["name"].replace("_", " ") for one in answer["not_separable"]]
    n = len(answer["stops"])
    sentence = (
        f"{len(answer['parameters'])} parameters from {answer['n_two_faced']} spheres seen on both "
        f"faces in {n} scan{'' if n == 1 else 's'}: the faces "
        f"were {1000 * before.rms:.1f} mm apart and are {1000 * after.rms:.1f} mm (RMS)."
    )
    return f"{sentence} Not told: {', '.join(held)}." if held else sentence
