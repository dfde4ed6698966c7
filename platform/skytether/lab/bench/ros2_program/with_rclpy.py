"""A node of ROS 2 as users write them, serialised messages in and out."""

from __future__ import annotations

import contextlib
import threading
from functools import partial
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import UInt8MultiArray

from .graph import HEAD_BYTES, Deliver, Flow, Graph, Wanted, serialise


class RclpyGraph(Graph):
    """One node, spun by the default executor in a thread of its own."""

    def __init__(self, wanted: Wanted, deliver: Deliver) -> None:
        """Join the graph."""
        rclpy.init(domain_id=wanted.domain)
        self._wanted = wanted
        self._pass_on = deliver
        self._node = rclpy.create_node("bench", enable_rosout=False, start_parameter_services=False)
        for i in wanted.receives:
            kind, raw = self._type(wanted.flows[i])
            self._node.create_subscription(
                kind, wanted.flows[i].topic, partial(self._deliver, i), self._quality(i), raw=raw
            )
        self._publishers = {
            i: self._node.create_publisher(self._type(flow)[0], flow.topic, self._quality(i))
            for i, flow in ((i, wanted.flows[i]) for i in wanted.sends)
        }
        self._thread = threading.Thread(target=self._spin, name="spin", daemon=True)
        self._thread.start()

    def connected(self) -> bool:
        heard = (self._node.count_publishers(self._wanted.flows[i].topic) for i in self._wanted.receives)
        return all(p.get_subscription_count() for p in self._publishers.values()) and all(heard)

    def publish(self, index: int, payload: bytes) -> None:
        self._publishers[index].publish(serialise(payload))

    def _type(self, flow: Flow) -> tuple[Any, bool]:
        """Of a topic's messages, and whether they are taken as they come."""
        del flow
        return UInt8MultiArray, True

    def _deliver(self, index: int, message: Any) -> None:
        self._pass_on(index, message, HEAD_BYTES)

    def close(self) -> None:
        rclpy.shutdown()
        self._thread.join(1.0)

    def _spin(self) -> None:
        with contextlib.suppress(ExternalShutdownException):
            rclpy.spin(self._node)

    def _quality(self, index: int) -> QoSProfile:
        kind = ReliabilityPolicy.RELIABLE if self._wanted.reliable else ReliabilityPolicy.BEST_EFFORT
        return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=self._wanted.flows[index].depth, reliability=kind)
