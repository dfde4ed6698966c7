"""A service that is a ROS 1 graph of its own, with unchanged nodes: ``python -m skytether.service.ros1``.

The manifest says ``graph: ros1`` and names a launch file. Here a roscore is started on a free port, with folders of its
own; the bridge joins its graph; when the robot has connected and handed over its parameters, roslaunch starts the
nodes. All of it ends with the service, also if that is killed.
"""

from __future__ import annotations

import logging
import os
import queue
import shlex
import shutil
import signal
import socket
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType

from skytether.api.grant import Grant
from skytether.bridge import Bridge, BridgeError, SessionSpec
from skytether.bridge.spec import parse_id, parse_key, topics_from_api
from skytether.ros import notes
from skytether.ros.names import Names, namespace_of
from skytether.ros.notes import Notes
from skytether.ros.ros1.master import MasterError
from skytether.ros.ros1.node import Node
from skytether.ros.ros1.port import CLOCK, Ros1Port
from skytether.ros.translate import Translated
from skytether.wire.events import Connected, Disconnected, Event
from skytether.wire.topic import Role

from .beat import touch
from .errors import ConfigError, ServiceError
from .health_port import answering
from .main import read_grant, write_ready_file
from .ros_guard import CORE, Guard

_log = logging.getLogger("skytether.service.ros1")

SETUP_VARIABLE = "SKYTETHER_ROS_SETUP"
"""A setup.bash that the programs of ROS need; without it the first of /opt/ros/*/setup.bash, if there is one."""
_PASSED_ON = ("HOME", "LANG", "LC_ALL", "TZ", "ROS_PACKAGE_PATH", "CMAKE_PREFIX_PATH", "LD_LIBRARY_PATH")
_CORE_S = 30.0
"""For roscore to answer."""
_POLL_S = 0.1
_NOTES_S = 10.0
"""From the session to what the robot tells of its graph; a robot that has none tells nothing."""


class _Ended(Exception):  # noqa: N818 (an end in order)
    """SIGTERM or SIGINT came."""


def serve(environ: Mapping[str, str]) -> int:
    """Run until SIGTERM, SIGINT, idle, or an end of the nodes; returns the exit status. Needs the main thread."""
    try:
        grant = read_grant(environ)
        if grant.launch is None:
            raise ConfigError(f"the manifest of {grant.service} names no launch file; add launch: PATH to its spec")
        with _ending_on_signals():
            return _serve(grant, grant.launch, environ)
    except ServiceError as error:
        print(f"error: {error}", file=sys.stderr)  # noqa: T201
        return error.status
    except _Ended:
        return 0


def _serve(grant: Grant, launch: str, environ: Mapping[str, str]) -> int:
    arguments = launch_arguments(launch, grant)
    topics = topics_from_api(grant.topics)
    clock = () if any(topic.name == CLOCK.name for topic in topics) else (CLOCK,)
    try:
        table = (*topics, *clock, *notes.topics())
        spec = SessionSpec(parse_id(grant.session_id), parse_key(grant.session_key), Role.SERVICE, table)
        names = Names(grant.topics, namespace_of(grant.robot), namespace_of(grant.service), grant.remap)
    except ValueError as error:
        raise ConfigError(f"the grant is wrong: {error}") from None
    with ExitStack() as stack:
        folder = Path(tempfile.mkdtemp(prefix="skytether-ros-"))
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        port = _free_port()
        environment = ros_environment(environ, port, folder)
        guard = Guard(folder, environment)
        stack.callback(guard.close)
        prefix = _prefix(environ)
        guard.run(CORE, *prefix, "roscore", "-p", str(port))
        node = stack.enter_context(Node("skytether", environment["ROS_MASTER_URI"], host="127.0.0.1"))
        _wait_for_core(node, guard)
        _set_params(node, {namespace_of(grant.service) + "/" + name: value for name, value in grant.params.items()})
        joined = _Joined(Ros1Port(node, Role.SERVICE, names, table, on_notes=lambda told: joined.notes.put(told)))
        bridge = Bridge(spec, Translated(joined, "ros1", table), bind=(grant.bind_host, grant.bind_port))
        try:
            bridge.start()
        except BridgeError as error:
            raise ServiceError(str(error)) from None
        stack.callback(joined.port.close)
        stack.callback(bridge.stop)
        write_ready_file(grant, bridge.address[1])
        stack.enter_context(answering(grant))
        return _work(grant, guard, node, joined, [*prefix, "roslaunch", *arguments])


