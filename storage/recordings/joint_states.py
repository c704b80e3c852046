"""sensor_msgs/msg/JointState in CDR: the angles of named joints."""

from __future__ import annotations

import numpy as np

from pipelines.values import Nanos
from storage.recordings import cdr
from storage.recordings.container import Batch, Channel
from storage.recordings.families import Series, broken_note, ordered

SCHEMA = "sensor_msgs/msg/JointState"
DEFINITION = f"""# State of a set of torque controlled joints.
{cdr.HEADER}
string[] name
float64[] position
float64[] velocity
float64[] effort
{cdr.HEADER_PARTS}"""


class JointStates:
    """Decoder of a topic of joint states."""

    def __init__(self, channel: Channel) -> None:
        """Start without messages."""
        self._topic = channel.topic
        self._messages = cdr.SmallMessages(_layout)

    def add(self, batch: Batch) -> None:
        """Take some messages."""
        self._messages.add(batch)

    def series(self) -> list[Series]:
        """Give one series per joint, in the order of their names."""
        tables = self._messages.tables()
        notes = broken_note(self._topic, self._messages.n_broken, self._messages.reason)
        joints = sorted({name for table in tables for name in table.names[0]})
        return [self._joint(joint, tables, notes) for joint in joints]

    def _joint(self, joint: str, tables: list[cdr.Table], notes: tuple[str, ...]) -> Series:
        """Collect the samples of one joint from all layouts."""
        mine = [table for table in tables if joint in table.names[0]]
        stamps = np.concatenate([_stamps(table) for table in mine])
        angles = np.concatenate(
            [table.columns[0][:, table.names[0].index(joint)] for table in mine]
        )
        if not stamps.any():
            stamps = np.concatenate([table.log_times_ns for table in mine])
            notes = (*notes, f"{self._topic} has no stamps; the times of recording are used.")
        finite = np.isfinite(angles)
        stamps, values, moved = ordered(stamps[finite], angles[finite, None])
        if moved:
            notes = (*notes, f"{moved} samples of {self._topic} were out of order or double.")
        return Series(
            topic=self._topic, names=(joint,), stamps_ns=stamps, values=values, notes=notes
        )


def _stamps(table: cdr.Table) -> Nanos:
    """Return the header stamps of a table."""
    return np.asarray(table.stamps_ns[:, 0])


def _layout(cursor: cdr.Cursor) -> cdr.Layout:
    """Find the numbers of one joint state."""
    stamp = cursor.stamp()
    cursor.text()
    names = tuple(cursor.text() for _ in range(cursor.count(4)))
    n_positions = cursor.count(8)
    positions = (cursor.skip("d", n_positions), n_positions)
    rest = []
    for _ in ("velocity", "effort"):
        n = cursor.count(8)
        rest.append((cursor.skip("d", n), n))
    return cdr.Layout(names=(names[:n_positions],), stamps=(stamp,), columns=(positions, *rest))
