"""The navigation experiment of the thesis (Mello, sections 4.3.5 and 5.6.2): nine goals in a building, over a network.

A simulated robot asks an orchestrator for the service ``navigation``, gives it the building's map and is driven to nine
goals, one after the other. Between the first and the second a person steps into its way. All but robot, building and
network is real: an orchestrator process, the service's process or container, the bridge, the agent with its supervisor.
"""

from __future__ import annotations

import json
import math
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import psutil
from prometheus_client.parser import text_string_to_metric_families

from skytether.api.client import Client
from skytether.api.rest import RobotCreate, SiteCreate
from skytether.messages import Message, Path, String, Twist, decode
from skytether.robot.agent import Agent, AgentConfig
from skytether.robot.supervisor import Limits

from .embedded import EmbeddedOrchestrator
from .link import LinkConditions, LinkEmulator
from .nine_goals_result import Point, TopicRow, Traces, TrialResult
from .throttle import Throttle, children_of
from .world.agent import Clockwork, WorldBase, WorldGraph
from .world.occupancy import Occupancy
from .world.plan import Plan, building
from .world.simulation import Simulation

ROBOT, SERVICE = "pioneer", "navigation"
_LOOK_S = 0.05
_TRACE_S = 0.1
_BEAT_S = 2.0
"""The map is given again so long after a service said that it has none."""
LIMITS = Limits(linear_max=0.5, linear_min=-0.1, angular_max=1.0)
"""What the simulated robot can do."""


class TrialError(Exception):
    """A trial could not begin; the text says why, in one sentence."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """Where the service runs, as seen from the robot.

    Attributes:
        name: For tables.
        rtt_s: Round trip of the network [s].
        jitter_s: Standard deviation of the round trip [s].
        loss: Share of round trips that are lost.
        params: Of the service, where they differ.
        cpu: Processors that the service gets at most; None: all. Then it runs on the robot itself.
    """

    name: str
    rtt_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    params: Mapping[str, Any] = field(default_factory=dict)
    cpu: float | None = None

    def link(self, seed: int, direction: int) -> LinkConditions:
        """One direction of the network, 0 or 1: half of the delay, of its variance and of the loss."""
        loss = 1 - math.sqrt(1 - self.loss)
        deviation = self.jitter_s / math.sqrt(2)
        return LinkConditions(delay=self.rtt_s / 2, jitter=deviation, loss=loss, seed=2 * seed + direction)


_EMBEDDED_RATES = {
    "control": 6.0,
    "planner": 0.4,
    "local_costmap": 4.0,
    "publish_local_costmap": 0.5,
    "global_costmap": 1.0,
    "publish_global_costmap": 0.4,
}
"""Table 5 of the thesis, for processing on the robot."""
ROBOT_CPU = 0.25
"""Processors of the robot's computer, in those of this machine: the Pioneer LX has an Atom of two slow cores (thesis,
section 5.2), here taken for an eighth of one of ours each. An assumption, not a measurement."""
SCENARIOS: Mapping[str, Scenario] = MappingProxyType(
    {
        scenario.name: scenario
        for scenario in (
            Scenario("embedded", params={"rates": _EMBEDDED_RATES}, cpu=ROBOT_CPU),
            Scenario("edge", 0.0287, 0.0209, 0.005),
            Scenario("commercial", 0.1522, 0.0247, 0.001),
            Scenario("private", 0.1962, 0.0241, 0.027),
        )
    }
)
"""Round trips, deviations and losses that section 5.6.3 measured with ping."""


@dataclass(frozen=True, slots=True)
class TrialSettings:
    """One trial.

    Attributes:
        scenario: Where the service runs.
        seed: Of sensor noise and network.
        docker: Options of a Docker site to run the service on; None: as a process.
        image: The service's, on that site; none: the manifest's.
        goals: Drive to the first so many.
        start_limit_s: The robot must move by then [s].
        drive_limit_s: And have reached its last goal by then [s].
    """

    scenario: Scenario
    seed: int = 1
    docker: Mapping[str, Any] | None = None
    image: str = ""
    goals: int = 9
    start_limit_s: float = 120.0
    drive_limit_s: float = 400.0

    def document(self) -> dict[str, Any]:
        """All that a trial's result depends on, for `KeptTrials`."""
        scenario = self.scenario
        network = {"rtt_s": scenario.rtt_s, "jitter_s": scenario.jitter_s, "loss": scenario.loss}
        asked: dict[str, Any] = {"scenario": scenario.name, "seed": self.seed, "goals": self.goals, **network}
        return {**asked, "cpu": scenario.cpu, "params": dict(scenario.params), "image": self.image}


class _Timed(WorldBase):
    """Counts what the simulation costs, which no robot pays."""

    def __init__(self, clockwork: Clockwork, graph: WorldGraph) -> None:
        super().__init__(clockwork, graph=graph)
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


