"""What pods have is changed while they run, by an API server that is made up, and refused by one that is too old."""

from __future__ import annotations

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
from skytether.orchestrator.runtimes.base import Launch, OvertakenError, Phase, RuntimeFailure, SiteSilentError
from skytether.orchestrator.runtimes.kubernetes import KubernetesRuntime
from skytether.orchestrator.runtimes.kubernetes.options import KubernetesOptions
from skytether.orchestrator.runtimes.kubernetes.resize import (
    Resources,
    differ,
    in_class_of,
    pull_progress,
    pull_resources,
    resources_of,
)

Open = Callable[..., KubernetesRuntime]
SPEC = ServiceSpec.model_validate({"image": "registry.invalid/toy:1", "needs": {"cpu": 0.5, "memory_mb": 128}})


@pytest.fixture
def cluster() -> Iterator[UnrulyCluster]:
    made = UnrulyCluster(17, pace=10)
    with made.running():
        yield made


@pytest.fixture
def open_site(cluster: UnrulyCluster, tmp_path: Path) -> Iterator[Open]:
    opened: list[KubernetesRuntime] = []

    def make() -> KubernetesRuntime:
        told = {"kubeconfig": str(kubeconfig_of(tmp_path, cluster.address)), "owner": "o1", "timeout_s": 2.0}
        opened.append(KubernetesRuntime("ward", tmp_path, KubernetesOptions.model_validate(told)))
        return opened[-1]

    yield make
    for one in opened:
        one.close()


def run(site: KubernetesRuntime, spec: ServiceSpec = SPEC, epoch: int = 7) -> None:
    site.lead(epoch)
    site.capacity()
    grant = Grant(instance="i1", service="toy", robot="r1", session_id="s1", session_key="a2V5", topics=())
    site.start(Launch(1, spec, grant))
    until(lambda: site.observe()["i1"].phase is Phase.RUNNING)


def has(cluster: UnrulyCluster) -> Any:
    (pod,) = cluster.objects("pods")
    return pull_resources(pod["status"]["containerStatuses"][0]["resources"])


def patches(cluster: UnrulyCluster) -> int:
    return sum(what == "PATCH pods/resize" for _, what in list(cluster.calls))


def test_a_pod_is_given_more_and_less_in_place(cluster: UnrulyCluster, open_site: Open) -> None:
    site = open_site()
    run(site)
    (pod,) = cluster.objects("pods")
    for cpu, memory in ((2, 512), (0.25, 128)):
        wanted = SPEC.sized(cpu, memory)
        until(lambda: site.resize("i1", 1, wanted))  # noqa: B023
        assert in_class_of(resources_of(wanted), resources_of(SPEC)) == has(cluster)
    assert patches(cluster) == 2
    seen = site.observe()["i1"]
    assert (seen.phase, seen.attempt) == (Phase.RUNNING, 1)
    (same,) = cluster.objects("pods")
    assert same["metadata"]["uid"] == pod["metadata"]["uid"]
    assert not site.resize("i1", 2, SPEC)
    assert not site.resize("nobody", 1, SPEC)


def test_an_old_cluster_says_that_it_cannot_and_is_asked_for_nothing(cluster: UnrulyCluster, open_site: Open) -> None:
    cluster.minor = 20
    site = open_site()
    run(site)
    assert "Kubernetes 1.33 can" in site.keeps_size(SPEC)
    with pytest.raises(RuntimeFailure, match=r"Kubernetes 1\.33 can"):
        site.resize("i1", 1, SPEC.sized(2, 512))
    assert patches(cluster) == 0


def test_it_is_found_out_and_not_guessed_by_the_version(cluster: UnrulyCluster, open_site: Open) -> None:
    site = open_site()
    assert site.keeps_size(SPEC), "nothing is known yet"
    site.capacity()
    assert site.keeps_size(SPEC) == ""
    assert [what for _, what in cluster.calls if "apiresources" in what] == ["GET apiresources"]


def test_a_node_without_room_says_so_and_what_was_is_given_back(cluster: UnrulyCluster, open_site: Open) -> None:
    site = open_site()
    run(site)
    cluster.no_room = "Infeasible"
    wanted = SPEC.sized(50, 512)
    failures: list[str] = []

    def refuses() -> bool:
        try:
            assert not site.resize("i1", 1, wanted)
        except RuntimeFailure as error:
            failures.append(str(error))
        return bool(failures)

    until(refuses)
    assert failures == ["node has no room: 50000m wanted"] or "no room" in failures[0]
    until(lambda: site.resize("i1", 1, SPEC))
    assert has(cluster) == resources_of(SPEC)


