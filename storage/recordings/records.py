"""Records of an MCAP file: how they follow each other, in the file and inside a chunk."""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.compilation import compiled
from spheremark.pipelines.model import Nanos

Octets = NDArray[np.uint8]

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F
RECORD_HEAD = 9  # [bytes] opcode and length before the body of a record
MESSAGE_HEAD = 22  # [bytes] channel, sequence and two times before the data of a message
_ROWS = 1 << 12  # records that one step of the walk reports


def walk(octets: Octets, position: int) -> tuple[Nanos, int, bool]:
    """Return the next records, (n, 5), the position behind them, and whether the last is whole.

    Columns: opcode, first byte and length of the body; of a message, channel and log time too.
    """
    rows = np.empty((min(_ROWS, (len(octets) - position) // RECORD_HEAD + 1), 5), np.int64)
    n, position, is_whole = _walk_kernel(octets, position, rows)
    return rows[:n], position, is_whole


def windows(octets: Octets, size: int) -> Octets:
    """Return a view of the bytes that follow each byte, (n, size)."""
    n = max(len(octets) - size + 1, 0)
    return np.ndarray((n, size), np.uint8, buffer=octets, strides=(1, 1))


def text(body: bytes, at: int) -> tuple[str, int]:
    """Read a string with its length before it."""
    (length,) = struct.unpack_from("<I", body, at)
    end = at + 4 + length
    if end > len(body):
        raise ValueError("a string is longer than its record")
    return body[at + 4 : end].decode(), end


@compiled
def _walk_kernel(octets, position, rows):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Fill rows with records until they are full, the footer is met, or a record is cut."""
    size = len(octets)
    n = 0
    while n < len(rows) and position < size:
        if position + 9 > size:
            return n, position, False
        opcode = octets[position]
        length = np.int64(0)
        for k in range(8):
            length |= np.int64(octets[position + 1 + k]) << (8 * k)
        start = position + 9
        if opcode == 0 or length < 0 or length > size - start or (opcode == 5 and length < 22):
            return n, position, False
        channel = np.int64(-1)
        log_time = np.int64(0)
        if opcode == 5:
            channel = np.int64(octets[start]) | np.int64(octets[start + 1]) << 8
            for k in range(8):
                log_time |= np.int64(octets[start + 6 + k]) << (8 * k)
        rows[n, 0] = opcode
        rows[n, 1] = start
        rows[n, 2] = length
        rows[n, 3] = channel
        rows[n, 4] = log_time
        n += 1
        position = start + length
        if opcode == 2:
            break
    return n, position, True
