"""The page of a recording: what can be computed, what cannot, and a timeline of its topics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any, NamedTuple

from spheremark.web.pages.base import Frame, Readout, Row
from spheremark.web.templating import number, render

_WIDTH = 1000.0  # of the timeline, in its own units
_ANGLE_HEIGHT = 100.0  # of the angle of the gimbal
_FULL_DEG = 350.0  # a turn, but for the ends that no revolution fills
_SPHERE_M = 0.2  # diameter of the usual markers
_TICKS = (
    0.1,
    0.2,
    0.5,
    1.0,
    2.0,
    5.0,
    10.0,
    20.0,
    60.0,
    120.0,
    300.0,
    600.0,
    1800.0,
    3600.0,
)  # [s]
_N_TICKS = 10  # at most
_WINDOW = 20  # messages that show a rate to an eighth


class Finding(NamedTuple):
    """Something that can be computed from a log, or cannot, and one sentence of advice."""

    what: str
    state: str  # ok, weak or failed
    advice: str


class Bar(NamedTuple):
    """A rectangle along the timeline."""

    x: float
    width: float
    shade: float  # 0 to 1
    title: str


class Lane(NamedTuple):
    """The messages of one topic along the timeline."""

    topic: str
    rate: str
    bars: Sequence[Bar]
    gaps: Sequence[Bar]


class Timeline(NamedTuple):
    """The lanes of a log, its stops, and its gimbal's angle as points of a line."""

    lanes: Sequence[Lane]
    stops: Sequence[Bar]
    line: str
    angles: tuple[str, str]  # smallest and largest
    ticks: Sequence[tuple[float, str]]


def recording_page(
    frame: Frame,
    recording: Row,
    preflight: Mapping[str, Any],
    jobs: Sequence[Row],
    surveys: Sequence[str],
) -> str:
    """Return the page of a recording.

    Parameters
    ----------
    frame : Frame
        The frame of the page.
    recording : mapping
        Its row.
    preflight : mapping
        Its preflight report.
    jobs : sequence of mapping
        Its jobs, newest first.
    surveys : sequence of str
        Surveys that it can be processed for.

    Returns
    -------
    str
        HTML.
    """
    found = findings(preflight)
    return render(
        "recording.html",
        frame=frame,
        recording=recording,
        preflight=preflight,
        jobs=jobs,
        surveys=surveys,
        can=[one for one in found if one.state == "ok"],
        cannot=[one for one in found if one.state != "ok"],
        timeline=timeline_of(preflight),
        readouts=readouts(preflight),
        is_cut=preflight["code"] == "input.recording.truncated",
    )


def findings(preflight: Mapping[str, Any]) -> list[Finding]:
    """Return what can be computed from a log, and what cannot, in the order of use."""
    has = preflight.get
    if has("verdict") == "refused":
        reason = next(iter(has("reasons") or ()), "The log cannot be read.")
        return [Finding("Centres of spheres and positions of stations", "failed", str(reason))]
    coverage, gap = has("gimbal_coverage_deg") or 0.0, has("coverage_gap_deg")
    reach = None if gap is None else _SPHERE_M / max(float(gap) * 0.0174533, 1e-9)
    return [
        Finding(
            "Centres of spheres",
            "ok" if has("has_shot_times") else "weak",
            "Every return has a time of its own."
            if has("has_shot_times")
            else "Returns have no times: let the driver publish the field time, or let the gimbal "
            "rest while it scans.",
        ),
        Finding(
            "Both faces of every marker",
            "ok" if coverage >= _FULL_DEG else "weak",
            "The gimbal turned by a full turn at every stop."
            if coverage >= _FULL_DEG
            else f"The gimbal turned by {coverage:.0f} deg: turn it by 360 deg at every stop.",
        ),
        _small_spheres(reach),
        Finding(
            "Levelled heights",
            "ok" if has("has_orientation") else "weak",
            "Orientations were recorded."
            if has("has_orientation")
            else "No orientation was recorded: record the IMU (sensor_msgs/msg/Imu), or let three "
            "or more control marks level the scan.",
        ),
        Finding(
            "The mounting of the LiDAR",
            "ok" if has("rig") else "failed",
            f"The log describes it (rig {has('rig')})."
            if has("rig")
            else "The log has no /tf_static from the gimbal to the LiDAR: record it, or give a rig "
            "to the survey.",
        ),
    ]


