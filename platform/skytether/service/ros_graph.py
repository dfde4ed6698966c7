"""A service that is a ROS graph of its own, with unchanged nodes: what both generations have in common.

The manifest says ``graph`` and names what has the nodes (``launch``). The graph is set up with folders of its own and
joined by the bridge; when the robot has connected, the nodes are started. All of it ends with the service, also if that
is killed. `skytether.service.ros1` and `skytether.service.ros2` say how a graph of their generation is set up.
"""

from __future__ import annotations

import logging
import os
import queue
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Protocol

from skytether.api.grant import Grant
from skytether.api.manifest import ServiceGraph
from skytether.bridge import Bridge, BridgeError, SessionSpec
from skytether.bridge.port import Port
from skytether.bridge.spec import parse_id, parse_key, topics_from_api
from skytether.messages import Encoding
from skytether.ros.names import Generation, Names, namespace_of
from skytether.ros.notes import Notes
from skytether.ros.translate import Translated
from skytether.wire.events import Connected, Disconnected, Event
from skytether.wire.topic import Role, Topic

from .beat import touch
from .errors import ConfigError, ServiceError
from .health_port import answering
from .main import check_graph, read_grant, write_ready_file
from .ros_guard import RosGuard

_log = logging.getLogger(__name__)

SETUP_VARIABLE = "SKYTETHER_ROS_SETUP"
"""A setup.bash that the programs of ROS need; without it the first of /opt/ros/*/setup.bash, if there is one."""
POLL_S = 0.1
_PASSED_ON = ("HOME", "LANG", "LC_ALL", "TZ", "CMAKE_PREFIX_PATH", "LD_LIBRARY_PATH")
_SETUP_S = 60.0
"""For a setup.bash to end."""
_NOTES_S = 10.0
"""From the session to what the robot tells of its graph; a robot that has none tells nothing."""


class _Ended(Exception):  # noqa: N818 (an end in order)
    """SIGTERM or SIGINT came."""


@dataclass(frozen=True, slots=True)
class Setting:
    """What a graph is set up for.

    Attributes:
        grant: The service's.
        launch: What has the nodes, as the manifest says it.
        names: Of the service's topics in the graph.
        table: Of the service's end of the session.
        environ: Of this process.
        folder: The graph's own; it goes with the service.
    """

    grant: Grant
    launch: str
    names: Names
    table: tuple[Topic, ...]
    environ: Mapping[str, str]
    folder: Path


class GraphPort(Port, Protocol):
    """A graph as a port of the bridge."""

    def close(self) -> None:
        """Leave the graph."""
        ...


class RosGraph(Protocol):
    """A graph that is there, without nodes."""

    @property
    def port(self) -> GraphPort:
        """The bridge's."""
        ...

    @property
    def guard(self) -> RosGuard:
        """Of its programs."""
        ...

    @property
    def program(self) -> str:
        """What starts the nodes, in a word, for messages."""
        ...

    @property
    def command(self) -> Sequence[str]:
        """The same, to be run."""
        ...

    def receive_notes(self, timeout: float) -> bool:
        """Wait so many seconds for what the robot tells of its graph, and use it; whether it came."""
        ...


@dataclass(frozen=True, slots=True)
class GraphType:
    """A generation of ROS, as a service's graph.

    Attributes:
        kind: As in the manifest.
        ros: The same, as a number.
        encoding: Of its messages.
        rows: What the table has beside the service's topics, where it does not name them itself.
        told: The robot tells of its graph before the nodes are started.
        join: Sets the graph up, for as long as the context lasts.
    """

    kind: ServiceGraph
    ros: Generation
    encoding: Encoding
    rows: Sequence[Topic]
    told: bool
    join: Callable[[Setting], AbstractContextManager[RosGraph]]


def run(graph: GraphType) -> int:
    """Be the process of such a service; returns the exit status."""
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    return serve(graph, os.environ)


def serve(graph: GraphType, environ: Mapping[str, str]) -> int:
    """Run until SIGTERM, SIGINT, idle, or an end of the nodes; returns the exit status. Needs the main thread."""
    try:
        grant = read_grant(environ)
        if grant.launch is None:
            raise ConfigError(f"the manifest of {grant.service} names no launch file; add launch: PATH to its spec")
        check_graph(grant, graph.kind)
        with _ending_on_signals():
            return _serve(graph, grant, grant.launch, environ)
    except ServiceError as error:
        print(f"error: {error}", file=sys.stderr)  # noqa: T201
        return error.status
    except _Ended:
        return 0


def _serve(graph: GraphType, grant: Grant, launch: str, environ: Mapping[str, str]) -> int:
    topics = topics_from_api(grant.topics)
    named = {topic.name for topic in topics}
    table = (*topics, *(row for row in graph.rows if row.name not in named))
    try:
        spec = SessionSpec(parse_id(grant.session_id), parse_key(grant.session_key), Role.SERVICE, table)
        names = Names(grant.topics, namespace_of(grant.robot), namespace_of(grant.service), grant.remap, ros=graph.ros)
    except ValueError as error:
        raise ConfigError(f"the grant is wrong: {error}") from None
    with ExitStack() as stack:
        folder = Path(tempfile.mkdtemp(prefix="skytether-ros-"))
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        running = stack.enter_context(graph.join(Setting(grant, launch, names, table, environ, folder)))
        joined = _Joined(running.port)
        bridge = Bridge(spec, Translated(joined, graph.encoding, table), bind=(grant.bind_host, grant.bind_port))
        try:
            bridge.start()
        except BridgeError as error:
            raise ServiceError(str(error)) from None
        stack.callback(bridge.stop)
        write_ready_file(grant, bridge.address[1])
        stack.enter_context(answering(grant))
        return _work(grant, running, joined, wait_s=_NOTES_S if graph.told else 0.0)


