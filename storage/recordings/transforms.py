"""tf2_msgs/msg/TFMessage in CDR: transforms between frames, static or changing."""

from __future__ import annotations

import numpy as np

from spheremark.storage.recordings import cdr
from spheremark.storage.recordings.container import Channel
from spheremark.storage.recordings.families import Series, series_of

SCHEMA = "tf2_msgs/msg/TFMessage"
FIELDS = "TransformStamped[] transforms"

_TRANSFORM_MIN = 70  # [bytes] of a transform with empty names


class Transforms(cdr.SignalDecoder):
    """Decoder of a topic of transforms."""

    def __init__(self, channel: Channel) -> None:
        """Start without messages."""
        super().__init__(channel, _layout)

    def series(self) -> list[Series]:
        """Return one series per pair of parent and child."""
        tables = self._messages.tables()
        pairs = list(dict.fromkeys(pair for table in tables for pair in table.names))
        return [self._pair(pair, tables) for pair in pairs]

    def _pair(self, pair: tuple[str, ...], tables: list[cdr.Table]) -> Series:
        """Collect the samples of one transform."""
        places = [
            (table, place)
            for table in tables
            for place, names in enumerate(table.names)
            if names == pair
        ]
        return series_of(
            self._topic,
            pair,
            np.concatenate([table.stamps_ns[:, place] for table, place in places]),
            np.concatenate([table.log_times_ns for table, _ in places]),
            np.concatenate([table.columns[place] for table, place in places]),
        )


def _layout(cursor: cdr.Cursor) -> cdr.Layout:
    """Return the places of the numbers in one message with any number of transforms."""
    names, stamps, columns = [], [], []
    for _ in range(cursor.count(_TRANSFORM_MIN)):
        stamps.append(cursor.stamp())
        parent, child = cursor.text(), cursor.text()
        names.append((parent.lstrip("/"), child.lstrip("/")))
        columns.append((cursor.skip("d", 7), 7))
    return cdr.Layout(names=tuple(names), stamps=tuple(stamps), columns=tuple(columns))