def test_a_node_that_is_full_for_now_is_waited_for(cluster: UnrulyCluster, open_site: Open) -> None:
    site = open_site()
    run(site)
    cluster.no_room = "Deferred"
    wanted = SPEC.sized(2, 512)
    deadline = time.monotonic() + 1.5
    while time.monotonic() < deadline:
        assert not site.resize("i1", 1, wanted)
        time.sleep(0.05)
    assert patches(cluster) == 1, "it is not asked again and again"


def test_an_answer_that_is_lost_is_made_good_without_another_change(cluster: UnrulyCluster, open_site: Open) -> None:
    site = open_site()
    run(site)
    cluster.regime = Regime(cut_after=1.0, only="PATCH pods/resize")
    wanted = SPEC.sized(2, 512)
    with pytest.raises(SiteSilentError):
        site.resize("i1", 1, wanted)
    cluster.regime = CALM

    def done() -> bool:
        try:
            return site.resize("i1", 1, wanted)
        except SiteSilentError:
            return False

    until(done)
    assert patches(cluster) == 1
    assert has(cluster) == in_class_of(resources_of(wanted), resources_of(SPEC))


def test_a_leader_that_was_followed_changes_nothing(cluster: UnrulyCluster, open_site: Open) -> None:
    first, second = open_site(), open_site()
    run(first)
    second.lead(8)
    with pytest.raises(OvertakenError):
        first.resize("i1", 1, SPEC.sized(2, 512))
    assert patches(cluster) == 0


def test_a_pod_stays_in_its_class(cluster: UnrulyCluster, open_site: Open) -> None:
    site = open_site()
    whole = SPEC.sized(1, 128)
    assert resources_of(whole).guaranteed
    run(site, whole)
    wanted = SPEC.sized(0.5, 128)
    until(lambda: site.resize("i1", 1, wanted))
    assert has(cluster) == Resources(500, 500, 128, 128)


@pytest.mark.parametrize(
    ("wanted", "present", "fitted"),
    [
        (Resources(2000, 2000, 64, 64), Resources(500, 1000, 64, 64), Resources(1999, 2000, 64, 64)),
        (Resources(500, 1000, 64, 64), Resources(1000, 1000, 64, 64), Resources(500, 500, 64, 64)),
        (Resources(1, 1, 64, 64), Resources(1, 2, 64, 64), Resources(1, 2, 64, 64)),
        (Resources(500, 1000, 64, 128), Resources(250, 1000, 64, 128), Resources(500, 1000, 64, 128)),
    ],
)
def test_in_class_of(wanted: Resources, present: Resources, fitted: Resources) -> None:
    assert in_class_of(wanted, present) == fitted
    assert fitted.guaranteed == present.guaranteed


def test_what_nodes_say_is_understood() -> None:
    def condition(kind: str, **more: str) -> dict[str, Any]:
        return {"conditions": [{"type": kind, "status": "True", **more}]}

    assert pull_progress({}) == (False, "")
    assert pull_progress(condition("PodResizeInProgress")) == (True, "")
    assert pull_progress(condition("PodResizePending", reason="Deferred", message="full")) == (True, "")
    assert pull_progress(condition("PodResizePending", reason="Infeasible", message="too much")) == (True, "too much")
    assert pull_progress({"resize": "Infeasible"}) == (False, "its node has no room for that")
    assert pull_progress({"resize": "InProgress"}) == (True, "")
    document = {"requests": {"cpu": "1500m", "memory": "1Gi"}, "limits": {"cpu": "2", "memory": "1073741824"}}
    assert pull_resources(document) == Resources(1500, 2000, 1024, 1024)
    assert pull_resources({"requests": {"cpu": "1"}}) is None
    assert pull_resources({}) is None
    assert not differ(Resources(2, 10, 64, 64), Resources(1, 5, 64, 64)), "the kernel rounds"
    assert differ(Resources(500, 1000, 64, 64), Resources(500, 1000, 64, 128))
    assert not differ(None, Resources(1, 1, 1, 1))
