"""``sensor_msgs``: what sensors say. SI units."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .base import Float32s, Float64s, Int32s, Message, Uint8s, array, message
from .geometry import Point32, Quaternion, Vector3
from .std import Header


@message("sensor_msgs/msg/LaserScan")
class LaserScan(Message):
    """One sweep of a planar laser; ray i points to ``angle_min + i * angle_increment`` in ``header.frame_id``.

    Angles in rad about z, times in s, ranges in m; outside ``range_min`` to ``range_max`` a range means nothing.
    ``intensities`` has one value for each range, or none.
    """

    header: Header = Header()
    angle_min: float = 0.0
    angle_max: float = 0.0
    angle_increment: float = 0.0
    time_increment: float = 0.0
    scan_time: float = 0.0
    range_min: float = 0.0
    range_max: float = 0.0
    ranges: Float32s = array(np.float32)
    intensities: Float32s = array(np.float32)


@message("sensor_msgs/msg/Range")
class Range(Message):
    """One distance: m, within a cone of ``field_of_view`` rad. ``radiation_type``: 0 ultrasound, 1 infrared."""

    header: Header = Header()
    radiation_type: int = 0
    field_of_view: float = 0.0
    min_range: float = 0.0
    max_range: float = 0.0
    range: float = 0.0
    variance: float = 0.0
    """m^2, 0 if unknown; from ROS 2 Iron on, not part of a ROS 1 message."""


@message("sensor_msgs/msg/JointState")
class JointState(Message):
    """State of joints: position rad or m, velocity rad/s or m/s, effort N m or N; as long as ``name`` or empty."""

    header: Header = Header()
    name: Sequence[str] = ()
    position: Float64s = array(np.float64)
    velocity: Float64s = array(np.float64)
    effort: Float64s = array(np.float64)


@message("sensor_msgs/msg/Imu")
class Imu(Message):
    """Orientation, angular velocity rad/s and linear acceleration m/s^2, with 3 x 3 covariances row by row.

    A covariance that starts with -1 says that its quantity is not measured.
    """

    header: Header = Header()
    orientation: Quaternion = Quaternion()
    orientation_covariance: Float64s = array(np.float64, 9)
    angular_velocity: Vector3 = Vector3()
    angular_velocity_covariance: Float64s = array(np.float64, 9)
    linear_acceleration: Vector3 = Vector3()
    linear_acceleration_covariance: Float64s = array(np.float64, 9)


@message("sensor_msgs/msg/CompressedImage")
class CompressedImage(Message):
    """A picture as a JPEG or PNG file; ``format`` is ``jpeg`` or ``png``, possibly with the pixel format before it."""

    header: Header = Header()
    format: str = ""
    data: Uint8s = array(np.uint8)


@message("sensor_msgs/msg/ChannelFloat32")
class ChannelFloat32(Message):
    """A value for each point of a `PointCloud`, in its order."""

    name: str = ""
    values: Float32s = array(np.float32)


@message("sensor_msgs/msg/PointCloud")
class PointCloud(Message):
    """Points, as old drivers give them (RosAria's sonars); others use `PointCloud2`."""

    header: Header = Header()
    points: Sequence[Point32] = ()
    channels: Sequence[ChannelFloat32] = ()


@message("sensor_msgs/msg/PointField")
class PointField(Message):
    """One channel of a point cloud.

    ``datatype``: 1 int8, 2 uint8, 3 int16, 4 uint16, 5 int32, 6 uint32, 7 float32, 8 float64.
    """

    name: str = ""
    offset: int = 0
    datatype: int = 0
    count: int = 0


@message("sensor_msgs/msg/PointCloud2")
class PointCloud2(Message):
    """Packed points: ``height`` rows of ``width`` points of ``point_step`` bytes, laid out by ``fields``."""

    header: Header = Header()
    height: int = 0
    width: int = 0
    fields: Sequence[PointField] = ()
    is_bigendian: bool = False
    point_step: int = 0
    row_step: int = 0
    data: Uint8s = array(np.uint8)
    is_dense: bool = False


@message("sensor_msgs/msg/Joy")
class Joy(Message):
    """Axes and buttons of a gamepad; axes in -1 to 1, buttons 0 or 1."""

    header: Header = Header()
    axes: Float32s = array(np.float32)
    buttons: Int32s = array(np.int32)
