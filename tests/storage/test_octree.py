"""Clouds in levels of detail: every point once, in its place, coarse levels spread evenly."""

import numpy as np
import pytest

from spheremark.pipelines.errors import InputError
from spheremark.storage.clouds.octree import BYTES_PER_POINT, build, node_bytes, octree_of
from spheremark.storage.clouds.stop import CloudView, write_cloud
from spheremark.storage.files import StorageFullError
from tests.surveyed import marks, stop

N = 60_000


@pytest.fixture(scope="module")
def cloud():
    rng = np.random.default_rng(12)
    residuals = rng.normal(0.0, 0.01, N).astype(np.float32)
    residuals[::3] = np.nan
    return CloudView(
        stop="one",
        fit_method="along_beam",
        n_returns=N,
        p_station=rng.uniform([-20, -15, -1], [20, 15, 2], (N, 3)).astype(np.float32),
        intensities=rng.uniform(0, 255, N).astype(np.float32),
        is_near=np.zeros(N, dtype=np.bool_),
        markers=(np.arange(N) % 5 - 1).astype(np.intp),
        residuals=residuals,
        names=("M01", "M02", "M03", "M04"),
    )


def decoded(index, content):
    """Return the points, residuals [m], intensities and markers of all nodes."""
    found = []
    for key, node in index["nodes"].items():
        part, n = content[node["offset"] :][: node["n"] * BYTES_PER_POINT], node["n"]
        level = len(key) - 1
        edge = index["edge_m"] / 2**level
        corner = np.array(index["origin_m"])
        for i, digit in enumerate(map(int, key[1:]), start=1):
            corner = corner + index["edge_m"] / 2**i * np.array(
                [digit >> 2, digit >> 1 & 1, digit & 1]
            )
        p = corner + edge * np.frombuffer(part, "<u2", 3 * n).reshape(-1, 3) / 65535
        residuals = np.frombuffer(part, "<i2", n, 6 * n)
        rest = np.frombuffer(part, np.uint8, 2 * n, 8 * n)
        found.append((p, residuals, rest[:n], rest[n:]))
    return [np.concatenate(parts) for parts in zip(*found, strict=True)]


def test_every_point_is_in_one_node_at_its_place(cloud):
    index, content = build(cloud)
    p, residuals, intensities, markers = decoded(index, content)
    assert len(p) == N
    worst = index["edge_m"] / 65535
    from scipy.spatial import cKDTree

    distances, rows = cKDTree(p).query(cloud.p_station)
    assert distances.max() < worst
    np.testing.assert_array_equal(markers[rows], cloud.markers + 1)
    np.testing.assert_array_equal(intensities[rows], cloud.intensities.astype(np.uint8))
    is_known = np.isfinite(cloud.residuals)
    assert (residuals[rows][~is_known] == np.iinfo(np.int16).min).all()
    np.testing.assert_allclose(
        residuals[rows][is_known] * 1e-4, cloud.residuals[is_known], rtol=0, atol=0.6e-4
    )


def test_a_node_holds_one_point_of_a_cell_and_those_below_it_the_others(cloud):
    index, content = build(cloud)
    n = {key: node["n"] for key, node in index["nodes"].items()}
    assert sum(n.values()) == N
    assert all(key[:-1] in n for key in n if key != "r")
    root = content[: n["r"] * BYTES_PER_POINT]
    p = np.frombuffer(root, "<u2", 3 * n["r"]).reshape(-1, 3) / 65535
    cells = np.minimum((p * index["cells"]).astype(int), index["cells"] - 1)
    # rounding to 1/65535 moves a point across the wall of a cell in one case of a thousand
    assert len(np.unique(cells, axis=0)) > 0.99 * n["r"]


def test_an_octree_is_kept_and_read_node_by_node(tmp_path):
    rng = np.random.default_rng(2)
    result, _ = stop("one", np.array([0.0, 0.0, 1.0]), marks(), rng)
    url = write_cloud(result, str(tmp_path / "clouds"))
    with pytest.raises(StorageFullError, match="are needed"):
        octree_of(url, tmp_path / "octrees", min_free=1 << 60)
    assert list((tmp_path / "octrees").iterdir()) == []
    made = octree_of(url, tmp_path / "octrees")
    changed = made.path.stat().st_mtime_ns
    again = octree_of(url, tmp_path / "octrees")
    assert again.path.stat().st_mtime_ns == changed
    n = sum(len(node_bytes(again, key)) for key in again.index["nodes"])
    assert n == again.index["n_points"] * BYTES_PER_POINT
    with pytest.raises(InputError, match="no node 'r9'"):
        node_bytes(again, "r9")
