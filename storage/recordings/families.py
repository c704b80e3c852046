"""What every message family gives: the neutral columns between decoders and the log.

A family is a module with a decoder class per message type. It knows its encoding and its message
type, nothing about files or about other families; whoever adds one lists it in ``reading.py``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pipelines.values import Array, Column, Nanos, Rings
from storage.recordings.container import Batch


class BrokenMessageError(ValueError):
    """A message does not hold what its type promises: it is left out and counted."""


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
        Instant of each shot, or of its message.
    has_shot_times : bool
        Whether the points carry usable times.
    message_stamps_ns : (k,)
        Instant of each message, by its header.
    notes : tuple of str
        What is missing, as sentences for people.
    """

    topic: str
    frame: str
    p_lidar: Column
    intensities: Column
    rings: Rings
    stamps_ns: Nanos
    has_shot_times: bool
    message_stamps_ns: Nanos
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Series:
    """One signal in time: a joint angle, a transform, an orientation.

    Attributes
    ----------
    topic : str
        Where it comes from.
    names : tuple of str
        The joint; or parent and child of a transform; or the frame of an orientation.
    stamps_ns : (n,)
        Instants, strictly increasing.
    values : (n, k)
        Angle [rad]; or translation [m] and quaternion x y z w; or quaternion alone.
    notes : tuple of str
        What is missing or was repaired, as sentences for people.
    """

    topic: str
    names: tuple[str, ...]
    stamps_ns: Nanos
    values: Array
    notes: tuple[str, ...] = ()


class Decoder(Protocol):
    """Takes the messages of one channel, in the order of the file."""

    def add(self, batch: Batch) -> None:
        """Take some messages."""


class LidarDecoder(Decoder, Protocol):
    """Decoder of a LiDAR topic; made from its channel and the size of the file [bytes]."""

    def returns(self) -> Returns:
        """Give all that the messages held."""


class SeriesDecoder(Decoder, Protocol):
    """Decoder of a topic with signals; made from its channel."""

    def series(self) -> list[Series]:
        """Give the signals that the messages held."""


def ordered(stamps_ns: Nanos, values: Array) -> tuple[Nanos, Array, int]:
    """Sort samples by time and keep the first of equal stamps.

    Parameters
    ----------
    stamps_ns : (n,)
        Instants in any order.
    values : (n, k)
        Samples.

    Returns
    -------
    stamps_ns : (m,)
        Strictly increasing instants.
    values : (m, k)
        Their samples.
    moved : int
        Number of samples that were out of order or left out.
    """
    if len(stamps_ns) < 2 or bool((np.diff(stamps_ns) > 0).all()):
        return stamps_ns, values, 0
    kept, first = np.unique(stamps_ns, return_index=True)
    moved = int((np.diff(stamps_ns) <= 0).sum())
    return kept, values[first], moved


def broken_note(topic: str, n_broken: int, reason: str) -> tuple[str, ...]:
    """Return the sentence about messages that were left out, if there were any."""
    if not n_broken:
        return ()
    plural = "message" if n_broken == 1 else "messages"
    return (f"{n_broken} {plural} of {topic} could not be decoded and are left out: {reason}.",)
