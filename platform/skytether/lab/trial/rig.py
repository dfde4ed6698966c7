"""The rig of an experiment: an orchestrator, a bad network and the agent of a simulated robot, around one service.

The robot asks the orchestrator for the service and is driven by it, in real time. What is to be done, and what came of
it, is the experiment's.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

import psutil
from prometheus_client.parser import text_string_to_metric_families

from skytether.api.client import Client
from skytether.api.rest import RobotCreate
from skytether.emulator.udp_link import LinkEmulator
from skytether.lab.embedded import EmbeddedOrchestrator
from skytether.lab.throttle import Throttle, children_of
from skytether.lab.world.agent import Clockwork, Observer, WorldGraph, WorldHardware
from skytether.lab.world.simulation import Simulation
from skytether.messages import Message, String, Twist, decode
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig
from skytether.robot.control.supervisor import VelocityLimits

from .errors import TrialError
from .results import Measured, TopicRow
from .scenario import TrialSettings
from .tracker import Tracker

_LOOK_S = 0.05
Status = Mapping[str, Any]
"""What a service says on its topic ``status``."""


@dataclass(frozen=True, slots=True)
class Task:
    """Who is to drive what.

    Attributes:
        service: Its name.
        params: Its parameters.
        robot: Name of the robot.
        limits: What the robot can do.
        names: Topics of the robot that have other names than the world's, see `WorldHardware`.
    """

    service: str
    params: Mapping[str, Any]
    robot: str
    limits: VelocityLimits
    names: Mapping[str, str] | None = None


class TimedBase(WorldHardware):
    """Counts what the simulation costs, which no robot pays."""

    def __init__(self, clockwork: Clockwork, graph: WorldGraph, names: Mapping[str, str] | None) -> None:
        super().__init__(clockwork, names=names, graph=graph)
        self.simulating_s = 0.0
        self.commanded = threading.Event()

    def read(self, now: float) -> Iterable[tuple[str, Message]]:
        begun = time.thread_time()
        found = super().read(now)
        self.simulating_s += time.thread_time() - begun
        return found

    def write(self, twist: Twist) -> None:
        if twist.linear.x or twist.angular.z:
            self.commanded.set()
        super().write(twist)


class Rig:
    """One run. A context manager: entering starts orchestrator, network and robot; leaving ends them in reverse order.

    Its parts are attributes, so that a test can meddle with them while it runs.

    Args:
        settings: Of the trial.
        task: Who is to drive what.
        world: With the robot, which is its first one.
        on_status: Told what the service says; in the bridge's thread.
        observers: Of the world, see `Clockwork`.
        simulating: Processor time of what else simulates in this process, beside the world's ticks [s].
    """

    def __init__(
        self,
        settings: TrialSettings,
        task: Task,
        world: Simulation,
        on_status: Callable[[Status], None] = lambda _: None,
        observers: Iterable[Observer] = (),
        simulating: Callable[[], float] = lambda: 0.0,
    ) -> None:
        self.settings, self.task, self.world = settings, task, world
        self.graph = WorldGraph()
        self.base = TimedBase(Clockwork(world, observers), self.graph, task.names)
        self.status: Status = {}
        self._on_status, self._simulating = on_status, simulating
        self._stack = ExitStack()

    def __enter__(self) -> Rig:
        settings, task = self.settings, self.task
        with ExitStack() as stack:
            options = {}
            if settings.docker is not None:
                # Docker's library is an extra, which trials of processes do without.
                from .on_docker import engine_site, use_engine

                options = stack.enter_context(engine_site(settings.docker))
            self.orchestrator = stack.enter_context(EmbeddedOrchestrator())
            self.operator = stack.enter_context(Client(self.orchestrator.url, self.orchestrator.operator_token))
            if settings.docker is not None:
                use_engine(self.operator, task.service, settings, options)
            token = self.operator.create_robot(RobotCreate(name=task.robot, services=(task.service,))).token
            up, down = (settings.scenario.link(settings.seed, direction) for direction in (0, 1))
            self.network = stack.enter_context(LinkEmulator(("127.0.0.1", 9), up=up, down=down))
            config = AgentConfig(
                robot=task.robot,
                url=self.orchestrator.url,
                token=token,
                service=task.service,
                params=task.params,
                limits=task.limits,
                bind=("127.0.0.1", 0),
                route=self._through_network,
            )
            self.agent = Agent(config, self.base, graph=self.graph)
            stack.callback(self.graph.subscribe("status", self._on_message))
            stack.enter_context(self.agent)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    @contextmanager
    def driving(self) -> Iterator[Drive]:
        """From the first command on, which is waited for.

        Raises:
            TrialError: It did not come in time.
        """
        limit = self.settings.start_limit_s
        if not self.base.commanded.wait(limit):
            trouble = self.agent.status().trouble or self.status.get("message") or "no command came"
            raise TrialError(f"the service did not drive the robot within {limit:.0f} s: {trouble}")
        with self._throttled():
            yield Drive(self)

    def spent(self) -> float:
        """Processor time of this process without the simulation [s]."""
        return time.process_time() - self.base.simulating_s - self._simulating()

    def metric(self, name: str) -> float:
        """Sum of a metric of the orchestrator over all its labels."""
        samples = (s for family in text_string_to_metric_families(self.operator.metrics()) for s in family.samples)
        return sum(sample.value for sample in samples if sample.name == name)

    def _throttled(self) -> AbstractContextManager[object]:
        """A process gets no more than the robot's computer has, from its first command on; a container always."""
        cpu = self.settings.scenario.cpu
        if cpu is None or self.settings.docker is not None:
            return nullcontext()
        return Throttle(cpu, lambda: children_of(self.orchestrator.pid))

    def _on_message(self, payload: bytes | memoryview) -> None:
        status: dict[str, Any] = json.loads(decode(String, payload, "cdr").data)
        self._on_status(status)
        self.status = status

    def _through_network(self, host: str, port: int) -> tuple[str, int]:
        self.network.set_target(host, port)
        return self.network.address


