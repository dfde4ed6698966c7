"""``visualization_msgs``: what RViz and Foxglove draw."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .base import Message, Uint8s, array, message
from .geometry import Point, Pose, Vector3
from .sensor import CompressedImage
from .std import ColorRGBA, Duration, Header


@message("visualization_msgs/msg/UVCoordinate")
class UVCoordinate(Message):
    """A place on a texture; ROS 2 only."""

    u: float = 0.0
    v: float = 0.0


@message("visualization_msgs/msg/MeshFile")
class MeshFile(Message):
    """A mesh within a message; ROS 2 only."""

    filename: str = ""
    data: Uint8s = array(np.uint8)


@message("visualization_msgs/msg/Marker")
class Marker(Message):
    """Something to draw, in ``header.frame_id``.

    ``type``: 0 arrow, 1 cube, 2 sphere, 3 cylinder, 4 line strip, 5 line list, 6 list of cubes, 7 of spheres, 8 points,
    9 text, 10 mesh, 11 list of triangles. ``action``: 0 add or change, 2 delete, 3 delete all. ``lifetime`` 0 is for
    ever. What has a texture, uv_coordinates or a mesh_file is of ROS 2 only.
    """

    header: Header = Header()
    ns: str = ""
    id: int = 0
    type: int = 0
    action: int = 0
    pose: Pose = Pose()
    scale: Vector3 = Vector3()
    color: ColorRGBA = ColorRGBA()
    lifetime: Duration = Duration()
    frame_locked: bool = False
    points: Sequence[Point] = ()
    colors: Sequence[ColorRGBA] = ()
    texture_resource: str = ""
    texture: CompressedImage = CompressedImage()
    uv_coordinates: Sequence[UVCoordinate] = ()
    text: str = ""
    mesh_resource: str = ""
    mesh_file: MeshFile = MeshFile()
    mesh_use_embedded_materials: bool = False


@message("visualization_msgs/msg/MarkerArray")
class MarkerArray(Message):
    """Markers that are drawn together."""

    markers: Sequence[Marker] = ()
