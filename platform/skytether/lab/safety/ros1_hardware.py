"""Wheels and sensors as a node of a real ROS 1 graph, with a master of its own."""

from __future__ import annotations

import asyncio
import os
import shutil
import socket
import subprocess
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from xmlrpc.client import Error, ServerProxy

from skytether.guard.clock import now
from skytether.guard.velocity import Velocity
from skytether.messages import Bool, Joy, LaserScan, Message, Twist, decode, encode, hash_of
from skytether.ros.ros1.node import Node
from skytether.ros.ros1.subscription import Listener

from .checker import SentVelocity
from .record import WheelRecord

_HOST = "127.0.0.1"
_WHEELS = "/cmd_vel_safe"
_SENSORS: Mapping[str, type[Message]] = {"scan": LaserScan, "estop": Bool, "joy": Joy}
_PATIENCE_S = 30.0
_LOOK_S = 0.004
_PROGRAM = "rosmaster"


def available() -> bool:
    """Whether there is a ROS 1 master to be started."""
    return shutil.which(_PROGRAM) is not None


class Ros1Hardware:
    """Remembers with each velocity when it was received: TCP says nothing of when it was sent.

    And since when it may have waited: the node's thread looks again and again, and between two looks it may be held up.

    Args:
        folder: Of the gate's sockets; the master's log is there too.

    Raises:
        OSError: The master does not start.
    """

    def __init__(self, folder: Path) -> None:
        self.record = WheelRecord()
        self._looked: deque[float] = deque([now()] * 2, 2)
        self._looks = False
        self._undo = ExitStack()
        with socket.create_server((_HOST, 0)) as free:
            port = free.getsockname()[1]
        self.master = f"http://{_HOST}:{port}"
        self.section: Mapping[str, Any] = {"ros1": {"master": self.master, "host": _HOST, "cmd_vel": _WHEELS}}
        self._folder = folder
        self._gone: Callable[[], None] | None = None
        try:
            self._process = self.start_master()
            self._undo.callback(self.end_master)
            self._node = Node("played_hardware", self.master, host=_HOST)
            self._node.start()
            self._undo.callback(self._node.close)
        except BaseException:
            self._undo.close()
            raise
        self._sensors = {
            name: self._node.advertise(f"/{name}", kind.TYPE, hash_of(kind.TYPE, "ros1"), queue=1)
            for name, kind in _SENSORS.items()
        }
        self.appear()

    def start_master(self) -> subprocess.Popen[bytes]:
        """Start the master, also after `end_master`."""
        port = self.master.rpartition(":")[2]
        environment = {**os.environ, "ROS_HOME": str(self._folder), "ROS_LOG_DIR": str(self._folder)}
        with (self._folder / "master.log").open("ab") as log:
            self._process = subprocess.Popen(
                [_PROGRAM, "--core", "-p", port], env=environment, stdout=log, stderr=log, stdin=subprocess.DEVNULL
            )
        end = time.monotonic() + _PATIENCE_S
        while not self._answers():
            if time.monotonic() > end:
                raise OSError(f"{_PROGRAM} does not answer within {_PATIENCE_S:g} s")
            time.sleep(0.05)
        return self._process

    def end_master(self) -> None:
        """Kill the master."""
        self._process.kill()
        self._process.wait()

    def send(self, topic: str, message: Message) -> None:
        """Hardware: publish it."""
        self._sensors[topic].publish(encode(message, "ros1"))

    def vanish(self) -> None:
        """Hardware: subscribe no more."""
        gone, self._gone = self._gone, None
        if gone is not None:
            gone()

    def appear(self) -> None:
        """Hardware: subscribe."""
        self._gone = self._node.subscribe(_WHEELS, Twist.TYPE, hash_of(Twist.TYPE, "ros1"), Listener(self._on_velocity))

    def close(self) -> None:
        """Hardware: leave the graph, end the master."""
        self._undo.close()

    def _answers(self) -> bool:
        try:
            with ServerProxy(self.master) as proxy:
                return bool(proxy.getPid("/played_hardware")[0] == 1)  # type: ignore[index]
        except (OSError, Error):
            return False

    def _on_velocity(self, data: bytes, _: object) -> None:
        if not self._looks:
            self._looks = True
            self._note_turn()
        twist = decode(Twist, data, "ros1")
        # Of the look in the same turn of the thread's loop nobody knows whether it was before or after the message.
        self.record.add(SentVelocity(now(), Velocity(twist.linear.x, twist.angular.z), earliest=self._looked[0]))

    def _note_turn(self) -> None:
        self._looked.append(now())
        asyncio.get_running_loop().call_later(_LOOK_S, self._note_turn)