class Drive:
    """What goes on from the first command to the end of the task.

    Attributes:
        tracker: What it notes for figures.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._robot = rig.world.robots[0]
        self.tracker = Tracker(self._robot, rig.network.counters)
        self._begun, self._from_m = time.monotonic(), self._robot.distance
        self._world_s = rig.world.time
        self._spent, self._used = rig.spent(), self._cpu_of_service()

    def passes(self) -> Iterator[float]:
        """The time since the beginning [s], some twenty times a second, until it is over."""
        while (now := time.monotonic() - self._begun) <= self._rig.settings.drive_limit_s:
            yield now
            time.sleep(_LOOK_S)

    def measured(self) -> Measured:
        """All of it, up to now."""
        rig, settings = self._rig, self._rig.settings
        took, way = time.monotonic() - self._begun, self._robot.distance - self._from_m
        spent = rig.spent() - self._spent
        status = rig.agent.status()
        first, asked = status.driver.first_command_at, status.asked_at
        topics = status.session.topics if status.session else ()
        return Measured(
            scenario=settings.scenario.name,
            seed=settings.seed,
            contacts=len(rig.world.contacts),
            start_s=first - asked if first is not None and asked is not None else math.nan,
            time_s=took,
            distance_m=way,
            mean_speed_m_s=way / took,
            rtt_ms=1000 * status.session.paths[0].rtt_p50 if status.session and status.session.paths else math.nan,
            robot_cpu=spent / took,
            service_cpu=(self._cpu_of_service() - self._used) / took,
            service_memory_mb=rig.metric("skytether_instance_memory_bytes") / 1e6,
            message=rig.status.get("message", ""),
            topics=tuple(TopicRow.of(topic) for topic in topics if topic.sent),
            robot_memory_mb=psutil.Process().memory_info().rss / 1e6,
            on_robot=settings.scenario.cpu is not None,
            held_up_s=max(0.0, took - (rig.world.time - self._world_s)),
        )

    def _cpu_of_service(self) -> float:
        """Processor time of the service [s]."""
        return self._rig.metric("skytether_instance_cpu_seconds_total")
