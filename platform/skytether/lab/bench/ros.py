"""``skytether lab bench ros``: a talker and a listener of ROS 2, as they are, and with Skytether between them.

Both are nodes under ROS 2's own Python that make and decode their messages. As they are, they share a domain. With
Skytether between, each has a domain of its own, and two ``skytether bridge`` join these over UDP on loopback: the
message passes two ports and the sealed session between them.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import psutil

from skytether.lab.ros2_python import ros2_python
from skytether.lab.throttle import cpu_time

from .pair import LOOPBACK, BenchError, free_port
from .ros2_node import Node, check_python
from .ros2_program.schedule import Order
from .rows import percentiles_ms
from .traffic import Flow
from .transports import TransportError

MESSAGES = (Flow("Twist", 52, 100.0), Flow("LaserScan", 2_220, 40.0), Flow("CompressedImage", 47_611, 15.0))
"""A velocity, a scan of 541 rays, a picture of 47 kB; named as their types."""
_TYPES = {
    "Twist": "geometry_msgs/msg/Twist",
    "LaserScan": "sensor_msgs/msg/LaserScan",
    "CompressedImage": "sensor_msgs/msg/CompressedImage",
}
PLAIN, BRIDGED = "plain", "skytether"
_ROLES = ("service", "robot")
_ALONE = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
_DEPTH = 10
"""Of all queues: ROS 2's default."""
_LEAD_S = 0.1
_WARM_UP_S = 0.5
_TRY_S = 0.3
_CONNECT_S = 30.0
_LOOK_S = 0.02


