"""``spheremark calibrate``: the rig of some logs from their spheres, as JSON and as a table.

The JSON is a public interface, and a rig file too: its ``rig`` is what ``--rig`` takes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spheremark.pipelines.calibration import Calibration, calibrate
from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.errors import RecordingError
from spheremark.pipelines.model import Rig, ScanLog
from spheremark.pipelines.scan.rigs import rig_digest, rig_to_mapping
from spheremark.pipelines.survey import Progress
from spheremark.storage.recordings import read_log

Plain = dict[str, Any]


@dataclass(frozen=True, slots=True)
class _Logs:
    """Logs that are read one by one, each time anew: a calibration goes through them often.

    A single one is read once and kept.
    """

    paths: tuple[Path, ...]
    kept: tuple[ScanLog, ...]

    def __iter__(self) -> Iterator[ScanLog]:
        return iter(self.kept) if self.kept else (_read(path) for path in self.paths)


def calibrate_logs(
    paths: Sequence[Path], config: SurveyConfig, rig: Rig | None, progress: Progress
) -> Calibration:
    """Estimate the rig from the spheres of some logs."""
    kept = (_read(paths[0]),) if len(paths) == 1 else ()
    return calibrate(_Logs(tuple(paths), kept), config=config, rig=rig, progress=progress)


def _read(path: Path) -> ScanLog:
    """Read one log of several; what is wrong with it is said of it by name."""
    try:
        return read_log(path)
    except RecordingError as error:
        error.args = (f"{path.name}: {error}",)
        raise


def calibration_answer(found: Calibration) -> Plain:
    """Return a calibration as plain values."""
    sigmas = np.sqrt(np.diag(found.cov))
    rows = zip(found.names, found.units, found.start_values, found.estimates, sigmas, strict=True)
    return {
        "rig": rig_to_mapping(found.rig),
        "rig_digest": rig_digest(found.rig),
        "start_rig_digest": rig_digest(found.start),
        "parameters": [
            {
                "name": name,
                "unit": unit,
                "start": float(start),
                "estimate": float(estimate),
                "sigma": float(sigma),
            }
            for name, unit, start, estimate, sigma in rows
        ],
        "covariance": found.cov.tolist(),
        "not_separable": [{"name": held.name, "reason": held.reason} for held in found.inseparable],
        "stops": list(found.stops),
        "n_spheres": found.n_spheres,
        "n_two_faced": found.n_two_faced,
        "n_returns": found.n_returns,
        "dof": found.dof,
        "sigma0": found.sigma0,
        "residual_rms_before_m": found.rms_before,
        "residual_rms_after_m": found.rms_after,
    }
