"""A Kubernetes site whose API server, with its nodes, is made up, over real sockets."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from orchestrator_program import until
from unruly_cluster import UnrulyCluster, kubeconfig_of

from skytether.api.grant import Grant
from skytether.api.manifest import ServiceSpec
from skytether.orchestrator.runtimes.base import Launch, Phase
from skytether.orchestrator.runtimes.kubernetes import KubernetesRuntime
from skytether.orchestrator.runtimes.kubernetes.options import KubernetesOptions

Open = Callable[..., KubernetesRuntime]


@pytest.fixture
def cluster() -> Iterator[UnrulyCluster]:
    made = UnrulyCluster(16)
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
