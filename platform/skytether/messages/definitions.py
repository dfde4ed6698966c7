"""Definitions of the message types that have a class here, as the codec's type stores hold them.

`rosbags` has them too, among those of 200 other types, and makes a class of each: that takes 100 to 200 ms at the start
of every service and robot, most of which never meet another type. A test holds these to those.
"""

from __future__ import annotations

from typing import Any

from rosbags.interfaces import Nodetype

from .action_definitions import ACTIONS

ROS2_PARTS = {
    "visualization_msgs/msg/MeshFile": "string filename, uint8[] data",
    "visualization_msgs/msg/UVCoordinate": "float32 u, float32 v",
}
"""What only types of ROS 2 are made of; ROS 1 has no such types, and nothing that names them."""

_BOTH = {
    "builtin_interfaces/msg/Duration": "int32 sec, uint32 nanosec",
    "builtin_interfaces/msg/Time": "int32 sec, uint32 nanosec",
    "geometry_msgs/msg/Point": "float64 x, float64 y, float64 z",
    "geometry_msgs/msg/Point32": "float32 x, float32 y, float32 z",
    "geometry_msgs/msg/Pose": "geometry_msgs/msg/Point position, geometry_msgs/msg/Quaternion orientation",
    "geometry_msgs/msg/PoseArray": "std_msgs/msg/Header header, geometry_msgs/msg/Pose[] poses",
    "geometry_msgs/msg/PoseStamped": "std_msgs/msg/Header header, geometry_msgs/msg/Pose pose",
    "geometry_msgs/msg/PoseWithCovariance": "geometry_msgs/msg/Pose pose, float64[36] covariance",
    "geometry_msgs/msg/PoseWithCovarianceStamped": (
        "std_msgs/msg/Header header, geometry_msgs/msg/PoseWithCovariance pose"
    ),
    "geometry_msgs/msg/Quaternion": "float64 x, float64 y, float64 z, float64 w",
    "geometry_msgs/msg/Transform": "geometry_msgs/msg/Vector3 translation, geometry_msgs/msg/Quaternion rotation",
    "geometry_msgs/msg/TransformStamped": (
        "std_msgs/msg/Header header, string child_frame_id, geometry_msgs/msg/Transform transform"
    ),
    "geometry_msgs/msg/Twist": "geometry_msgs/msg/Vector3 linear, geometry_msgs/msg/Vector3 angular",
    "geometry_msgs/msg/TwistStamped": "std_msgs/msg/Header header, geometry_msgs/msg/Twist twist",
    "geometry_msgs/msg/TwistWithCovariance": "geometry_msgs/msg/Twist twist, float64[36] covariance",
    "geometry_msgs/msg/Vector3": "float64 x, float64 y, float64 z",
    "geometry_msgs/msg/Wrench": "geometry_msgs/msg/Vector3 force, geometry_msgs/msg/Vector3 torque",
    "geometry_msgs/msg/WrenchStamped": "std_msgs/msg/Header header, geometry_msgs/msg/Wrench wrench",
    "nav_msgs/msg/MapMetaData": (
        "builtin_interfaces/msg/Time map_load_time, float32 resolution, uint32 width, uint32 height, "
        "geometry_msgs/msg/Pose origin"
    ),
    "nav_msgs/msg/OccupancyGrid": "std_msgs/msg/Header header, nav_msgs/msg/MapMetaData info, int8[] data",
    "nav_msgs/msg/Odometry": (
        "std_msgs/msg/Header header, string child_frame_id, geometry_msgs/msg/PoseWithCovariance pose, "
        "geometry_msgs/msg/TwistWithCovariance twist"
    ),
    "nav_msgs/msg/Path": "std_msgs/msg/Header header, geometry_msgs/msg/PoseStamped[] poses",
    "nav_msgs/srv/GetMap_Request": "uint8 structure_needs_at_least_one_member",
    "nav_msgs/srv/GetMap_Response": "nav_msgs/msg/OccupancyGrid map",
    "nav_msgs/srv/GetPlan_Request": (
        "geometry_msgs/msg/PoseStamped start, geometry_msgs/msg/PoseStamped goal, float32 tolerance"
    ),
    "nav_msgs/srv/GetPlan_Response": "nav_msgs/msg/Path plan",
    "sensor_msgs/msg/CompressedImage": "std_msgs/msg/Header header, string format, uint8[] data",
    "sensor_msgs/msg/Imu": (
        "std_msgs/msg/Header header, geometry_msgs/msg/Quaternion orientation, float64[9] orientation_covariance, "
        "geometry_msgs/msg/Vector3 angular_velocity, float64[9] angular_velocity_covariance, "
        "geometry_msgs/msg/Vector3 linear_acceleration, float64[9] linear_acceleration_covariance"
    ),
    "sensor_msgs/msg/JointState": (
        "std_msgs/msg/Header header, string[] name, float64[] position, float64[] velocity, float64[] effort"
    ),
    "sensor_msgs/msg/Joy": "std_msgs/msg/Header header, float32[] axes, int32[] buttons",
    "sensor_msgs/msg/LaserScan": (
        "std_msgs/msg/Header header, float32 angle_min, float32 angle_max, float32 angle_increment, "
        "float32 time_increment, float32 scan_time, float32 range_min, float32 range_max, float32[] ranges, "
        "float32[] intensities"
    ),
    "sensor_msgs/msg/ChannelFloat32": "string name, float32[] values",
    "sensor_msgs/msg/PointCloud": (
        "std_msgs/msg/Header header, geometry_msgs/msg/Point32[] points, sensor_msgs/msg/ChannelFloat32[] channels"
    ),
    "sensor_msgs/msg/PointCloud2": (
        "std_msgs/msg/Header header, uint32 height, uint32 width, sensor_msgs/msg/PointField[] fields, "
        "bool is_bigendian, uint32 point_step, uint32 row_step, uint8[] data, bool is_dense"
    ),
    "sensor_msgs/msg/PointField": (
        "uint8 INT8=1, uint8 UINT8=2, uint8 INT16=3, uint8 UINT16=4, uint8 INT32=5, uint8 UINT32=6, "
        "uint8 FLOAT32=7, uint8 FLOAT64=8, string name, uint32 offset, uint8 datatype, uint32 count"
    ),
    "std_msgs/msg/Bool": "bool data",
    "std_msgs/msg/ColorRGBA": "float32 r, float32 g, float32 b, float32 a",
    "std_msgs/msg/Float32": "float32 data",
    "std_msgs/msg/Float64": "float64 data",
    "std_msgs/msg/String": "string data",
    "std_srvs/srv/SetBool_Request": "bool data",
    "std_srvs/srv/SetBool_Response": "bool success, string message",
    "std_srvs/srv/Trigger_Request": "uint8 structure_needs_at_least_one_member",
    "std_srvs/srv/Trigger_Response": "bool success, string message",
    "tf2_msgs/msg/TFMessage": "geometry_msgs/msg/TransformStamped[] transforms",
    "visualization_msgs/msg/MarkerArray": "visualization_msgs/msg/Marker[] markers",
    **ROS2_PARTS,
    **ACTIONS,
}
"""Of types that are the same in ROS 1 and ROS 2, in the words of ``.msg`` files."""

