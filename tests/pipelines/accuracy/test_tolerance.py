"""Up to which distance a tolerance is kept: estimates, bounds, and how often the bounds fail."""

import numpy as np
import pytest

from spheremark.pipelines.accuracy.tolerance import DistanceBins, tolerance_reach


def bins(within, sizes, farthest):
    """Return bins of scans: for each bin, the errors within and in all of each scan."""
    within, sizes = ([np.array(one, dtype=float) for one in part] for part in (within, sizes))
    return DistanceBins(
        farthest=np.array(farthest, dtype=float),
        n=np.array([one.sum() for one in sizes]),
        n_within=np.array([one.sum() for one in within]),
        n_scans=np.array([float(len(one)) for one in sizes]),
        kk=np.array([k @ k for k in within]),
        kn=np.array([k @ n for k, n in zip(within, sizes, strict=True)]),
        nn=np.array([n @ n for n in sizes]),
    )


def test_the_reach_ends_before_the_first_bin_that_fails():
    sizes = [np.full(400, 5.0)] * 3
    found = tolerance_reach(bins([sizes[0], 0.9 * sizes[1], sizes[2]], sizes, [5, 10, 15]))
    assert found.estimate == found.confident == 5.0
    assert found.lower[0] > 0.95


def test_errors_all_within_from_few_scans_prove_nothing():
    sizes = [np.full(58, 20.0)]
    found = tolerance_reach(bins(sizes, sizes, [5]))
    assert found.estimate == 5.0
    assert found.confident == 0.0
    assert found.scans_needed == 59
    assert tolerance_reach(bins([np.full(59, 20.0)], [np.full(59, 20.0)], [5])).confident == 5.0


def test_a_nearest_bin_that_fails_leaves_no_reach():
    found = tolerance_reach(bins([np.zeros(50)], [np.full(50, 4.0)], [5]))
    assert found.estimate == found.confident == 0.0
    assert found.lower[0] == 0.0


@pytest.mark.parametrize("spread", [0.02, 0.3])
def test_the_bound_fails_in_at_most_one_of_twenty_samples(spread):
    """Shares vary from scan to scan: errors of a scan are dependent; the true share is 95 %."""
    rng = np.random.default_rng(4)
    n_samples, m, n = 4000, 120, 14
    shape = (1.0 - spread) / spread
    counts = rng.binomial(n, rng.beta(0.95 * shape, 0.05 * shape, (n_samples, m)))
    sizes = [np.full(m, n)] * n_samples
    found = tolerance_reach(bins(list(counts), sizes, np.arange(n_samples)))
    wrong = np.mean(found.lower > 0.95)
    assert wrong <= 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / n_samples)
