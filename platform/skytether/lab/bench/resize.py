"""How long a robot is without commands while its service is given more cores and memory, or less.

Everything is real: an orchestrator, the service in a container of this machine's engine (or as a process), a simulated
walker whose agent drives at 100 Hz, an operator in a process of its own. The instance is under load: another program in
its container, within its limits, keeps half a core busy. Beside each change the same is measured over as long a time
without one.

A robot has a computer of its own. Here it shares the processors with its edge machine, so its threads go before all
others where that is permitted, and its packets take the way of those that come from elsewhere.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass

import numpy as np

from skytether.api.client import Client
from skytether.api.rest import Resize, RobotCreate, Size
from skytether.lab.bench.containers import docker, docker_site, gateway
from skytether.lab.bench.migrate import PERIOD_MS, Commands, instance_of, wait_for
from skytether.lab.bench.pair import BenchError
from skytether.lab.demo import ROBOT, SERVICE, WalkerHardware
from skytether.lab.embedded import EmbeddedOrchestrator
from skytether.lab.trail import Trail
from skytether.lab.walk import World
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig
from skytether.robot.control.command import Source

SIZES = Size(cpu=2.0, memory_mb=512), Size(cpu=1.0, memory_mb=256)
"""In turn; both hard limits change each time."""
_AROUND_S = 0.5
"""Commands from so long before the request until so long after it was done count."""
_LOOK_S = 0.1
_LIMIT_S = 30.0
_LOAD = """
import time
while True:
    until = time.perf_counter() + 0.005
    while time.perf_counter() < until:
        pass
    time.sleep(0.005)
