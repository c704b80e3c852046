"""The table of precision against distance, and the bars that centres must keep."""

import pytest

from service.precision import Wish, accuracy_table


def silent(share, what):
    """Tell nobody."""


def rows_of(**wish):
    return accuracy_table(Wish(**wish), silent)


@pytest.mark.slow
def test_every_method_stands_beside_the_bound_at_every_distance():
    rows = rows_of(n_stops=1, sigmas=(0.02,))
    assert {row["distance_m"] for row in rows} == {5.0 + 2.5 * i for i in range(11)}
    near = {row["method"]: row for row in rows if row["distance_m"] == 7.5}
    assert len(near) == 6
    assert near["silhouette"]["rms_m"] < near["along_beam"]["rms_m"] < near["paper"]["rms_m"]
    assert 0.0025 < near["along_beam"]["bound_m"] < 0.0035


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.01, 0.02])
def test_centres_keep_near_the_bound(sigma):
    # 10 stops, 80 fits a distance: the ratio is good to 4 % of itself, the mean NEES to 0.3
    rows = rows_of(n_stops=10, sigmas=(sigma,), methods=("along_beam", "silhouette"), seed=100)
    for row in rows:
        distance, few = row["distance_m"], row["mean_hits"] < 40
        assert (1.6 if few else 1.8) < row["mean_nees"] < (5.4 if few else 4.5)
        if row["method"] == "along_beam":
            bar = 0.90 if distance <= 10 else 0.85 if distance <= 20 else 0.80
            assert row["bound_over_rms"] > bar - 0.10
            assert abs(row["radial_bias_m"]) < (0.001 if distance <= 15 else 0.004)
        elif sigma == 0.02 and distance <= 15:
            assert row["bound_over_rms"] > 1.0
        if distance <= 20:
            assert row["p95_m"] < 0.03
