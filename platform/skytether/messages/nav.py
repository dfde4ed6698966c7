"""``nav_msgs`` and ``tf2_msgs``: where the robot is, where it shall go, the map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .base import Int8s, Message, array, message
from .geometry import Pose, PoseStamped, PoseWithCovariance, TransformStamped, TwistWithCovariance
from .std import Header, Time


@message("nav_msgs/msg/Odometry")
class Odometry(Message):
    """Estimated motion: the pose in ``header.frame_id``, the twist in ``child_frame_id``."""

    header: Header = Header()
    child_frame_id: str = ""
    pose: PoseWithCovariance = PoseWithCovariance()
    twist: TwistWithCovariance = TwistWithCovariance()


@message("nav_msgs/msg/Path")
class Path(Message):
    """Poses to go through, in order."""

    header: Header = Header()
    poses: Sequence[PoseStamped] = ()


@message("nav_msgs/msg/MapMetaData")
class MapMetaData(Message):
    """Geometry of a map: ``resolution`` m per cell, size in cells, ``origin`` is the pose of cell (0, 0)'s corner."""

    map_load_time: Time = Time()
    resolution: float = 0.0
    width: int = 0
    height: int = 0
    origin: Pose = Pose()


@message("nav_msgs/msg/OccupancyGrid")
class OccupancyGrid(Message):
    """A map: ``data`` row by row from (0, 0), probability of being occupied in per cent, -1 unknown."""

    header: Header = Header()
    info: MapMetaData = MapMetaData()
    data: Int8s = array(np.int8)


@message("tf2_msgs/msg/TFMessage")
class TFMessage(Message):
    """Transforms between frames, as on ``/tf``."""

    transforms: Sequence[TransformStamped] = ()
