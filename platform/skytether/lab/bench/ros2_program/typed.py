"""A talker and a listener as users write them: messages are made and decoded, number and time stand in their fields."""

from __future__ import annotations

from array import array
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Twist, Vector3
from sensor_msgs.msg import CompressedImage, LaserScan
from std_msgs.msg import Header

from .graph import Deliver, Flow, Wanted
from .schedule import HEADER
from .with_rclpy import RclpyGraph

_NANO = 1_000_000_000
RAYS = 541


class TypedGraph(RclpyGraph):
    """Topics of the types that the flows name."""

    def __init__(self, wanted: Wanted, deliver: Deliver) -> None:
        """Join the graph."""
        self._ranges = array("f", [1.0]) * RAYS
        self._pictures = {i: array("B", bytes(flow.size)) for i, flow in enumerate(wanted.flows)}
        super().__init__(wanted, deliver)

    def _type(self, flow: Flow) -> tuple[Any, bool]:
        return {"Twist": Twist, "LaserScan": LaserScan, "CompressedImage": CompressedImage}[flow.type], False

    def publish(self, index: int, payload: bytes) -> None:
        number, at = HEADER.unpack_from(payload)
        self._publishers[index].publish(self._message(index, number, at))

    def _message(self, index: int, number: int, at: float) -> Any:
        kind = self._wanted.flows[index].type
        if kind == "Twist":
            return Twist(linear=Vector3(x=at, y=float(number)))
        nanoseconds = round(at * _NANO)
        header = Header(stamp=Time(sec=nanoseconds // _NANO, nanosec=nanoseconds % _NANO), frame_id=str(number))
        if kind == "LaserScan":
            return LaserScan(header=header, ranges=self._ranges)
        return CompressedImage(header=header, format="jpeg", data=self._pictures[index])

    def _deliver(self, index: int, message: Any) -> None:
        if isinstance(message, Twist):
            number, at = int(message.linear.y), message.linear.x
        else:
            stamp = message.header.stamp
            number, at = int(message.header.frame_id), stamp.sec + stamp.nanosec / _NANO
        self._pass_on(index, HEADER.pack(number, at), 0)
