import weakref
from dataclasses import replace

import numpy as np
import pytest

from spheremark.pipelines.accuracy.truth import marker_errors, station_error
from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.errors import MissingRigError, NoMarkersError
from spheremark.pipelines.model import ControlMarks, NoFix, Status
from spheremark.pipelines.simulation import SimulationConfig, scenario, simulate_stop
from spheremark.pipelines.survey import process

OURS = ("along_beam", "free_station")
CONFIG = SurveyConfig.from_mapping({"fitting": {"methods": ["along_beam"]}})


@pytest.fixture(scope="module")
def field():
    return scenario("paper-field", 17)


@pytest.fixture(scope="module")
def stop(field):
    return simulate_stop(field, "lane3-stop4", SimulationConfig(only_near_spheres=True))


def some_of(marks, chosen):
    return ControlMarks(
        names=tuple(marks.names[i] for i in chosen),
        p_site=marks.p_site[chosen],
        cov_p_site=marks.cov_p_site[chosen],
    )


def part_of(log, share):
    """The first part of a log, as if the recorder had been stopped."""
    end = log.stamps_lidar_ns[0] + int(share * np.ptp(log.stamps_lidar_ns))
    shots, joints = log.stamps_lidar_ns <= end, log.stamps_gimbal_ns <= end + 20_000_000
    return replace(
        log,
        p_lidar=log.p_lidar[shots],
        intensities=log.intensities[shots],
        rings=log.rings[shots],
        stamps_lidar_ns=log.stamps_lidar_ns[shots],
        gimbal_angles=log.gimbal_angles[joints],
        stamps_gimbal_ns=log.stamps_gimbal_ns[joints],
    )


def test_a_simulated_stop_is_positioned_within_what_its_covariances_say(field, stop):
    (result,) = process(stop.log, config=CONFIG, marks=field.marks)
    errors = marker_errors(result.fits["along_beam"], stop.truth, field.marks)
    fix = result.fixes[OURS]
    assert (errors.marks >= 0).sum() == 14
    assert np.nanmax(errors.error_3d) < CONFIG.tolerance
    error = station_error(fix.T_site_station, stop.truth).error_site
    assert error @ np.linalg.solve(fix.cov_p_site, error) < 21.1  # 99.99 % of chi-square with 3
    assert fix.status is Status.OK


def test_a_turn_under_half_is_a_weak_fix_that_says_so(field, stop):
    (result,) = process(part_of(stop.log, 0.4), config=CONFIG, marks=field.marks)
    fix = result.fixes[OURS]
    assert fix.status is Status.WEAK
    assert "under 180 deg" in fix.reason


def test_two_control_marks_among_all_markers_give_a_weak_fix_near_the_truth(field, stop):
    rise = np.abs(np.subtract.outer(field.marks.p_site[:, 2], field.marks.p_site[:, 2]))
    pair = list(np.unravel_index(np.argmax(rise), rise.shape))
    (result,) = process(stop.log, config=CONFIG, marks=some_of(field.marks, pair))
    fix = result.fixes[OURS]
    assert fix.status is Status.WEAK
    assert "only two marks" in fix.reason
    assert station_error(fix.T_site_station, stop.truth).error_3d < 5 * fix.sigma_3d


def test_one_control_mark_costs_the_position_and_no_marker(field, stop):
    (result,) = process(stop.log, config=CONFIG, marks=some_of(field.marks, [0]))
    assert isinstance(result.fixes[OURS], NoFix)
    assert "One control mark gives no position" in result.fixes[OURS].reason
    assert len(result.fits["along_beam"].fits) == 14


def test_without_control_marks_there_are_centres_and_no_position(stop):
    (result,) = process(stop.log, config=CONFIG)
    assert result.fixes == {}
    assert len(result.fits["along_beam"].fits) == 14


def test_spheres_of_another_size_are_no_markers(stop):
    config = SurveyConfig.from_mapping({**CONFIG.to_mapping(), "marker_radius": 0.4})
    with pytest.raises(NoMarkersError, match=r"show no sphere of radius 0\.400 m"):
        process(stop.log, config=config)


def test_possible_markers_are_named_where_none_is_sure(stop):
    strict = replace(CONFIG, extraction=replace(CONFIG.extraction, false_rate=1e-9))
    with pytest.raises(NoMarkersError, match=r"likeliest of \d+ possible ones, \d\.\d m away"):
        process(stop.log, config=strict)


def test_a_log_without_a_rig_is_refused_and_a_given_one_serves(stop):
    bare = replace(stop.log, rig=None)
    with pytest.raises(MissingRigError, match="rig"):
        process(bare, config=CONFIG)
    (result,) = process(bare, config=CONFIG, rig=stop.log.rig)
    assert len(result.fits["along_beam"].fits) == 14


def test_progress_rises_and_may_stop_the_work(stop):
    seen = []
    process(stop.log, config=CONFIG, progress=lambda share, what: seen.append((share, what)))
    shares = [share for share, _ in seen]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0

    def stop_it(_share, _what):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        process(stop.log, config=CONFIG, progress=stop_it)


def test_a_log_that_nobody_else_keeps_is_let_go_once_it_is_stitched(stop):
    logs = [replace(stop.log, p_lidar=stop.log.p_lidar.copy())]
    returns = weakref.ref(logs[0].p_lidar)
    is_kept = {}
    process(
        logs.pop(),
        config=CONFIG,
        progress=lambda _share, what: is_kept.update({what.split()[0]: returns() is not None}),
    )
    assert is_kept["Stitching"]
    assert not is_kept["Extracting"]
