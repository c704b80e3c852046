"""sensor_msgs/msg/Imu in CDR: the orientation of an AHRS."""

from __future__ import annotations

import numpy as np

from spheremark.pipelines.model import Array
from spheremark.storage.recordings import cdr
from spheremark.storage.recordings.container import Channel
from spheremark.storage.recordings.families import Series, series_of

SCHEMA = "sensor_msgs/msg/Imu"
FIELDS = (
    "Header header, Quaternion orientation, float64[9] orientation_covariance, "
    "Vector3 angular_velocity, float64[9] angular_velocity_covariance, "
    "Vector3 linear_acceleration, float64[9] linear_acceleration_covariance"
)

_UNIT = 0.1  # how far the norm of a quaternion may be from 1


class Orientations(cdr.SignalDecoder):
    """Decoder of a topic of IMU messages."""

    def __init__(self, channel: Channel) -> None:
        """Start without messages."""
        super().__init__(channel, _layout)

    def series(self) -> list[Series]:
        """Return one series per frame; none when the device has no orientation."""
        tables = self._messages.tables()
        frames = sorted({table.names[0] for table in tables})
        found = (self._frame(frame, [t for t in tables if t.names[0] == frame]) for frame in frames)
        return [series for series in found if len(series.stamps_ns)]

    def accelerations(self) -> list[Series]:
        """Return the accelerations of each frame [m/s^2]."""
        tables = self._messages.tables()
        frames = sorted({table.names[0] for table in tables})
        by_frame = ((frame, [t for t in tables if t.names[0] == frame]) for frame in frames)
        return [_series(self._topic, frame, mine, 2) for frame, mine in by_frame]

    def _frame(self, frame: tuple[str, ...], tables: list[cdr.Table]) -> Series:
        """Collect the orientations of one frame."""
        quaternions = np.concatenate([table.columns[0] for table in tables])
        unknown = np.concatenate([table.columns[1][:, 0] == -1.0 for table in tables])
        with np.errstate(over="ignore", invalid="ignore"):
            norms = np.linalg.norm(quaternions, axis=1)
        quaternions[~(np.abs(norms - 1.0) < _UNIT) | unknown] = np.nan
        quaternions /= norms[:, None]
        return _series(self._topic, frame, tables, 0, quaternions)


def _series(
    topic: str,
    frame: tuple[str, ...],
    tables: list[cdr.Table],
    column: int,
    values: Array | None = None,
) -> Series:
    """Collect a column of tables, or given values of their messages."""
    if values is None:
        values = np.concatenate([table.columns[column] for table in tables])
    return series_of(
        topic,
        frame,
        np.concatenate([table.stamps_ns[:, 0] for table in tables]),
        np.concatenate([table.log_times_ns for table in tables]),
        values,
    )


def _layout(cursor: cdr.Cursor) -> cdr.Layout:
    """Return the places of the numbers in one IMU message."""
    stamp = cursor.stamp()
    frame = cursor.text()
    orientation = cursor.skip("d", 4)
    variance = cursor.skip("d")
    rest = cursor.skip("d", 8 + 3 + 9)
    acceleration = cursor.skip("d", 3)
    last = cursor.skip("d", 9)
    return cdr.Layout(
        names=((frame,),),
        stamps=(stamp,),
        columns=((orientation, 4), (variance, 1), (acceleration, 3)),
        passed=((rest, 20), (last, 9)),
    )
