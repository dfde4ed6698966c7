"""What pods use, as a metrics API and services say it: a made-up cluster."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from typing import Any

import pytest

from skytether.api.usage import NO_USAGE, Usage
from skytether.orchestrator.runtimes.base import Phase
from skytether.orchestrator.runtimes.kubernetes.cluster import ClusterGoneError, RefusedError
from skytether.orchestrator.runtimes.kubernetes.options import KubernetesOptions
from skytether.orchestrator.runtimes.kubernetes.seen import PodState, observation
from skytether.orchestrator.runtimes.kubernetes.usage import Meter, bounded, pull_samples

POD = PodState("p1", "u1", "7", "i1", 1, "64Mi", "500m", made_at=1000.0, phase="Running", running=True, started=True)


def listed(at: str, cpu: str = "250m", memory: str = "20Mi", window: str = "15s") -> dict[str, Any]:
    """As metrics-server answers."""
    item = {"metadata": {"name": "p1"}, "timestamp": at, "window": window}
    return {"items": [{**item, "containers": [{"name": "service", "usage": {"cpu": cpu, "memory": memory}}]}]}


class MadeUpCluster:
    def __init__(self) -> None:
        self.answer: Any = listed("2026-11-25T07:00:00Z")
        self.asked: list[str] = []

    def path(self, kind: str, *, group: str) -> str:
        return f"/apis/{group}/namespaces/skytether/{kind}"

    def get(self, path: str, **query: str) -> Any:
        self.asked.append(f"{path}?{query['labelSelector']}")
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


class Bench:
    def __init__(self) -> None:
        self.now = 0.0
        self.told = NO_USAGE
        self.cluster: Any = MadeUpCluster()
        self.meter = Meter(self.cluster, "o1", lambda _: self.told, lambda: self.now, lambda: 1100.0)

    def look(self, after_s: float = 15.0) -> Usage:
        self.now += after_s
        self.meter.begin([POD])
        for thread in threading.enumerate():
            if thread.name == "kubernetes-metrics":
                thread.join(10.0)
        return self.meter.of(POD)


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_the_metrics_api_is_asked_once_for_all_pods_and_its_means_are_summed_up(bench: Bench) -> None:
    bench.told = Usage(10.0, 1, 2000, 3000)
    assert bench.look() == Usage(10.0, 20 << 20, 2000, 3000)  # until then the service alone can tell
    bench.cluster.answer = listed("2026-11-25T07:00:20Z", cpu="500m", memory="30Mi")
    assert bench.look() == Usage(20.0, 30 << 20, 2000, 3000)
    assert bench.look() == Usage(20.0, 30 << 20, 2000, 3000)  # the same sample again
    assert bench.look(after_s=5.0).cpu_s == 20.0
    assert bench.cluster.asked == ["/apis/metrics.k8s.io/v1beta1/namespaces/skytether/pods?skytether.io/owner=o1"] * 3


def test_without_the_api_what_the_service_says_counts_and_it_is_seldom_asked_for(bench: Bench) -> None:
    bench.told = Usage(3.0, 5000, 7, 8)
    for status in (404, 403):
        bench.cluster.answer = RefusedError("no", status, "")
        bench.cluster.asked.clear()
        bench.now += 300.0
        for _ in range(10):
            assert bench.look() == bench.told
        assert len(bench.cluster.asked) == 1


def test_an_api_that_is_silent_or_odd_takes_nothing_back(bench: Bench) -> None:
    known = bench.look()
    for answer in (ClusterGoneError("away"), {"items": [{"containers": [{}]}]}, listed("yesterday")):
        bench.cluster.answer = answer
        assert bench.look() == known


def test_what_has_ended_keeps_what_it_used_until_it_is_removed(bench: Bench) -> None:
    used = bench.look()
    ended = replace(POD, running=False)
    assert bench.meter.of(ended) == used
    bench.meter.begin([])
    assert bench.meter.of(ended) == NO_USAGE


def test_a_service_cannot_have_used_more_than_its_container_may() -> None:
    lies = Usage(1e9, 1 << 40, 1, 2)
    assert bounded(lies, POD, 1100.0) == Usage(0.5 * 160, 64 << 20, 1, 2)
    assert bounded(lies, replace(POD, cpu_limit="", memory_limit=""), 1100.0) == lies


def test_durations_and_samples_are_read_as_the_api_writes_them() -> None:
    (sample,) = pull_samples(listed("2026-11-25T07:00:00Z", cpu="12345678n", memory="1024Ki", window="1m2.5s")).values()
    assert (sample.window_s, sample.cores, sample.memory_bytes) == (62.5, pytest.approx(0.012345678), 1 << 20)
    assert pull_samples({}) == {}
    begun = time.gmtime(sample.at)
    assert (begun.tm_hour, begun.tm_min) == (7, 0)


def test_out_of_memory_says_limit_and_use() -> None:
    ended = replace(POD, running=False, phase="Failed", ended_how="OOMKilled", exit_code=137)
    told = observation(ended, KubernetesOptions(), usage=Usage(memory_bytes=50 << 20))
    assert told.phase is Phase.EXITED
    assert told.detail == (
        "ran out of memory: its limit is 64 MiB (limits.memory_mb of its manifest), "
        "and it used 50 MiB when that was last looked at"
    )
