import struct

import numpy as np
import pytest
from numpy.testing import assert_allclose

from spheremark.pipelines.errors import RecordingError
from spheremark.storage.imports.reference_scans import read_packets, read_points


def packet(distances):
    """A packet as the maker's manual describes it; distances (12, 32) in steps of 2 mm."""
    blocks = b"".join(
        struct.pack("<HH", 0xEEFF, 100 * i) + b"".join(struct.pack("<HB", d, 40) for d in block)
        for i, block in enumerate(distances)
    )
    return blocks + struct.pack("<IBB", 0, 0x37, 0x22)


def test_ranges_lasers_and_instants_are_those_of_the_manual(tmp_path):
    distances = np.zeros((12, 32), int)
    distances[0, 1], distances[11, 16] = 2500, 1000
    (tmp_path / "two.bin").write_bytes(packet(distances) * 2)
    shots = read_packets(tmp_path / "two.bin")
    assert_allclose(shots.ranges, [5.0, 2.0, 5.0, 2.0], rtol=0, atol=1e-9)
    assert shots.rings.tolist() == [8, 0, 8, 0]  # the second laser fired is at +1 deg
    firings = np.array([0, 23, 24, 47]) * 55_296 + np.array([2_304, 0, 2_304, 0])
    assert_allclose(shots.offsets_ns, firings, rtol=0, atol=1)
    assert set(shots.intensities) == {40.0}


@pytest.mark.parametrize("octets", [b"", b"x" * 1206, packet(np.ones((12, 32), int))[:-1]])
def test_what_is_no_packet_is_refused_with_its_size(tmp_path, octets):
    (tmp_path / "no.bin").write_bytes(octets)
    with pytest.raises(RecordingError, match=f"no.bin holds {len(octets):,} bytes"):
        read_packets(tmp_path / "no.bin")


def test_points_are_read_with_spaces_or_commas_and_without_what_is_not_finite(tmp_path):
    (tmp_path / "a.xyz").write_text("1 2 3\n4,5,6\nnan 0 0\n7 8 9 250\n")
    p = read_points(tmp_path / "a.xyz")
    assert_allclose(p, [[1, 2, 3], [4, 5, 6], [7, 8, 9]])
    assert p.dtype == np.float32


@pytest.mark.parametrize("text", ["1 2\n", "x y z\n"])
def test_what_is_no_list_of_points_is_refused_by_name(tmp_path, text):
    (tmp_path / "b.xyz").write_text(text)
    with pytest.raises(RecordingError, match=r"b\.xyz is no list of points"):
        read_points(tmp_path / "b.xyz")
