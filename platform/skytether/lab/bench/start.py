"""How long a robot waits: from its request over REST to the first velocity command that it accepts."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass

import numpy as np

from skytether.api.client import Client
from skytether.api.rest import RobotCreate
from skytether.lab.demo import ROBOT, SERVICE, WalkerBase
from skytether.lab.embedded import EmbeddedOrchestrator
from skytether.lab.trail import Trail
from skytether.lab.world import World
from skytether.robot.agent import Agent, AgentConfig

_LIMIT_S = 20.0
_LOOK_S = 0.005


class BenchError(Exception):
    """Nothing could be measured; the text says why."""


@dataclass(frozen=True, slots=True)
class StartRow:
    """One line of the table.

    Attributes:
        runtime: Kind of the site.
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


def bench_start(n: int, on_start: Callable[[int, float], None] = lambda *_: None) -> list[StartRow]:
    """Start ``n`` instances of virtual-trail one after the other on an orchestrator of our own.

    Raises:
        BenchError: An instance did not drive in time.
    """
    seconds = []
    for i, took in enumerate(_starts(n)):
        seconds.append(took)
        on_start(i, took)
    p50, p99 = np.percentile(seconds, [50, 99], method="inverted_cdf")
    return [StartRow("process", 0, round(float(p50), 4), round(float(p99), 4), n)]


def _starts(n: int) -> Iterator[float]:
    with EmbeddedOrchestrator() as orchestrator:
        with Client(orchestrator.url, orchestrator.operator_token) as operator:
            token = operator.create_robot(RobotCreate(name=ROBOT, services=(SERVICE,))).token
        config = AgentConfig(robot=ROBOT, url=orchestrator.url, token=token, service=SERVICE, bind=("127.0.0.1", 0))
        for _ in range(n):
            with Agent(config, WalkerBase(World(Trail(), seed=1))) as agent:
                yield _first_command(agent)


def _first_command(agent: Agent) -> float:
    deadline = time.monotonic() + _LIMIT_S
    while time.monotonic() < deadline:
        status = agent.status()
        if status.driver.first_command_at is not None and status.asked_at is not None:
            return status.driver.first_command_at - status.asked_at
        time.sleep(_LOOK_S)
    raise BenchError(f"no command within {_LIMIT_S:.0f} s: {agent.status().trouble or 'the service is silent'}")