@dataclass(frozen=True, slots=True)
class RosRow:
    """One kind of message on one way.

    Attributes:
        message: Its type's name.
        way: ``plain``, or ``skytether``.
        hz: Messages a second.
        sent: In the time that counts.
        delivered: Of these.
        p50_ms: From the talker's stamp to the listener's callback; None without any.
        p99_ms: Likewise.
        max_ms: Likewise.
        nodes_us: Processor time of talker and listener for each message, beyond what they take at rest.
        robot_us: Of the robot's end of the bridge, its side program under ROS 2's Python included; 0 without.
        service_us: Of the service's end, likewise.
        nodes_rest: Share of a core that talker and listener take together while nothing is sent.
        ends_rest: And both ends of the bridge.
    """

    message: str
    way: str
    hz: float
    sent: int
    delivered: int
    p50_ms: float | None
    p99_ms: float | None
    max_ms: float | None
    nodes_us: float
    robot_us: float
    service_us: float
    nodes_rest: float
    ends_rest: float

    def document(self) -> dict[str, object]:
        """For ``--json``."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class _Scene:
    talker: Node
    listener: Node
    ends: tuple[psutil.Process, ...] = ()
    logs: tuple[Path, ...] = ()


@dataclass(frozen=True, slots=True)
class _Seen:
    """What came of one order: kinds of message that arrived, delays [s], processor seconds of nodes and ends."""

    seconds: float
    kinds: set[int]
    sent: int
    delays: tuple[float, ...]
    nodes_s: float
    ends_s: tuple[float, ...]


def bench_ros(
    seconds: float, ways: Sequence[str] = (PLAIN, BRIDGED), on_progress: Callable[[str], None] = lambda _: None
) -> list[RosRow]:
    """Measure each kind of message on each way.

    Args:
        seconds: For each.
        ways: Of `PLAIN` and `BRIDGED`.
        on_progress: Told what is measured now.

    Raises:
        BenchError: ROS 2 is missing, or a program ended.
    """
    rows = []
    try:
        check_python()
        for way in ways:
            on_progress(f"{way}: joining")
            with _scene(way) as scene:
                _wait(scene)
                rest = _run(scene, [], seconds, _WARM_UP_S)
                for index, flow in enumerate(MESSAGES):
                    on_progress(f"{way}: {flow.name} at {flow.hz:g} Hz")
                    rows.append(_row(way, index, _run(scene, [index], seconds, _WARM_UP_S), rest))
    except (TransportError, psutil.Error) as error:
        raise BenchError(str(error)) from error
    return rows


@contextmanager
def _scene(way: str) -> Iterator[_Scene]:
    with ExitStack() as undo:
        folder = undo.enter_context(tempfile.TemporaryDirectory(prefix="skytether-bench-"))
        # Whoever else measures here is in other domains.
        domains = (first := 2 * (os.getpid() % 50), first if way == PLAIN else first + 1)
        ends: list[psutil.Process] = []
        if way == BRIDGED:
            ends = undo.enter_context(_bridge_ends(Path(folder), domains))
        numbers = list(range(len(MESSAGES)))
        made = []
        for name, domain, sends, receives in (
            ("talker", domains[0], numbers, []),
            ("listener", domains[1], [], numbers),
        ):
            made.append(Node(_wanted(domain, sends, receives), folder, name, _ALONE))
            undo.callback(made[-1].stop)
        logs = (Path(folder) / f"{role}.log" for role in _ROLES) if ends else ()
        yield _Scene(made[0], made[1], tuple(ends), tuple(logs))


def _wanted(domain: int, sends: list[int], receives: list[int]) -> dict[str, Any]:
    flows = [{"size": f.size, "hz": f.hz, "topic": f"/bench/{f.name.lower()}", "type": f.name} for f in MESSAGES]
    return {"kind": "typed", "domain": domain, "reliable": True, "flows": flows, "sends": sends, "receives": receives}


@contextmanager
def _bridge_ends(folder: Path, domains: tuple[int, int]) -> Iterator[list[psutil.Process]]:
    """Two ``skytether bridge``, as anybody starts them."""
    program = [sys.executable, "-m", "skytether.cli", "bridge"]
    subprocess.run([*program, "--new-key", str(folder / "bridge.key")], check=True, capture_output=True)
    address = {"host": LOOPBACK, "port": free_port()}
    topics = [{"name": f.name.lower(), "type": _TYPES[f.name], "direction": "in", "depth": _DEPTH} for f in MESSAGES]
    common = {"id": "00000000000000ff", "key_file": "bridge.key", "topics": topics}
    with ExitStack() as undo:
        ends = []
        for role, where, domain in zip(_ROLES, ("bind", "peer"), reversed(domains), strict=True):
            config = folder / f"{role}.yaml"
            graph = {"domain": domain, "namespace": "/bench", "python": ros2_python()}
            config.write_text(json.dumps({"role": role, where: address, "ros2": graph, **common}))  # YAML, too
            log = undo.enter_context((folder / f"{role}.log").open("w"))
            process = subprocess.Popen(
                [*program, "--config", str(config)], stdout=log, stderr=log, env={**os.environ, **_ALONE}
            )
            undo.callback(process.wait)
            undo.callback(process.terminate)
            ends.append(psutil.Process(process.pid))
        yield ends


def _wait(scene: _Scene) -> None:
    """Until each kind of message arrives."""
    deadline = time.monotonic() + _CONNECT_S
    for node in (scene.talker, scene.listener):
        while not node.connected():
            _check_and_sleep(scene, deadline)
    indices = list(range(len(MESSAGES)))
    while _run(scene, indices, _TRY_S, 0.0).kinds != set(indices):
        _check_and_sleep(scene, deadline)


def _check_and_sleep(scene: _Scene, deadline: float) -> None:
    for end, log in zip(scene.ends, scene.logs, strict=True):
        if not end.is_running() or end.status() == psutil.STATUS_ZOMBIE:
            raise BenchError(f"an end of the bridge ended: {log.read_text().strip()}")
    if time.monotonic() > deadline:
        raise BenchError(f"talker and listener did not find each other within {_CONNECT_S:.0f} s")
    time.sleep(_LOOK_S)


def _row(way: str, index: int, seen: _Seen, rest: _Seen) -> RosRow:
    p50, _, p99, most = percentiles_ms(seen.delays)
    flow = MESSAGES[index]
    each = 1e6 / max(1, seen.sent)
    service_s, robot_s = (
        (used - idle for used, idle in zip(seen.ends_s, rest.ends_s, strict=True)) if rest.ends_s else (0.0, 0.0)
    )
    return RosRow(
        message=flow.name,
        way=way,
        hz=flow.hz,
        sent=seen.sent,
        delivered=len(seen.delays),
        p50_ms=p50,
        p99_ms=p99,
        max_ms=most,
        nodes_us=round((seen.nodes_s - rest.nodes_s) * each, 1),
        robot_us=round(robot_s * each, 1),
        service_us=round(service_s * each, 1),
        nodes_rest=round(rest.nodes_s / rest.seconds, 4),
        ends_rest=round(sum(rest.ends_s) / rest.seconds, 4),
    )


def _run(scene: _Scene, indices: list[int], seconds: float, warm_up: float) -> _Seen:
    """Send these kinds of message, and look at what everybody takes for it."""
    begin = time.monotonic() + _LEAD_S
    order = Order(MESSAGES, begin, begin + warm_up, begin + warm_up + seconds)
    scene.talker.begin(order, indices)
    scene.listener.begin(order, [])
    time.sleep(max(0.0, order.start - time.monotonic()))
    before = [_cpu_s(end) for end in scene.ends]
    time.sleep(max(0.0, order.end - time.monotonic()))
    ends_s = tuple(_cpu_s(end) - at for end, at in zip(scene.ends, before, strict=True))
    talker, listener = scene.talker.noted(), scene.listener.noted()
    sent = [(i, n) for i in indices for n, at in enumerate(talker.sent[i]) if order.start <= at < order.end]
    arrived = {(i, n): now - at for i in indices for n, at, now in listener.received[i]}
    delays = tuple(arrived[message] for message in sent if message in arrived)
    return _Seen(seconds, {i for i, _ in arrived}, len(sent), delays, talker.cpu_s + listener.cpu_s, ends_s)


def _cpu_s(process: psutil.Process) -> float:
    """Of a process and all that it started and that still runs."""
    return sum(cpu_time(p.pid) for p in (process, *process.children(recursive=True)))
