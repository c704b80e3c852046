"""Centres of spheres that all scan lines cross at one place, in scans whose lines fall on lines."""

import numpy as np
import pytest

from spheremark.pipelines.accuracy.truth import marker_errors
from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.simulation import SimulationConfig, scenario, simulate_stop
from spheremark.pipelines.survey import process

CONFIG = SurveyConfig.from_mapping({"fitting": {"methods": ["along_beam"]}})
LINES_ON_LINES = SimulationConfig(turn=18.0, only_near_spheres=True)  # 2 deg in a revolution


@pytest.mark.parametrize("seed", [74, 77])
def test_centres_beside_lines_that_fall_on_lines_are_as_good_as_promised(seed):
    field, squares = scenario("paper-field", seed), []
    for name in ("lane2-stop3", "lane4-stop6"):
        stop = simulate_stop(field, name, LINES_ON_LINES)
        fits = process(stop.log, config=CONFIG)[0].fits["along_beam"]
        errors = marker_errors(fits, stop.truth, field.marks).error_base
        known = np.isfinite(errors).all(axis=1)
        covs = np.array([fit.cov_p_base for fit in fits.fits])[known]
        p, errors = np.array([fit.p_base for fit in fits.fits])[known], errors[known]
        sideways = np.column_stack([-p[:, 1], p[:, 0], np.zeros(len(p))])
        weighted = np.linalg.solve(covs, sideways[:, :, None])[:, :, 0]
        errors -= np.sum(weighted * errors) / np.sum(weighted * sideways) * sideways  # the heading
        squares += list(
            np.einsum("ni,ni->n", errors, np.linalg.solve(covs, errors[:, :, None])[:, :, 0])
        )
    assert len(squares) > 20
    assert np.mean(squares) / 3.0 < 1.7
