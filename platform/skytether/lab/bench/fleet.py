"""A fleet over one orchestrator: do the sums on ``/metrics`` tell of every message, whatever happened meanwhile?

The orchestrator is real, a program that is asked over HTTP with the robots' own tokens, and so are the instances'
processes, which sleep. Both ends of each bridge are real sessions with the traffic of Table 4 of the thesis, but over a
made-up link in made-up time: a hundred robots' packets would need more processors than a machine has. The robots' side
of REST, the sums over sessions and the reports are those of the agent.

Of ten robots, one each has its program started anew, its service killed, answers that are lost while requests come
twice and late, its service moved, or leaves and comes back; the orchestrator is killed in between, and comes back.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass

import psutil
from prometheus_client.parser import text_string_to_metric_families

from skytether.api.client import Client, Unreachable
from skytether.api.rest import InstanceCreate, RobotCreate, SiteCreate
from skytether.lab.embedded import EmbeddedOrchestrator
from skytether.robot.session.counter_totals import COUNTERS

from .fleet_robot import LEASE_S, MANIFEST, Series, SimulatedRobot
from .observe import Spread, cpu_seconds, instance_of
from .pair import BenchError
from .requests import SERVICE

PHASES = 4
_QUIET_S = 5.0
"""Made-up seconds without traffic at the end, in which what is under way arrives and is told of."""
_LIMIT_S = 60.0
"""For one robot to be as it should be again."""
_MESSAGES = tuple(name for name in COUNTERS if name != "bytes_sent")
LEAST_ROBOTS = 6
"""So that each thing happens to one of them."""


@dataclass(frozen=True, slots=True)
class FleetRow:
    """What was counted.

    Attributes:
        robots: In the fleet.
        seconds: Of traffic for each, in made-up time.
        messages: Sent, both directions.
        sent_bytes: On the wire.
        lost_in_accounting: Messages by which ``/metrics`` and the robots' own sums differ, or that the books
            ``sent = delivered + superseded + lost - late + unknown`` do not explain.
        miscounted: Messages by which ``delivered`` differs from what the graphs were given, over the robots of which
            neither end was killed (who is killed takes what it had not told yet).
        fallen: Counters that went down between two scrapes.
        left_over: Series of robots that had gone.
        renewals: Requests with a report.
        renew_p50_ms: Median time of their answers, one asked at a time.
        renew_p99_ms: 99th percentile.
        cpu: Cores that the orchestrator kept busy on average, its second start included.
        memory_mb: The orchestrator's, at the end.
        scrape_ms: One look at ``/metrics``, at the end.
        metrics_kb: Its size.
        took_s: The measurement.
    """

    robots: int
    seconds: float
    messages: int
    sent_bytes: int
    lost_in_accounting: int
    miscounted: int
    fallen: int
    left_over: int
    renewals: int
    renew_p50_ms: float
    renew_p99_ms: float
    cpu: float
    memory_mb: float
    scrape_ms: float
    metrics_kb: float
    took_s: float

    def document(self) -> dict[str, object]:
        """For ``--json``."""
        return asdict(self)


def bench_fleet(robots: int, seconds: float, on_progress: Callable[[str], None] = lambda _: None) -> FleetRow:
    """Drive a fleet, disturb it, and compare what it counted with what the orchestrator exports.

    Args:
        robots: At least ``LEAST_ROBOTS``.
        seconds: Of traffic for each robot, made-up time.
        on_progress: Told what is done.

    Raises:
        BenchError: A robot did not get its service (again) in time.
    """
    with ExitStack() as stack:
        orchestrator = stack.enter_context(EmbeddedOrchestrator())
        operator = stack.enter_context(Client(orchestrator.url, orchestrator.operator_token, timeout=30))
        operator.put_service(SERVICE, MANIFEST)
        for site in "ab":
            options = {"cpu": robots}
            operator.create_site(SiteCreate(name=site, tier="edge", runtime="process", options=options))
        operator.delete_site("local")
        tokens = [operator.create_robot(RobotCreate(name=f"robot-{i}")).token for i in range(robots)]
        clients = [stack.enter_context(Client(orchestrator.url, token)) for token in tokens]
        fleet = _Fleet(orchestrator, operator, clients, on_progress)
        began = time.monotonic()
        fleet.wait(fleet.robots, "start")
        fleet.drive(seconds / PHASES, "all is well")
        fleet.disturb()
        fleet.drive(seconds / PHASES, "after the disturbances")
        fleet.kill_orchestrator()
        fleet.drive(seconds / PHASES, "without an orchestrator")
        fleet.start_orchestrator()
        fleet.drive(seconds / PHASES, "with the next orchestrator")
        fleet.drive(_QUIET_S, "quiet", traffic=False)
        fleet.wait(fleet.robots, "last report")
        return fleet.row(seconds, time.monotonic() - began)


class _Fleet:
    """All robots, and what was seen of them on ``/metrics``."""

    def __init__(
        self,
        orchestrator: EmbeddedOrchestrator,
        operator: Client,
        clients: list[Client],
        on_progress: Callable[[str], None],
    ) -> None:
        """``clients`` are the robots' own."""
        self._orchestrator = orchestrator
        self._operator = operator
        self._on_progress = on_progress
        self._seen: Series = Counter()
        self._fallen = 0
        self._left_over = 0
        self._cpu_s = -cpu_seconds(orchestrator.pid)  # its first start is no matter of the fleet
        self.robots = []
        for i, client in enumerate(clients):
            request = InstanceCreate(robot=f"robot-{i}", service=SERVICE, lease_s=LEASE_S)
            self.robots.append(SimulatedRobot(i, client, request, odd=i % 10 == 3))

    def wait(self, robots: list[SimulatedRobot], what: str) -> None:
        """Until each is served by one running instance, and has reported."""
        deadline = time.monotonic() + _LIMIT_S
        waiting = list(robots)
        while waiting:
            self._on_progress(f"{what}: {len(waiting)} of {len(robots)} robots to come")
            for robot in waiting:
                robot.run(0.3, traffic=False)
                robot.exchange()
            waiting = [robot for robot in waiting if not robot.settled]
            if waiting and time.monotonic() > deadline:
                raise BenchError(f"{what}: {waiting[0].name} was not served again: {waiting[0].trouble or 'no reason'}")
            time.sleep(0.02)

    def drive(self, seconds: float, what: str, *, traffic: bool = True) -> None:
        """Let made-up time pass, with a report of each robot every second; scrape once a round."""
        rounds = max(1, round(seconds))
        for n in range(rounds):
            self._on_progress(f"{what}: {n + 1} of {rounds}")
            for robot in self.robots:
                robot.run(seconds / rounds, traffic=traffic)
                robot.exchange()
            with suppress(Unreachable):
                self._scrape()

    def disturb(self) -> None:
        """One thing to one robot each of ten."""
        self._on_progress("disturbances")
        programs, killed, _, moved, leaving = ([r for r in self.robots if r.number % 10 == k] for k in range(1, 6))
        for robot in programs:
            robot.begin_anew()
        for robot in killed:
            self._kill_service(robot)
        for robot in moved:
            self._operator.migrate_instance(robot.instance.id)
        for robot in leaving:
            robot.leave()
        self._wait_gone(leaving)
        self.wait(self.robots, "after the disturbances")

    def kill_orchestrator(self) -> None:
        self._cpu_s += cpu_seconds(self._orchestrator.pid)
        self._orchestrator.kill()

    def start_orchestrator(self) -> None:
        self._orchestrator.start()
        self.wait(self.robots, "the next orchestrator")

    def row(self, seconds: float, took: float) -> FleetRow:
        """The measurement's result."""
        began = time.monotonic()
        text = self._operator.metrics()
        scrape = time.monotonic() - began
        exported = self._parse_metrics(text)
        self._cpu_s += cpu_seconds(self._orchestrator.pid)
        counted: Series = Counter()
        unexplained = 0
        for robot in self.robots:
            counted.update(robot.counted())
            unexplained += robot.unexplained()
        keys = {key for key in exported.keys() | counted.keys() if key[-1] in _MESSAGES}
        answers = Spread.of([seconds for robot in self.robots for seconds in robot.answers])
        return FleetRow(
            robots=len(self.robots),
            seconds=seconds,
            messages=sum(n for key, n in counted.items() if key[-1] == "sent"),
            sent_bytes=sum(n for key, n in counted.items() if key[-1] == "bytes_sent"),
            lost_in_accounting=unexplained + sum(abs(exported[key] - counted[key]) for key in keys),
            miscounted=sum(robot.miscounted(exported) for robot in self.robots),
            fallen=self._fallen,
            left_over=self._left_over,
            renewals=answers.n,
            renew_p50_ms=answers.p50_ms,
            renew_p99_ms=answers.p99_ms,
            cpu=round(self._cpu_s / took, 3),
            memory_mb=round(psutil.Process(self._orchestrator.pid).memory_info().rss / 2**20, 1),
            scrape_ms=round(scrape * 1e3, 1),
            metrics_kb=round(len(text) / 1024, 1),
            took_s=round(took, 1),
        )

    def _kill_service(self, robot: SimulatedRobot) -> None:
        """Kill -9 its process; the orchestrator begins another one for the same session."""
        instance = robot.instance.id
        for process in psutil.Process(self._orchestrator.pid).children():
            if instance_of(process) == instance:
                process.kill()
        deadline = time.monotonic() + _LIMIT_S
        while self._operator.get_instance(instance).restarts == 0:
            if time.monotonic() > deadline:
                raise BenchError(f"{robot.name}: its service was killed, and nobody noticed")
            time.sleep(0.02)
        robot.service_restarted()

    def _wait_gone(self, robots: list[SimulatedRobot]) -> None:
        """Look how many series of robots that let go are still there after a while, and let them come back."""
        names = {robot.name for robot in robots}
        deadline = time.monotonic() + _LIMIT_S / 6
        while left := sum(key[0] in names for key in self._scrape()):
            if time.monotonic() > deadline:
                break
            time.sleep(0.1)
        self._left_over += left
        for robot in robots:
            robot.come_back()

    def _scrape(self) -> Series:
        return self._parse_metrics(self._operator.metrics())

    def _parse_metrics(self, text: str) -> Series:
        found: Series = Counter()
        for family in text_string_to_metric_families(text):
            for sample in family.samples:
                labels = sample.labels
                if sample.name == "skytether_topic_messages_total":
                    key = (labels["robot"], labels["topic"], labels["direction"], labels["outcome"])
                    found[key] += round(sample.value)
        self._fallen += sum(found[key] < before for key, before in self._seen.items() if key in found)
        self._seen = found
        return found