_OF_ONE: dict[str, dict[str, str]] = {
    "ros1": {
        "sensor_msgs/msg/Range": (
            "uint8 ULTRASOUND=0, uint8 INFRARED=1, std_msgs/msg/Header header, uint8 radiation_type, "
            "float32 field_of_view, float32 min_range, float32 max_range, float32 range"
        ),
        "std_msgs/msg/Header": "uint32 seq, builtin_interfaces/msg/Time stamp, string frame_id",
        "visualization_msgs/msg/Marker": (
            "uint8 ARROW=0, uint8 CUBE=1, uint8 SPHERE=2, uint8 CYLINDER=3, uint8 LINE_STRIP=4, uint8 LINE_LIST=5, "
            "uint8 CUBE_LIST=6, uint8 SPHERE_LIST=7, uint8 POINTS=8, uint8 TEXT_VIEW_FACING=9, uint8 MESH_RESOURCE=10, "
            "uint8 TRIANGLE_LIST=11, uint8 ADD=0, uint8 MODIFY=0, uint8 DELETE=2, uint8 DELETEALL=3, "
            "std_msgs/msg/Header header, string ns, int32 id, int32 type, int32 action, geometry_msgs/msg/Pose pose, "
            "geometry_msgs/msg/Vector3 scale, std_msgs/msg/ColorRGBA color, builtin_interfaces/msg/Duration lifetime, "
            "bool frame_locked, geometry_msgs/msg/Point[] points, std_msgs/msg/ColorRGBA[] colors, string text, "
            "string mesh_resource, bool mesh_use_embedded_materials"
        ),
    },
    "cdr": {
        "sensor_msgs/msg/Range": (
            "uint8 ULTRASOUND=0, uint8 INFRARED=1, std_msgs/msg/Header header, uint8 radiation_type, "
            "float32 field_of_view, float32 min_range, float32 max_range, float32 range, float32 variance"
        ),
        "std_msgs/msg/Header": "builtin_interfaces/msg/Time stamp, string frame_id",
        "visualization_msgs/msg/Marker": (
            "int32 ARROW=0, int32 CUBE=1, int32 SPHERE=2, int32 CYLINDER=3, int32 LINE_STRIP=4, int32 LINE_LIST=5, "
            "int32 CUBE_LIST=6, int32 SPHERE_LIST=7, int32 POINTS=8, int32 TEXT_VIEW_FACING=9, int32 MESH_RESOURCE=10, "
            "int32 TRIANGLE_LIST=11, int32 ARROW_STRIP=12, int32 ADD=0, int32 MODIFY=0, int32 DELETE=2, "
            "int32 DELETEALL=3, "
            "std_msgs/msg/Header header, string ns, int32 id, int32 type, int32 action, geometry_msgs/msg/Pose pose, "
            "geometry_msgs/msg/Vector3 scale, std_msgs/msg/ColorRGBA color, builtin_interfaces/msg/Duration lifetime, "
            "bool frame_locked, geometry_msgs/msg/Point[] points, std_msgs/msg/ColorRGBA[] colors, "
            "string texture_resource, sensor_msgs/msg/CompressedImage texture, "
            "visualization_msgs/msg/UVCoordinate[] uv_coordinates, string text, string mesh_resource, "
            "visualization_msgs/msg/MeshFile mesh_file, bool mesh_use_embedded_materials"
        ),
    },
}


def definitions(encoding: str) -> dict[str, Any]:
    """By type name: constants (name, type, value), and fields (name, kind), as in `rosbags`."""
    return {name: _parse(text) for name, text in (_BOTH | _OF_ONE[encoding]).items()}


def _parse(text: str) -> tuple[list[tuple[str, str, int]], list[tuple[str, Any]]]:
    constants, fields = [], []
    for part in text.split(", "):
        kind, name = part.split(" ")
        if "=" in name:
            name, value = name.split("=")
            constants.append((name, kind, int(value)))
        else:
            fields.append((name, _kind(kind)))
    return constants, fields


def _kind(text: str) -> Any:
    if text.endswith("]"):
        element, length = text[:-1].split("[")
        return (Nodetype.ARRAY, (_kind(element), int(length))) if length else (Nodetype.SEQUENCE, (_kind(element), 0))
    return (Nodetype.NAME, text) if "/" in text else (Nodetype.BASE, (text, 0))
