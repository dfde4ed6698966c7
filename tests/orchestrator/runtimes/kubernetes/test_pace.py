"""How fast an API server is asked: in made-up time, and by real sockets where it says that it has too much to do."""

from __future__ import annotations

import threading
import time
from collections import deque
from pathlib import Path

import pytest

from skytether.lab.bench.scale import calls, kubeconfig_of, made_up_cluster
from skytether.orchestrator.runtimes.kubernetes.cluster import Cluster, ClusterGoneError
from skytether.orchestrator.runtimes.kubernetes.options import KubernetesOptions
from skytether.orchestrator.runtimes.kubernetes.pace import Pace


class Time:
    now = 100.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def test_a_burst_goes_at_once_and_the_rest_evenly() -> None:
    clock = Time()
    pace = Pace(10.0, 5, clock, clock.sleep)
    times = []
    for _ in range(25):
        pace.wait()
        times.append(clock.now - 100.0)
    assert times[:5] == [0.0] * 5
    assert times[5:8] == pytest.approx([0.1, 0.2, 0.3])
    assert times[-1] == pytest.approx(2.0)


def test_no_second_has_more_than_rate_and_burst_together() -> None:
    clock = Time()
    pace = Pace(10.0, 5, clock, clock.sleep)
    last: deque[float] = deque()
    for n in range(200):
        if n % 17 == 0:
            clock.now += 0.7  # a rest, after which there is a burst again
        pace.wait()
        last.append(clock.now)
        while last[0] <= clock.now - 1.0:
            last.popleft()
        assert len(last) <= 15


def test_all_are_held_for_as_long_as_it_was_said() -> None:
    clock = Time()
    pace = Pace(10.0, 5, clock, clock.sleep)
    pace.wait()
    pace.hold(3.0)
    pace.wait()
    assert clock.now == pytest.approx(103.0)
    pace.wait()
    assert clock.now == pytest.approx(103.0), "what was held goes as a burst may"


def options(folder: Path, address: str, timeout_s: float) -> KubernetesOptions:
    return KubernetesOptions(kubeconfig=str(kubeconfig_of(folder, address)), timeout_s=timeout_s)


@pytest.mark.slow
def test_who_is_refused_for_coming_too_often_waits_and_comes_again(tmp_path: Path) -> None:
    with made_up_cluster(0.1, 20) as address:
        cluster = Cluster(options(tmp_path, address, 30.0))
        path = cluster.path("secrets")

        def create(first: int) -> None:
            for n in range(first, first + 15):
                cluster.create(path, {"metadata": {"name": f"s{n}", "labels": {}}})

        threads = [threading.Thread(target=create, args=(first,)) for first in (0, 100, 200)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
        told = calls(address)
        assert told["calls"]["POST secrets"] == 45, "each once, and none is missing"
        assert told["refused"] > 0, "else nothing was tried"
        assert told["refused"] < 45, "who is refused waits"
        cluster.close()


@pytest.mark.slow
def test_who_is_refused_for_too_long_says_that_the_api_server_is_busy(tmp_path: Path) -> None:
    with made_up_cluster(0.1, 0) as address:
        cluster = Cluster(options(tmp_path, address, 1.5))
        began = time.monotonic()
        with pytest.raises(ClusterGoneError, match="busy or unwell: too many requests"):
            cluster.get(cluster.path("pods"))
        assert time.monotonic() - began < 10
        cluster.close()
