"""A Kubernetes site whose API server, with its nodes, is made up, over real sockets."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from orchestrator_program import until
from unruly_cluster import CALM, Regime, UnrulyCluster

from skytether.api.grant import Grant
from skytether.api.manifest import ServiceSpec
from skytether.lab.bench.scale import kubeconfig_of
from skytether.orchestrator.runtimes.base import Launch, OvertakenError, Phase, SiteSilentError
from skytether.orchestrator.runtimes.kubernetes import KubernetesRuntime
from skytether.orchestrator.runtimes.kubernetes.options import KubernetesOptions

Open = Callable[..., KubernetesRuntime]


@pytest.fixture
def cluster() -> Iterator[UnrulyCluster]:
    made = UnrulyCluster(16, pace=10)
    with made.running():
        yield made


@pytest.fixture
def open_site(cluster: UnrulyCluster, tmp_path: Path) -> Iterator[Open]:
    opened: list[KubernetesRuntime] = []

    def make(**options: Any) -> KubernetesRuntime:
        told = {"kubeconfig": str(kubeconfig_of(tmp_path, cluster.address)), "owner": "o1", "timeout_s": 2.0, **options}
        opened.append(KubernetesRuntime("ward", tmp_path, KubernetesOptions.model_validate(told)))
        return opened[-1]

    yield make
    for one in opened:
        one.close()


def launch(instance: str, attempt: int = 1) -> Launch:
    spec = ServiceSpec.model_validate({"image": "registry.invalid/toy:1"})
    grant = Grant(instance=instance, service="toy", robot="r1", session_id="s1", session_key="a2V5", topics=())
    return Launch(attempt, spec, grant)


def run(site: KubernetesRuntime, instance: str, attempt: int = 1) -> None:
    site.start(launch(instance, attempt))
    until(lambda: site.observe()[instance].phase is Phase.RUNNING)


def test_while_an_instance_ends_the_api_server_is_asked_once(cluster: UnrulyCluster, open_site: Open) -> None:
    site = open_site()
    site.lead(7)
    run(site, "i1")
    before = len(cluster.calls)
    while site.observe()["i1"].phase is not Phase.EXITED:
        site.stop("i1", force=True)
        time.sleep(0.01)
    site.stop("i1", force=True)
    assert [what for _, what in list(cluster.calls)[before:]] == ["GET configmaps", "PATCH pods"]


def test_a_pod_of_the_same_run_that_is_not_gone_yet_is_waited_for_and_not_taken_for_begun(
    cluster: UnrulyCluster, open_site: Open
) -> None:
    site = open_site()
    site.lead(7)
    site.start(launch("i1"))
    until(lambda: site.observe()["i1"].phase is Phase.RUNNING)
    pod = cluster.objects("pods")[0]["metadata"]
    cluster.do(lambda: cluster.hold(pod["uid"]))
    site.remove("i1")
    assert "i1" not in site.observe()
    with pytest.raises(SiteSilentError, match="not gone yet"):
        site.start(launch("i1"))
    cluster.do(lambda: cluster.let_go(pod["uid"]))

    def begun() -> bool:
        with contextlib.suppress(SiteSilentError):
            site.start(launch("i1"))
            return True
        return False

    until(begun)
    until(lambda: site.observe()["i1"].phase is Phase.RUNNING)
    assert cluster.doubles == []


def test_a_pod_that_was_made_while_its_answer_was_lost_does_not_cost_its_robot_half_a_minute(
    cluster: UnrulyCluster, open_site: Open
) -> None:
    site = open_site()
    site.lead(7)
    cluster.regime = Regime(cut_after=1.0, only="POST pods")
    with pytest.raises(SiteSilentError):
        site.start(launch("i1"))
    cluster.regime = CALM
    until(lambda: "i1" in site.observe())

    def runs() -> bool:  # as the orchestrator goes about it
        time.sleep(0.05)
        site.tidy()
        with contextlib.suppress(SiteSilentError):
            if "i1" not in site.observe():
                site.start(launch("i1"))
        return "i1" in site.observe() and site.observe()["i1"].phase is Phase.RUNNING

    until(runs, patience=10)
    assert cluster.doubles == []


def test_who_was_overtaken_in_a_start_begins_nothing_though_what_tells_of_it_was_removed(
    cluster: UnrulyCluster, open_site: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of a leader that is frozen just before it makes a pod."""
    before, after = open_site(), open_site()
    before.lead(7)
    make = before.cluster.create

    def frozen(path: str, body: Any) -> Any:
        if body["kind"] == "Pod":
            after.lead(8)
            run(after, "i1", attempt=2)
            cluster.remove_one("configmaps")
        return make(path, body)

    monkeypatch.setattr(before.cluster, "create", frozen)
    with pytest.raises(SiteSilentError, match="somebody has removed the ConfigMap skytether-o1-leader"):
        before.start(launch("i1"))
    assert cluster.doubles == []
    after.tidy()
    run(after, "i2")
    with pytest.raises(OvertakenError):
        before.start(launch("i3"))
