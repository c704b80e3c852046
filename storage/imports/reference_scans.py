"""Published real scans, for comparison with simulated ones.

Two formats: a sequence of raw packets of a VLP-16 (``.bin``), and points as text, x y z in a row
(``.xyz``).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spheremark.pipelines.errors import RecordingError
from spheremark.pipelines.model import Array, Column, Nanos, Rings
from spheremark.pipelines.scan.rigs import (
    FIRING_CYCLE,
    FIRING_ORDER,
    FIRINGS_PER_BLOCK,
    LASER_CYCLE,
    N_BLOCKS,
    N_LASERS,
    RANGE_STEP,
)

_RETURN = np.dtype([("distance", "<u2"), ("reflectivity", "u1")])
_BLOCK = np.dtype(
    [("flag", "<u2"), ("azimuth", "<u2"), ("returns", _RETURN, (FIRINGS_PER_BLOCK, N_LASERS))]
)
_PACKET = np.dtype([("blocks", _BLOCK, N_BLOCKS), ("tail", "V6")])
_FLAG = 0xEEFF


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MeasuredReturns:
    """Measured returns of a real LiDAR, in the order of its pulses.

    Attributes
    ----------
    ranges : (n,)
        Measured distances [m].
    rings : (n,) uint8
        Laser of each return, 0 the lowest.
    offsets_ns : (n,)
        Instants since the first pulse, without gaps between packets.
    intensities : (n,)
        Reflectivity, 0-255.
    """

    ranges: Array
    rings: Rings
    offsets_ns: Nanos
    intensities: Array


def read_packets(path: Path) -> MeasuredReturns:
    """Read a file of single-return packets of a VLP-16.

    Parameters
    ----------
    path : Path
        Packets of 1206 bytes each.

    Returns
    -------
    MeasuredReturns
        The returns.

    Raises
    ------
    RecordingError
        If the file is not made of such packets.
    """
    octets = path.read_bytes()
    n = len(octets) // _PACKET.itemsize
    packets = np.frombuffer(octets, _PACKET, n)
    if not n or len(octets) % _PACKET.itemsize or (packets["blocks"]["flag"] != _FLAG).any():
        raise RecordingError(
            f"{path.name} holds {len(octets):,} bytes that are no VLP-16 packets of "
            f"{_PACKET.itemsize} bytes with 12 blocks each; give a file of whole packets."
        )
    returns = packets["blocks"]["returns"].reshape(-1, N_LASERS)
    firings, lasers = np.nonzero(returns["distance"])
    seconds = firings * FIRING_CYCLE + lasers * LASER_CYCLE
    return MeasuredReturns(
        ranges=returns["distance"][firings, lasers] * RANGE_STEP,
        rings=FIRING_ORDER[lasers].astype(np.uint8),
        offsets_ns=np.rint(seconds * 1e9).astype(np.int64),
        intensities=returns["reflectivity"][firings, lasers].astype(np.float64),
    )


def read_points(path: Path) -> Column:
    """Read points from text.

    Parameters
    ----------
    path : Path
        One point in a row: x y z in metres; further columns are ignored.

    Returns
    -------
    (n, 3) float32
        The finite points [m].

    Raises
    ------
    RecordingError
        If a row does not begin with three numbers.
    """
    try:
        text = path.read_text("utf-8").replace(",", " ")
        p = np.loadtxt(text.splitlines(), dtype=np.float32, usecols=(0, 1, 2), ndmin=2)
    except (ValueError, UnicodeDecodeError) as error:
        raise RecordingError(
            f"{path.name} is no list of points: each row must begin with x y z in metres ({error})."
        ) from error
    return np.asarray(p[np.isfinite(p).all(axis=1)])
