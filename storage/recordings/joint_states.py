"""sensor_msgs/msg/JointState in CDR: the angles of named joints."""

from __future__ import annotations

import numpy as np

from spheremark.storage.recordings import cdr
from spheremark.storage.recordings.container import Channel
from spheremark.storage.recordings.families import Series, series_of

SCHEMA = "sensor_msgs/msg/JointState"
FIELDS = "Header header, string[] name, float64[] position, float64[] velocity, float64[] effort"


class JointStates(cdr.SignalDecoder):
    """Decoder of a topic of joint states."""

    def __init__(self, channel: Channel) -> None:
        """Start without messages."""
        super().__init__(channel, _layout)

    def series(self) -> list[Series]:
        """Return one series per joint, in the order of their names."""
        tables = self._messages.tables()
        joints = sorted({name for table in tables for name in table.names[0]})
        return [self._joint(joint, tables) for joint in joints]

    def _joint(self, joint: str, tables: list[cdr.Table]) -> Series:
        """Collect the samples of one joint from all layouts."""
        mine = [table for table in tables if joint in table.names[0]]
        return series_of(
            self._topic,
            (joint,),
            np.concatenate([table.stamps_ns[:, 0] for table in mine]),
            np.concatenate([table.log_times_ns for table in mine]),
            np.concatenate([t.columns[0][:, [t.names[0].index(joint)]] for t in mine]),
        )


def _layout(cursor: cdr.Cursor) -> cdr.Layout:
    """Return the places of the numbers in one joint state."""
    stamp = cursor.stamp()
    cursor.text()
    names = tuple(cursor.text() for _ in range(cursor.count(4)))
    n_positions = cursor.count(8)
    positions = (cursor.skip("d", n_positions), n_positions)
    passed = []
    for _ in ("velocity", "effort"):
        n = cursor.count(8)
        passed.append((cursor.skip("d", n), n))
    return cdr.Layout(
        names=(names[:n_positions],), stamps=(stamp,), columns=(positions,), passed=tuple(passed)
    )