def _small_spheres(reach: float | None) -> Finding:
    """Return how far spheres of the usual size are met by scan lines."""
    what = "Small spheres far away"
    if reach is None:
        return Finding(
            what, "weak", "The distance of scan lines is not known without times of returns."
        )
    if reach < 15.0:
        return Finding(
            what,
            "weak",
            f"Spheres of 0.2 m can hide between scan lines beyond {reach:.1f} m: turn the gimbal "
            "slower, or so that its time for a turn is no multiple of the LiDAR's.",
        )
    return Finding(what, "ok", f"Scan lines meet spheres of 0.2 m up to {reach:.0f} m.")


def readouts(preflight: Mapping[str, Any]) -> list[Readout]:
    """Return the key numbers of a log."""
    has = preflight.get
    if not has("n_returns"):
        return []
    return [
        Readout("Returns", f"{has('n_returns'):,}", "", f"in {number(has('duration_s'), 1)} s"),
        Readout("Stops", str(has("n_stops")), "", "rover still, gimbal turning"),
        Readout(
            "Gimbal",
            number(has("gimbal_coverage_deg"), 0),
            "deg",
            f"at {number(has('gimbal_speed_deg_per_s'), 1)} deg/s",
        ),
        Readout(
            "LiDAR",
            number(has("lidar_speed_rpm"), 0),
            "rpm",
            f"clock skew {number(has('clock_skew_s'), 3)} s",
        ),
    ]


def timeline_of(preflight: Mapping[str, Any]) -> Timeline | None:
    """Return the timeline of a log; none without messages at different times."""
    duration = float(preflight["log_duration_s"])
    topics = [one for one in preflight["topics"] if one["counts"]]
    if duration <= 0.0 or not topics:
        return None
    scale = _WIDTH / duration
    times, angles = preflight["gimbal_times_s"], preflight["gimbal_angles_deg"]
    low, high = (min(angles), max(angles)) if angles else (0.0, 0.0)
    tall = _ANGLE_HEIGHT / ((high - low) or 1.0)
    step = next((one for one in _TICKS if duration / one <= _N_TICKS), duration)
    return Timeline(
        lanes=[_lane(one, scale) for one in topics],
        stops=[
            Bar(scale * begin, scale * (end - begin), 1.0, f"stop {i}: {begin:.1f} to {end:.1f} s")
            for i, (begin, end) in enumerate(preflight["stop_spans_s"], start=1)
        ],
        line=" ".join(
            f"{scale * time:.1f},{tall * (high - angle):.1f}"
            for time, angle in zip(times, angles, strict=True)
        ),
        angles=(number(low, 0), number(high, 0)),
        ticks=[
            (100.0 * i * step / duration, f"{i * step:g}") for i in range(int(duration / step) + 1)
        ],
    )


def _lane(topic: Mapping[str, Any], scale: float) -> Lane:
    """Return the messages of a topic: runs of equal density, and its pauses."""
    density = _density(topic["counts"])
    width = _WIDTH / len(density)
    bars: list[Bar] = []
    for i, shade in enumerate(density):
        if bars and bars[-1].shade == shade:
            bars[-1] = bars[-1]._replace(width=bars[-1].width + width)
        else:
            bars.append(Bar(i * width, width, shade, ""))
    return Lane(
        topic=topic["topic"],
        rate=f"{number(topic['rate_hz'], 1)} Hz"
        if topic["n_messages"] > 1
        else f"{topic['n_messages']} message",
        bars=[bar for bar in bars if bar.shade],
        gaps=[
            Bar(scale * begin, max(scale * (end - begin), 2.0), 1.0, f"{end - begin:.2f} s silent")
            for begin, end in topic["gaps_s"]
        ],
    )


def _density(counts: Sequence[int]) -> list[float]:
    """Return the density of messages against the usual one, in quarters; 0 where there are none.

    Counted over windows of twenty messages or more, so that few messages show no pattern of chance.
    """
    n, n_messages = len(counts), sum(counts)
    half = min(n, -(-_WINDOW * n // max(n_messages, 1))) // 2
    windows = [sum(counts[max(0, i - half) : i + half + 1]) for i in range(n)]
    widths = [min(n, i + half + 1) - max(0, i - half) for i in range(n)]
    rates = [count / width for count, width in zip(windows, widths, strict=True)]
    filled = [i for i, count in enumerate(counts) if count]
    usual = median(rates[i] for i in filled)
    return [
        max(0.25, min(1.0, round(4.0 * rate / usual) / 4.0))
        if filled[0] <= i <= filled[-1] and rate
        else 0.0
        for i, rate in enumerate(rates)
    ]
