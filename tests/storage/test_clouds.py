from dataclasses import replace

import fsspec
import numpy as np
import pyarrow.parquet as pq
import pytest

from spheremark.pipelines.errors import InputError, NotFoundError
from spheremark.storage.clouds.stop import NO_MARKER, read_cloud, view, write_cloud
from tests.storage.made_up import R_station_base, stop

MEMBERS = 60  # ten on each of six marks


def test_a_cloud_comes_back_as_it_was_chosen(tmp_path):
    written, found = view(stop(), 500), read_cloud(write_cloud(stop(), str(tmp_path), n_max=500))
    for name in ("p_station", "intensities", "is_near", "markers", "residuals"):
        one, other = getattr(written, name), getattr(found, name)
        np.testing.assert_array_equal(one, other)
        assert one.dtype == other.dtype
    assert (found.stop, found.fit_method, found.names) == (
        written.stop, written.fit_method, written.names,
    )  # fmt: skip
    assert found.n_returns == len(stop().cloud.p_base)


def test_points_are_levelled_and_keep_the_order_of_the_recording(tmp_path):
    one = stop()
    found = read_cloud(write_cloud(one, str(tmp_path)))
    expected = one.cloud.p_base @ R_station_base().T
    np.testing.assert_allclose(found.p_station, expected, rtol=0, atol=2e-6)
    np.testing.assert_array_equal(found.intensities, one.cloud.intensities)


def test_members_carry_their_marker_and_used_ones_their_residual(tmp_path):
    one = stop()
    found = read_cloud(write_cloud(one, str(tmp_path)))
    fits = one.fits["along_beam"].fits
    assert found.names == tuple(f"M0{i}" for i in range(1, len(fits) + 1))
    for i, fit in enumerate(fits):
        members = np.sort(np.concatenate([fit.used, fit.rejected]))
        np.testing.assert_array_equal(np.flatnonzero(found.markers == i), members)
        np.testing.assert_array_equal(found.residuals[fit.used], fit.residuals.astype(np.float32))
        assert np.isnan(found.residuals[fit.rejected]).all()
    assert np.isnan(found.residuals[found.markers == NO_MARKER]).all()


def test_what_is_near_a_centre_is_kept_however_much_is_thinned():
    one = stop()
    centres = np.array([fit.p_base for fit in one.fits["along_beam"].fits])
    distances = np.linalg.norm(one.cloud.p_base[:, None] - centres[None], axis=2).min(axis=1)
    found = view(one, 100)
    assert found.is_near.sum() == np.sum(distances <= 0.5) >= MEMBERS
    assert 90 <= np.sum(~found.is_near) <= 100


def test_thinning_is_even_and_blind_to_the_period_of_the_lasers():
    one = stop()
    kept = view(one, 1000)
    rows = np.flatnonzero(np.isin(one.cloud.intensities, kept.intensities[~kept.is_near]))
    lasers = np.bincount(rows % 16, minlength=16)
    assert lasers.min() > 0.5 * lasers.mean()  # a stride of four would leave twelve lasers out
    halves = np.bincount(2 * rows // len(one.cloud.p_base), minlength=2)
    assert abs(halves[0] - halves[1]) < 0.05 * halves.sum()


@pytest.mark.parametrize("n_max", [20, 70, 800, 10_000])
def test_a_reader_gets_at_most_what_it_asks_for_and_members_first(tmp_path, n_max):
    url = write_cloud(stop(), str(tmp_path))
    whole, found = read_cloud(url), read_cloud(url, n_max=n_max)
    assert 0.8 * min(n_max, len(whole)) < len(found) <= n_max
    n_members = np.sum(found.markers != NO_MARKER)
    assert n_members >= 0.8 * min(n_max, MEMBERS)
    if n_max >= whole.is_near.sum():
        assert found.is_near.sum() == whole.is_near.sum()


def test_the_same_stop_is_one_file_and_another_one_is_another(tmp_path):
    first = write_cloud(stop(), str(tmp_path))
    assert write_cloud(stop(), str(tmp_path)) == first
    assert write_cloud(stop(seed=4), str(tmp_path)) != first
    assert len(list(tmp_path.iterdir())) == 2


def test_a_cloud_can_live_behind_a_url():
    url = write_cloud(stop(), "memory://clouds/run1")
    assert url.startswith("memory://clouds/run1/")
    assert len(read_cloud(url)) == len(stop().cloud.p_base)
    fsspec.filesystem("memory").rm("/clouds", recursive=True)


def test_a_stop_without_markers_has_a_cloud_too(tmp_path):
    one = stop()
    empty = replace(one.fits["paper"], fits=())
    found = read_cloud(write_cloud(replace(one, fits={"paper": empty}), str(tmp_path), n_max=50))
    assert found.names == ()
    assert not found.is_near.any()


def test_a_cloud_that_is_gone_is_not_found(tmp_path):
    with pytest.raises(NotFoundError, match="run the job again"):
        read_cloud(str(tmp_path / "gone.parquet"))


def test_a_file_that_is_no_cloud_is_refused(tmp_path):
    (tmp_path / "x.parquet").write_bytes(b"no parquet")
    with pytest.raises(InputError, match="is not a cloud"):
        read_cloud(str(tmp_path / "x.parquet"))
    url = write_cloud(stop(), str(tmp_path))
    pq.write_table(pq.read_table(url).replace_schema_metadata({}), url)
    with pytest.raises(InputError, match="is not a cloud that this version"):
        read_cloud(url)


def test_others_can_read_the_parquet_file(tmp_path):
    table = pq.read_table(write_cloud(stop(), str(tmp_path)))
    assert table.column_names == [
        "x_m", "y_m", "z_m", "intensity", "is_near", "marker", "residual_m",
    ]  # fmt: skip