class _Joined:
    """The port, and what the main thread waits for."""

    def __init__(self, port: GraphPort) -> None:
        self.port = port
        self.connected_at: float | None = None
        self.attach = port.attach
        self.deliver = port.deliver

    def notify(self, event: Event) -> None:
        if isinstance(event, Connected):
            _log.info("connected; topics: %s", ", ".join(topic.name for topic in event.topics))
            self.connected_at = time.monotonic()
        elif isinstance(event, Disconnected):
            _log.info("disconnected: %s", event.reason)
            self.connected_at = None
        self.port.notify(event)


def _work(grant: Grant, graph: RosGraph, joined: _Joined, *, wait_s: float) -> int:
    """Launch once the robot is there, and has told of its graph or not within so many seconds; then watch."""
    launched = False
    idle_since = time.monotonic()
    while True:
        if grant.ready_file is not None:
            touch(grant.ready_file, 0.0)  # for the health check: this loop is alive
        told = graph.receive_notes(POLL_S)
        now = time.monotonic()
        since = joined.connected_at
        if since is not None:
            idle_since = now
        elif now - idle_since > grant.idle_exit_s:
            _log.info("no robot for %g s: ending", grant.idle_exit_s)
            return 0
        if not launched and (told or (since is not None and now - since > wait_s)):
            launched = True
            _log.info("starting %s", shlex.join(graph.command))
            graph.guard.run(graph.program, *graph.command)
        ended = graph.guard.ended()
        if ended:
            raise ServiceError(f"{ended}; see the lines above")


def receive_from(notes: queue.SimpleQueue[Notes], timeout: float, use: Callable[[Notes], object]) -> bool:
    """`RosGraph.receive_notes` for what comes in a queue."""
    try:
        told = notes.get(timeout=timeout)
    except queue.Empty:
        return False
    use(told)
    return True


@contextmanager
def guarding(folder: Path, environment: Mapping[str, str]) -> Iterator[RosGuard]:
    """A guard of the graph's programs, for as long as the context lasts."""
    guard = RosGuard(folder, environment)
    try:
        yield guard
    finally:
        guard.close()


def spaces_of(grant: Grant) -> dict[str, str]:
    """What launch files get beside the parameters: the namespaces of robot and service, without the slash."""
    return {"robot": namespace_of(grant.robot)[1:], "service": namespace_of(grant.service)[1:]}


def argument(name: str, value: object) -> str:
    """A launch file's argument."""
    return f"{name}:={str(value).lower() if isinstance(value, bool) else value}"


def ros_environment(
    environ: Mapping[str, str], folder: Path, own: Mapping[str, str], passed_on: Iterable[str] = ()
) -> dict[str, str]:
    """Of a graph's programs: their own folders, and nothing of this program's Python or secrets.

    Args:
        environ: Of this process.
        folder: The graph's.
        own: What makes the graph theirs.
        passed_on: Variables of this process that they get beside the usual ones.
    """
    ours = str(Path(sys.executable).parent)
    path = [entry for entry in environ.get("PATH", os.defpath).split(os.pathsep) if entry != ours]
    kept = {name: environ[name] for name in (*_PASSED_ON, *passed_on) if name in environ}
    return {
        **kept,
        "PATH": os.pathsep.join(path),
        "PYTHONUNBUFFERED": "1",
        "ROS_HOME": str(folder),
        "ROS_LOG_DIR": str(folder / "log"),
        "TMPDIR": str(folder),
        **own,
    }


def with_setup(environ: Mapping[str, str], environment: dict[str, str]) -> dict[str, str]:
    """An environment with the set-up of a ROS that is not installed in the system's folders.

    Raises:
        ServiceError: The set-up fails.
    """
    found = environ.get(SETUP_VARIABLE) or next((str(p) for p in sorted(Path("/opt/ros").glob("*/setup.bash"))), "")
    if not found:
        return environment
    command = ["bash", "-c", 'source "$0" >&2 && exec env -0', found]
    try:
        done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, timeout=_SETUP_S, check=True)
    except (OSError, subprocess.SubprocessError) as error:
        raise ServiceError(f"the set-up of ROS, {found}, fails: {error}") from None
    return dict(entry.split("=", 1) for entry in os.fsdecode(done.stdout).split("\0") if "=" in entry)


@contextmanager
def _ending_on_signals() -> Iterator[None]:
    """SIGTERM and SIGINT end the service in order, wherever it is."""

    def end(_number: int, _frame: FrameType | None) -> None:
        for number in before:
            signal.signal(number, signal.SIG_IGN)  # the end takes its time, and is not ended itself
        raise _Ended

    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    for number in before:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
