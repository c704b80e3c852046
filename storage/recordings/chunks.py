"""Chunks of an MCAP file: read, decompressed and checked many at a time, by two threads.

All go into one buffer that is reused, compressed or not: to read a block into it costs less than
the page faults of mapping the block.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import lz4.frame
import numpy as np
import zstandard
from isal.isal_zlib import crc32

from spheremark.pipelines.model import Nanos
from spheremark.pipelines.threads import by_turns
from spheremark.storage.recordings.records import RECORD_HEAD, Octets, text, walk

_STRETCH = 1 << 26  # [bytes] of chunks that are read together: each stretch costs half a ms
_CHUNK_LIMIT = 1 << 29  # [bytes] a larger decompressed chunk is refused, whatever it declares
_HEAD = 8 + 8 + 8 + 4 + 4 + 64 + 8  # [bytes] before the records of a chunk, at the most
_BROKEN = (ValueError, struct.error, zstandard.ZstdError, RuntimeError)


class Chunk(NamedTuple):
    """The header of a chunk, and its place."""

    record: int  # where its record begins in the file
    begin: int  # where its records begin, compressed or not
    length: int  # of them in the file [bytes]
    size: int  # of them decompressed [bytes]
    crc: int  # of them decompressed; 0 when not recorded
    compression: str


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Stretch:
    """Chunks that follow each other, decompressed.

    Attributes
    ----------
    octets : (size,) uint8
        Their records; valid until the next stretch.
    rows : (n, 5)
        The records, as from ``records.walk``.
    damage : (int, str) or None
        First byte and fault of the first damaged chunk; its records are left out.
    """

    octets: Octets
    rows: Nanos
    damage: tuple[int, str] | None


class Chunks:
    """Brings the chunks of one file.

    Parameters
    ----------
    octets : (size,) uint8
        The file.
    file : int or None
        Its descriptor, if there is one.
    """

    def __init__(self, octets: Octets, file: int | None) -> None:
        self._octets = octets
        self._file = file
        self._buffer = np.empty(0, np.uint8)
        self._n_compressed = self._n_decompressed = 1

    @property
    def expansion(self) -> float:
        """Ratio of decompressed to compressed size of the chunks so far."""
        return self._n_decompressed / self._n_compressed

    def stretches(self, rows: Nanos) -> Iterator[Stretch]:
        """Yield the chunks, as many at a time as memory should hold."""
        chunks: list[Chunk] = []
        n_octets = 0
        damage = None
        for start, length in rows[:, 1:3].tolist():
            try:
                chunk = _described(self._octets[start : start + length], start)
            except _BROKEN as error:
                damage = (start - RECORD_HEAD, f"a chunk is damaged: {error}")
                break
            if chunks and n_octets + chunk.size > _STRETCH:
                yield (stretch := self._brought(chunks, None))
                if stretch.damage is not None:
                    return
                chunks, n_octets = [], 0
            chunks.append(chunk)
            n_octets += chunk.size
        yield self._brought(chunks, damage)

    def _brought(self, chunks: Sequence[Chunk], damage: tuple[int, str] | None) -> Stretch:
        """Bring some chunks side by side; damage among them comes before that behind them."""
        places = [0, *np.cumsum([chunk.size for chunk in chunks]).tolist()]
        if places[-1] > len(self._buffer):
            self._buffer = np.empty(max(places[-1], _STRETCH), np.uint8)
        found = [np.empty((0, 5), np.int64)]

        def bring(begin: int, end: int) -> tuple[list[Nanos], tuple[int, str] | None]:
            return self._bring(chunks[begin:end], places[begin:end])

        for rows, damaged in by_turns(bring, len(chunks), size=1, threaded_from=2):
            found += rows
            if damaged is not None:
                damage = damaged
                break
        self._n_compressed += sum(chunk.length for chunk in chunks)
        self._n_decompressed += places[-1]
        octets = self._buffer[: places[-1]]
        octets.flags.writeable = False
        return Stretch(octets=octets, rows=np.concatenate(found), damage=damage)

    def _bring(
        self, chunks: Sequence[Chunk], places: Sequence[int]
    ) -> tuple[list[Nanos], tuple[int, str] | None]:
        """Put chunks into their places; return their records and what is damaged."""
        found: list[Nanos] = []
        for chunk, place in zip(chunks, places, strict=True):
            octets = self._buffer[place : place + chunk.size]
            try:
                self._fill(chunk, octets)
            except _BROKEN as error:
                return found, (chunk.record, f"a chunk is damaged: {error}")
            position, is_whole = 0, True
            while is_whole and position < chunk.size:
                rows, position, is_whole = walk(octets, position)
                rows[:, 1] += place
                found.append(rows)
            if not is_whole:
                return found, (chunk.record, "a record in a chunk is cut")
        return found, None

    def _fill(self, chunk: Chunk, out: Octets) -> None:
        """Write the records of a chunk, unpacked and checked."""
        packed = self._octets[chunk.begin : chunk.begin + chunk.length]
        if chunk.compression == "":
            self._read(chunk.begin, out)
        elif chunk.compression == "lz4":
            _fill_whole(out, lz4.frame.LZ4FrameDecompressor().decompress(packed, len(out) + 1))
        else:
            _fill_zstd(out, packed)
        if chunk.crc and crc32(out.data) != chunk.crc:
            raise ValueError("its checksum does not agree")

    def _read(self, begin: int, out: Octets) -> None:
        """Copy bytes of the file."""
        if self._file is None:
            out[:] = self._octets[begin : begin + len(out)]
            return
        n = 0
        while n < len(out):
            step = os.preadv(self._file, [out[n:].data], begin + n)
            if not step:
                raise ValueError("the file has become shorter")
            n += step


def _described(body: Octets, start: int) -> Chunk:
    """Return the header of a chunk; raise if it cannot be true."""
    head = body[:_HEAD].tobytes()
    size, crc = struct.unpack_from("<QI", head, 16)
    compression, at = text(head, 28)
    (length,) = struct.unpack_from("<Q", head, at)
    at += 8
    packed = body[at : at + length]
    if len(packed) != length:
        raise ValueError(f"it declares {length:,} bytes and has {len(packed):,}")
    if compression not in ("", "lz4", "zstd"):
        raise ValueError(f"its compression {compression!r} is unknown; known: lz4, zstd")
    if compression == "" and size != length:
        raise ValueError(f"it declares {size:,} bytes of records and holds {length:,}")
    if compression and size > _CHUNK_LIMIT:
        raise ValueError(f"it declares {size:,} bytes, more than {_CHUNK_LIMIT:,}")
    if compression == "zstd" and zstandard.frame_content_size(packed.data) not in (-1, size):
        raise ValueError("its compressed frame declares another size")
    return Chunk(start - RECORD_HEAD, start + at, length, size, crc, compression)


def _fill_zstd(out: Octets, packed: Octets) -> None:
    """Decompress into a buffer, and require that it is filled and nothing is left."""
    reader = zstandard.ZstdDecompressor().stream_reader(packed.data)
    n = 0
    while n < len(out) and (step := reader.readinto(out[n:].data)):
        n += step
    if n < len(out):
        raise ValueError(f"it declares {len(out):,} bytes of records and holds {n:,}")
    if reader.read(1):
        raise ValueError(f"it declares {len(out):,} bytes of records and holds more")


def _fill_whole(out: Octets, unpacked: bytes) -> None:
    """Copy what was decompressed, if it is as much as declared."""
    if len(unpacked) != len(out):
        many = "more" if len(unpacked) > len(out) else f"{len(unpacked):,}"
        raise ValueError(f"it declares {len(out):,} bytes of records and holds {many}")
    out[:] = np.frombuffer(unpacked, np.uint8)
