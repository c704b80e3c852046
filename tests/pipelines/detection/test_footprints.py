"""How wide beams are along the spin axis and how far they scatter: what spheres show of both."""

import numpy as np
import pytest
from scipy import stats

from spheremark.pipelines.detection.beams import Beams
from spheremark.pipelines.detection.hypotheses import SIGMAS, USUAL
from spheremark.pipelines.detection.search import shared_by
from spheremark.pipelines.detection.shapes import (
    ALONG,
    CYLINDER,
    EDGE,
    FORM,
    MEAN,
    N_PARAMETERS,
    NOISE,
    PANEL,
    SCATTER,
    SOLID,
    SPHERE,
    STRETCH,
    Z,
    _Beam,
    _form_of,
    _inside,
    _surface,
    log_likelihood,
)

NOISE_OF_RANGES, ACROSS = 0.1, 0.2  # radii; half the width of a beam square to the spin axis
SIGMAS_OF_BEAMS = SIGMAS[ALONG - NOISE - 1 : STRETCH - NOISE - 1]  # without the noise


def beams_of(along, sheet, rng, scatter=0.0):
    """Beams at a sphere before an empty sky: how wide along a level spin axis, and by the sheet.

    ``scatter`` is the standard deviation, across and up, of where they pass about where they are
    said to [radii].
    """
    axis = np.arange(-1.7, 1.7, 0.12)
    x, y = (values.ravel() + rng.uniform(0, 0.12) for values in np.meshgrid(axis, axis))
    true_x, true_y = np.array([x, y]) + scatter * rng.normal(size=(2, len(x)))
    off = np.hypot(true_x, true_y)
    blur = np.hypot(along * true_x, ACROSS * true_y) / off
    reach = 1.0 + USUAL[0] * blur
    part = 0.5 * (np.clip(off - blur, 0.0, 1.0) + 1.0)  # the middle of a beam's part on the sphere
    surface = -np.sqrt(1.0 - np.where(off + blur < 1.0, off, part) ** 2)
    surface += NOISE_OF_RANGES * rng.normal(size=len(x))
    ones = np.ones(len(x))
    return Beams(
        x=x,
        y=y,
        z=np.where(off < reach, surface, np.inf),
        face=0.5 * ones,
        behind=np.where(off < reach, 1e-3, 0.9),
        wide=0.0 * ones,
        empty=ones,
        even=0.0 * ones,
        away=np.inf * ones,
        merged=0.0 * ones,
        widths=np.array([[0.0, sheet], [ACROSS, 0.0]]),
        lost=0.02,
        faintest=0.1,
    )


def prior_of():
    """A sphere about the origin in a scan of which nothing is known."""
    prior = np.zeros((2, N_PARAMETERS))
    prior[0, Z], prior[1, : Z + 1] = -MEAN, (0.3, 0.3, 0.4)
    prior[0, NOISE], prior[1, NOISE] = np.log(NOISE_OF_RANGES), 0.3
    prior[0, EDGE : FORM + 1], prior[1, EDGE : FORM + 1] = USUAL, SIGMAS
    prior[1, ALONG:STRETCH] = 0.0
    return prior


def shown_of(parameter, draw, n):
    """What n spheres show of a parameter without a prior, and its standard deviation."""
    prior, own, shown = prior_of(), parameter - NOISE, []
    for _ in range(n):
        values, cov = shared_by(prior[0], prior, SIGMAS_OF_BEAMS, draw())
        begun, sigma = prior[0, parameter], SIGMAS_OF_BEAMS[parameter - ALONG]
        alone = 1.0 / cov[own, own] - sigma**-2.0
        shown.append((alone, values[own] / cov[own, own] - begun / sigma**2))
    information, pulls = np.sum(shown, axis=0)
    return pulls / information, information**-0.5


@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.0])
def test_spheres_show_how_wide_beams_are_along_the_spin_axis(ratio):
    rng, sheet = np.random.default_rng(11), 0.1
    found, sigma = shown_of(ALONG, lambda: beams_of(ratio * sheet, sheet, rng), 8)
    assert sigma < 0.2
    assert found == pytest.approx(np.log(ratio), abs=3.0 * sigma)


@pytest.mark.parametrize("scatter", [0.06, 0.1, 0.16])
def test_spheres_show_how_far_beams_scatter_about_their_directions(scatter):
    """To a factor of 1.7: outlines are softer in the model, even without scatter, than here."""
    rng, half = np.random.default_rng(12), np.sqrt(0.5 * (0.1**2 + ACROSS**2))
    found, sigma = shown_of(SCATTER, lambda: beams_of(0.1, 0.1, rng, scatter), 8)
    assert sigma < 0.2
    assert found == pytest.approx(np.log(scatter / half), abs=np.log(1.7))


