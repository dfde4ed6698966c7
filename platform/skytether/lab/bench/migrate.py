"""How long a robot is without commands when its service moves from one site to another.

Everything is real: an orchestrator with two sites, the service as a process on each, a simulated walker whose agent
drives at 100 Hz. The service is moved to and fro while it drives. Beside each move the same is measured while nothing
happens, and while another program of the service's size is started on the same machine, as a peer: all of it shares the
processors, and a start that has nothing to do with the robot delays its commands as well.
"""

from __future__ import annotations

import gc
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from itertools import pairwise

import numpy as np

from skytether.api.client import Client
from skytether.api.rest import RobotCreate, SiteCreate
from skytether.lab.demo import ROBOT, SERVICE, WalkerHardware
from skytether.lab.embedded import EmbeddedOrchestrator
from skytether.lab.trail import Trail
from skytether.lab.walk import World
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig
from skytether.robot.control.command import Command, Source
from skytether.robot.control.supervisor import Objection

from .pair import BenchError

PERIOD_MS = 10.0
"""Of the service's commands."""
_LIMIT_S = 30.0
_LOOK_S = 0.02
_AROUND_S = 0.5
"""Commands from so long before the request until so long after the change count."""


@dataclass(frozen=True, slots=True)
class MigrateRow:
    """One line of the table.

    Attributes:
        n: Moves.
        gap_p50_ms: Median of the longest time between two commands around each move.
        gap_max_ms: The largest of them.
        gap_still_p50_ms: The same over as long a time without a move: what machine and service do by themselves.
        gap_still_max_ms: The largest of those.
        gap_start_p50_ms: The same around the start of another program, which loads what the service does and ends: what
            a start costs on this machine.
        gap_start_max_ms: The largest of those.
        move_p50_s: Median time from the request to the first command of the other instance.
        fallbacks: Moves during which the robot's own controller took over.
        bound_ms: Two periods of the service's commands.
    """

    n: int
    gap_p50_ms: float
    gap_max_ms: float
    gap_still_p50_ms: float
    gap_still_max_ms: float
    gap_start_p50_ms: float
    gap_start_max_ms: float
    move_p50_s: float
    fallbacks: int
    bound_ms: float = 2 * PERIOD_MS

    def document(self) -> dict[str, object]:
        """For ``--json``."""
        return asdict(self)


class Commands:
    """Arrivals of commands that were admitted."""

    def __init__(self) -> None:
        self.times: list[float] = []

    def __call__(self, command: Command, objection: Objection | None) -> None:
        if objection is None:
            self.times.append(command.received_at)

    def longest_gap_ms(self, since: float, until: float) -> float:
        """The longest time between two of them, in a span of the monotonic clock."""
        times = [t for t in list(self.times) if since <= t <= until]
        return max((b - a for a, b in pairwise(times)), default=np.inf) * 1e3


def bench_migrate(n: int, on_move: Callable[[int, float], None] = lambda *_: None) -> MigrateRow:
    """Move a service ``n`` times under a driven robot.

    Raises:
        BenchError: It did not drive, or was not moved, in time.
    """
    gaps, still, starts, moves, fallbacks = [], [], [], [], 0
    with EmbeddedOrchestrator() as orchestrator, Client(orchestrator.url, orchestrator.operator_token) as operator:
        operator.create_site(SiteCreate(name="other", tier="edge", runtime="process"))
        program = str(operator.get_service(SERVICE).spec.entrypoint)
        token = operator.create_robot(RobotCreate(name=ROBOT, services=(SERVICE,))).token
        bind = ("127.0.0.1", 0)
        config = AgentConfig(robot=ROBOT, url=orchestrator.url, token=token, service=SERVICE, bind=bind, renew_s=0.5)
        seen = Commands()
        with Agent(config, WalkerHardware(World(Trail(), seed=1)), observer=seen) as agent:
            wait_for(lambda: agent.source is Source.CLOUD, agent)
            gc.freeze()  # as a robot's program does
            for i in range(n):
                time.sleep(2 * _AROUND_S)
                began = time.monotonic()
                still.append(seen.longest_gap_ms(began - 2 * _AROUND_S, began))
                _load(program)
                ended = time.monotonic()
                time.sleep(_AROUND_S)
                starts.append(seen.longest_gap_ms(began - _AROUND_S, ended + _AROUND_S))
                time.sleep(_AROUND_S)
                began = time.monotonic()
                before = len(agent.status().driver.transitions)
                coming = operator.migrate_instance(instance_of(agent)).id
                wait_for(lambda: instance_of(agent) == coming, agent)  # noqa: B023 (called at once)
                changed = time.monotonic()
                time.sleep(_AROUND_S)
                gaps.append(seen.longest_gap_ms(began - _AROUND_S, changed + _AROUND_S))
                moves.append(changed - began)
                fallbacks += len(agent.status().driver.transitions) > before
                on_move(i, gaps[-1])
    return MigrateRow(
        n,
        round(float(np.median(gaps)), 2),
        round(max(gaps), 2),
        round(float(np.median(still)), 2),
        round(max(still), 2),
        round(float(np.median(starts)), 2),
        round(max(starts), 2),
        round(float(np.median(moves)), 3),
        fallbacks,
    )


def _load(program: str) -> None:
    """Load what a service does, in a process of its own, and end it."""
    command = [sys.executable, "-P", "-c", f"import {program}.__main__, skytether.bridge"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_LIMIT_S, check=False)
    except subprocess.TimeoutExpired:
        raise BenchError(f"the service's program does not load within {_LIMIT_S:.0f} s") from None
    if done.returncode:
        raise BenchError(f"the service's program does not load: {done.stderr.strip().splitlines()[-1]}")


def instance_of(agent: Agent) -> str:
    """The id of the instance that drives it; empty: none."""
    instance = agent.status().instance
    return instance.id if instance else ""


def wait_for(condition: Callable[[], bool], agent: Agent) -> None:
    """Until it is so.

    Raises:
        BenchError: It was not so in time.
    """
    deadline = time.monotonic() + _LIMIT_S
    while not condition():
        if time.monotonic() > deadline:
            why = agent.status().trouble or "the service does not do what was asked"
            raise BenchError(f"nothing happened within {_LIMIT_S:.0f} s: {why}")
        time.sleep(_LOOK_S)
