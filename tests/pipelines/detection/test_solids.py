"""The prior of solids of another shape, derived from shapes that are met."""

import numpy as np
import pytest

from spheremark.pipelines.detection.hypotheses import SOLIDS

GRID = np.linspace(-1.8, 1.8, 181)
X, Y = np.meshgrid(GRID, GRID)  # across and up, in radii of the marker
TURNS = np.linspace(-np.pi, np.pi, 72, endpoint=False)
LEANS = np.radians([-30, -15, 0, 15, 30])


def cap(squares, depth):
    """Outline and depth of half an ellipsoid that is 1 where squares are 0."""
    return squares < 1.0, -depth * np.sqrt(np.maximum(1.0 - squares, 0.0))


def seen(name, x, y):
    """Where a shape stops beams, and how deep, in radii: all about as large as a marker."""
    half, corner = 0.88, np.radians(20.0)
    match name:
        case "face of a cube":
            return (np.abs(x) < half) & (np.abs(y) < half), 0.0 * x
        case "edge of a cube":
            return (np.abs(x) < half * np.sqrt(2.0)) & (np.abs(y) < half), np.abs(x)
        case "cube, turned":
            depth = np.where(x > -0.4, np.tan(corner) * x, -x / np.tan(corner))
            return (x < 1.58) & (x > -0.91) & (np.abs(y) < half), depth
        case "cylinder":
            return (np.abs(x) < 0.9) & (np.abs(y) < 1.0), cap((x / 0.9) ** 2, 0.9)[1]
        case "lying cylinder":
            return (np.abs(y) < 0.9) & (np.abs(x) < 1.0), cap((y / 0.9) ** 2, 0.9)[1]
        case "cone":
            wide = (1.0 - y) / 2.0
            return (np.abs(x) < wide) & (np.abs(y) < 1.0), -np.sqrt(np.maximum(wide**2 - x**2, 0.0))
        case "lamp":
            return cap(x**2 / 1.21 + y**2 / 0.64, 1.1)
        case "mirror":
            return cap(x**2 + y**2 / 0.6, 0.5)


NAMES = (
    *("face of a cube", "edge of a cube", "cube, turned", "cylinder", "lying cylinder"),
    *("cone", "lamp", "mirror"),
)


def form_of(name, lean):
    """Form of a leaning shape by least squares, as in ``SOLIDS`` but for its size."""
    c, s = np.cos(lean), np.sin(lean)
    is_on, depths = seen(name, c * X + s * Y, c * Y - s * X)
    x, y, z = X[is_on], Y[is_on], depths[is_on]
    middle, size = (x.mean(), y.mean()), np.sqrt(len(x) * (GRID[1] - GRID[0]) ** 2 / np.pi)
    reaches = np.linspace(0.0, 2.5, 500)[:, None]
    places = np.stack([middle[k] + reaches * f(TURNS) for k, f in ((0, np.cos), (1, np.sin))])
    column, row = np.clip(np.rint((places - GRID[0]) / (GRID[1] - GRID[0])), 0, 180).astype(int)
    limb = np.max(np.where(is_on[row, column], reaches, 0.01), axis=0) / size
    waves = [f(k * TURNS) for k in (1, 2, 3) for f in (np.cos, np.sin)]
    outline = np.linalg.lstsq(np.column_stack([np.ones(72), *waves]), np.log(limb))[0]
    x, y, z = (x - middle[0]) / size, (y - middle[1]) / size, z / size
    square = x * x + y * y
    terms = np.column_stack([np.ones_like(x), x, y, square - 0.5, x * x - y * y, 2.0 * x * y])
    depth = np.linalg.lstsq(terms, z + np.sqrt(np.maximum(1.0 - square, 0.0)))[0]
    return np.concatenate([outline[3:], depth[1:]])


def test_the_prior_of_solids_is_as_wide_as_the_shapes_that_are_met():
    forms = np.array([form_of(name, lean) for name in NAMES for lean in LEANS])
    means, sigmas = np.array(SOLIDS[1:]).T
    scatter = np.sqrt(np.mean((forms - means) ** 2, axis=0))
    assert np.all(np.abs(forms.mean(axis=0) - means) < 0.5 * sigmas)
    assert np.all(scatter < 1.35 * sigmas)
    assert np.all(scatter > 0.45 * sigmas)
    assert np.mean(((forms - means) / sigmas) ** 2) == pytest.approx(1.0, abs=0.35)
