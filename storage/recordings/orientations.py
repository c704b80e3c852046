"""sensor_msgs/msg/Imu in CDR: the orientation of an AHRS."""

from __future__ import annotations

import numpy as np

from storage.recordings import cdr
from storage.recordings.container import Batch, Channel
from storage.recordings.families import Series, broken_note, ordered

SCHEMA = "sensor_msgs/msg/Imu"
DEFINITION = f"""# Orientation, angular velocity [rad/s] and linear acceleration [m/s^2] of an IMU.
{cdr.HEADER}
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
{cdr.HEADER_PARTS}{cdr.VECTOR_PARTS}"""

_UNIT = 0.1  # how far the norm of a quaternion may be from 1


class Orientations:
    """Decoder of a topic of IMU messages."""

    def __init__(self, channel: Channel) -> None:
        """Start without messages."""
        self._topic = channel.topic
        self._messages = cdr.SmallMessages(_layout)

    def add(self, batch: Batch) -> None:
        """Take some messages."""
        self._messages.add(batch)

    def series(self) -> list[Series]:
        """Give one series per frame; none when the device tells no orientation."""
        tables = self._messages.tables()
        notes = broken_note(self._topic, self._messages.n_broken, self._messages.reason)
        frames = sorted({table.names[0] for table in tables})
        found = (
            self._frame(frame, [t for t in tables if t.names[0] == frame], notes)
            for frame in frames
        )
        return [series for series in found if len(series.stamps_ns)]

    def _frame(
        self, frame: tuple[str, ...], tables: list[cdr.Table], notes: tuple[str, ...]
    ) -> Series:
        """Collect the orientations of one frame."""
        stamps = np.concatenate([table.stamps_ns[:, 0] for table in tables])
        quaternions = np.concatenate([table.columns[0] for table in tables])
        unknown = np.concatenate([table.columns[1][:, 0] == -1.0 for table in tables])
        if not stamps.any():
            stamps = np.concatenate([table.log_times_ns for table in tables])
            notes = (*notes, f"{self._topic} has no stamps; the times of recording are used.")
        norms = np.linalg.norm(quaternions, axis=1)
        usable = (np.abs(norms - 1.0) < _UNIT) & ~unknown
        stamps, values, _ = ordered(stamps[usable], quaternions[usable] / norms[usable, None])
        return Series(topic=self._topic, names=frame, stamps_ns=stamps, values=values, notes=notes)


def _layout(cursor: cdr.Cursor) -> cdr.Layout:
    """Find the numbers of one IMU message."""
    stamp = cursor.stamp()
    frame = cursor.text()
    orientation = cursor.skip("d", 4)
    covariance = cursor.skip("d", 9)
    rest = cursor.skip("d", 3 + 9 + 3 + 9)
    return cdr.Layout(
        names=((frame,),),
        stamps=(stamp,),
        columns=((orientation, 4), (covariance, 9), (rest, 24)),
    )