class _Tracker:
    """Notes for figures what goes by. Its times are those of the caller."""

    def __init__(self, world: Simulation, network: LinkEmulator) -> None:
        self._world, self._network = world, network
        self._way: list[Point] = []
        self._person: list[Point] = []
        self._plans: list[tuple[Point, ...]] = []
        self._goals: list[int] = []
        self._kbit: list[tuple[float, float]] = []
        self._due = self._counted_at = -math.inf
        self._bytes = (0, 0)

    def look(self, now: float, reached: int) -> None:
        """Take what is due.

        Args:
            now: [s], not less than before.
            reached: Goals so far.
        """
        if now < self._due:
            return
        self._due = now + _TRACE_S
        self._goals += [len(self._way)] * (reached - len(self._goals))
        self._way.append(_rounded(self._world.robots[0].pose[:2]))
        for stance in self._world.stances[:1]:
            if self._person[-1:] != [place := _rounded(stance.trunk)]:
                self._person.append(place)
        if now - self._counted_at >= 1:
            up = self._network.counters()["up"]
            bytes_ = (up.bytes_received, up.bytes_forwarded)
            if self._counted_at > -math.inf:
                took = 125 * (now - self._counted_at)
                sent, arrived = ((b - a) / took for a, b in zip(self._bytes, bytes_, strict=True))
                self._kbit.append((round(sent, 1), round(arrived, 1)))
            self._bytes, self._counted_at = bytes_, now

    def plan(self, payload: bytes | memoryview) -> None:
        """A path that the service plans: those around the person are kept, each fourth point and the last."""
        if len(self._goals) == 1:
            poses = decode(Path, payload, "cdr").poses
            points = [_rounded((one.pose.position.x, one.pose.position.y)) for one in poses]
            self._plans.append((*points[:-1:4], *points[-1:]))

    def traces(self, reached: int) -> Traces:
        """All of it."""
        goals = (*self._goals, *[len(self._way) - 1] * (reached - len(self._goals)))
        sent, arrived = zip(*self._kbit, strict=True) if self._kbit else ((), ())
        return Traces(tuple(self._way), goals, tuple(self._person), tuple(self._plans), sent, arrived)