class _Joined:
    """The port, and what the main thread waits for."""

    def __init__(self, port: Ros1Port) -> None:
        self.port = port
        self.notes: queue.SimpleQueue[Notes] = queue.SimpleQueue()
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


def _work(grant: Grant, guard: Guard, node: Node, joined: _Joined, command: list[str]) -> int:
    """Launch once the robot is there; then watch."""
    launched = False
    idle_since = time.monotonic()
    while True:
        if grant.ready_file is not None:
            touch(grant.ready_file, 0.0)  # for the health check: this loop is alive
        told = None
        try:
            told = joined.notes.get(timeout=_POLL_S)
            _set_params(node, told.params)
        except queue.Empty:
            pass
        now = time.monotonic()
        since = joined.connected_at
        if since is not None:
            idle_since = now
        elif now - idle_since > grant.idle_exit_s:
            _log.info("no robot for %g s: ending", grant.idle_exit_s)
            return 0
        if not launched and (told is not None or (since is not None and now - since > _NOTES_S)):
            launched = True
            _log.info("starting %s", shlex.join(command))
            guard.run("roslaunch", *command)
        ended = guard.ended()
        if ended:
            _log.error("%s; see the lines above", ended)
            return 1


def _set_params(node: Node, params: Mapping[str, object]) -> None:
    for name, value in params.items():
        try:
            node.master.set_param(name, value)
        except MasterError as error:
            _log.error("parameter %s was not set: %s", name, error)


def _wait_for_core(node: Node, guard: Guard) -> None:
    deadline = time.monotonic() + _CORE_S
    while not node.master_present:
        ended = guard.ended()
        if ended:
            raise ServiceError(f"{ended}: is ROS 1 installed here? The image skytether/ros1-base has it")
        if time.monotonic() > deadline:
            raise ServiceError(f"roscore did not answer within {_CORE_S:.0f} s")
        time.sleep(_POLL_S)


def launch_arguments(launch: str, grant: Grant) -> list[str]:
    """What roslaunch is called with: the file, and those of the parameters that it has an ``arg`` for.

    ``robot`` and ``service`` are the namespaces of their topics, without the slash.

    Raises:
        ConfigError: There is no such file, or it is no XML.
    """
    spaces = {"robot": namespace_of(grant.robot)[1:], "service": namespace_of(grant.service)[1:]}
    known = {**grant.params, **spaces}
    if not launch.startswith("/"):
        package, _, file = launch.partition("/")
        if not file:
            raise ConfigError(f"launch must be an absolute path or package/file.launch, not '{launch}'")
        return [package, file]
    try:
        root = ET.parse(launch).getroot()  # noqa: S314 (the operator's own file; roslaunch reads it the same way)
    except OSError as error:
        raise ConfigError(f"cannot read the launch file {launch}: {error.strerror}") from None
    except ET.ParseError as error:
        raise ConfigError(f"the launch file {launch} is no XML: {error}") from None
    taken = [arg.get("name", "") for arg in root.findall("arg") if arg.get("value") is None]
    return [launch, *(f"{name}:={_text(known[name])}" for name in taken if name in known)]


def _text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def ros_environment(environ: Mapping[str, str], port: int, folder: Path) -> dict[str, str]:
    """Of roscore and the nodes: their own master and folders, and nothing of this program's Python or secrets."""
    own = str(Path(sys.executable).parent)
    path = [entry for entry in environ.get("PATH", os.defpath).split(os.pathsep) if entry != own]
    kept = {name: environ[name] for name in _PASSED_ON if name in environ}
    return {
        **kept,
        "PATH": os.pathsep.join(path),
        "PYTHONUNBUFFERED": "1",
        "ROS_MASTER_URI": f"http://127.0.0.1:{port}",
        "ROS_IP": "127.0.0.1",
        "ROS_HOME": str(folder),
        "ROS_LOG_DIR": str(folder / "log"),
        "TMPDIR": str(folder),
    }


def _prefix(environ: Mapping[str, str]) -> list[str]:
    """Runs a program with the set-up of a ROS that is not installed in the system's folders."""
    found = environ.get(SETUP_VARIABLE) or next((str(p) for p in sorted(Path("/opt/ros").glob("*/setup.bash"))), "")
    return ["bash", "-c", 'source "$0" && exec "$@"', found] if found else []


def _free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


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


if __name__ == "__main__":
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    sys.exit(serve(os.environ))
