"""The interface of message families: neutral columns between decoders and the log.

A family is a module with a decoder class per message type. It depends on its encoding and message
type alone; a new one is listed in ``decoding.py``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from spheremark.pipelines.model import Array, Column, Mask, Nanos, Rings
from spheremark.storage.recordings.container import Batch

_FAR_NS = 86_400e9  # a day: clocks that differ differ for all, or by a mistake of decades


class BrokenMessageError(ValueError):
    """A message does not agree with its type: it is left out and counted."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Returns:
    """All returns of one LiDAR topic.

    Attributes
    ----------
    topic, frame : str
        Name of the topic and of its coordinate frame.
    p_lidar : (n, 3) float32
        Returns, without those that are not finite or at the origin [m].
    intensities : (n,) float32
        As recorded; zero when not recorded.
    rings : (n,) uint8
        As recorded; ``RING_UNKNOWN`` throughout when not.
    stamps_ns : (n,)
        Instant of each pulse, or of its message.
    has_pulse_times : bool
        Whether the points carry usable times.
    message_stamps_ns : (k,)
        Instant of each message, by its header.
    notes : tuple of str
        What is missing, as sentences.
    has_heights : bool or None
        Whether the coordinates include the heights of the lasers; None where that is not known.
    span_ns : int
        Median time from the stamp of a message to its last pulse; 0 where that is not known.
    lateness_ns : int
        Median time from the last pulse of a message to its recording.
    """

    topic: str
    frame: str
    p_lidar: Column
    intensities: Column
    rings: Rings
    stamps_ns: Nanos
    has_pulse_times: bool
    message_stamps_ns: Nanos
    notes: tuple[str, ...]
    has_heights: bool | None = None
    span_ns: int = 0
    lateness_ns: int = 0


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Series:
    """One signal in time: a joint angle, a transform, an orientation.

    Attributes
    ----------
    topic : str
        Topic of the messages.
    names : tuple of str
        The joint; or parent and child of a transform; or the frame of an orientation.
    stamps_ns : (n,)
        Instants, strictly increasing.
    values : (n, k)
        Angle [rad]; or translation [m] and quaternion x y z w; or quaternion alone.
    notes : tuple of str
        What is missing or was repaired, as sentences.
    lateness_ns : int
        Median time from a stamp to its recording.
    """

    topic: str
    names: tuple[str, ...]
    stamps_ns: Nanos
    values: Array
    notes: tuple[str, ...] = ()
    lateness_ns: int = 0


class Decoder(Protocol):
    """Takes the messages of one channel, in the order of the file."""

    def add(self, batch: Batch) -> None:
        """Take some messages."""


class LidarDecoder(Decoder, Protocol):
    """Decoder of a LiDAR topic; made from its channel and the likely size of all [bytes]."""

    def returns(self) -> Returns:
        """Return all returns of the messages."""


class SeriesDecoder(Decoder, Protocol):
    """Decoder of a topic with signals; made from its channel."""

    def series(self) -> list[Series]:
        """Return the signals of the messages."""

    def notes(self) -> tuple[str, ...]:
        """Return notes on messages that could not be decoded, after ``series``."""


def series_of(
    topic: str, names: tuple[str, ...], stamps_ns: Nanos, log_times_ns: Nanos, values: Array
) -> Series:
    """Build a series from samples as they were recorded."""
    notes: list[str] = []
    if not stamps_ns.any():
        stamps_ns = log_times_ns
        notes.append(f"{topic} has no stamps; the times of recording are used.")
    near = plausible(stamps_ns, log_times_ns)
    if not near.all():
        notes.append(far_note(topic, int((~near).sum()), "samples"))
    late = int(np.median((log_times_ns - stamps_ns)[near])) if near.any() else 0
    usable = near & np.isfinite(values).all(axis=1)
    stamps_ns, values = stamps_ns[usable], values[usable]
    moved = int((stamps_ns[1:] <= stamps_ns[:-1]).sum())
    if moved:
        stamps_ns, first = np.unique(stamps_ns, return_index=True)
        values = values[first]
        notes.append(f"{moved} samples of {topic} were out of order or double.")
    return Series(
        topic=topic,
        names=names,
        stamps_ns=stamps_ns,
        values=values,
        notes=tuple(notes),
        lateness_ns=late,
    )


def plausible(stamps_ns: Nanos, log_times_ns: Nanos) -> Mask:
    """Return which stamps lag the times of recording about as much as the others."""
    late = log_times_ns.astype(np.float64) - stamps_ns.astype(np.float64)
    if not len(late) or np.ptp(late) <= _FAR_NS:
        return np.ones(len(late), np.bool_)
    return np.asarray(np.abs(late - np.median(late)) <= _FAR_NS)


def far_note(topic: str, n: int, unit: str) -> str:
    """Return the sentence about stamps that are not plausible."""
    return f"{n} {unit} of {topic} are left out: their stamps are more than a day off."


def broken_note(topic: str, n_broken: int, reason: str) -> tuple[str, ...]:
    """Return the sentence about messages that were left out, if there were any."""
    if not n_broken:
        return ()
    plural = "message" if n_broken == 1 else "messages"
    return (f"{n_broken} {plural} of {topic} could not be decoded and are left out: {reason}.",)
