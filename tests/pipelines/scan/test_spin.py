"""Instants of pulses whose messages have one time only, against those of the simulator."""

from dataclasses import replace

import numpy as np
import pytest

from spheremark.pipelines.config import ExtractionConfig, StitchingConfig
from spheremark.pipelines.detection.cells import cells_of
from spheremark.pipelines.detection.evidence import gather_evidence
from spheremark.pipelines.detection.ground import ground_of
from spheremark.pipelines.detection.target import Target
from spheremark.pipelines.geometry import inverse, transform
from spheremark.pipelines.scan.firings import clock_of
from spheremark.pipelines.scan.rigs import AZIMUTH_STEP
from spheremark.pipelines.scan.spin import stamps_by_spin
from spheremark.pipelines.scan.stitching import stitch
from spheremark.pipelines.simulation import SimulationConfig, scenario, simulate_stop

CONFIG = SimulationConfig(
    step=np.radians(2.0), rest_revolutions=4, move=0.06, has_rings=False, sweep=np.radians(40.0)
)
EXTRACTION = ExtractionConfig()
CYCLE_NS = 55_296


@pytest.fixture(scope="module")
def timed():
    """A stop of a gimbal that rests and moves in turn, with the time of every pulse."""
    return simulate_stop(scenario("paper-field", 2), "lane3-stop4", CONFIG)


@pytest.fixture(scope="module")
def by_message(timed):
    """The same log as a driver writes it that stamps revolutions."""
    begin = timed.log.stamps_lidar_ns[0] // 100_000_000 * 100_000_000
    stamps_ns = begin + (timed.log.stamps_lidar_ns - begin) // 100_000_000 * 100_000_000
    return replace(timed.log, stamps_lidar_ns=stamps_ns, has_pulse_times=False)


@pytest.fixture(scope="module")
def cloud(by_message):
    return stitch(by_message, by_message.rig, StitchingConfig())


def rings_of(log):
    elevations = np.arctan2(log.p_lidar[:, 2], np.hypot(*log.p_lidar[:, :2].T))
    return np.abs(elevations[:, None] - log.rig.laser_elevations).argmin(axis=1).astype(np.uint8)


def found(log, rings=None, rows=slice(None)):
    rings = rings_of(log) if rings is None else rings
    good = np.ones(len(rings), np.bool_)
    return stamps_by_spin(
        log.p_lidar[rows], rings[rows], log.stamps_lidar_ns[rows], good[rows], log.rig
    )


def test_the_spin_shows_when_every_pulse_was_fired(timed, by_message):
    off_ns = found(by_message) - timed.log.stamps_lidar_ns
    # one constant for all: all messages follow each other
    assert np.mean(np.abs(off_ns - np.median(off_ns)) < 10) > 0.999
    assert np.abs(np.median(off_ns)) < 100_000_000


def test_pulses_after_a_pause_are_a_whole_number_of_firings_later(timed, by_message):
    seconds = (by_message.stamps_lidar_ns - by_message.stamps_lidar_ns[0]) * 1e-9
    rows = (seconds % 3.0) < 2.0
    off_ns = found(by_message, rows=rows) - timed.log.stamps_lidar_ns[rows]
    off_ns -= off_ns[0]
    assert len(np.unique(off_ns // CYCLE_NS)) > 1
    rest = off_ns % CYCLE_NS
    assert np.mean(np.minimum(rest, CYCLE_NS - rest) < 10) > 0.999


def test_returns_in_another_order_than_that_of_firing_keep_the_times_of_their_messages(by_message):
    rings = rings_of(by_message)
    by_laser = np.lexsort((np.arange(len(rings)), rings, by_message.stamps_lidar_ns))
    assert found(by_message, rows=by_laser) is None
    shuffled = np.random.default_rng(4).permutation(len(rings))
    assert found(by_message, rows=shuffled) is None


def test_unknown_lasers_and_other_lidars_keep_the_times_of_their_messages(by_message):
    assert found(by_message, rings=by_message.rings) is None
    other = replace(
        by_message.rig,
        laser_elevations=np.radians(np.linspace(-16.0, 15.0, 32)),
        laser_heights=np.zeros(32),
        laser_range_biases=np.zeros(32),
    )
    assert found(replace(by_message, rig=other), rings_of(by_message)) is None


def test_the_gimbal_is_at_rest_at_all_pulses_whose_times_are_found(cloud):
    steps = np.degrees(cloud.gimbal_angles[:] - cloud.gimbal_angles[0]) / 2.0
    assert np.abs(steps - np.rint(steps)).max() < 0.03
    assert len(np.unique(cloud.seconds(slice(0, 20_000)))) > 10_000


def test_silent_pulses_are_known_and_none_are_made_up_in_pauses(cloud, timed):
    field = scenario("paper-field", 2)
    marks = transform(inverse(timed.truth.T_site_base), field.marks.p_site)
    cells = cells_of(cloud, EXTRACTION)
    target = Target(field.marker_radius, cells.R_station_base[2], 0.003)
    ground = ground_of(cloud, cells, EXTRACTION, field.marker_radius)
    evidence, _ = gather_evidence(cloud, cells, ground, marks, target)
    n_inside, n_on, n_beside = 0, 0, 0
    for seen in evidence:
        gaps = np.hypot(*seen.silent[:2]) / field.marker_radius
        n_inside += np.sum(gaps < 0.8)
        n_beside += np.sum(gaps > 1.5)
        n_on += seen.n_on
    assert n_inside < 0.02 * n_on  # drop-outs alone
    assert n_beside > 0.1 * n_on


def test_azimuths_of_the_clock_are_better_than_they_are_recorded(timed):
    clock, why_not = clock_of(stitch(timed.log, timed.log.rig, StitchingConfig()))
    assert not why_not
    times = clock.times - clock.times.mean()
    even = np.polynomial.Polynomial.fit(times, clock.azimuths, 1)  # the simulator's spin is steady
    off = clock.azimuths - even(times)
    rounded = AZIMUTH_STEP / np.sqrt(12.0)
    assert np.sqrt(np.mean(off**2)) < 0.5 * rounded
    assert np.abs(off).max() < AZIMUTH_STEP
