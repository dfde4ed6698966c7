"""``skytether robot run``: the agent on a robot that is a ROS graph."""

from __future__ import annotations

import gc
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skytether.api.config_file import ConfigError
from skytether.bridge.interfaces import LocalPath, Wanted
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig
from skytether.robot.agent.diagnostics import Ros1Diagnostics
from skytether.robot.agent.gated_hardware import GatedHardware
from skytether.robot.config.robot_config import load_config, load_token
from skytether.robot.control.fallback import FallbackError
from skytether.robot.control.supervisor import Limits
from skytether.robot.graphs.ros1 import Ros1Robot, Ros1RobotConfig
from skytether.robot.offload.site_prober import TaskConfig
from skytether.robot.safety.client import GateLink
from skytether.ros.ros1.arguments import PRIVATE
from skytether.ros.ros1.console import Console
from skytether.ros.ros1.master import Master, MasterError
from skytether.ros.ros1.node import Node, NodeError

from ...output import console, fail
from ...ros_words import RosWords, given
from .check import check_robot
from .gate_process import gate
from .never_wait import never_wait
from .ros2 import check_ros2, join_ros2

if TYPE_CHECKING:
    from skytether.robot.agent.snapshot import AgentStatus
    from skytether.robot.config.robot_config import RobotConfig, Ros1Config, Ros2Config
    from skytether.robot.control.control_loop import RobotHardware
    from skytether.ros.ros1.arguments import RosArguments

    from .gate_process import FoundGate, OwnGate

_log = logging.getLogger(__name__)

_STATUS_S = 0.5
"""Between looks at the agent, to say what changed."""


def run(
    config: Annotated[
        Path, typer.Argument(help="YAML of the robot: robot, orchestrator, token_file, service, ros1 or ros2, ...")
    ],
    check: Annotated[
        bool, typer.Option("--check", help="Only look whether everything is there, topic by topic; status 1 if not.")
    ] = False,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="End after this long; without it at Ctrl-C.")] = None,
    ros: RosWords = None,
) -> None:
    """Join the robot's ROS graph, ask for its service, and drive with what the service says.

    The robot's own nodes stay as they are: what the service takes in is subscribed, what it gives out is published,
    and velocities pass the supervisor before they reach the wheels' topic.
    """
    if not check:
        never_wait()  # a log that nobody reads must cost no robot anything
    ros1 = given(ros)
    try:
        settings = load_config(config, ros1)
        if ros1.name and settings.ros1 is not None:
            ros1 = private_parameters(ros1, settings.ros1.master, settings.node())
            settings = load_config(config, ros1)
        token = load_token(settings, config.parent)
    except ConfigError as error:
        fail(str(error), 2)
    if settings.ros2 is not None:
        try:
            _run_ros2(settings, settings.ros2, config, token, seconds, ros1, check=check)
        except ConfigError as error:
            fail(str(error), 2)
        return
    if settings.ros1 is None:
        fail(f"{config}: ros1: is missing", 2)
    if check:
        # With the agent's own name the master would end the agent that runs.
        with _node(settings, settings.ros1, settings.node("check"), threading.Event()) as node:
            raise typer.Exit(0 if check_robot(settings, ros1_config(settings, settings.ros1), node, token) else 1)
    _run(settings, settings.ros1, config, token, seconds, ros1)


def _run(
    settings: RobotConfig, ros1: Ros1Config, path: Path, token: str, seconds: float | None, ros: RosArguments
) -> None:

    ended = threading.Event()
    config = agent_config(settings, path.parent, token)
    with (
        gate(path, settings.safety, assumed=settings.gate_is_assumed, ros=ros) as own,
        _node(settings, ros1, settings.node(), ended) as node,
        Console(node),
    ):
        for name in ros.unused:
            _log.warning("the private parameter %s/%s is none of %s", node.name, name, ", ".join(PRIVATE))
        robot = Ros1Robot(ros1_config(settings, ros1), node)
        try:
            with Agent(config, _base(settings, robot.base), graph=robot) as agent:
                _watch(
                    agent.status, ended, seconds, own, Ros1Diagnostics(settings.robot, settings.service, node).publish
                )
        except FallbackError as error:
            fail(str(error), 2)
        finally:
            robot.close()


def _run_ros2(
    settings: RobotConfig,
    ros2: Ros2Config,
    path: Path,
    token: str,
    seconds: float | None,
    ros: RosArguments,
    *,
    check: bool,
) -> None:
    """A robot that is a ROS 2 graph.

    Raises:
        ConfigError: The graph cannot be joined as it is configured.
    """
    folder = path.parent
    if check:
        raise typer.Exit(0 if check_ros2(settings, ros2, folder, token) else 1)
    with (
        gate(path, settings.safety, assumed=settings.gate_is_assumed, ros=ros) as own,
        join_ros2(settings, ros2, folder) as (robot, diagnostics),
    ):
        for name in ros.unused:
            _log.warning("the parameter %s is none of %s", name, ", ".join(PRIVATE))
        try:
            with Agent(agent_config(settings, folder, token), _base(settings, robot.base), graph=robot) as agent:
                _watch(agent.status, threading.Event(), seconds, own, diagnostics.publish)
        except FallbackError as error:
            fail(str(error), 2)


