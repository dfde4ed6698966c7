"""An orchestrator with many instances: its answers, its reconcile passes, its memory.

Everything is real: the orchestrator as a program, each instance a sleeping process, requests over HTTP. Requests are
due at fixed times, whether or not those before were answered, and are timed from when they were due.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass

import httpx
import numpy as np
import psutil

from skytether.api.client import Client
from skytether.api.rest import InstanceCreate, SiteCreate, State
from skytether.lab.embedded import EmbeddedOrchestrator

from .pair import BenchError

SERVICE = "sleeper"
_MANIFEST = {
    "apiVersion": "skytether.io/v1",
    "kind": "Service",
    "metadata": {"name": SERVICE},
    "spec": {"entrypoint": "skytether.testing.toy_service", "needs": {"cpu": 0.001, "memory_mb": 1}},
}
_START_LIMIT_S = 600.0
_LEASE_S = 3600.0
_THREADS = 32
"""Requests under way at most; one that waits for a thread is late, and counts as such."""


@dataclass(frozen=True, slots=True)
class ApiRow:
    """One line of the table.

    Attributes:
        instances: That run meanwhile.
        rate_hz: Requests a second: renewals, looks at one, creations and ends.
        requests: Made.
        failed: Of these, those without a good answer.
        api_p50_ms: Median time from due to answered.
        api_p99_ms: 99th percentile.
        pass_p50_ms: Median reconcile pass over the site.
        pass_max_ms: Bound of the histogram's bucket that holds the slowest.
        memory_mb: The orchestrator's resident memory.
        lost: Instances that do not run any more, or were never started, or run twice.
        start_s: From the first request to the last instance running.
    """

    instances: int
    rate_hz: float
    requests: int
    failed: int
    api_p50_ms: float
    api_p99_ms: float
    pass_p50_ms: float
    pass_max_ms: float
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
    with EmbeddedOrchestrator() as orchestrator, Client(orchestrator.url, orchestrator.operator_token) as operator:
        operator.put_service(SERVICE, _MANIFEST)
        operator.create_site(SiteCreate(name="fleet", tier="edge", runtime="process", options={"cpu": instances}))
        operator.delete_site("local")
        began = time.monotonic()
        held = _start(operator, instances, on_progress)
        start_s = time.monotonic() - began
        before = _passes(operator)
        on_progress(f"{rate_hz:g} requests a second for {seconds:g} s")
        took, failed = _ask(orchestrator, held, rate_hz, seconds)
        after = _passes(operator)
        memory = max(_memory(orchestrator.pid), 0)
        alive = [i.id for i in operator.instances() if i.state is State.RUNNING]
        lost = len(set(held) ^ (set(alive) & set(held))) + len(alive) - len(set(alive))
    p50, p99 = np.percentile(took, [50, 99], method="inverted_cdf")
    pass_p50, pass_max = _spread(before, after)
    return ApiRow(
        instances,
        rate_hz,
        len(took),
        failed,
        round(float(p50) * 1e3, 2),
        round(float(p99) * 1e3, 2),
        pass_p50 * 1e3,
        pass_max * 1e3,
        round(memory / 2**20, 1),
        lost,
        round(start_s, 1),
    )


def _start(operator: Client, n: int, on_progress: Callable[[str], None]) -> list[str]:
    held = [
        operator.create_instance(InstanceCreate(robot=f"robot-{i}", service=SERVICE, lease_s=_LEASE_S)).id
        for i in range(n)
    ]
    deadline = time.monotonic() + _START_LIMIT_S
    while (up := sum(i.state is State.RUNNING for i in operator.instances())) < n:
        if time.monotonic() > deadline:
            raise BenchError(f"only {up} of {n} instances ran within {_START_LIMIT_S:.0f} s")
        on_progress(f"{up} of {n} instances run")
        time.sleep(0.5)
    return held


def _ask(orchestrator: EmbeddedOrchestrator, held: list[str], rate: float, seconds: float) -> tuple[list[float], int]:
    """Renewals mostly, as robots do; looks; and now and then a new instance, which is let go at once."""
    took: list[float] = []
    failures: list[int] = []
    lock = threading.Lock()
    headers = {"Authorization": f"Bearer {orchestrator.operator_token}"}
    limits = httpx.Limits(max_connections=_THREADS, max_keepalive_connections=_THREADS)
    http = httpx.Client(
        base_url=f"{orchestrator.url}/api/v1", headers=headers, limits=limits, timeout=30, trust_env=False
    )

    def one(number: int, due: float) -> None:
        instance = held[number % len(held)]
        if number % 50 == 49:
            body = {"robot": "passer-by", "service": SERVICE, "lease_s": 60}
            answer = http.post("/instances", json=body)
            if answer.is_success:
                http.delete(f"/instances/{answer.json()['id']}")
        elif number % 5 == 4:
            answer = http.get(f"/instances/{instance}")
        else:
            answer = http.post(f"/instances/{instance}/renew", json={"report": {"rtt_s": 0.01}})
        with lock:
            took.append(time.monotonic() - due)
            failures.append(not answer.is_success)

    with http, ThreadPoolExecutor(_THREADS) as pool:
        start = time.monotonic()
        for number in range(round(rate * seconds)):
            due = start + number / rate
            time.sleep(max(0.0, due - time.monotonic()))
            pool.submit(one, number, due)
    if not took:
        raise BenchError("no request was answered")
    return took, sum(failures)


def _memory(pid: int) -> int:
    return int(psutil.Process(pid).memory_info().rss)


_BUCKET = re.compile(r'^skytether_reconcile_pass_seconds_bucket\{le="([^"]+)",site="fleet"\} (\S+)$', re.MULTILINE)


def _passes(operator: Client) -> dict[float, float]:
    """Passes so far that took at most so many seconds."""
    return {float(bound): float(count) for bound, count in _BUCKET.findall(operator.metrics())}


def _spread(before: dict[float, float], after: dict[float, float]) -> tuple[float, float]:
    """Bounds of the buckets that hold the median and the slowest of the passes in between."""
    counts = {bound: count - before.get(bound, 0.0) for bound, count in sorted(after.items())}
    total = max(counts.values(), default=0.0)
    if not total:
        raise BenchError("the reconciler made no pass")
    median = next(bound for bound, count in counts.items() if count >= total / 2)
    return median, next(bound for bound, count in counts.items() if count >= total)