"""


@dataclass(frozen=True, slots=True)
class ResizeRow:
    """One line of the table; gaps are the longest time between two commands of one span.

    Attributes:
        runtime: Kind of the site.
        n: Changes.
        gap_p50_periods: Median of the gap around a change, in periods of the commands.
        gap_max_periods: The largest of them.
        gap_still_p50_periods: The same over as long a time without a change.
        gap_still_max_periods: The largest of those.
        over: Changes with a gap of more than two periods.
        over_still: The same of the times without a change.
        resize_p50_s: Median time from the request until the instance had it.
        fallbacks: Changes during which the robot's own controller took over.
        restarts: Of the instance.
        robot_first: Whether the robot's threads could be given real-time priority.
    """

    runtime: str
    n: int
    gap_p50_periods: float
    gap_max_periods: float
    gap_still_p50_periods: float
    gap_still_max_periods: float
    over: int
    over_still: int
    resize_p50_s: float
    fallbacks: int
    restarts: int
    robot_first: bool

    def document(self) -> dict[str, object]:
        """For ``--json``."""
        return asdict(self)


def bench_resize(
    n: int,
    runtime: str = "docker",
    prefix: str = "skytether/",
    on_resize: Callable[[int, float], None] = lambda *_: None,
) -> ResizeRow:
    """Change what a driven robot's instance has, ``n`` times.

    Args:
        n: Changes.
        runtime: ``docker`` or ``process``.
        prefix: Of the images' names.
        on_resize: Called with the number of each change and its gap [ms].

    Raises:
        BenchError: It did not drive, was not changed in time, or there is no such image, or engine.
    """
    if runtime not in ("docker", "process"):
        raise BenchError(f"there is no runtime '{runtime}' to measure; there are docker, process")
    gaps: list[float] = []
    still: list[float] = []
    took: list[float] = []
    fallbacks = 0
    host: str | None = None
    with (
        EmbeddedOrchestrator() as orchestrator,
        ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as operators,
        ExitStack() as site,
    ):
        if runtime == "docker":
            host = gateway() if "DOCKER_HOST" not in os.environ else None
            site.enter_context(docker_site(orchestrator, prefix, SERVICE, host))
        access = orchestrator.url, orchestrator.operator_token
        with Client(*access) as operator:
            token = operator.create_robot(RobotCreate(name=ROBOT, services=(SERVICE,))).token
        config = AgentConfig(ROBOT, orchestrator.url, SERVICE, token, bind=(host or "127.0.0.1", 0))
        seen = Commands()
        with Agent(config, WalkerHardware(World(Trail(), seed=1)), observer=seen) as agent:
            wait_for(lambda: agent.source is Source.CLOUD, agent)
            gc.freeze()  # as a robot's program does
            instance = instance_of(agent)
            operators.submit(_poll, access, instance, 0.0).result()  # it is there, and has imported all
            robot_first = _robot_first()
            with _loaded(instance, runtime):
                for i in range(n):
                    time.sleep(2 * _AROUND_S)
                    before = len(agent.status().driver.transitions)
                    began, done = operators.submit(_change, access, instance, SIZES[i % len(SIZES)]).result()
                    if (now := instance_of(agent)) != instance:
                        raise BenchError(f"the robot was handed over to {now}: the site did not change {instance}")
                    time.sleep(_AROUND_S)
                    gaps.append(seen.longest_gap_ms(began - _AROUND_S, done + _AROUND_S))
                    took.append(done - began)
                    fallbacks += len(agent.status().driver.transitions) > before
                    on_resize(i, gaps[-1])
                    time.sleep(2 * _AROUND_S)
                    began = operators.submit(_poll, access, instance, took[-1]).result()
                    time.sleep(_AROUND_S)
                    still.append(seen.longest_gap_ms(began - _AROUND_S, began + took[-1] + _AROUND_S))
            with Client(*access) as operator:
                restarts = operator.get_instance(instance).restarts
    periods, still_periods = np.array(gaps) / PERIOD_MS, np.array(still) / PERIOD_MS
    return ResizeRow(
        runtime,
        n,
        round(float(np.median(periods)), 3),
        round(float(periods.max()), 3),
        round(float(np.median(still_periods)), 3),
        round(float(still_periods.max()), 3),
        int((periods > 2).sum()),
        int((still_periods > 2).sum()),
        round(float(np.median(took)), 3),
        fallbacks,
        restarts,
        robot_first,
    )


def _robot_first() -> bool:
    """Let the threads of this process, the robot, go before all others; whether that is permitted."""
    try:
        for thread in os.listdir("/proc/self/task"):
            os.sched_setscheduler(int(thread), os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    except ProcessLookupError:
        return _robot_first()  # one of them ended meanwhile
    except PermissionError:
        return False
    return True


def _change(access: tuple[str, str], instance: str, size: Size) -> tuple[float, float]:
    """When it was asked for, and when it was seen to be done; in the operator's process."""
    with Client(*access) as operator:
        began = time.monotonic()
        operator.resize_instance(instance, Resize(cpu=size.cpu, memory_mb=size.memory_mb))
        while operator.get_instance(instance).size != size:
            if time.monotonic() > began + _LIMIT_S:
                raise BenchError(f"the instance does not have {size} within {_LIMIT_S:.0f} s")
            time.sleep(_LOOK_S)
        return began, time.monotonic()


def _poll(access: tuple[str, str], instance: str, seconds: float) -> float:
    """Ask as often as while it is changed; since when."""
    with Client(*access) as operator:
        began = time.monotonic()
        operator.get_instance(instance)
        while time.monotonic() < began + seconds:
            operator.get_instance(instance)
            time.sleep(_LOOK_S)
        return began


@contextmanager
def _loaded(instance: str, runtime: str) -> Iterator[None]:
    """Keep half a core of the instance busy meanwhile."""
    if runtime == "docker":
        (container,) = docker("ps", "-q", "--filter", f"label=skytether.io/instance={instance}").split()
        docker("exec", "-d", container, "/app/bin/python", "-c", _LOAD)
        yield  # it ends with its container
        return
    load = subprocess.Popen([sys.executable, "-c", _LOAD])
    try:
        yield
    finally:
        load.kill()
        load.wait()
