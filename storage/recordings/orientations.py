"""sensor_msgs/msg/Imu in CDR: the orientation of an AHRS."""

from __future__ import annotations

import numpy as np

from spheremark.storage.recordings import cdr
from spheremark.storage.recordings.container import Channel
from spheremark.storage.recordings.families import Series, series_of

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

    def _frame(self, frame: tuple[str, ...], tables: list[cdr.Table]) -> Series:
        """Collect the orientations of one frame."""
        quaternions = np.concatenate([table.columns[0] for table in tables])
        unknown = np.concatenate([table.columns[1][:, 0] == -1.0 for table in tables])
        with np.errstate(over="ignore", invalid="ignore"):
            norms = np.linalg.norm(quaternions, axis=1)
        quaternions[~(np.abs(norms - 1.0) < _UNIT) | unknown] = np.nan
        return series_of(
            self._topic,
            frame,
            np.concatenate([table.stamps_ns[:, 0] for table in tables]),
            np.concatenate([table.log_times_ns for table in tables]),
            quaternions / norms[:, None],
        )


def _layout(cursor: cdr.Cursor) -> cdr.Layout:
    """Return the places of the numbers in one IMU message."""
    stamp = cursor.stamp()
    frame = cursor.text()
    orientation = cursor.skip("d", 4)
    variance = cursor.skip("d")
    rest = cursor.skip("d", 8 + 3 + 9 + 3 + 9)
    return cdr.Layout(
        names=((frame,),),
        stamps=(stamp,),
        columns=((orientation, 4), (variance, 1)),
        passed=((rest, 32),),
    )
