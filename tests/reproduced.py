"""A reproduction made up of known errors, for tests of its tables, statements and page."""

import numpy as np

from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.evaluation.reproduction.noise import RangeNoise
from spheremark.pipelines.evaluation.reproduction.plan import (
    CENTRE,
    CENTRE_REAL,
    DISTANCES,
    DISTANCES_REAL,
    FULL_SPHERE,
    GROUND,
    LANE_2,
    OURS,
    PAPER,
    Scan,
)
from spheremark.pipelines.evaluation.reproduction.scans import Example, Reproduction, columns_of
from spheremark.pipelines.published import TABLE_2

SIGMA = {OURS: 0.001, PAPER: 0.003, FULL_SPHERE: 0.003, GROUND: 0.003}  # [m] per axis at 8 m
BIAS = {OURS: 0.0, PAPER: -0.027, FULL_SPHERE: -0.06, GROUND: -0.012}  # [m] towards the scanner


def scans():
    """Two worlds at the centre stop, lane 2, and level ground with two times of a turn."""
    centre = [
        Scan(series=CENTRE, scenario="paper-field", stop="lane3-stop4", seed=i, turn=13.2)
        for i in range(2)
    ]
    lane = [
        Scan(series=LANE_2, scenario="paper-field", stop=f"lane2-stop{i + 1}", seed=0, turn=13.2)
        for i in range(7)
    ]
    level = [
        Scan(series=series, scenario="range-lane", stop="centre", seed=0, turn=turn)
        for series in (DISTANCES, DISTANCES_REAL)
        for turn in (6.6, 13.2)
    ]
    real = Scan(series=CENTRE_REAL, scenario="paper-field", stop="lane3-stop4", seed=0, turn=13.2)
    return (*centre, *lane, *level, real)


def reproduction(seed=3):
    rng = np.random.default_rng(seed)
    plan = scans()
    rows = [row for i, scan in enumerate(plan) for row in _centres(i, scan, rng)]
    return Reproduction(
        scans=plan,
        n_marks=np.array([14] * 9 + [88] * 4 + [14]),
        centres=columns_of(rows),
        example=example(rng),
        noise=RangeNoise(
            sigmas=np.array([np.nan, 0.0107, 0.0089, np.nan, np.nan]), n=np.array([0, 90, 80, 3, 0])
        ),
        config=SurveyConfig(),
    )


def _centres(i, scan, rng):
    is_centre = scan.series in (CENTRE, CENTRE_REAL)
    methods = [OURS, PAPER] + ([FULL_SPHERE, GROUND] if is_centre else [])
    is_lane = scan.scenario == "range-lane"
    ranges = np.repeat(np.arange(5.0, 30.1, 2.5), 8) if is_lane else TABLE_2.ranges
    n = len(ranges)
    names = np.repeat(methods, n)
    sigmas = np.array([SIGMA[name] for name in names]) * np.tile(ranges, len(methods)) / 8.0
    errors = rng.normal(size=(len(names), 3)) * sigmas[:, None]
    errors[:, 0] += [BIAS[name] for name in names]
    counts = np.tile(np.ceil(6800.0 * scan.turn / 13.2 / ranges**2), len(methods))
    incidences = rng.uniform(0.7, 0.9, len(names))
    origin = {"stop": scan.stop, "series": scan.series, "world": scan.seed, "turn_s": scan.turn}
    return [
        {
            "scan": i,
            **origin,
            "fit_method": str(name),
            "marker": f"P{k % n + 1:02d}",
            "mark": f"P{k % n + 1:02d}",
            "status": "ok",
            "reason": "",
            "range_m": ranges[k % n],
            "n_points": int(counts[k]),
            "incidence_deg": np.degrees(incidences[k]),
            "sigma_3d_m": 0.002,
            "rms_m": 0.009,
            "error_towards_m": errors[k, 0],
            "error_left_m": errors[k, 1],
            "error_up_m": errors[k, 2],
            "error_3d_m": np.linalg.norm(errors[k]),
        }
        for k, name in enumerate(names)
    ]


def example(rng):
    points = rng.normal(size=(120, 3))
    points *= 0.1 / np.linalg.norm(points, axis=1, keepdims=True)
    points[:, 0] = -np.abs(points[:, 0])
    return Example(
        mark="P01",
        distance=7.19,
        points_station=points,
        is_left=points[:, 2] > -0.02,
        cut=-0.02,
        ground=-0.06,
        radius=0.1,
        centres_station={
            OURS: np.array([0.001, 0.0, 0.0]),
            PAPER: np.array([-0.02, 0.0, 0.01]),
            FULL_SPHERE: np.array([-0.05, 0.0, 0.03]),
        },
    )
