"""The types of ROS 2, and the raw packets of a Velodyne, as rosbags knows them."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_VELODYNE = f"""std_msgs/Header header
VelodynePacket[] packets
{"=" * 80}
MSG: velodyne_msgs/VelodynePacket
builtin_interfaces/Time stamp
uint8[1206] data
"""


@cache
def store() -> Typestore:
    """Return all types; slow to make the first time.

    Returns
    -------
    Typestore
        Those of ROS 2 and the raw packets.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)
    types.register(get_types_from_msg(_VELODYNE, "velodyne_msgs/msg/VelodyneScan"))
    return types


def definition(schema: str) -> str:
    """Return the whole definition of a type, as ROS 2 records it.

    Parameters
    ----------
    schema : str
        Name of the type, as sensor_msgs/msg/PointCloud2.

    Returns
    -------
    str
        Its fields and those of all types in it.
    """
    return store().generate_msgdef(schema, ros_version=2)[0]
