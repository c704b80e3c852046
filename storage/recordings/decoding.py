"""The decoders of one recording: which of them reads which channel, and what is left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from spheremark.storage.recordings import (
    joint_states,
    orientations,
    packets,
    pointclouds,
    transforms,
)
from spheremark.storage.recordings.cdr import definition_agrees
from spheremark.storage.recordings.container import Batch, Channel
from spheremark.storage.recordings.families import LidarDecoder, SeriesDecoder, broken_note
from spheremark.storage.recordings.sources import Recording
from spheremark.storage.recordings.translations import Translator, translator_of

# By message type: the decoder, and the fields that it reads. A new family is a module and a
# line here; other encodings and types are rewritten by ``translations``.
_LIDARS: dict[str, tuple[Callable[[Channel, int], LidarDecoder], str]] = {
    pointclouds.SCHEMA: (pointclouds.PointClouds, pointclouds.FIELDS),
    packets.SCHEMA: (packets.Packets, packets.FIELDS),
}
_SIGNALS: dict[str, tuple[str, Callable[[Channel], SeriesDecoder], str]] = {
    joint_states.SCHEMA: ("joints", joint_states.JointStates, joint_states.FIELDS),
    transforms.SCHEMA: ("frames", transforms.Transforms, transforms.FIELDS),
    orientations.SCHEMA: ("ahrs", orientations.Orientations, orientations.FIELDS),
}
LIDAR_TYPES = (*_LIDARS, "foxglove.PointCloud", "CustomMsg of Livox")


@dataclass(slots=True)
class Decoders:
    """The decoders of one recording, by role and topic.

    Attributes
    ----------
    recording : Recording
        Its likely size reserves memory.
    lidars, joints, numbers, frames, ahrs : dict of str to decoder
        By topic; numbers are plain ones, which may be the angle of a joint.
    by_channel : dict of Channel to decoder or None
        None for channels of no use.
    translators : dict of Channel to Translator or None
        None for channels that a decoder reads as they are.
    notes : list of str
        What was left out, as sentences.
    """

    recording: Recording
    lidars: dict[str, LidarDecoder] = field(default_factory=dict)
    joints: dict[str, SeriesDecoder] = field(default_factory=dict)
    numbers: dict[str, SeriesDecoder] = field(default_factory=dict)
    frames: dict[str, SeriesDecoder] = field(default_factory=dict)
    ahrs: dict[str, orientations.Orientations] = field(default_factory=dict)
    by_channel: dict[Channel, LidarDecoder | SeriesDecoder | None] = field(default_factory=dict)
    translators: dict[Channel, Translator | None] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def add(self, batch: Batch) -> None:
        """Decode a batch, if its channel has a decoder."""
        channel = batch.channel
        if channel not in self.by_channel:
            self.translators[channel] = translator_of(channel)
            self.by_channel[channel] = self._find(channel)
        decoder, translator = self.by_channel[channel], self.translators[channel]
        if decoder is not None:
            decoder.add(batch if translator is None else translator.translated(batch))

    def all_notes(self) -> tuple[str, ...]:
        """Return notes on what was left out: damage, whole channels, and messages of signals."""
        signals = (self.joints, self.numbers, self.frames, self.ahrs)
        broken = (
            note
            for one in self.translators.values()
            if one is not None
            for note in broken_note(one.topic, one.n_broken, one.reason)
        )
        notes = (n for role in signals for one in role.values() for n in one.notes())
        return (*self.recording.lost, *self.notes, *broken, *notes)

    def _find(self, channel: Channel) -> LidarDecoder | SeriesDecoder | None:
        """Make the decoder of a channel, or take that of its topic."""
        translator = self.translators[channel]
        if translator is None and channel.encoding != "cdr":
            return None
        read = channel if translator is None else translator.channel
        if read.schema in _LIDARS and self._is_readable(channel, read, _LIDARS[read.schema][1]):
            make = _LIDARS[read.schema][0]
            decoder = make(read, self.recording.likely_size)
            return self.lidars.setdefault(channel.topic, decoder)
        if read.schema not in _SIGNALS:
            return None
        role, make_signal, fields = _SIGNALS[read.schema]
        if not self._is_readable(channel, read, fields):
            return None
        mine: dict[str, SeriesDecoder]
        mine = getattr(self, "numbers" if channel.schema.startswith("std_msgs/") else role)
        return mine.setdefault(channel.topic, make_signal(read))

    def _is_readable(self, channel: Channel, read: Channel, fields: str) -> bool:
        """Return whether the definition is that of the decoder; note it if not."""
        is_same = channel.schema.replace("/msg/", "/") == read.schema.replace("/msg/", "/")
        if not is_same or definition_agrees(channel, fields):
            return True
        self.notes.append(
            f"{channel.topic} is left out: its definition of {channel.schema} is not that of ROS."
        )
        return False
