"""How long a robot waits: from its request over REST to the first velocity command that it accepts."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from skytether.api.client import Client
from skytether.api.rest import RobotCreate, State
from skytether.lab.bench.containers import docker_run, docker_site
from skytether.lab.bench.pair import BenchError
from skytether.lab.bench.pods import kubernetes_site
from skytether.lab.bench.start_robots import ROBOTS, Asking, Watch
from skytether.lab.embedded import EmbeddedOrchestrator
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig

ROBOT = "robot"
_LIMIT_S = 60.0
_LOOK_S = 0.005
_REST_S = 3.0
"""Before each start of a container: what the site does after the one before is over, and nothing shares the machine."""


@dataclass(frozen=True, slots=True)
class StartRow:
    """One line of the table.

    Attributes:
        runtime: Kind of the site; ``docker run``: none, until the service listens.
        standby: Instances kept warm.
        p50_s: Median time from request to first command [s].
        p99_s: 99th percentile (the largest, when there are fewer than 100) [s].
        n: Starts measured.
        moving_p50_s: Median time until the first command that moves the robot; None: it has no reason to move.
        moving_p99_s: Its 99th percentile.
    """

    runtime: str
    standby: int
    p50_s: float
    p99_s: float
    n: int
    moving_p50_s: float | None = None
    moving_p99_s: float | None = None

    def document(self) -> dict[str, object]:
        """For ``--json``."""
        return asdict(self)


def bench_start(
    n: int,
    runtimes: Sequence[str] = ("process",),
    prefix: str = "skytether/",
    on_start: Callable[[str, float], None] = lambda *_: None,
    service: str = "virtual-trail",
) -> list[StartRow]:
    """Start ``n`` instances of a service one after the other, on orchestrators of our own.

    Args:
        n: Starts of each kind.
        runtimes: ``process``, ``docker``, ``kubernetes``. Beside ``docker``, in turn, ``docker run`` of the same
            image is timed until its service listens: no robot, no orchestrator, no limits.
        prefix: Of the images' names.
        on_start: Called with the row and the time of each start [s].
        service: One of `ROBOTS`.

    Raises:
        BenchError: An instance did not drive in time, or there is no such runtime or service.
    """
    if service not in ROBOTS:
        raise BenchError(f"no robot of the benchmark asks for '{service}'; there are some for {', '.join(ROBOTS)}")
    asking, rows = ROBOTS[service](), []
    for runtime in runtimes:
        if runtime not in _STARTS:
            raise BenchError(f"there is no runtime '{runtime}' to measure; there are {', '.join(_STARTS)}")
        starts: dict[tuple[str, int], list[tuple[float, float]]] = {}
        for row, standby, took, moving in _STARTS[runtime](service, asking, n, prefix):
            starts.setdefault((row, standby), []).append((took, moving))
            on_start(row, took)
        for (row, standby), all_of_it in starts.items():
            (p50, moving_p50), (p99, moving_p99) = np.percentile(all_of_it, [50, 99], axis=0, method="inverted_cdf")
            times = (_seconds(moving_p50), _seconds(moving_p99)) if math.isfinite(moving_p99) else (None, None)
            rows.append(StartRow(row, standby, _seconds(p50), _seconds(p99), n, *times))
    return rows


_Start = tuple[str, int, float, float]
"""Row, instances kept warm, seconds to the first command, and to the first that moves: NaN where there is none."""


def _process(service: str, asking: Asking, n: int, prefix: str) -> Iterator[_Start]:  # noqa: ARG001 (without image)
    with EmbeddedOrchestrator() as orchestrator, Client(orchestrator.url, orchestrator.operator_token) as operator:
        for standby, took, moving in _starts(operator, orchestrator.url, service, asking, n):
            yield "process", standby, took, moving


def _docker(service: str, asking: Asking, n: int, prefix: str) -> Iterator[_Start]:
    with (
        EmbeddedOrchestrator() as orchestrator,
        docker_site(orchestrator, prefix, service) as image,
        Client(orchestrator.url, orchestrator.operator_token) as operator,
    ):
        for standby, took, moving in _starts(operator, orchestrator.url, service, asking, n, _REST_S):
            yield "docker", standby, took, moving
            if not standby:
                time.sleep(_REST_S)
                yield "docker run", 0, docker_run(image), math.nan


def _kubernetes(service: str, asking: Asking, n: int, prefix: str) -> Iterator[_Start]:
    with (
        EmbeddedOrchestrator() as orchestrator,
        kubernetes_site(orchestrator, prefix, service),
        Client(orchestrator.url, orchestrator.operator_token) as operator,
    ):
        for standby, took, moving in _starts(operator, orchestrator.url, service, asking, n, _REST_S, bind="0.0.0.0"):  # noqa: S104 (its peer is a node)
            yield "kubernetes", standby, took, moving


_STARTS = {"process": _process, "docker": _docker, "kubernetes": _kubernetes}


def _starts(
    operator: Client, url: str, service: str, asking: Asking, n: int, rest_s: float = 0.0, bind: str = "127.0.0.1"
) -> Iterator[tuple[int, float, float]]:
    """Cold starts, each after a rest, then as many with an instance kept warm."""
    token = operator.create_robot(RobotCreate(name=ROBOT, services=(service,))).token
    config = AgentConfig(ROBOT, url, service, token, params=asking.params, bind=(bind, 0))
    for standby in (0, 1):
        manifest = operator.get_service(service)
        needs = manifest.spec.needs.model_copy(update={"standby": standby})
        spec = manifest.spec.model_copy(update={"needs": needs})
        operator.put_service(service, manifest.model_copy(update={"spec": spec}))
        for _ in range(n):
            if standby:
                _until_warm(operator)
            else:
                time.sleep(rest_s)
            watch = Watch()
            with asking.agent(config, watch) as agent:
                took, moving = first_command(agent, watch if asking.moves else None)
            yield standby, took, moving


def _until_warm(operator: Client) -> None:
    """Wait until an instance that is nobody's runs, and nothing else: it would share the machine with the start."""
    deadline = time.monotonic() + _LIMIT_S
    while True:
        live = [one for one in operator.instances() if not one.state.final]
        if len(live) == 1 and not live[0].robot and live[0].state is State.RUNNING:
            return
        if time.monotonic() > deadline:
            raise BenchError(f"no instance was warm within {_LIMIT_S:.0f} s")
        time.sleep(_LOOK_S)


def first_command(agent: Agent, watch: Watch | None) -> tuple[float, float]:
    """Seconds until the first command, and until the first that moves the robot, where that is watched for.

    Raises:
        BenchError: There was none.
    """
    deadline = time.monotonic() + _LIMIT_S
    while time.monotonic() < deadline:
        status = agent.status()
        asked, first = status.asked_at, status.driver.first_command_at
        moved = watch.moved_at if watch is not None else math.nan
        if asked is not None and first is not None and moved is not None:
            return first - asked, moved - asked
        time.sleep(_LOOK_S)
    raise BenchError(f"no command within {_LIMIT_S:.0f} s: {agent.status().trouble or 'the service is silent'}")


def _seconds(value: float) -> float:
    return round(float(value), 4)
