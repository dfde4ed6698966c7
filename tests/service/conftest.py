from __future__ import annotations

import base64
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from skytether.bridge import Bridge, SessionSpec
from skytether.wire.events import Event, MessageReceived
from skytether.wire.topic import Direction, Role, Topic

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
SESSION = 0x0123456789ABCDEF
KEY = bytes(range(32))
SCAN = {"name": "scan", "type": "sensor_msgs/msg/LaserScan", "direction": "in"}
CMD_VEL = {"name": "cmd_vel", "type": "geometry_msgs/msg/Twist", "direction": "out"}


class Grants:
    """Makes grant files for the example service, right ones unless told otherwise."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.ready = folder / "ready.json"

    def __call__(self, **changes: Any) -> dict[str, str]:
        """Write a grant; returns the environment that names it."""
        document = {
            "instance": "i-1",
            "service": "wall-stop",
            "robot": "walker",
            "session_id": f"{SESSION:016x}",
            "session_key": base64.b64encode(KEY).decode(),
            "topics": [SCAN, CMD_VEL],
            "ready_file": str(self.ready),
            "data_dir": str(self.folder),
        } | changes
        path = self.folder / "grant.json"
        path.write_text(json.dumps(document))
        return {"SKYTETHER_GRANT": str(path)}


class Robot:
    """The robot's end of the session: keeps what it hears, lets one wait for it."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self.messages: list[MessageReceived] = []
        self._changed = threading.Condition()
        topics = tuple(Topic(t["name"], t["type"], Direction(t["direction"]), encoding="ros1") for t in (SCAN, CMD_VEL))
        self.bridge = Bridge(SessionSpec(SESSION, KEY, Role.ROBOT, topics), self)

    def attach(self, publisher: object) -> None:
        pass

    def deliver(self, message: MessageReceived) -> None:
        with self._changed:
            self.messages.append(message)
            self._changed.notify_all()

    def notify(self, event: Event) -> None:
        with self._changed:
            self.events.append(event)
            self._changed.notify_all()

    def wait_for(self, what: Callable[[], bool], seconds: float = 10.0) -> None:
        with self._changed:
            assert self._changed.wait_for(what, seconds), (self.events, len(self.messages))

    def heard(self, kind: type[Event]) -> bool:
        return any(isinstance(event, kind) for event in self.events)


@pytest.fixture
def grant(tmp_path: Path) -> Grants:
    return Grants(tmp_path)


@pytest.fixture
def robot() -> Iterator[Robot]:
    robot = Robot()
    robot.bridge.start()
    yield robot
    robot.bridge.stop()


@pytest.fixture
def spawn() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start ``python -m MODULE`` with a grant; whatever still runs at the end is killed."""
    children: list[subprocess.Popen[str]] = []

    def start(module: str, environment: dict[str, str], *folders: Path) -> subprocess.Popen[str]:
        path = os.pathsep.join(map(str, (*folders, EXAMPLES, *filter(None, [os.environ.get("PYTHONPATH")]))))
        child = subprocess.Popen(
            [sys.executable, "-m", module],
            env=os.environ | environment | {"PYTHONPATH": path},
            stderr=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        children.append(child)
        return child

    yield start
    for child in children:
        child.kill()
        child.communicate()
