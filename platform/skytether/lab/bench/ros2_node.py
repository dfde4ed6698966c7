"""A node under ROS 2's own Python, in a process of its own: found, started, told what to send, asked what it noted."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import subprocess
import threading
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from skytether.lab.ros2_python import PYTHON, ros2_python

from . import ros2_program
from .ros2_program.schedule import Order
from .rows import Notes
from .transports.base import TransportError

_START = "import runpy, sys; sys.path.append(sys.argv[1]); runpy.run_module(sys.argv[2], run_name='__main__')"
_STOP_S = 0.5
_OVERRULED = ("ROS_LOCALHOST_ONLY", "ROS_SECURITY_ENABLE", "FASTRTPS_DEFAULT_PROFILES_FILE", "CYCLONEDDS_URI")
"""What the user's environment may say, and a measurement decides."""


def check_python(module: str = "rclpy") -> None:
    """See that ROS 2's Python has what is needed.

    Raises:
        TransportError: It has not; the text says what to install.
    """
    trouble = _why_missing(ros2_python(), module)
    if trouble is not None:
        raise TransportError(f"{trouble}: run `make ros2`, or name a Python that can with {PYTHON}")


@cache
def _why_missing(python: str, module: str) -> str | None:
    try:
        tried = subprocess.run([python, "-c", f"import {module}"], capture_output=True, text=True, check=False)
    except OSError as error:
        return f"{python}: {error.strerror}"
    return f"{python} cannot import {module}" if tried.returncode else None


class Node:
    """Started when it is made; its graph is joined then, not yet connected."""

    def __init__(self, wanted: Mapping[str, Any], folder: str, name: str, environment: Mapping[str, str]) -> None:
        """Start it.

        Args:
            wanted: What it is to be; the program's `Wanted`.
            folder: For its log.
            name: Of its log.
            environment: Beyond what this process has.

        Raises:
            TransportError: It ended.
        """
        self.log = Path(folder) / f"{name}.log"
        self._answers: queue.Queue[Any] = queue.Queue()
        package = Path(ros2_program.__file__).parent
        kept = {key: value for key, value in os.environ.items() if key not in _OVERRULED}
        with self.log.open("w") as log:
            self._process = subprocess.Popen(
                [ros2_python(), "-c", _START, str(package.parent), package.name],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                cwd=folder,
                env={**kept, "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp", "ROS_LOG_DIR": folder, **environment},
            )
        self._thread = threading.Thread(target=self._listen, name="ros2", daemon=True)
        self._thread.start()
        try:
            self._send(wanted)
            self._receive()
        except TransportError:
            self.stop()
            raise

    def connected(self) -> bool:
        """Whether each topic has its other end; true once only.

        Raises:
            TransportError: The program ended.
        """
        try:
            self._checked(self._answers.get_nowait())
        except queue.Empty:
            return False
        return True

    def begin(self, order: Order, sends: Sequence[int]) -> None:
        """Let it send these flows of an order, and listen."""
        self._send(
            {
                "flows": [{"size": flow.size, "hz": flow.hz} for flow in order.flows],
                "begin": order.begin,
                "start": order.start,
                "end": order.end,
                "sends": sends,
            }
        )

    def noted(self) -> Notes:
        """What came of the order.

        Raises:
            TransportError: The program ended.
        """
        noted = self._receive()
        sent = {int(i): times for i, times in noted["sent"].items()}
        received = {int(i): [(n, at, now) for n, at, now in got] for i, got in noted["received"].items()}
        return Notes(sent, received, noted["cpu_s"])

    def measure(self, order: Order, sends: Sequence[int]) -> Notes:
        """Both.

        Raises:
            TransportError: The program ended.
        """
        self.begin(order, sends)
        return self.noted()

    def said(self) -> str:
        """Its last words."""
        lines = self.log.read_text().strip().splitlines()
        return lines[-1] if lines else "without a word"

    def stop(self) -> None:
        """End it."""
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:  # in the midst of a measurement, or it never found the other end
            self._process.kill()
            self._process.wait()
        self._thread.join()

    def _send(self, what: Mapping[str, Any]) -> None:
        if self._process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):  # its last words are read next
                print(json.dumps(what), file=self._process.stdin, flush=True)

    def _receive(self) -> Any:
        return self._checked(self._answers.get())

    def _checked(self, answer: Any) -> Any:
        if answer is None:
            raise TransportError(f"the program under ROS 2's Python ended: {self.said()}")
        return answer

    def _listen(self) -> None:
        """Pass on what the program says, None at its end."""
        if self._process.stdout is not None:
            with self._process.stdout as answers:
                for line in answers:
                    self._answers.put(json.loads(line))
        self._answers.put(None)
