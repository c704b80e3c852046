"""The decision on a stop while the rover still stands there, in sentences.

Is the station good enough, which marker is bad, and what would help.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from spheremark.pipelines.accuracy.probability import keeps_tolerance, probability_within
from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.geometry import by_motion
from spheremark.pipelines.model import (
    Array,
    ControlMarks,
    MarkerFits,
    NoFix,
    StationFix,
    Status,
    StopResult,
)

_CERTAIN = 0.999  # probability above which its digits say nothing
_N_TIED = 3  # markers that tie a stop without control to others, with none to spare
_TURN = np.radians(350.0)  # a full turn, but for the ends that no revolution fills
_N_DIRECTIONS = 36  # in which one more marker is tried


@dataclass(frozen=True, slots=True, kw_only=True)
class StopDecision:
    """What to do about a stop before the rover leaves it.

    Attributes
    ----------
    stop : str
        Its name.
    is_good_enough : bool
        Whether its station, or without control its markers, can be relied on.
    summary : str
        The result in a sentence.
    bad_markers : tuple of str
        Markers that are weak, left out or contradict the control, with the reason.
    advice : tuple of str
        What would make the stop better; empty where nothing needs to be.
    """

    stop: str
    is_good_enough: bool
    summary: str
    bad_markers: tuple[str, ...] = ()
    advice: tuple[str, ...] = ()

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {**asdict(self), "bad_markers": [*self.bad_markers], "advice": [*self.advice]}

    @property
    def text(self) -> str:
        """All sentences in one line."""
        grade = "good enough" if self.is_good_enough else "not good enough"
        return " ".join((f"{self.stop}: {grade}.", self.summary, *self.bad_markers, *self.advice))


def is_good_enough(status: str, cov_p_site: Array, tolerance: float) -> bool:
    """Return whether a station can be relied on and is within the tolerance in 95 of 100 cases.

    Parameters
    ----------
    status : str
        Status of its fix.
    cov_p_site : (3, 3)
        Covariance of its position [m^2].
    tolerance : float
        Largest error that is accepted [m].

    Returns
    -------
    bool
        Whether it is good enough.
    """
    return status == Status.OK and bool(keeps_tolerance(np.asarray(cov_p_site)[None], tolerance)[0])


def decide(stop: StopResult, config: SurveyConfig, marks: ControlMarks | None) -> StopDecision:
    """Decide on a stop by its first methods.

    Parameters
    ----------
    stop : StopResult
        The results of the stop.
    config : SurveyConfig
        What they were made with: the tolerance.
    marks : ControlMarks or None
        The control marks of the survey.

    Returns
    -------
    StopDecision
        The decision with its reasons.
    """
    found = next(iter(stop.fits.values()))
    n = len(found.fits)
    counted = f"{n} marker{'' if n == 1 else 's'}"
    fix = next(iter(stop.fixes.values()), None)
    bad = [f"{one.name} is weak: {_ended(one.reason)}" for one in found.fits if one.reason]
    if fix is None or marks is None:
        n_ok = sum(one.status is Status.OK for one in found.fits)
        summary = f"{counted}, {n_ok} of them ok; no control marks, so no position."
        good = n_ok > _N_TIED
        advice = _for_scan(stop)
        if not good:
            advice.append(f"Place more markers: {_N_TIED + 1} or more tie stops to each other.")
    elif isinstance(fix, NoFix):
        good, summary = False, f"{counted}; no position: {_ended(fix.reason)}"
        advice = _for_scan(stop)
    else:
        bad += [f"{found.fits[one.fit].name} is left out: {one.reason}" for one in fix.excluded]
        good = is_good_enough(fix.status, fix.cov_p_site, config.tolerance)
        summary = _summary(fix, counted, config.tolerance)
        advice = [] if good else [*_for_scan(stop), *_more_markers(fix, found, marks)]
    if marks is not None and (text := _contradiction(stop, marks)):
        bad.append(text)
    return StopDecision(
        stop=stop.name,
        is_good_enough=good,
        summary=summary,
        bad_markers=tuple(bad),
        advice=tuple(advice),
    )


def _ended(reason: str) -> str:
    """Return a reason with a full stop."""
    return f"{reason.strip().rstrip('.')}."


def _summary(fix: StationFix, counted: str, tolerance: float) -> str:
    """Return the station in a sentence."""
    within = float(probability_within(fix.cov_p_site[None], tolerance)[0])
    text = (
        f"{counted}, {len(fix.matches)} of them on marks; station with a sigma of "
        f"{1000 * fix.sigma_3d:.1f} mm (3-D), within {1000 * tolerance:.0f} mm with a probability "
        f"{'of' if within < _CERTAIN else 'above'} {100 * min(within, _CERTAIN):.1f} %"
    )
    return f"{text}; weak: {_ended(fix.reason)}" if fix.status is Status.WEAK else f"{text}."


def _contradiction(stop: StopResult, marks: ControlMarks) -> str:
    """Name the control marks that the distances in a scan contradict, if any."""
    checks = stop.distances
    is_fixed = any(isinstance(fix, StationFix) for fix in stop.fixes.values())
    if checks is None or not checks.suspects or not is_fixed:
        return ""
    names = ", ".join(marks.names[mark] for mark in checks.suspects)
    return (
        f"{int(checks.is_off.sum())} of {len(checks.is_off)} distances between marks in "
        f"{stop.name} are not those of the control: look at {names}."
    )


def _for_scan(stop: StopResult) -> list[str]:
    """Return what a second scan from the same place could do better."""
    found = []
    if stop.cloud.coverage < _TURN:
        found.append(
            f"The gimbal turned by {np.degrees(stop.cloud.coverage):.0f} deg: turn it by 360 deg, "
            "which shows every marker to both faces."
        )
    if not stop.cloud.levelling.is_measured:
        found.append("Nothing levels the scan: record the IMU (sensor_msgs/msg/Imu).")
    return found


def _more_markers(fix: StationFix, found: MarkerFits, marks: ControlMarks) -> Iterator[str]:
    """Yield which marks or markers, added to a station, would make it better, and by how much."""
    used, on = fix.matches.T
    own = [np.trace(found.fits[i].cov_p_base) / 3.0 for i in used]
    variance = float(np.median(own))
    motion = np.eye(6)
    motion[3:, :3] = by_motion(fix.p_site)[:, :3]
    cov = motion @ fix.cov_T_site_station @ motion.T  # of rotation and place at the station
    cov[3:, 3:] = fix.cov_p_site
    # all centres are turned alike by what leaves the heading open
    axis = fix.T_site_station[:3, :3] @ fix.axis_station
    cov[:3, :3] -= fix.sigma_heading**2 * np.outer(axis, axis)
    reach = max(found.fits[i].mean_range for i in used)
    offsets = marks.p_site - fix.p_site
    missing = np.setdiff1d(np.flatnonzero(np.linalg.norm(offsets, axis=1) <= reach), on)
    now = 1000.0 * fix.sigma_3d
    if len(missing):
        sigmas = _sigmas_with(cov, offsets[missing], variance)
        best = int(np.argmin(sigmas))
        mark = missing[best]
        distance = float(np.linalg.norm(offsets[mark]))
        yield (
            f"{marks.names[mark]}, {distance:.1f} m away, was not found: clear the view to it. "
            f"With it the sigma would be {1000 * sigmas[best]:.1f} mm in place of {now:.1f} mm."
        )
        return
    bearings = np.linspace(0.0, 2.0 * np.pi, _N_DIRECTIONS, endpoint=False)
    middle = float(np.median([found.fits[i].mean_range for i in used]))
    ring = middle * np.column_stack([np.sin(bearings), np.cos(bearings), np.zeros(len(bearings))])
    sigmas = _sigmas_with(cov, ring, variance)
    best = int(np.argmin(sigmas))
    yield (
        f"One more marker at {middle:.0f} m with a bearing of {np.degrees(bearings[best]):.0f} deg "
        f"(clockwise from y of the site) would help most: a sigma of {1000 * sigmas[best]:.1f} mm "
        f"in place of {now:.1f} mm."
    )


def _sigmas_with(cov: Array, offsets: Array, variance: float) -> Array:
    """Return the 3-D sigma of a station with one more marker at each of some places [m].

    The update of a covariance by an observation; what all centres have in common stays.
    """
    J = by_motion(offsets)
    innovation = J @ cov @ np.swapaxes(J, 1, 2) + variance * np.eye(3)
    gain = cov @ np.swapaxes(J, 1, 2) @ np.linalg.inv(innovation)
    updated = cov - gain @ J @ cov
    return np.asarray(np.sqrt(np.trace(updated[:, 3:, 3:], axis1=1, axis2=2)))
