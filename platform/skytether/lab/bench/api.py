"""An orchestrator with many robots: its answers, its reconcile passes, its memory.

Everything is real: the orchestrator as a program, each instance a sleeping process, requests over HTTP with the robots'
own tokens. Requests are due at random times (Poisson), whether or not those before were answered, and are timed from
when they were due until all of the answer was read. The same client asks for ``/healthz`` first, which costs the
orchestrator next to nothing: what it, the machine's network and HTTP take by themselves.
"""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import TypeVar

import numpy as np
import psutil

from skytether.api.client import Client
from skytether.api.rest import InstanceCreate, RobotCreate, SiteCreate, State
from skytether.lab.embedded import EmbeddedOrchestrator

from .observe import Spread, cpu_seconds, instance_of
from .open_loop import Answered, ask_openly
from .pair import BenchError
from .requests import MANIFEST, SERVICE, Held, Mix, healthz

_START_LIMIT_S = 600.0
_LEASE_S = 3600.0
_FLOOR_S = 5.0
"""For how long ``/healthz`` is asked for, at most."""
_SETTLE_S = 2.0
"""After the last start, and after the last request for what is being let go."""
_SEED = 20

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class ApiRow:
    """One line of the table.

    Attributes:
        instances: That run meanwhile.
        rate_hz: Requests a second.
        requests: Made.
        failed: Of these, those without a good answer.
        api_p50_ms: Median time from due to answered.
        api_p99_ms: 99th percentile.
        api_max_ms: The slowest.
        kinds: The same by kind of request.
        client_p50_ms: Median time of ``/healthz``, asked in the same way: the client's own share.
        client_p99_ms: 99th percentile of that.
        pass_p50_ms: Median reconcile pass over the site, while requests came; most look only at what starts or stops.
        pass_max_ms: The slowest.
        placer_max_ms: Slowest pass of the placer, which looks at all instances.
        cpu_idle: Cores that the orchestrator kept busy before the requests.
        cpu: The same while they came.
        memory_mb: The most memory that the orchestrator had resident.
        lost: Instances that do not run any more, or run twice.
        start_s: From the first request to the last instance running.
    """

    instances: int
    rate_hz: float
    requests: int
    failed: int
    api_p50_ms: float
    api_p99_ms: float
    api_max_ms: float
    kinds: dict[str, Spread]
    client_p50_ms: float
    client_p99_ms: float
    pass_p50_ms: float
    pass_max_ms: float
    placer_max_ms: float
    cpu_idle: float
    cpu: float
    memory_mb: float
    lost: int
    start_s: float

    def document(self) -> dict[str, object]:
        """For ``--json``."""
        return asdict(self)


def bench_api(
    instances: int, rate_hz: float, seconds: float, on_progress: Callable[[str], None] = lambda _: None
) -> ApiRow:
    """Start instances, then ask.

    Raises:
        BenchError: Not all of them ran in time.
    """
    rng = np.random.default_rng(_SEED)
    with (
        EmbeddedOrchestrator(environment={"SKYTETHER_LOGS_LEVEL": "debug"}) as orchestrator,
        Client(orchestrator.url, orchestrator.operator_token, timeout=30) as operator,
    ):
        operator.put_service(SERVICE, MANIFEST)
        operator.create_site(SiteCreate(name="fleet", tier="edge", runtime="process", options={"cpu": instances}))
        operator.delete_site("local")
        tokens = [operator.create_robot(RobotCreate(name=f"robot-{i}")).token for i in range(instances)]
        began = time.monotonic()
        held = start(operator, tokens, on_progress)
        start_s = time.monotonic() - began
        cpu_idle = _busy(orchestrator.pid, lambda: time.sleep(_SETTLE_S))[0]
        on_progress("the client by itself")
        floor = ask_openly(orchestrator.url, healthz, rate_hz, min(seconds, _FLOOR_S), rng)
        on_progress(f"{rate_hz:g} requests a second for {seconds:g} s")
        mix = Mix(held, orchestrator.operator_token, rng)
        written = len(orchestrator.log)
        cpu, answers = _busy(orchestrator.pid, lambda: ask_openly(orchestrator.url, mix.next, rate_hz, seconds, rng))
        passes = passes_in(orchestrator.log[written:])
        time.sleep(_SETTLE_S)
        missing = lost(operator, [one.instance for one in held])
        memory = _peak_mb(orchestrator.pid)
    site, placer = passes.get("site-fleet"), passes.get("placer")
    if not site or not placer:
        raise BenchError("the reconciler made no pass")
    every, client = Spread.of([one.seconds for one in answers]), Spread.of([one.seconds for one in floor])
    return ApiRow(
        instances=instances,
        rate_hz=rate_hz,
        requests=len(answers),
        failed=sum(not one.good for one in answers),
        api_p50_ms=every.p50_ms,
        api_p99_ms=every.p99_ms,
        api_max_ms=every.max_ms,
        kinds=_by_kind(answers),
        client_p50_ms=client.p50_ms,
        client_p99_ms=client.p99_ms,
        pass_p50_ms=round(median(site), 2),
        pass_max_ms=max(site),
        placer_max_ms=max(placer),
        cpu_idle=round(cpu_idle, 3),
        cpu=round(cpu, 3),
        memory_mb=round(memory, 1),
        lost=missing,
        start_s=round(start_s, 1),
    )


def start(
    operator: Client, tokens: list[str], on_progress: Callable[[str], None], lease_s: float = _LEASE_S
) -> list[Held]:
    """An instance for each robot, named by its number.

    Raises:
        BenchError: Not all of them ran in time.
    """
    held = []
    for i, token in enumerate(tokens):
        asked = InstanceCreate(robot=f"robot-{i}", service=SERVICE, lease_s=lease_s)
        held.append(Held(f"robot-{i}", token, operator.create_instance(asked).id))
    deadline = time.monotonic() + _START_LIMIT_S
    while (up := sum(i.state is State.RUNNING for i in operator.instances())) < len(held):
        if time.monotonic() > deadline:
            raise BenchError(f"only {up} of {len(held)} instances ran within {_START_LIMIT_S:.0f} s")
        on_progress(f"{up} of {len(held)} instances run")
        time.sleep(0.5)
    return held


def _by_kind(answers: list[Answered]) -> dict[str, Spread]:
    kinds: dict[str, list[float]] = {}
    for one in answers:
        kinds.setdefault(one.kind, []).append(one.seconds)
    return {kind: Spread.of(seconds) for kind, seconds in sorted(kinds.items())}


def _busy(pid: int, act: Callable[[], T]) -> tuple[float, T]:
    """How many cores a process kept busy meanwhile."""
    before, began = cpu_seconds(pid), time.monotonic()
    result = act()
    return (cpu_seconds(pid) - before) / (time.monotonic() - began), result


def _peak_mb(pid: int) -> float:
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024


def lost(operator: Client, held: list[str]) -> int:
    """Instances that are not running, as the orchestrator says, in exactly one process, as the kernel says."""
    running = {one.id for one in operator.instances() if one.state is State.RUNNING}
    processes = Counter(instance_of(process) for process in psutil.process_iter())
    return sum(one not in running or processes[one] != 1 for one in held)


_PASS = re.compile(r"(\S+): pass of (\S+) ms$", re.MULTILINE)


def passes_in(log: str) -> dict[str, list[float]]:
    """How long the passes took that an orchestrator's log tells of, in milliseconds, by the loop's name."""
    passes: dict[str, list[float]] = {}
    for name, took in _PASS.findall(log):
        passes.setdefault(name, []).append(float(took))
    return passes
