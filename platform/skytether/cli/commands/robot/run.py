"""``skytether robot run``: the agent on a robot that is a ROS graph."""

from __future__ import annotations

import gc
import logging
import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Annotated

import typer

from skytether.api.config_file import ConfigError
from skytether.bridge.interfaces import LocalPath, Wanted
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig
from skytether.robot.agent.diagnostics import Diagnostics
from skytether.robot.agent.gated_hardware import GatedHardware
from skytether.robot.config.robot_config import load_config, load_token
from skytether.robot.control.fallback import FallbackError
from skytether.robot.control.supervisor import VelocityLimits
from skytether.robot.graphs.graph_base import PublishesDiagnostics
from skytether.robot.graphs.registry import keys
from skytether.robot.offload.site_prober import TaskConfig
from skytether.robot.safety.client import GateLink

from ...output import console, fail
from ...ros_words import RosWords, given
from .check import check_run, show
from .gate_process import gate
from .never_wait import never_wait

if TYPE_CHECKING:
    from skytether.robot.agent.snapshot import AgentStatus
    from skytether.robot.config.robot_config import RobotConfig
    from skytether.robot.control.control_loop import RobotHardware
    from skytether.robot.graphs.graph_base import RobotGraph
    from skytether.ros.ros1.arguments import RosArguments

    from .gate_process import FoundGate, OwnGate

_log = logging.getLogger(__name__)

_STATUS_S = 0.5
"""Between looks at the agent, to say what changed."""


def run(
    config: Annotated[
        Path, typer.Argument(help=f"YAML of the robot: robot, orchestrator, token_file, service, {keys()}, ...")
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
    words = given(ros)
    try:
        settings = load_config(config, words)
        more = settings.kind.arguments(settings.graph, settings.home, words)
        if more is not words:
            settings = load_config(config, words := more)
        token = load_token(settings, config.parent)
        if check:
            raise typer.Exit(0 if show(check_run(settings, config.parent, token)) else 1)
        _run(settings, config, token, seconds, words)
    except ConfigError as error:
        fail(str(error), 2)


def _run(settings: RobotConfig, path: Path, token: str, seconds: float | None, ros: RosArguments) -> None:
    """Drive until the end.

    Raises:
        ConfigError: The graph cannot be joined as it is configured.
    """
    ended: SimpleQueue[str] = SimpleQueue()  # an interrupt in the middle of `threading.Event.wait` is another error

    def end(reason: str) -> None:
        says = f"robot {settings.robot} ends: {reason or 'asked to by rosnode kill'}"
        _log.error("%s", says)
        console.print(says, markup=False, soft_wrap=True)
        ended.put(reason)

    folder = path.parent
    with (
        gate(path, settings.safety, assumed=settings.gate_is_assumed, ros=ros) as own,
        settings.kind.join(settings.graph, settings.graph_config, folder, ros, end) as robot,
    ):
        try:
            with Agent(agent_config(settings, folder, token), _base(settings, robot.base), graph=robot) as agent:
                _watch(agent.status, ended, seconds, own, _teller(settings, robot))
        except FallbackError as error:
            fail(str(error), 2)


def _teller(settings: RobotConfig, robot: RobotGraph) -> Callable[[AgentStatus], object]:
    """What tells people in the graph how the agent is, if the graph has such."""
    if isinstance(robot, PublishesDiagnostics):
        return Diagnostics(settings.robot, settings.service, robot).publish
    return lambda _: None


def _base(settings: RobotConfig, graph: RobotHardware) -> RobotHardware:
    """The wheels: behind the gate if there is one, else a topic of the graph."""
    if settings.safety is None:
        return graph

    return GatedHardware(graph, GateLink(settings.safety.place()))


def _watch(
    status: Callable[[], AgentStatus],
    ended: SimpleQueue[str],
    seconds: float | None,
    gate: OwnGate | FoundGate | None,
    on_status: Callable[[AgentStatus], object],
) -> None:
    """Say what changes, until the end.

    Args:
        status: How the agent is.
        ended: Somebody wants the end.
        seconds: Until the end; None: for ever.
        gate: Before the wheels.
        on_status: Told often how the agent is.
    """
    gc.freeze()  # all that is loaded by now stays: looking through it for garbage takes ticks of the control loop
    begin = time.monotonic()
    before = ""
    while seconds is None or time.monotonic() - begin < seconds:
        found = status()
        on_status(found)
        now = _sentence(found)
        if now != before:
            console.print(now, markup=False, soft_wrap=True)
            before = now
        with suppress(Empty):
            ended.get(timeout=_STATUS_S)
            return
        trouble = gate.ensure_running() if gate is not None else ""
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
        limits=VelocityLimits(**settings.limits),
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
