"""CDR, the encoding of ROS 2: a cursor for one message, and many small ones decoded at once.

Plain CDR (XCDR1) and XCDR2 of final types, little and big endian. Alignment counts from behind the
four bytes of the encapsulation header; XCDR2 aligns nothing wider than four bytes.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from spheremark.pipelines.model import Mask, Nanos
from spheremark.storage.recordings.container import Batch, Channel
from spheremark.storage.recordings.families import BrokenMessageError, broken_note
from spheremark.storage.recordings.records import Octets, windows

_ENCAPSULATIONS = {0: (">", 8), 1: ("<", 8), 6: (">", 4), 7: ("<", 4)}  # identifier: order, widest
_SIZES = {"B": 1, "i": 4, "I": 4, "d": 8}
_ALIKE_MAX = 1 << 10  # messages that are compared with one at a time
_LAYOUTS_MAX = 256  # layouts of one length on one channel; real topics have one to ten

_Kind = TypeVar("_Kind", bound=np.generic)


class Cursor:
    """Reads one message from front to back without copying it."""

    def __init__(self, octets: Octets) -> None:
        """Start behind the encapsulation header."""
        self._view = octets.data
        identifier = int.from_bytes(self._view[:2], "big") if len(octets) >= 4 else -1
        if identifier not in _ENCAPSULATIONS:
            raise BrokenMessageError(f"its first bytes {bytes(self._view[:4])!r} are not plain CDR")
        self.order, self._widest = _ENCAPSULATIONS[identifier]
        self.at = 4

    def number(self, code: str) -> int:
        """Read one whole number (struct's letter)."""
        at = self.skip(code)
        return int(struct.unpack_from(self.order + code, self._view, at)[0])

    def skip(self, code: str, count: int = 1) -> int:
        """Pass some numbers and return where they begin."""
        size = _SIZES[code]
        if count:
            step = min(size, self._widest)
            self.at = 4 - (4 - self.at) // step * step
        at, end = self.at, self.at + size * count
        if end > len(self._view):
            raise BrokenMessageError(f"it ends at byte {len(self._view)} and must have {end}")
        self.at = end
        return at

    def count(self, smallest: int = 1) -> int:
        """Read the length of a sequence whose members have at least so many bytes."""
        n = self.number("I")
        if n * smallest > len(self._view) - self.at:
            raise BrokenMessageError(f"it declares {n:,} members, more than it has bytes for")
        return n

    def text(self) -> str:
        """Read a string."""
        n = self.count()
        self.at += n
        return bytes(self._view[self.at - n : self.at]).rstrip(b"\0").decode("utf-8", "replace")

    def stamp(self) -> int:
        """Pass a time and return where it begins."""
        at = self.skip("i")
        self.skip("I")
        return at


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Places of the varying numbers in a small message; all other bytes are equal in its group.

    Attributes
    ----------
    names : tuple of tuple of str
        Names of the quantities.
    stamps : tuple of int
        Where times begin.
    columns : tuple of (int, int)
        Where runs of float64 begin, and their lengths.
    passed : tuple of (int, int)
        The same of numbers that are not read.
    """

    names: tuple[tuple[str, ...], ...]
    stamps: tuple[int, ...]
    columns: tuple[tuple[int, int], ...]
    passed: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Table:
    """Messages of one layout, decoded.

    Attributes
    ----------
    names : tuple of tuple of str
        As in the layout.
    stamps_ns : (n, s)
        Times.
    columns : tuple of (n, k)
        Numbers.
    log_times_ns : (n,)
        When the messages were recorded.
    """

    names: tuple[tuple[str, ...], ...]
    stamps_ns: Nanos
    columns: tuple[NDArray[np.float64], ...]
    log_times_ns: Nanos


class SmallMessages:
    """Collects the messages of a channel and decodes those of one layout together."""

    def __init__(self, layout_of: Callable[[Cursor], Layout]) -> None:
        """Start without messages; the function finds the layout of one message."""
        self._layout_of = layout_of
        self._rows: dict[int, list[tuple[Octets, Nanos]]] = {}
        self.n_broken = 0
        self.reason = ""

    def add(self, batch: Batch) -> None:
        """Copy the messages of a batch, by length."""
        for length in np.unique(batch.lengths).tolist():
            mine = batch.lengths == length
            rows = windows(batch.octets, length)[batch.starts[mine]]
            self._rows.setdefault(length, []).append((rows, batch.log_times_ns[mine]))

    def tables(self) -> list[Table]:
        """Decode all messages, layout by layout."""
        tables: list[Table] = []
        self.n_broken, self.reason = 0, ""
        for parts in self._rows.values():
            rows, log_times = (_joined(column) for column in zip(*parts, strict=True))
            for _ in range(_LAYOUTS_MAX):
                if not len(rows):
                    break
                alike = self._decode_alike(rows, log_times, tables)
                rows, log_times = rows[~alike], log_times[~alike]
            self._give_up(len(rows), f"the channel has more than {_LAYOUTS_MAX} layouts")
        return tables

    def _decode_alike(self, rows: Octets, log_times: Nanos, tables: list[Table]) -> Mask:
        """Decode the first message and all of its layout; return which these are."""
        cursor_order, layout = "<", None
        try:
            cursor = Cursor(rows[0])
            cursor_order, layout = cursor.order, self._layout_of(cursor)
        except BrokenMessageError as error:
            alike = (rows == rows[0]).all(axis=1)
            self._give_up(int(alike.sum()), str(error))
            return np.asarray(alike)
        alike = _alike(rows, layout)
        mine = slice(None) if alike.all() else alike
        tables.append(_decode(rows[mine], log_times[mine], layout, cursor_order))
        return alike

    def _give_up(self, n: int, reason: str) -> None:
        """Count messages that cannot be decoded."""
        if n:
            self.n_broken += n
            self.reason = self.reason or reason


class SignalDecoder:
    """Decoder of a topic of small messages: counts the broken ones; subclasses build the series."""

    def __init__(self, channel: Channel, layout_of: Callable[[Cursor], Layout]) -> None:
        """Start without messages."""
        self._topic = channel.topic
        self._messages = SmallMessages(layout_of)

    def add(self, batch: Batch) -> None:
        """Take some messages."""
        self._messages.add(batch)

    def notes(self) -> tuple[str, ...]:
        """Return a note on messages that could not be decoded."""
        return broken_note(self._topic, self._messages.n_broken, self._messages.reason)


def heads_alike(batch: Batch, i: int, size: int, varying: Iterable[int]) -> Octets:
    """Return the heads of message i and those behind it that equal it except in varying bytes."""
    rows = slice(i, i + _ALIKE_MAX)
    n = n_leading(batch.lengths[rows] >= size)
    heads = windows(batch.octets, size)[batch.starts[rows][:n]]
    fixed = np.ones(size, np.bool_)
    fixed[list(varying)] = False
    return np.asarray(heads[: n_leading((heads[:, fixed] == heads[0, fixed]).all(axis=1))])


def n_leading(is_so: Mask) -> int:
    """Count the leading true values."""
    return len(is_so) if is_so.all() else int(np.argmin(is_so))


def definition_agrees(channel: Channel, fields: str) -> bool:
    """Return whether the recorded definition has the fields that the decoder reads, in order."""
    text = channel.definition.decode("utf-8", "replace")
    if channel.schema_encoding not in ("ros1msg", "ros2msg") or not text.strip():
        return True
    return _fields(text) == _fields(fields.replace(", ", "\n"))


def _fields(text: str) -> list[tuple[str, str]]:
    """Return type and name of each field of the top level of a definition."""
    top = re.split(r"^={20,}\s*$", text, maxsplit=1, flags=re.MULTILINE)[0]
    lines = (re.sub(r"#.*", "", line).split() for line in top.splitlines())
    fields = [line for line in lines if len(line) >= 2 and "=" not in "".join(line[1:])]
    return [(kind.rsplit("/", 1)[-1], name) for kind, name, *_ in fields]


def _joined(parts: Sequence[NDArray[_Kind]]) -> NDArray[_Kind]:
    """Concatenate arrays, without copying if there is only one."""
    return np.concatenate(parts) if len(parts) > 1 else parts[0]


def _alike(rows: Octets, layout: Layout) -> Mask:
    """Return which messages equal the first one wherever the layout does not vary."""
    fixed = np.ones(rows.shape[1], np.bool_)
    for at in layout.stamps:
        fixed[at : at + 8] = False
    for at, count in (*layout.columns, *layout.passed):
        fixed[at : at + 8 * count] = False
    return np.asarray((rows[:, fixed] == rows[0, fixed]).all(axis=1))


def _decode(rows: Octets, log_times: Nanos, layout: Layout, order: str) -> Table:
    """Read all numbers of messages of one layout."""
    stamps = [stamps_ns(rows, at, order) for at in layout.stamps]
    return Table(
        names=layout.names,
        stamps_ns=np.column_stack([np.empty((len(rows), 0), np.int64), *stamps]),
        columns=tuple(
            numbers(rows, at, count, order + "f8").astype(np.float64, copy=False)
            for at, count in layout.columns
        ),
        log_times_ns=log_times,
    )


def stamps_ns(rows: Octets, at: int, order: str) -> Nanos:
    """Read a time from each of some messages."""
    seconds = numbers(rows, at, 1, order + "i4")[:, 0].astype(np.int64)
    return seconds * 1_000_000_000 + numbers(rows, at + 4, 1, order + "u4")[:, 0].astype(np.int64)


def numbers(rows: Octets, at: int, count: int, kind: str) -> NDArray[np.generic]:
    """Read a run of numbers from each of some messages."""
    size = np.dtype(kind).itemsize * count
    return np.ascontiguousarray(rows[:, at : at + size]).view(kind).reshape(len(rows), count)
