"""The whole chain in memory: from a scan log to positions with covariances."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from spheremark.pipelines.accuracy.truth import (
    MarkerErrors,
    StationError,
    marker_errors,
    station_error,
)
from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.detection import extract
from spheremark.pipelines.errors import NoMarkersError, SolveError
from spheremark.pipelines.model import (
    ControlMarks,
    DistanceChecks,
    MarkerFits,
    NoFix,
    Rig,
    ScanLog,
    StationFix,
    StationQuality,
    Status,
    StopResult,
    SubsetFixes,
    Truth,
)
from spheremark.pipelines.positioning.quality_control import check_distances, station_quality
from spheremark.pipelines.positioning.resection import resect
from spheremark.pipelines.positioning.subsets import resect_subsets
from spheremark.pipelines.progress import Progress, part_of
from spheremark.pipelines.scan.stitching import choose_rig, split_stops, stitch
from spheremark.pipelines.sphere import fit_markers

__all__ = ["Progress", "StopErrors", "process", "stop_errors"]

_MOUNTING_WRONG = 2.0  # times the prior: six errors within it reach that once in 25,000 scans


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StopErrors:
    """Errors of a stop's results against truth.

    Attributes
    ----------
    markers : mapping of str to MarkerErrors
        By fitting method.
    stations : mapping of (str, str) to StationError
        By fitting and resection method, of each station that was positioned.
    """

    markers: Mapping[str, MarkerErrors]
    stations: Mapping[tuple[str, str], StationError]


def process(
    log: ScanLog,
    *,
    config: SurveyConfig = SurveyConfig(),  # noqa: B008  frozen
    rig: Rig | None = None,
    marks: ControlMarks | None = None,
    progress: Progress = lambda _share, _what: None,
) -> tuple[StopResult, ...]:
    """Find the markers of each stop of a log and position its stations.

    Parameters
    ----------
    log : ScanLog
        One stop or many.
    config : SurveyConfig
        What to do, and how.
    rig : Rig, optional
        The rig; by default the one that the log describes.
    marks : ControlMarks, optional
        Marks at known places; without them there are centres, but no positions.
    progress : callable
        Takes the finished share of the computation, 0 to 1, and the next step.

    Returns
    -------
    tuple of StopResult
        One for each stop, in the order of time.

    Raises
    ------
    MissingRigError
        If neither the log nor the caller gives the mounting of the LiDAR.
    NoMarkersError
        If not one marker was found in any stop.
    RecordingError
        If the log cannot be stitched.

    Notes
    -----
    A station that cannot be positioned has a ``NoFix`` with the reason; its markers are kept. Cost
    grows linearly with the returns. The log is released as soon as it is stitched: a caller without
    a reference to it, as in ``process(read_log(path), ...)``, needs less memory.
    """
    rig = choose_rig(log, rig)
    stops = list(split_stops(log, config.stitching))
    del log
    results: list[StopResult] = []
    n = len(stops)
    while stops:
        part = part_of(progress, len(results) / n, (len(results) + 1) / n)
        results.append(_process_stop(stops.pop(0), rig, marks, config, part))
    if not any(fits.fits for result in results for fits in result.fits.values()):
        raise NoMarkersError(_why_no_markers(results, config))
    return tuple(results)


def stop_errors(stop: StopResult, truth: Truth) -> StopErrors | None:
    """Compare the results of a stop with the truth.

    Parameters
    ----------
    stop : StopResult
        The results.
    truth : Truth
        True marks, and the true poses of some stops.

    Returns
    -------
    StopErrors or None
        None if the true pose of the stop is not known.
    """
    pose = next((one for one in truth.stops if one.name == stop.name), None)
    if pose is None:
        return None
    return StopErrors(
        markers={
            method: marker_errors(fits, pose, truth.marks) for method, fits in stop.fits.items()
        },
        stations={
            methods: station_error(fix.T_site_station, pose)
            for methods, fix in stop.fixes.items()
            if isinstance(fix, StationFix)
        },
    )


def _process_stop(
    log: ScanLog,
    rig: Rig,
    marks: ControlMarks | None,
    config: SurveyConfig,
    progress: Progress,
) -> StopResult:
    """Run the chain on one stop."""
    timings: dict[str, float] = {}
    name = log.origin.name
    progress(0.0, f"Stitching {name}")
    with _timed(timings, "stitching"):
        cloud = stitch(log, rig, config.stitching)
    weaknesses = (*log.weaknesses, *cloud.weaknesses, *_half_turn(cloud.coverage))
    del log
    progress(0.3, f"Extracting markers from {len(cloud.p_base):,} returns")
    with _timed(timings, "extraction"):
        candidates = extract(cloud, config.extraction, config.marker_radius)
    fits = {}
    for i, method in enumerate(config.fitting.methods):
        share = 0.5 + 0.3 * i / len(config.fitting.methods)
        progress(share, f"Fitting {len(candidates.candidates)} centres by {method}")
        with _timed(timings, f"fitting.{method}"):
            fits[method] = fit_markers(
                method, cloud, candidates, config.fitting, config.marker_radius
            )
    cloud = replace(cloud, notes=cloud.notes + _mounting_notes(next(iter(fits.values()))))
    progress(0.8, "Positioning the station")
    with _timed(timings, "resection"):
        fixes = _position(fits, marks, config, weaknesses)
    with _timed(timings, "subsets"):
        subsets = _subsets(fits, fixes, marks, config)
    with _timed(timings, "quality_control"):
        quality = _quality(fits, fixes, marks, config)
        distances = _distances(next(iter(fits.values())), marks, config)
    progress(1.0, f"{name} done")
    return StopResult(
        name=name,
        cloud=cloud,
        fits=fits,
        fixes=fixes,
        subsets=subsets,
        quality=quality,
        distances=distances,
        timings=timings,
    )


def _mounting_notes(fits: MarkerFits) -> tuple[str, ...]:
    """Return a note where the two faces of spheres show errors of the rig beyond their prior."""
    if fits.mounting_factor < _MOUNTING_WRONG:
        return ()
    return (
        "The two faces of its spheres lie apart as if the errors of the mounting were "
        f"{fits.mounting_factor:.1f} times fitting.sigma_mounting and sigma_offset. Before you "
        "rely on its centres, calibrate the rig (spheremark calibrate).",
    )


def _position(
    fits: dict[str, MarkerFits],
    marks: ControlMarks | None,
    config: SurveyConfig,
    weaknesses: tuple[str, ...],
) -> dict[tuple[str, str], StationFix | NoFix]:
    """Position the station from each set of fits by each resection method."""
    fixes: dict[tuple[str, str], StationFix | NoFix] = {}
    if marks is None:
        return fixes
    for fit_method, centres in fits.items():
        for method in config.resection.methods:
            try:
                fix = resect(method, centres, marks, config.resection)
            except SolveError as error:
                no = NoFix(method=method, code=error.code, reason=str(error))
                fixes[fit_method, method] = no
            else:
                fixes[fit_method, method] = _qualified(fix, weaknesses)
    return fixes


def _subsets(
    fits: dict[str, MarkerFits],
    fixes: dict[tuple[str, str], StationFix | NoFix],
    marks: ControlMarks | None,
    config: SurveyConfig,
) -> dict[tuple[str, str], tuple[SubsetFixes, ...]]:
    """Position the station from all pairs and triples of the fix that uses most markers."""
    found: dict[tuple[str, str], tuple[SubsetFixes, ...]] = {}
    if marks is None:
        return found
    for fit_method, centres in fits.items():
        own = [f for (m, _), f in fixes.items() if m == fit_method and isinstance(f, StationFix)]
        if not own:
            continue
        fix = max(own, key=lambda one: len(one.matches))
        methods = config.resection.subset_methods
        by_method = resect_subsets(methods, fix, centres, marks, config.resection)
        found |= {(fit_method, method): sizes for method, sizes in by_method.items()}
    return found


def _quality(
    fits: dict[str, MarkerFits],
    fixes: dict[tuple[str, str], StationFix | NoFix],
    marks: ControlMarks | None,
    config: SurveyConfig,
) -> dict[tuple[str, str], StationQuality]:
    """Return the quality of each station that was positioned."""
    if marks is None:
        return {}
    return {
        (fit_method, method): station_quality(fix, fits[fit_method], marks, config.resection)
        for (fit_method, method), fix in fixes.items()
        if isinstance(fix, StationFix)
    }


def _distances(
    fits: MarkerFits, marks: ControlMarks | None, config: SurveyConfig
) -> DistanceChecks | None:
    """Compare distances between markers with the control; None with fewer than two of either."""
    if marks is None or len(fits.fits) < 2 or len(marks.names) < 2:
        return None
    try:
        return check_distances(fits, marks, config.resection, config.tolerance)
    except SolveError as error:
        return DistanceChecks.none(str(error))


def _half_turn(coverage: float) -> tuple[str, ...]:
    """Return why results are weak where the gimbal turned by less than half a turn [rad]."""
    if coverage >= np.pi:
        return ()
    return (
        f"the gimbal turned by {np.degrees(coverage):.0f} deg only: under 180 deg no direction is "
        "swept twice, and errors of the gimbal neither cancel nor show",
    )


def _qualified(fix: StationFix, weaknesses: tuple[str, ...]) -> StationFix:
    """Return the fix, weak if there is a reason."""
    if not weaknesses:
        return fix
    reason = "; ".join(one.rstrip(".") for one in (fix.reason, *weaknesses) if one)
    return replace(fix, status=Status.WEAK, reason=reason)


def _why_no_markers(results: list[StopResult], config: SurveyConfig) -> str:
    """Return the reason: the returns, and the likeliest possible marker or largest other group."""
    returns = sum(len(result.cloud.p_base) for result in results)
    found = [next(iter(result.fits.values())) for result in results if result.fits]
    possible = [one for fits in found for one in fits.possible]
    refused = [one for fits in found for one in fits.rejected]
    seen = f"{returns:,} returns show no sphere of radius {config.marker_radius:.3f} m"
    if possible:
        best = max(possible, key=lambda one: one.probability)
        what = f"possible ones, {np.linalg.norm(best.p_base):.1f} m away, {best.n_points} returns"
        return f"{seen} for sure; the likeliest of {len(possible)} {what}: {best.reason}"
    if refused:
        largest = max(refused, key=lambda one: one.n_points)
        return f"{seen}; the largest of {len(refused)} refused groups: {largest.reason}"
    return f"{seen} between {config.stitching.range_min} and {config.extraction.range_max} m."


@contextmanager
def _timed(timings: dict[str, float], step: str) -> Iterator[None]:
    """Record how long the step takes [s]."""
    start = perf_counter()
    yield
    timings[step] = perf_counter() - start