@pytest.mark.parametrize("steepness", [0.0, 0.5, 2.0])
def test_the_scatter_of_beams_adds_to_the_noise_of_ranges_on_a_steep_surface(steepness):
    """On a panel: by the scatter times the slope."""
    beams, scatter = beams_of(0.1, 0.1, np.random.default_rng(7)), 0.2
    is_on, half = np.hypot(beams.x, beams.y) < 0.8, np.sqrt(0.5 * (0.1**2 + ACROSS**2))
    columns = [name for name, value in beams._asdict().items() if np.shape(value) == is_on.shape]
    beams = beams._replace(**{name: getattr(beams, name)[is_on] for name in columns})
    beams = beams._replace(z=steepness * beams.x + np.linspace(-0.4, 0.4, is_on.sum()))

    def log_of(noise, scatter):
        prior = prior_of()
        shape, densities = prior[0].copy(), np.empty(len(beams.x))
        shape[Z], shape[NOISE], shape[SCATTER] = 0.0, np.log(noise), np.log(scatter / half)
        shape[FORM : FORM + 4] = np.log(3.0), np.log(3.0), steepness, 0.0
        prior[0] = shape
        return log_likelihood(PANEL, shape, prior, beams, densities)

    rougher = np.hypot(0.1, steepness * scatter)
    assert log_of(0.1, scatter) == pytest.approx(log_of(rougher, 1e-9))


def test_the_share_of_hits_of_beams_that_scatter_is_nearly_normal_across_an_outline():
    inner, scatter = np.linspace(-0.5, 0.5, 21), 0.2
    shares = [_inside(off, 0.0, _Beam(0.0, 0.0, 0.0, scatter)) for off in inner]
    np.testing.assert_allclose(shares, stats.norm.cdf(inner / scatter), atol=0.035)


@pytest.mark.parametrize("kind", [SPHERE, CYLINDER, SOLID, PANEL])
@pytest.mark.parametrize("at", [0.2, 0.4, 0.6])
def test_the_slope_of_a_surface_is_that_of_its_depth(kind, at):
    """By differences of depths, outwards from the middle."""
    shape, step = np.zeros(N_PARAMETERS), 1e-4
    if kind == PANEL:
        shape[FORM + 2] = 0.7
    if kind == SOLID:
        shape[FORM + 5], shape[FORM + 7] = 0.1, -0.35
    beam, form = _Beam(1.0, 0.0, 0.0, 0.0), _form_of(kind, shape)
    (_, before, _, _), (_, _, _, slope), (_, beyond, _, _) = (
        _surface(kind, x, 0.0, shape, form, beam) for x in (at - step, at, at + step)
    )
    assert slope == pytest.approx((beyond - before) / (2.0 * step), rel=1e-3)


def test_the_comparison_takes_the_width_along_the_axis_as_it_is_given():
    beams = beams_of(0.2, 0.2, np.random.default_rng(5))
    by_sheet = beams._replace(widths=beams.widths * np.array([[1.0, 0.5], [1.0, 1.0]]))
    prior, densities = prior_of(), np.empty(len(beams.x))
    shape = prior[0].copy()
    true = log_likelihood(SPHERE, shape, prior, beams, densities)
    narrow = log_likelihood(SPHERE, shape, prior, by_sheet, densities)
    shape[ALONG] = prior[0, ALONG] = np.log(2.0)
    wider = np.sum(beams.widths**2) / np.sum(by_sheet.widths**2)
    shape[SCATTER] = prior[0, SCATTER] = prior[0, SCATTER] + 0.5 * np.log(wider)
    assert log_likelihood(SPHERE, shape, prior, by_sheet, densities) == pytest.approx(true)
    assert true > narrow + 10.0


def test_what_a_sphere_shares_is_estimated_without_changing_it():
    prior = prior_of()
    beams = beams_of(0.2, 0.1, np.random.default_rng(6))
    sphere = prior[0].copy()
    values, cov = shared_by(sphere, prior, SIGMAS_OF_BEAMS, beams)
    assert len(values) == len(cov) == STRETCH + 2 - NOISE
    np.testing.assert_array_equal(sphere, prior[0])
    assert not prior[1, ALONG:STRETCH].any()
