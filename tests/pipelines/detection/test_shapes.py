"""What holds an object up, as the beams below it meet it."""

import numpy as np
import pytest

from spheremark.pipelines.detection.beams import Beams
from spheremark.pipelines.detection.shapes import (
    BOULDER,
    EDGE,
    FORM,
    MEAN,
    N_PARAMETERS,
    NAMES,
    NOISE,
    POLE,
    SPHERE,
    STONE,
    Z,
    _on_stone,
    log_likelihood,
)

BLUR, NOISE_OF_RANGES = 0.01, 0.05  # half the width of a beam, and the noise, in radii
STONE_RADIUS = 2.0


def beams_below(depths_of):
    """Beams in front of and below a sphere about the origin; none of those below is beside it."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-0.4, 0.4, 5), np.linspace(-2.5, 0.5, 13)))
    on, ones = np.hypot(x, y) < 1.0, np.ones(x.size)
    depths = np.where(on, -np.sqrt(np.maximum(1.0 - x**2 - y**2, 0.0)), depths_of(x, y))
    return Beams(
        x=x,
        y=y,
        z=depths,
        face=0.5 * ones,
        behind=np.where(depths < 3.0, 0.05, 0.9),
        wide=0.0 * ones,
        empty=ones,
        even=0.0 * ones,
        away=40.0 * ones,
        merged=0.0 * ones,
        widths=np.array([[BLUR, 0.0], [BLUR, 0.0]]),
        lost=0.02,
        faintest=0.5,
    )


def log_of(kind, beams, stone):
    """Logarithm of the likelihood where a stone holds a sphere up with some probability."""
    prior = np.zeros((2, N_PARAMETERS))
    prior[0, [Z, NOISE, EDGE, POLE]] = -MEAN, np.log(NOISE_OF_RANGES), 0.5, np.log(0.2)
    prior[0, STONE], prior[1, POLE] = stone, float(kind == SPHERE)
    shape, densities = prior[0].copy(), np.empty(len(beams.x))
    shape[FORM : FORM + 3] = 0.0
    return log_likelihood(kind, shape, prior, beams, densities), densities


def on_stone(top):
    """Depths on a round stone whose top is some way below the centre of what it holds."""

    def depths(x, y):
        up = y + top + STONE_RADIUS  # above its own centre
        return -np.sqrt(np.maximum(STONE_RADIUS**2 - up**2 - x**2, 0.0))

    return depths


def past(x, _):
    """Depths of beams that go past."""
    return np.full(x.shape, 20.0)


def test_a_stone_is_round_on_top():
    down = 0.3
    half = np.sqrt(2.0 * STONE_RADIUS * down)  # of its chord, not far below its top
    assert _on_stone(0.9 * half, 0.0, (down, down), BLUR)[0] == pytest.approx(1.0)
    assert _on_stone(1.1 * half, 0.0, (down, down), BLUR)[0] == 0.0
    assert _on_stone(0.9 * half, 0.0, (down, -0.1), BLUR)[0] == pytest.approx(0.5)
    depths = np.linspace(-2.0, 1.5, 351)
    densities = [_on_stone(0.0, float(one), (down, down), BLUR)[1] for one in depths]
    assert depths[int(np.argmax(densities))] == pytest.approx(-half, abs=0.02)
    mixed = [_on_stone(0.0, float(one), (down, 0.2 * down), BLUR)[1] for one in depths]
    for one in (densities, mixed):
        assert np.trapezoid(one, depths) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("kind", [SPHERE, BOULDER], ids=[NAMES[SPHERE], NAMES[BOULDER]])
@pytest.mark.parametrize("depths_of", [on_stone(0.8), on_stone(1.0), past])
def test_a_stone_or_else_a_pole_holds_it_up(kind, depths_of):
    beams, share = beams_below(depths_of), 0.3
    (without, densities), (certain, _) = (log_of(kind, beams, stone) for stone in (0.0, 1.0))
    found, weighted = log_of(kind, beams, share)
    expected = np.logaddexp(np.log(1.0 - share) + without, np.log(share) + certain)
    assert found == pytest.approx(expected, abs=1e-6)
    assert (certain > without + 10.0) == (depths_of is not past)
    is_below = beams.y < -0.8
    np.testing.assert_allclose(weighted[~is_below], densities[~is_below])
    assert np.allclose(weighted[is_below], densities[is_below], rtol=0.01) == (depths_of is past)
