"""``geometry_msgs``: metres, radians, seconds, newtons; right-handed frames, x forward, y left, z up."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from .base import Float64s, Message, array, message
from .std import Header


@message("geometry_msgs/msg/Vector3")
class Vector3(Message):
    """A free vector, in the unit of the field that holds it."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@message("geometry_msgs/msg/Point")
class Point(Message):
    """A position, m."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@message("geometry_msgs/msg/Point32")
class Point32(Message):
    """A position in single precision, m."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@message("geometry_msgs/msg/Quaternion")
class Quaternion(Message):
    """A rotation as a unit quaternion; the default turns nothing."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


@message("geometry_msgs/msg/Pose")
class Pose(Message):
    """Position and orientation."""

    position: Point = Point()
    orientation: Quaternion = Quaternion()


@message("geometry_msgs/msg/PoseStamped")
class PoseStamped(Message):
    """A pose in ``header.frame_id``."""

    header: Header = Header()
    pose: Pose = Pose()


@message("geometry_msgs/msg/PoseArray")
class PoseArray(Message):
    """Poses in ``header.frame_id``, such as those of particles."""

    header: Header = Header()
    poses: Sequence[Pose] = ()


@message("geometry_msgs/msg/PoseWithCovariance")
class PoseWithCovariance(Message):
    """A pose and the 6 x 6 covariance, row by row, of x, y, z, and rotation about x, y, z (m, rad)."""

    pose: Pose = Pose()
    covariance: Float64s = array(np.float64, 36)


@message("geometry_msgs/msg/PoseWithCovarianceStamped")
class PoseWithCovarianceStamped(Message):
    """An uncertain pose in ``header.frame_id``."""

    header: Header = Header()
    pose: PoseWithCovariance = PoseWithCovariance()


@message("geometry_msgs/msg/Twist")
class Twist(Message):
    """Velocity: linear m/s, angular rad/s; a command is in the robot's base frame."""

    linear: Vector3 = Vector3()
    angular: Vector3 = Vector3()


@message("geometry_msgs/msg/TwistStamped")
class TwistStamped(Message):
    """A velocity in ``header.frame_id``."""

    header: Header = Header()
    twist: Twist = Twist()


@message("geometry_msgs/msg/TwistWithCovariance")
class TwistWithCovariance(Message):
    """A velocity and the 6 x 6 covariance, row by row, of its linear and angular parts (m/s, rad/s)."""

    twist: Twist = Twist()
    covariance: Float64s = array(np.float64, 36)


@message("geometry_msgs/msg/Wrench")
class Wrench(Message):
    """Force N and torque N m."""

    force: Vector3 = Vector3()
    torque: Vector3 = Vector3()


@message("geometry_msgs/msg/WrenchStamped")
class WrenchStamped(Message):
    """A wrench in ``header.frame_id``."""

    header: Header = Header()
    wrench: Wrench = Wrench()


@message("geometry_msgs/msg/Transform")
class Transform(Message):
    """Takes coordinates in the child frame to the parent frame: rotation first, then translation (m)."""

    translation: Vector3 = Vector3()
    rotation: Quaternion = Quaternion()


@message("geometry_msgs/msg/TransformStamped")
class TransformStamped(Message):
    """Pose of ``child_frame_id`` in ``header.frame_id``."""

    header: Header = Header()
    child_frame_id: str = ""
    transform: Transform = Transform()


def yaw_of(rotation: Quaternion) -> float:
    """Rotation about z, rad in [-pi, pi]; the quaternion need not have unit length."""
    x, y, z, w = rotation.x, rotation.y, rotation.z, rotation.w
    return math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def quaternion_from_yaw(yaw: float) -> Quaternion:
    """Rotation about z by ``yaw`` rad."""
    return Quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2))
