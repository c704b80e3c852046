"""A whole simulated survey from ranges to a network, against the truth of the world."""

from dataclasses import replace

import numpy as np
import pytest

from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.errors import TruthError
from spheremark.pipelines.model import ControlMarks, StopTruth, Truth
from spheremark.pipelines.network import adjust_network, assemble, compare
from spheremark.pipelines.positioning.resection import resect
from spheremark.pipelines.simulation import SimulationConfig, scenario, simulate_stop
from spheremark.pipelines.survey import process
from tests.synthetic import control, field, pose, sightings

CONFIG = SurveyConfig.from_mapping({"fitting": {"methods": ["along_beam"]}})
WORLD = SimulationConfig(only_near_spheres=True, sigma_range=0.020)


def truth_of(marks, poses):
    stops = tuple(StopTruth(name=name, T_site_base=T) for name, T in poses.items())
    return Truth(marks=marks, stops=stops, rig=None)


def small_survey(with_control=None):
    """A network of three stations with noise, on some marks as control or free, and its truth."""
    rng = np.random.default_rng(3)
    marks = field(rng)
    poses = {f"S{i}": pose(rng.uniform(-3, 3, 3), rng.uniform(-3, 3)) for i in range(3)}
    scans = [
        (name, sightings(marks, T, noise=rng.normal(0, 4e-3, (14, 3))))
        for name, T in poses.items()
    ]  # fmt: skip
    given = None if with_control is None else marks_of(marks, with_control)
    network = assemble(scans, given, CONFIG.resection)
    return adjust_network(network, CONFIG.resection), truth_of(marks, poses)


def marks_of(marks, n):
    """The first marks, as exact control."""
    return ControlMarks(
        names=marks.names[:n], p_site=marks.p_site[:n], cov_p_site=np.zeros((n, 3, 3))
    )


@pytest.fixture
def small():
    return small_survey()


def test_a_network_compares_alike_with_a_truth_that_was_moved(small):
    result, truth = small
    motion = pose([40.0, -7.0, 2.0], 1.0, (0.3, -0.2))
    marks = control(truth.marks.p_site @ motion[:3, :3].T + motion[:3, 3])
    moved = truth_of(marks, {one.name: motion @ one.T_site_base for one in truth.stops})
    here, there = compare(result, truth), compare(result, moved)
    np.testing.assert_allclose(there.error_marks, here.error_marks, atol=1e-9)
    np.testing.assert_allclose(there.error_stations, here.error_stations, atol=1e-9)
    assert there.nees_marks == pytest.approx(here.nees_marks, rel=1e-6)
    assert 1e-3 < here.rms_marks < 6e-3
    assert 0.3 < here.nees_marks < 2.0


def test_marks_that_were_given_as_exact_say_nothing_of_the_covariance():
    whole, part = (compare(*small_survey(n)) for n in (14, 5))
    assert np.isnan(whole.nees_marks)
    assert np.isfinite(whole.nees_stations)
    assert 0.3 < part.nees_marks < 2.0


def test_a_mark_that_is_none_is_called_false(small):
    result, truth = small
    keep = np.arange(1, 14)
    fewer = replace(truth, marks=control(truth.marks.p_site[keep]))
    errors = compare(result, fewer)
    assert np.sum(errors.marks < 0) == 1
    assert np.isnan(errors.error_marks[errors.marks < 0]).all()


def test_the_truth_of_another_survey_is_refused(small):
    result, truth = small
    with pytest.raises(TruthError, match="0 stations"):
        compare(result, replace(truth, stops=()))


@pytest.fixture(scope="module")
def scanned():
    """Truth and centres of every other stop of one world, 18 of 35."""
    world = scenario("paper-field", 77)
    scans, poses = [], {}
    for stop in world.stops[::2]:
        made = simulate_stop(world, stop.name, WORLD)
        (found,) = process(made.log, config=CONFIG)
        scans.append((stop.name, found.fits["along_beam"]))
        poses[stop.name] = made.truth.T_site_base
    return truth_of(world.marks, poses), scans


@pytest.fixture(scope="module")
def half(scanned):
    """Errors of the network of these stops."""
    truth, scans = scanned
    result = adjust_network(assemble(scans, None, CONFIG.resection), CONFIG.resection)
    assert len(result.network.stations) == 18
    return compare(result, truth)


@pytest.mark.slow
def test_half_a_survey_of_the_study_s_field_reaches_a_millimetre(half):
    """Errors of marks are 1.4 times those of all stops.

    Means over 38 worlds with all stops: marks 0.53 mm, stations 0.83 mm, NEES 1.1.
    """
    assert np.all(half.marks >= 0)
    assert half.rms_marks < 1.15e-3  # 0.74 mm is usual; 0.7 mm of all stops would be 0.98 mm
    assert half.rms_stations < 1.5e-3
    assert 0.5 < half.nees_marks < 1.8  # one world: 36 degrees of freedom


@pytest.mark.slow
def test_stations_of_half_a_survey_are_as_good_as_they_say(half):
    """Of sixteen other worlds (even seeds 78 to 92 and 100 to 114) the mean is 1.04."""
    assert 0.6 < half.nees_stations < 1.6


@pytest.mark.slow
def test_heights_of_single_stations_are_as_good_as_they_say(scanned):
    """Of sixteen other worlds, 288 stations, the mean is 0.98.

    It would be 3.2 if the edges above and below were taken as known: a scan cannot tell a height
    of all spheres from a difference between these edges.
    """
    truth, scans = scanned
    squares = []
    for (_, fits), stop in zip(scans, truth.stops, strict=True):
        fix = resect("free_station", fits, truth.marks, CONFIG.resection)
        off = fix.T_site_station[2, 3] - stop.T_site_base[2, 3]
        squares.append(off**2 / fix.cov_p_site[2, 2])
    assert 0.27 < np.mean(squares) < 2.35  # chi-square of 18 degrees of freedom, 0.1 % on each side
