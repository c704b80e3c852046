"""The rig from what spheres show on both faces of a scan: no plane and no coordinate is needed.

A LiDAR whose spin axis is tilted sweeps every direction twice in a full turn of the gimbal, once on
either side of its head. Errors of the rig separate the two images of a sphere; ``calibrate`` brings
them together.

- ``gimbal``: how the parameters of a rig move its beams
- ``faces``: a rough rig from the two centres of each sphere, however bad the start
- ``estimation``: adjustment of rig and centres to the ranges

Each face is processed apart first, because a rig that is wrong by a tenth of a degree splits
spheres in two, and the detection would miss them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from spheremark.pipelines.calibration.estimation import (
    Estimate,
    Inseparable,
    estimate,
    residual_rms,
)
from spheremark.pipelines.calibration.faces import front_face, rig_from_faces
from spheremark.pipelines.calibration.gimbal import GIMBAL, Pulses, recorded_pulses, values
from spheremark.pipelines.calibration.result import BIAS, Calibration, Scan
from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.errors import DegenerateGeometryError, RigError
from spheremark.pipelines.geometry import unit
from spheremark.pipelines.model import Array, Index, MarkerFits, Mask, Rig, ScanLog, Status
from spheremark.pipelines.scan.rigs import rig_digest
from spheremark.pipelines.scan.stitching import choose_rig, split_stops, stitch
from spheremark.pipelines.sphere import fit_markers

__all__ = ["Calibration", "Inseparable", "Scan", "calibrate"]

Progress = Callable[[float, str], None]

_N_PASSES = 3
_SETTLED = 0.5  # sigmas by which the rig may still move from pass to pass
_N_FACE = 6  # returns on either face of a sphere that count as seen on both
_SUFFIX = "-calibrated"
_N_SPHERES = 3  # seen on both faces: fewer leave offset and eccentricity undetermined


def calibrate(
    logs: Iterable[ScanLog],
    *,
    config: SurveyConfig = SurveyConfig(),  # noqa: B008  frozen
    rig: Rig | None = None,
    progress: Progress = lambda _share, _what: None,
) -> Calibration:
    """Estimate the rig from the spheres of one scan or many.

    Parameters
    ----------
    logs : iterable of ScanLog
        Scans with the same rig. It is gone through several times, so that a collection that reads
        its logs one by one keeps memory small.
    config : SurveyConfig
        How spheres are found; the fitting's sigma of direction.
    rig : Rig, optional
        Where to start; by default the one that the logs describe.
    progress : callable
        Receives the share that is done, 0 to 1, and the next step; may raise to cancel.

    Returns
    -------
    Calibration
        The rig with covariance, and the parameters that were held.

    Raises
    ------
    DegenerateGeometryError
        If fewer than three spheres are seen on both faces.
    MissingRigError
        If neither the logs nor the caller give the mounting of the LiDAR.
    NotConvergedError
        If the adjustment does not settle.
    RigError
        If the logs describe different rigs and none was given.

    Notes
    -----
    Offsets of the axis, tilt and zero of the spin axis, eccentricity of the encoder and biases of
    the lasers are estimated without priors as far as the ranges determine them. Cost grows linearly
    with returns and with scans.
    """
    start = _start(logs, rig)
    progress(0.0, "Looking at both faces of each sphere")
    rough = rig_from_faces(_stops(logs, config), start, config)
    seen, found = _passed(logs, rough, config)
    for number in range(1, _N_PASSES):
        progress(number / _N_PASSES, f"Adjusting rig and centres, pass {number + 1}")
        before = found.rig
        seen, found = _passed(logs, before, config)
        if _in_sigmas(found, before) < _SETTLED:
            break
    progress(1.0, "Calibrated")
    return _calibration(start, seen, found, config)


def _passed(logs: Iterable[ScanLog], rig: Rig, config: SurveyConfig) -> tuple[_Seen, Estimate]:
    """Find all spheres with a rig, and adjust it to them."""
    seen = _see(logs, rig, config)
    return seen, estimate(
        *(seen.pulses, rig, seen.centres, seen.covs),
        config.marker_radius,
        config.fitting,
    )


def _start(logs: Iterable[ScanLog], rig: Rig | None) -> Rig:
    """Return the rig to start with."""
    rigs = {rig_digest(one): one for one in (choose_rig(log, rig) for log in logs)}
    if not rigs:
        raise DegenerateGeometryError("No log was given; a calibration needs at least one scan.")
    if len(rigs) > 1:
        raise RigError(
            f"The logs describe {len(rigs)} different rigs; calibrate the logs of one rig, or say "
            "which one to start with (--rig rig.json)."
        )
    return next(iter(rigs.values()))


def _stops(logs: Iterable[ScanLog], config: SurveyConfig) -> Iterable[ScanLog]:
    """Yield the stops of all logs."""
    for log in logs:
        yield from split_stops(log, config.stitching)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _Seen:
    """What all stops show with one rig: pulses at spheres, and rough centres.

    ``scans`` are the markers of each stop, ``places``, (m, 2), stop and place of each sphere.
    """

    pulses: Pulses
    centres: Array
    covs: Array
    scans: tuple[tuple[str, MarkerFits], ...]
    places: Index
    n_two_faced: int
    sigma0: float


def _see(logs: Iterable[ScanLog], rig: Rig, config: SurveyConfig) -> _Seen:
    """Find and fit the spheres of all stops with a rig."""
    parts, fits, places, n_two_faced = [], [], [], 0
    scans: list[tuple[str, MarkerFits]] = []
    for log in _stops(logs, config):
        cloud = stitch(log, rig, config.stitching)
        candidates = extract(cloud, config.extraction, config.marker_radius)
        found = fit_markers("along_beam", cloud, candidates, config.fitting, config.marker_radius)
        chosen = [k for k, fit in enumerate(found.fits) if fit.status is Status.OK]
        good = [found.fits[k] for k in chosen]
        if not good:
            continue
        rows = np.concatenate([fit.used for fit in good])
        which = np.repeat(np.arange(len(good)), [len(fit.used) for fit in good])
        n_two_faced += _n_two_faced(front_face(cloud)[rows], which)
        unknown = config.fitting.sigma_direction
        parts.append(recorded_pulses(log, cloud, rows, which, unknown))
        fits += good
        places += [(len(scans), k) for k in chosen]
        scans.append((log.origin.name, found))
    if n_two_faced < _N_SPHERES:
        raise DegenerateGeometryError(
            f"{n_two_faced} spheres are seen on both faces; a calibration needs at least "
            f"{_N_SPHERES}. Turn the gimbal by 360 degrees among more markers, or give more scans."
        )
    return _Seen(
        pulses=Pulses.joined(parts),
        centres=np.array([fit.p_base for fit in fits]),
        covs=np.array([fit.cov_p_base for fit in fits]),
        scans=tuple(scans),
        places=np.array(places, dtype=np.intp),
        n_two_faced=n_two_faced,
        sigma0=float(np.sqrt(np.mean([fit.sigma0**2 for fit in fits]))),
    )


def _n_two_faced(is_front: Mask, which: Index) -> int:
    """Return the number of spheres with returns enough on both faces."""
    n = int(which.max()) + 1
    counts = [np.bincount(which[side], minlength=n) for side in (is_front, ~is_front)]
    return int(np.sum(np.min(counts, axis=0) >= _N_FACE))


def _calibrated(name: str) -> str:
    """Return what a calibrated rig is called."""
    return name if name.endswith(_SUFFIX) else name + _SUFFIX


def _in_sigmas(found: Estimate, before: Rig) -> float:
    """Return how far the rig moved, in sigmas of the parameter that moved most."""
    steps = _chosen(found.rig, found) - _chosen(before, found)
    sigmas = np.sqrt(np.diag(found.cov))
    return float(np.max(np.abs(steps) / np.maximum(sigmas, 1e-12)))


def _chosen(rig: Rig, found: Estimate) -> Array:
    """Return the values in a rig of the parameters that were estimated."""
    return np.concatenate([values(rig)[found.is_free], rig.laser_range_biases[found.lasers]])


def _calibration(start: Rig, seen: _Seen, found: Estimate, config: SurveyConfig) -> Calibration:
    """Assemble the result."""
    free = [parameter for parameter, is_free in zip(GIMBAL, found.is_free, strict=True) if is_free]
    names = [p.name for p in free] + [f"{BIAS}{k}" for k in found.lasers]
    before, after = (
        residual_rms(seen.pulses, rig, found, seen.covs, config.marker_radius)
        for rig in (start, found.rig)
    )
    return Calibration(
        rig=replace(found.rig, name=_calibrated(start.name)),
        start=start,
        names=tuple(names),
        units=(*(p.unit for p in free), *("m" for _ in found.lasers)),
        start_values=_chosen(start, found),
        estimates=_chosen(found.rig, found),
        cov=found.cov.copy(),
        inseparable=found.held,
        stops=tuple(name for name, _ in seen.scans),
        n_spheres=len(found.centres),
        n_two_faced=seen.n_two_faced,
        n_returns=int(found.is_used.sum()),
        dof=found.dof,
        sigma0=seen.sigma0,
        rms_before=before,
        rms_after=after,
        basis=found.basis,
        weights=found.weights,
        scans=dict(_scans(seen, found)),
    )


def _scans(seen: _Seen, found: Estimate) -> Iterator[tuple[str, Scan]]:
    """Yield name and centres of each stop, those of the estimate in place of the rough ones.

    Those are moved to the optics that their own scan shows, with which networks take them.
    """
    for number, (name, rough) in enumerate(seen.scans):
        fits = list(rough.fits)
        effects = np.zeros((len(fits), 3, found.basis.shape[1]))
        for sphere in np.flatnonzero(seen.places[:, 0] == number):
            place = seen.places[sphere, 1]
            p, cov = found.centres[sphere], found.cov_centres[sphere].copy()
            if (optics := fits[place].optics) is not None:
                p = p - unit(p) * (fits[place].range_by_optics @ (optics.estimates - found.optics))
            fits[place] = replace(fits[place], p_base=p.copy(), cov_p_base=cov)
            effects[place] = found.effects[sphere]
        yield name, Scan(fits=replace(rough, fits=tuple(fits)), effects=effects)
