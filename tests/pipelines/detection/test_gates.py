"""Echoes of a sphere and of what stands behind it that are one, with a range between the two."""

import numpy as np
import pytest
from scipy.stats import norm

from spheremark.pipelines.detection.beams import GATES, Beams, merged_within
from spheremark.pipelines.detection.decision import gates_of
from spheremark.pipelines.detection.shapes import (
    EDGE,
    N_PARAMETERS,
    NOISE,
    POLE,
    SCATTER,
    SPHERE,
    log_likelihood,
)

RADIUS, BLUR, NOISE_OF_RANGES = 0.1, 0.2, 0.05


def beams_before_a_wall(rng, away, *, is_merged):
    """Beams on a lattice, on a sphere and on a wall so many radii behind its centre."""
    axis = np.arange(-1.5, 1.5, 0.15)
    x, y = (values.ravel() for values in np.meshgrid(axis, axis))
    off = np.hypot(x, y)
    depth = -np.sqrt(np.maximum(1.0 - off**2, 0.0))
    share = np.clip(0.5 + 0.5 * (1.0 - off) / BLUR, 0.0, 1.0)  # of a beam on the sphere
    z = np.where(share > 0.5, depth, away)
    if is_merged:
        z = share * depth + (1.0 - share) * away
    z += NOISE_OF_RANGES * rng.normal(size=len(x))
    ones = np.ones(len(x))
    return Beams(
        x=x,
        y=y,
        z=z,
        face=0.5 * ones,
        behind=1.0 / 12.0 + 0.5 * norm.pdf(z, away, 2.0 * NOISE_OF_RANGES),
        wide=0.0 * ones,
        empty=0.0 * ones,
        even=0.0 * ones,
        away=away * ones,
        merged=0.0 * ones,
        widths=np.array([[BLUR, 0.0], [BLUR, 0.0]]),
        lost=0.02,
        faintest=0.1,
    )


def by_gate(beams):
    """The logarithms of the likelihoods of the sphere that is there."""
    shape, prior = np.zeros(N_PARAMETERS), np.zeros((2, N_PARAMETERS))
    shape[NOISE], shape[SCATTER], shape[EDGE : EDGE + 2] = np.log(NOISE_OF_RANGES), -9.0, 0.0
    shape[2], shape[POLE] = -2.0 / 3.0, np.log(0.2)
    return np.array(
        [
            log_likelihood(
                SPHERE,
                shape,
                prior,
                merged_within(beams, gate, RADIUS),
                np.empty(len(beams.x)),
            )
            for gate in np.eye(len(GATES))
        ]
    )


@pytest.mark.parametrize("away", [1.5, 2.5, 4.5])
def test_merged_echoes_show_a_gate_beyond_their_distance(away):
    rng = np.random.default_rng(5)
    logs = np.array([by_gate(beams_before_a_wall(rng, away, is_merged=True)) for _ in range(3)])
    gates = gates_of(logs, [0.99, 0.98, 0.5])
    assert gates.sum() == pytest.approx(1.0)
    assert gates[away * RADIUS < GATES].sum() > 0.999


def test_separate_echoes_before_a_wall_show_no_gate_beyond_its_distance():
    rng = np.random.default_rng(6)
    logs = np.array([by_gate(beams_before_a_wall(rng, 2.5, is_merged=False)) for _ in range(3)])
    assert gates_of(logs, [0.99, 0.98, 0.5])[GATES > 0.25].sum() < 1e-3


def test_what_is_no_marker_shows_no_gate():
    logs = by_gate(beams_before_a_wall(np.random.default_rng(7), 2.5, is_merged=True))
    assert gates_of(logs[None], [0.0])[0] == pytest.approx(0.5)
