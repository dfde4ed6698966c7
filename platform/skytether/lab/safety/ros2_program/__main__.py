"""Played wheels and sensors as a plain node. Reads lines of JSON: what to do; says each velocity, and when it was.

``{"do": "send", "topic": ..., "data": base64 of CDR}``, ``vanish``, ``appear``; ``intrude`` and ``leave``: another node
listens to the velocities, as if they were of another type. It says ``ready``,
then ``[taken, published, x, z]`` for each velocity: both times [s] of CLOCK_BOOTTIME, the second by DDS, which has the
writer's.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import sys
import threading
import time
from typing import Any

import rclpy
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Joy, LaserScan
from std_msgs.msg import Bool, String

_SENSORS = {"scan": LaserScan, "estop": Bool, "joy": Joy}
_DEPTH = 100
"""Of the wheels' subscription: what comes in one go is seen, whole."""


def _since_start() -> float:
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class _Played:
    def __init__(self, wheels: str, stamped: bool) -> None:
        self._answers = os.fdopen(os.dup(1), "w", buffering=1)
        os.dup2(2, 1)  # libraries write to standard output; answers only go where answers are read
        rclpy.init()
        self._node = rclpy.create_node("played_hardware", start_parameter_services=False)
        self._wheels, self._stamped = wheels, stamped
        quality = QoSProfile(depth=10)
        self._sensors = {name: self._node.create_publisher(kind, name, quality) for name, kind in _SENSORS.items()}
        self._subscription: Any = None
        self._stranger: Any = None
        self._do_appear()
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)

    def run(self) -> None:
        threading.Thread(target=self._read, daemon=True).start()
        print(json.dumps("ready"), file=self._answers, flush=True)
        with contextlib.suppress(ExternalShutdownException):
            self._executor.spin()

    def _read(self) -> None:
        for line in sys.stdin:
            what = json.loads(line)
            do = getattr(self, f"_do_{what.pop('do')}")
            if do == self._do_send:
                do(**what)
            else:
                self._executor.create_task(do)
        os._exit(0)

    def _do_send(self, topic: str, data: str) -> None:
        self._sensors[topic].publish(base64.b64decode(data))

    def _do_vanish(self) -> None:
        self._node.destroy_subscription(self._subscription)

    def _do_appear(self) -> None:
        kind = TwistStamped if self._stamped else Twist
        self._subscription = self._node.create_subscription(
            kind, self._wheels, self._on_velocity, QoSProfile(depth=_DEPTH)
        )

    def _do_intrude(self) -> None:
        context = rclpy.Context()  # a participant of its own: one has a topic with one type only
        rclpy.init(context=context)
        self._stranger = rclpy.create_node("stranger", context=context, start_parameter_services=False)
        self._stranger.create_subscription(String, self._wheels, lambda _: None, QoSProfile(depth=1))

    def _do_leave(self) -> None:
        self._stranger.destroy_node()

    def _on_velocity(self, message: Any, info: Any) -> None:
        taken = _since_start()
        ago = time.time() - info["source_timestamp"] * 1e-9
        twist = message.twist if self._stamped else message
        print(json.dumps([taken, taken - ago, twist.linear.x, twist.angular.z]), file=self._answers, flush=True)


_Played(sys.argv[-2], sys.argv[-1] == "stamped").run()