def _base(settings: RobotConfig, graph: RobotHardware) -> RobotHardware:
    """The wheels: behind the gate if there is one, else a topic of the graph."""
    if settings.safety is None:
        return graph

    return GatedHardware(graph, GateLink(settings.safety.place()))


@contextmanager
def _node(settings: RobotConfig, ros1: Ros1Config, name: str, ended: threading.Event) -> Iterator[Node]:
    """The node; what goes wrong with it ends the command."""

    def end(reason: str) -> None:
        says = f"robot {settings.robot} ends: {reason or 'asked to by rosnode kill'}"
        _log.error("%s", says)
        console.print(says, markup=False, soft_wrap=True)
        ended.set()

    node = Node(name, ros1.master, host=ros1.host, on_end=end)
    try:
        node.start()
    except NodeError as error:
        fail(str(error), 2)
    try:
        yield node
    finally:
        node.close()


def private_parameters(ros: RosArguments, master: str, node: str) -> RosArguments:
    """With those that roslaunch has set: below the node's name, or below the one that roslaunch takes for it."""
    found: dict[str, Any] = {}
    for name in (f"/{ros.name.lstrip('/')}", node):
        try:
            params = Master(master, node).get_param(name)
        except MasterError:  # it has none, or does not answer: the node says so
            continue
        found.update(params if isinstance(params, dict) else {})
    return ros.private(found)


def _watch(
    status: Callable[[], AgentStatus],
    ended: threading.Event,
    seconds: float | None,
    gate: OwnGate | FoundGate | None,
    tell: Callable[[AgentStatus], object] = lambda _: None,
) -> None:
    """Say what changes, until the end.

    Args:
        status: How the agent is.
        ended: Somebody wants the end.
        seconds: Until the end; None: for ever.
        gate: Before the wheels.
        tell: Told often how the agent is.
    """
    gc.freeze()  # all that is loaded by now stays: looking through it for garbage takes ticks of the control loop
    begin = time.monotonic()
    before = ""
    while seconds is None or time.monotonic() - begin < seconds:
        found = status()
        tell(found)
        now = _sentence(found)
        if now != before:
            console.print(now, markup=False, soft_wrap=True)
            before = now
        if ended.wait(_STATUS_S):
            return
        trouble = gate.look() if gate is not None else ""
        if trouble:
            console.print(f"error: {trouble}", markup=False, soft_wrap=True)


def _sentence(status: AgentStatus) -> str:
    """What changes rarely, for people."""
    driver = status.driver
    reason = driver.transitions[-1].reason if driver.transitions else ""
    instance = f"instance {status.instance.id} {status.instance.state}" if status.instance else "no instance"
    session = "session up" if status.connected else "no session"
    trouble = f"; {status.trouble}" if status.trouble else ""
    return f"driving: {driver.source} ({reason}); {instance}, {session}{trouble}"


def agent_config(settings: RobotConfig, folder: Path, token: str) -> AgentConfig:
    """What the agent needs of the configuration.

    Args:
        settings: The file.
        folder: That its paths are relative to.
        token: The robot's, as it is now.
    """
    task = settings.task
    paths: Wanted = (
        "auto"
        if settings.paths == "auto"
        else [LocalPath(p.local, p.cost, (p.peer.host, p.peer.port) if p.peer else None) for p in settings.paths]
    )
    return AgentConfig(
        robot=settings.robot,
        url=settings.orchestrator,
        token=token,
        service=settings.service,
        params=settings.params,
        fallback=settings.fallback.name,
        fallback_options=settings.fallback.options,
        limits=Limits(**settings.limits),
        needs=settings.needs.needs(),
        command_topic=settings.command_topic,
        rate_hz=settings.rate_hz,
        bind=(settings.bind.host, settings.bind.port),
        paths=paths,
        ca_file=str(settings.ca_file) if settings.ca_file else os.environ.get("SKYTETHER_CA_FILE"),
        insecure_http=settings.insecure_http,
        task=TaskConfig(task.policy(), task.addresses, task.probe_s),
        fresh_token=lambda: load_token(settings, folder),
        status_port=settings.status_port,
        gate=None if settings.safety is None else settings.safety.place(),
        stop_from_afar=settings.safety is not None and settings.safety.stop_from_afar,
    )


def ros1_config(settings: RobotConfig, ros1: Ros1Config) -> Ros1RobotConfig:
    """What the graph needs of the configuration."""
    return Ros1RobotConfig(
        robot=settings.robot,
        service=settings.service,
        namespace=ros1.namespace,
        remap=ros1.remap,
        cmd_vel=ros1.cmd_vel if settings.safety is None else None,
        idle_s=ros1.idle_s,
        fresh_s=Limits(**settings.limits).watchdog_s,
        readings=ros1.readings,
        topics=ros1.topics,
        params=ros1.params,
        use_sim_time=ros1.use_sim_time,
        allowed=settings.allowed,
        protected=settings.protected,
        wheels=settings.wheels,
        drivers=settings.drivers,
    )