class Trial:
    """One run. A context manager: entering starts orchestrator, network and robot; leaving ends them in reverse order.

    Its parts are attributes, so that a test can meddle with them while it runs.
    """

    def __init__(self, settings: TrialSettings, plan: Plan | None = None) -> None:
        self.settings = settings
        self.plan = plan or building()
        self.world = Simulation(self.plan, seed=settings.seed)
        self.graph = WorldGraph()
        self.base = _Timed(Clockwork(self.world), self.graph)
        self.status: dict[str, Any] = {}
        self._mapped_at = -math.inf
        self._reached: dict[int, float] = {}
        self._stack = ExitStack()

    def __enter__(self) -> Trial:
        settings = self.settings
        with ExitStack() as stack:
            self.orchestrator = stack.enter_context(EmbeddedOrchestrator())
            self.operator = stack.enter_context(Client(self.orchestrator.url, self.orchestrator.operator_token))
            if settings.docker is not None:
                stack.enter_context(_on_docker(self.operator, settings))
            token = self.operator.create_robot(RobotCreate(name=ROBOT, services=(SERVICE,))).token
            links = [settings.scenario.link(settings.seed, direction) for direction in (0, 1)]
            self.network = stack.enter_context(LinkEmulator(("127.0.0.1", 9), up=links[0], down=links[1]))
            config = AgentConfig(
                robot=ROBOT,
                url=self.orchestrator.url,
                token=token,
                service=SERVICE,
                params=self._params(),
                limits=LIMITS,
                bind=("127.0.0.1", 0),
                route=self._through_network,
            )
            self.agent = Agent(config, self.base, graph=self.graph)
            self._tracker = _Tracker(self.world, self.network)
            stack.callback(self.graph.subscribe("status", self._hear))
            stack.callback(self.graph.subscribe("plan", self._tracker.plan))
            stack.enter_context(self.agent)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def drive(self, on_progress: Callable[[Mapping[str, Any]], None] = lambda _: None) -> TrialResult:
        """Wait until the last goal is reached, given up, or the time is over.

        Args:
            on_progress: Told the service's status, some twenty times a second.

        Raises:
            TrialError: The service did not drive in time.
        """
        limit = self.settings.start_limit_s
        if not self.base.commanded.wait(limit):
            trouble = self.agent.status().trouble or self.status.get("message") or "no command came"
            raise TrialError(f"the service did not drive the robot within {limit:.0f} s: {trouble}")
        robot = self.world.robots[0]
        with self._throttled():
            begun, from_m, spent, used = time.monotonic(), robot.distance, self._spent(), self._used()
            while self.status.get("state") not in ("succeeded", "failed"):
                if time.monotonic() - begun > self.settings.drive_limit_s:
                    break
                self._tracker.look(time.monotonic() - begun, self._goals_reached())
                on_progress(self.status)
                time.sleep(_LOOK_S)
            took, way = time.monotonic() - begun, robot.distance - from_m
            return self._result(took, way, (self._spent() - spent) / took, used)

    def _throttled(self) -> AbstractContextManager[object]:
        """A process gets no more than the robot's computer has, from its first command on; a container always."""
        cpu = self.settings.scenario.cpu
        if cpu is None or self.settings.docker is not None:
            return nullcontext()
        return Throttle(cpu, lambda: children_of(self.orchestrator.pid))

    def _result(self, took: float, way: float, robot_cpu: float, used: float) -> TrialResult:
        status = self.agent.status()
        first, asked = status.driver.first_command_at, status.asked_at
        contacts = len(self.world.contacts)
        succeeded = self.status.get("state") == "succeeded"
        topics = status.session.topics if status.session else ()
        return TrialResult(
            scenario=self.settings.scenario.name,
            seed=self.settings.seed,
            completed=succeeded and not contacts,
            contacts=contacts,
            goals=self.settings.goals if succeeded else max(0, self.status.get("goal", 1) - 1),
            start_s=first - asked if first is not None and asked is not None else math.nan,
            time_s=took,
            distance_m=way,
            first_leg_m=self._reached.get(2, math.nan) - self._reached.get(1, math.nan),
            mean_speed_m_s=way / took,
            rtt_ms=1000 * status.session.paths[0].rtt_p50 if status.session and status.session.paths else math.nan,
            robot_cpu=robot_cpu,
            service_cpu=(self._used() - used) / took,
            service_memory_mb=self._metric("skytether_instance_memory_bytes") / 1e6,
            message=self.status.get("message", ""),
            topics=tuple(TopicRow.of(topic) for topic in topics if topic.sent),
            robot_memory_mb=psutil.Process().memory_info().rss / 1e6,
            on_robot=self.settings.scenario.cpu is not None,
            traces=self._tracker.traces(self._goals_reached()),
        )

    def _params(self) -> dict[str, Any]:
        start, goals = self.plan.starts[0], self.plan.goals[: self.settings.goals]
        return {
            "start": {"x": start.x, "y": start.y, "yaw": start.heading},
            "goals": [{"x": goal.x, "y": goal.y, "yaw": goal.heading} for goal in goals],
            **self.settings.scenario.params,
        }

    def _hear(self, payload: bytes | memoryview) -> None:
        """The service's status: it asks for a map with it, and tells which goal is next."""
        status: dict[str, Any] = json.loads(decode(String, payload, "cdr").data)
        reached = status["goal"] - 1 if status["state"] != "succeeded" else status["goals"]
        self._reached.setdefault(reached, self.world.robots[0].distance)
        now = time.monotonic()
        if status["code"] == "no_map" and now - self._mapped_at > _BEAT_S:
            self._mapped_at = now
            self.graph.publish("map", Occupancy(self.plan).message())
        self.status = status

    def _goals_reached(self) -> int:
        return max(tuple(self._reached), default=0)  # a copy: another thread adds to it

    def _spent(self) -> float:
        """Processor time of this process without the simulation [s]."""
        return time.process_time() - self.base.simulating_s

    def _used(self) -> float:
        """Processor time of the service [s]."""
        return self._metric("skytether_instance_cpu_seconds_total")

    def _metric(self, name: str) -> float:
        samples = (s for family in text_string_to_metric_families(self.operator.metrics()) for s in family.samples)
        return sum(sample.value for sample in samples if sample.name == name)

    def _through_network(self, host: str, port: int) -> tuple[str, int]:
        self.network.set_target(host, port)
        return self.network.address


@contextmanager
def _on_docker(operator: Client, settings: TrialSettings) -> Iterator[None]:
    """Make an engine the only site."""
    manifest = operator.get_service(SERVICE)
    changes: dict[str, Any] = {"image": settings.image} if settings.image else {}
    if cpu := settings.scenario.cpu:  # the engine's quota of processor time
        changes["needs"] = manifest.spec.needs.model_copy(update={"cpu": min(manifest.spec.needs.cpu, cpu)})
        changes["limits"] = manifest.spec.limits.model_copy(update={"cpu": cpu})
    if changes:
        spec = manifest.spec.model_copy(update=changes)
        operator.put_service(SERVICE, manifest.model_copy(update={"spec": spec}))
    named = {"owner": f"trial-{secrets.token_hex(4)}", **(settings.docker or {})}
    operator.create_site(SiteCreate(name="docker", tier="edge", runtime="docker", options=named))
    operator.delete_site("local")
    yield


def _rounded(place: Sequence[float]) -> Point:
    return round(place[0], 3), round(place[1], 3)
