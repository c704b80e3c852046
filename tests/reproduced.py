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
from spheremark.pipelines.evaluation.reproduction.scans import Centres, Example, Reproduction
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
    tables = [_centres(i, scan, rng) for i, scan in enumerate(plan)]
    joined = {
        name: np.concatenate([table[name] for table in tables])
        for name in ("scans", "ranges", "n_points", "incidences", "error_station", "rms")
    }
    return Reproduction(
        scans=plan,
        n_marks=np.array([14] * 9 + [88] * 4 + [14]),
        centres=Centres(
            **joined,
            sigma_3d=np.full(len(joined["scans"]), 0.002),
            methods=tuple(name for table in tables for name in table["methods"]),
            marks=tuple(name for table in tables for name in table["marks"]),
        ),
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
    return {
        "scans": np.full(len(names), i, dtype=np.intp),
        "methods": names.tolist(),
        "marks": [f"P{k % n + 1:02d}" for k in range(len(names))],
        "ranges": np.tile(ranges, len(methods)),
        "n_points": counts,
        "incidences": rng.uniform(0.7, 0.9, len(names)),
        "error_station": errors,
        "rms": np.full(len(names), 0.009),
    }


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
