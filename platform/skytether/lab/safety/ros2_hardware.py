"""Wheels and sensors as a plain node of a real ROS 2 graph, under ROS 2's own Python."""

from __future__ import annotations

import base64
import json
import os
import signal
import subprocess
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from skytether.guard.velocity import Velocity
from skytether.lab.ros2_python import ros2_python
from skytether.messages import Message, Twist, TwistStamped, encode

from . import ros2_program
from .checker import SentVelocity
from .record import WheelRecord

_WHEELS = "/cmd_vel_safe"
_START = "import runpy, sys; sys.path.append(sys.argv[1]); runpy.run_module(sys.argv[2], run_name='__main__')"
_DOMAINS = 100
_STOP_S = 3.0


class Ros2Hardware:
    """Remembers with each velocity when its node took it, and when it was published, as DDS tells.

    Args:
        folder: Of the gate's sockets; the node's log is there too.
        stamped: Whether the wheels take TwistStamped.

    Raises:
        OSError: The node does not start.
    """

    def __init__(self, folder: Path, *, stamped: bool = False) -> None:
        self.record = WheelRecord()
        domain = os.getpid() % _DOMAINS  # whoever else measures here is in another
        kind = TwistStamped if stamped else Twist
        self.section: Mapping[str, Any] = {
            "ros2": {"domain": domain, "python": ros2_python(), "cmd_vel": _WHEELS, "cmd_vel_type": kind.TYPE}
        }
        package = Path(ros2_program.__file__).parent
        words = [str(package.parent), package.name, _WHEELS, "stamped" if stamped else "plain"]
        with (folder / "hardware.log").open("ab") as log:
            self._process = subprocess.Popen(
                [ros2_python(), "-c", _START, *words],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
            )
        self._lock = threading.Lock()
        self._joined = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="ros2-hardware", daemon=True)
        self._thread.start()
        self._joined.wait()
        if self._process.poll() is not None:
            raise OSError(f"the played node ended: {(folder / 'hardware.log').read_text()[-500:]}")

    def send(self, topic: str, message: Message) -> None:
        """Hardware: publish it."""
        self._send(do="send", topic=topic, data=base64.b64encode(encode(message)).decode())

    def vanish(self) -> None:
        """Hardware: subscribe no more."""
        self._send(do="vanish")

    def appear(self) -> None:
        """Hardware: subscribe."""
        self._send(do="appear")

    def freeze(self) -> None:
        """The node's program stands still."""
        self._process.send_signal(signal.SIGSTOP)

    def thaw(self) -> None:
        """It goes on."""
        self._process.send_signal(signal.SIGCONT)

    def intrude(self) -> None:
        """Another node listens to the velocities, as if they were of another type."""
        self._send(do="intrude")

    def leave(self) -> None:
        """That one is gone."""
        self._send(do="leave")

    def close(self) -> None:
        """Hardware: leave the graph."""
        self._process.kill()
        self._process.wait(_STOP_S)
        self._thread.join()
        if self._process.stdin is not None:
            with suppress(BrokenPipeError):
                self._process.stdin.close()

    def _send(self, **what: Any) -> None:
        with self._lock, suppress(OSError):
            print(json.dumps(what), file=self._process.stdin, flush=True)

    def _listen(self) -> None:
        if self._process.stdout is not None:
            with self._process.stdout as answers:
                for line in answers:
                    self._on_answer(json.loads(line))
        self._joined.set()

    def _on_answer(self, said: Any) -> None:
        if not self._joined.is_set():  # it is ready
            self._joined.set()
            return
        taken, published, x, z = said
        self.record.add(SentVelocity(taken, Velocity(x, z), earliest=min(published, taken)))
