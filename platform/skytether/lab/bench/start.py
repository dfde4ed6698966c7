"""How long a robot waits: from its request over REST to the first velocity command that it accepts."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from skytether.api.client import Client
from skytether.api.rest import RobotCreate, State
from skytether.lab.bench.containers import docker_run, docker_site
from skytether.lab.bench.pair import BenchError
from skytether.lab.demo import ROBOT, SERVICE, WalkerBase
from skytether.lab.embedded import EmbeddedOrchestrator
from skytether.lab.trail import Trail
from skytether.lab.walk import World
from skytether.robot.agent import Agent, AgentConfig

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
    """

    runtime: str
    standby: int
    p50_s: float
    p99_s: float
    n: int

    def document(self) -> dict[str, object]:
        """For ``--json``."""
        return asdict(self)


def bench_start(
    n: int,
    runtimes: Sequence[str] = ("process",),
    prefix: str = "skytether/",
    on_start: Callable[[str, float], None] = lambda *_: None,
) -> list[StartRow]:
    """Start ``n`` instances of virtual-trail one after the other, on orchestrators of our own.

    Args:
        n: Starts of each kind.
        runtimes: ``process``, ``docker``. Beside the latter, in turn with it, ``docker run`` of the same image is timed
            until its service listens: no robot, no orchestrator, no limits.
        prefix: Of the images' names.
        on_start: Called with the row and the time of each start [s].

    Raises:
        BenchError: An instance did not drive in time, or there is no such runtime.
    """
    rows = []
    for runtime in runtimes:
        if runtime not in _STARTS:
            raise BenchError(f"there is no runtime '{runtime}' to measure; there are {', '.join(_STARTS)}")
        seconds: dict[tuple[str, int], list[float]] = {}
        for row, standby, took in _STARTS[runtime](n, prefix):
            seconds.setdefault((row, standby), []).append(took)
            on_start(row, took)
        for (row, standby), all_of_it in seconds.items():
            p50, p99 = np.percentile(all_of_it, [50, 99], method="inverted_cdf")
            rows.append(StartRow(row, standby, round(float(p50), 4), round(float(p99), 4), n))
    return rows


def _process(n: int, prefix: str) -> Iterator[_Start]:  # noqa: ARG001 (processes have no image)
    with EmbeddedOrchestrator() as orchestrator, Client(orchestrator.url, orchestrator.operator_token) as operator:
        for standby, took in _starts(operator, orchestrator.url, n):
            yield "process", standby, took


def _docker(n: int, prefix: str) -> Iterator[_Start]:
    with (
        EmbeddedOrchestrator() as orchestrator,
        docker_site(orchestrator, prefix) as service,
        Client(orchestrator.url, orchestrator.operator_token) as operator,
    ):
        for standby, took in _starts(operator, orchestrator.url, n, _REST_S):
            yield "docker", standby, took
            if not standby:
                time.sleep(_REST_S)
                yield "docker run", 0, docker_run(service)


_Start = tuple[str, int, float]
"""Row, instances kept warm, seconds."""
_STARTS = {"process": _process, "docker": _docker}


def _starts(operator: Client, url: str, n: int, rest_s: float = 0.0) -> Iterator[tuple[int, float]]:
    """Cold starts, each after a rest, then as many with an instance kept warm."""
    token = operator.create_robot(RobotCreate(name=ROBOT, services=(SERVICE,))).token
    config = AgentConfig(robot=ROBOT, url=url, token=token, service=SERVICE, bind=("127.0.0.1", 0))
    for standby in (0, 1):
        manifest = operator.get_service(SERVICE)
        needs = manifest.spec.needs.model_copy(update={"standby": standby})
        spec = manifest.spec.model_copy(update={"needs": needs})
        operator.put_service(SERVICE, manifest.model_copy(update={"spec": spec}))
        for _ in range(n):
            if standby:
                _until_warm(operator)
            else:
                time.sleep(rest_s)
            with Agent(config, WalkerBase(World(Trail(), seed=1))) as agent:
                took = _first_command(agent)
            yield standby, took


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


def _first_command(agent: Agent) -> float:
    deadline = time.monotonic() + _LIMIT_S
    while time.monotonic() < deadline:
        status = agent.status()
        if status.driver.first_command_at is not None and status.asked_at is not None:
            return status.driver.first_command_at - status.asked_at
        time.sleep(_LOOK_S)
    raise BenchError(f"no command within {_LIMIT_S:.0f} s: {agent.status().trouble or 'the service is silent'}")
