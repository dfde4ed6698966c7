"""Real nodes of ROS 2, in processes of their own under ROS 2's Python; every test has a ROS domain to itself."""

from __future__ import annotations

import fcntl
import json
import os
import queue
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import pytest

from skytether.lab.netns import Namespace

_T = TypeVar("_T")
LIMIT_S = 30.0
"""Patience; discovery takes up to 3 s, on a machine that others use too longer."""

_BEFORE = """
import json, sys, threading, time
import rclpy
from rclpy.qos import DurabilityPolicy as Durability, QoSProfile, ReliabilityPolicy as Reliability

def qos(reliable=True, latched=False, depth=10):
    return QoSProfile(
        depth=depth,
        reliability=Reliability.RELIABLE if reliable else Reliability.BEST_EFFORT,
        durability=Durability.TRANSIENT_LOCAL if latched else Durability.VOLATILE,
    )

lock = threading.Lock()
def say(what):
    with lock:  # threads may say something at once
        print(json.dumps(what), flush=True)

rclpy.init()
node = rclpy.create_node(NAME, namespace=NAMESPACE)
"""
_AFTER = """
say("ready")
try:
    rclpy.spin(node)
except BaseException:
    pass
"""


class Node:
    """One process with one node; what it says as lines of JSON is read with `next`, first that it is ready."""

    def __init__(self, command: list[str], environment: dict[str, str]) -> None:
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
        self.heard: list[Any] = []
        """For a test to keep what it has read too early."""
        self._said: queue.Queue[Any] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        while (said := self.next()) != "ready":
            self.heard.append(said)

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.endswith("\n"):  # or it was killed while it said so
                self._said.put(json.loads(line))
        self._said.put(EOFError("the node has ended"))

    def next(self, limit_s: float = LIMIT_S) -> Any:
        """What it says next."""
        said = self._said.get(timeout=max(limit_s, 0.0))
        if isinstance(said, EOFError):
            raise said
        return said

    def all(self) -> list[Any]:
        """What it has said, and nobody has read."""
        found = []
        while not self._said.empty():
            found.append(self._said.get())
        return found

    def tell(self, line: str) -> None:
        """Give its code a line to read."""
        assert self.process.stdin is not None
        print(line, file=self.process.stdin, flush=True)

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self._reader.join()
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe is not None
            pipe.close()


class Ros2Nodes:
    """The nodes of one domain."""

    def __init__(self, python: str, domain: int) -> None:
        self.python, self.domain = python, domain
        self._nodes: list[Node] = []

    def start(self, code: str, name: str = "peer", namespace: str = "/", where: Namespace | None = None) -> Node:
        """Start a node, ``node`` in its code, which says things with ``say``; returns when it spins."""
        environment = {**os.environ, "ROS_DOMAIN_ID": str(self.domain)}
        text = f"NAME, NAMESPACE = {name!r}, {namespace!r}\n{_BEFORE}{code}{_AFTER}"

        def start() -> Node:
            return Node([self.python, "-c", text], environment)

        self._nodes.append(start() if where is None else where.run(start))
        return self._nodes[-1]

    def close(self) -> None:
        for node in self._nodes:
            node.close()


def first(node: Node, what: str, limit_s: float = LIMIT_S) -> Any:
    """The next thing that a node says of this, a list that begins with it; what it says of others waits."""
    deadline = time.monotonic() + limit_s
    while True:
        for said in node.heard:
            if said[0] == what:
                node.heard.remove(said)
                return said
        node.heard.append(node.next(deadline - time.monotonic()))


@contextmanager
def own_domain() -> Iterator[int]:
    """A domain that no other test on this machine has."""
    folder = Path(tempfile.gettempdir()) / "skytether-ros2-domains"
    folder.mkdir(exist_ok=True)
    for domain in range(1, 101):
        lock = (folder / str(domain)).open("w")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
            continue
        break
    else:
        pytest.fail("100 domains of ROS 2 are in use")
    with lock:
        yield domain


@pytest.fixture
def ros2_nodes(ros2: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ros2Nodes]:
    """A graph of its own, discovery limited to the machine."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("SKYTETHER_ROS2_PYTHON", ros2)
    monkeypatch.delenv("RMW_IMPLEMENTATION", raising=False)
    with own_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        nodes = Ros2Nodes(ros2, domain)
        yield nodes
        nodes.close()


@pytest.fixture
def far_nodes(ros2_nodes: Ros2Nodes) -> Iterator[Ros2Nodes]:
    """Another graph: also where networks part them, shared memory would not."""
    with own_domain() as domain:
        nodes = Ros2Nodes(ros2_nodes.python, domain)
        yield nodes
        nodes.close()


def until(condition: Callable[[], object], what: str = "it", limit_s: float = LIMIT_S, each_s: float = 0.01) -> None:
    """Wait until something is so; looked at again and again, so long after each look."""
    deadline = time.monotonic() + limit_s
    while not condition():
        if time.monotonic() > deadline:
            raise AssertionError(f"waited {limit_s:g} s for {what}")
        time.sleep(each_s)


def steady(read: Callable[[], _T], for_s: float = 0.5, limit_s: float = LIMIT_S) -> _T:
    """Wait until something is the same for so long; returns it."""
    now = time.monotonic()
    deadline, since, value = now + limit_s, now, read()
    while time.monotonic() - since < for_s:
        assert time.monotonic() < deadline, f"still changing after {limit_s:g} s: {value}"
        time.sleep(0.05)
        if (new := read()) != value:
            since, value = time.monotonic(), new
    return value
