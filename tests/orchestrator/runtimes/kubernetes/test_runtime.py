"""The Kubernetes runtime on a real cluster, beside what the contract's suite asks of every runtime."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Any

import docker_runs
import pytest
import yaml
from docker_runs import launch
from kubernetes_site import KubernetesSite

from skytether.orchestrator.runtimes.base import Observation, OvertakenError, Phase, RuntimeFailure, SiteSilentError
from skytether.orchestrator.runtimes.kubernetes import KubernetesRuntime
from skytether.orchestrator.runtimes.kubernetes.objects import pod

pytestmark = [pytest.mark.slow, pytest.mark.docker, pytest.mark.kubernetes]

until = partial(docker_runs.until, patience_s=90.0)
ENDS = {Phase.EXITED, Phase.RUNNING}


@pytest.fixture
def runtime(kubernetes_site: KubernetesSite, tmp_path: Path) -> Iterator[KubernetesRuntime]:
    with closing(kubernetes_site.open(tmp_path)) as opened:
        yield opened


def until_seen(runtime: KubernetesRuntime, what: Callable[[Observation], bool], instance: str = "i1") -> Observation:
    def there() -> Observation | None:
        runtime.tidy()
        seen = runtime.observe().get(instance)
        return seen if seen is not None and what(seen) else None

    found: Observation = until(there)
    return found


def test_an_image_that_is_nowhere_is_named_and_given_up(
    kubernetes_site: KubernetesSite, runtime: KubernetesRuntime
) -> None:
    runtime.start(launch(kubernetes_site, image="nobody-has-this:1"))
    told = until_seen(runtime, lambda seen: seen.phase is Phase.EXITED)
    assert told.unstarted
    assert told.detail == (
        "could not be started: its image 'nobody-has-this:1' is not on the node, and is never pulled"
    )


def test_what_no_node_has_room_for_says_what_is_lacking(
    kubernetes_site: KubernetesSite, runtime: KubernetesRuntime
) -> None:
    runtime.start(launch(kubernetes_site, needs={"cpu": 1000}))
    told = until_seen(runtime, lambda seen: bool(seen.detail))
    assert told.phase is Phase.STARTING
    assert re.search("no node takes it: .* Insufficient cpu", told.detail)
    runtime.stop("i1", force=False)
    assert until_seen(runtime, lambda seen: seen.phase is Phase.EXITED).detail == "was stopped before it ran"
    assert kubernetes_site.there("pods") == []


def test_out_of_memory_is_told_with_the_limit(kubernetes_site: KubernetesSite, runtime: KubernetesRuntime) -> None:
    runtime.start(launch(kubernetes_site, needs={"memory_mb": 32}, params={"hog_mb": 200}))
    told = until_seen(runtime, lambda seen: seen.phase is Phase.EXITED)
    assert told.detail.startswith("ran out of memory: its limit is 32 MiB (limits.memory_mb of its manifest)")


def test_a_pod_that_somebody_deletes_is_gone_and_begun_anew(
    kubernetes_site: KubernetesSite, runtime: KubernetesRuntime
) -> None:
    runtime.start(launch(kubernetes_site))
    before = until_seen(runtime, lambda seen: seen.phase is Phase.RUNNING)
    kubernetes_site.kubectl("-n", kubernetes_site.namespace, "delete", "pods", "--all", "--grace-period=1")
    until(lambda: "i1" not in runtime.observe())
    runtime.start(launch(kubernetes_site, attempt=2))
    after = until_seen(runtime, lambda seen: seen.phase is Phase.RUNNING)
    assert (after.attempt, after.port) == (2, before.port)


def test_a_quota_is_told_as_the_cluster_says_it(kubernetes_site: KubernetesSite, runtime: KubernetesRuntime) -> None:
    space = ("-n", kubernetes_site.namespace)
    kubernetes_site.kubectl(*space, "create", "quota", "none", "--hard=pods=0")
    try:
        until(lambda: kubernetes_site.there("resourcequotas")[0]["status"].get("hard"))
        with pytest.raises(RuntimeFailure, match=r"the cluster refuses it: .* exceeded quota: none"):
            runtime.start(launch(kubernetes_site))
    finally:
        kubernetes_site.kubectl(*space, "delete", "quota", "none")
    assert runtime.observe() == {}
    assert kubernetes_site.there("secrets", "skytether.io/owner") == []


def test_a_run_that_was_made_and_not_begun_is_removed_by_who_leads_next(
    kubernetes_site: KubernetesSite, runtime: KubernetesRuntime, tmp_path: Path
) -> None:
    body = pod(launch(kubernetes_site), runtime.options, kubernetes_site.owner, 20_123, {})
    with closing(kubernetes_site.open(tmp_path)) as late:
        late.lead(1)
        late.cluster.create(late.cluster.path("pods"), body)  # and killed then
        until(lambda: runtime.observe())
        runtime.lead(2)
        assert runtime.observe() == {}
        until(lambda: kubernetes_site.there("pods") == [])

        def begun() -> bool:
            with suppress(SiteSilentError):  # the one that is removed has its name, until it is gone
                runtime.start(launch(kubernetes_site))
                return True
            return False

        until(begun)
        until_seen(runtime, lambda seen: seen.phase is Phase.RUNNING)
        for act in (lambda: late.start(launch(kubernetes_site, "i2")), lambda: late.remove("i1"), lambda: late.lead(1)):
            with pytest.raises(OvertakenError):
                act()
        until(lambda: late.observe()["i1"].phase is Phase.RUNNING)


def test_no_run_is_begun_by_the_secret_of_an_earlier_pod_of_its_name(
    kubernetes_site: KubernetesSite, runtime: KubernetesRuntime, tmp_path: Path
) -> None:
    lacking = launch(kubernetes_site, needs={"cpu": 1000})  # no node takes it: it waits
    runtime.lead(1)
    runtime.start(lacking)
    (before,) = kubernetes_site.there("secrets", "skytether.io/instance=i1")
    runtime.stop("i1", force=False)
    assert kubernetes_site.there("secrets", "skytether.io/instance=i1") == []  # and not only when it is collected
    earlier = {"metadata": {"name": before["metadata"]["name"]}, "kind": "Secret", "apiVersion": "v1"}
    runtime.cluster.create(runtime.cluster.path("secrets"), earlier)
    body = pod(lacking, runtime.options, kubernetes_site.owner, 20_123, {})
    runtime.cluster.create(runtime.cluster.path("pods"), body)  # and killed then
    with closing(kubernetes_site.open(tmp_path)) as late:
        late.lead(2)
        assert late.observe() == {}
        until(lambda: kubernetes_site.there("pods", f"skytether.io/owner={kubernetes_site.owner}") == [])


def test_a_port_that_another_site_has_is_not_waited_for(kubernetes_site: KubernetesSite, tmp_path: Path) -> None:
    folder = tmp_path / "other"
    folder.mkdir()
    few = {"ports": [20_500, 20_501]}
    with (
        closing(kubernetes_site.open(folder, **few, owner="another-site")) as other,
        closing(kubernetes_site.open(tmp_path, **few)) as runtime,
    ):
        other.start(launch(kubernetes_site))
        theirs = until_seen(other, lambda seen: seen.phase is Phase.RUNNING).port
        for instance in ("i1", "i2"):
            runtime.start(launch(kubernetes_site, instance))
        until(lambda: runtime.tidy() or {seen.phase for seen in runtime.observe().values()} == ENDS)
        one, other_one = sorted(runtime.observe().values(), key=lambda seen: seen.phase)
        assert {theirs, other_one.port} == {20_500, 20_501}
        assert one.unstarted
        assert one.detail == ("could not be started: every UDP port from 20500 to 20501 is taken (option 'ports')")


def test_pods_stay_closed_off_whatever_becomes_of_the_policy(
    kubernetes_site: KubernetesSite, runtime: KubernetesRuntime
) -> None:
    runtime.start(launch(kubernetes_site))
    (before,) = kubernetes_site.there("networkpolicies", f"skytether.io/owner={kubernetes_site.owner}")
    name, space = before["metadata"]["name"], ("-n", kubernetes_site.namespace)
    asked = runtime.cluster.path("networkpolicies", name, group="networking.k8s.io/v1")
    written_by = runtime.cluster.get(asked)["metadata"]["managedFields"]
    assert [(one["manager"], one["operation"]) for one in written_by] == [("skytether", "Apply")]

    def restored() -> bool:
        runtime.tidy()
        there = kubernetes_site.there("networkpolicies", f"skytether.io/owner={kubernetes_site.owner}")
        return [one["spec"] for one in there] == [before["spec"]]

    kubernetes_site.kubectl(*space, "delete", "networkpolicy", name)
    until(restored)
    opened = '{"spec": {"egress": [{}]}}'
    kubernetes_site.kubectl(*space, "patch", "networkpolicy", name, "--type=merge", "-p", opened)
    until(restored)


def test_a_port_of_the_nodes_that_the_cluster_chooses_is_kept_over_runs(
    kubernetes_site: KubernetesSite, tmp_path: Path
) -> None:
    with closing(kubernetes_site.open(tmp_path, reach="nodeport")) as runtime:
        runtime.start(launch(kubernetes_site))
        first = until_seen(runtime, lambda seen: seen.phase is Phase.RUNNING)
        assert kubernetes_site.there("services")[0]["spec"]["ports"][0]["nodePort"] == first.port
        runtime.start(launch(kubernetes_site, attempt=2))
        second = until_seen(runtime, lambda seen: seen.phase is Phase.RUNNING and seen.attempt == 2)
        assert second.port == first.port
        runtime.remove("i1")
        assert kubernetes_site.there("services") == []


def test_the_rights_of_the_docs_are_enough_and_one_that_lacks_is_named(
    kubernetes_site: KubernetesSite, tmp_path: Path
) -> None:
    role = kubernetes_site.role("skytether")
    kubernetes_site.give_account(role)
    own = {"kubeconfig": kubernetes_site.kubeconfig_of("skytether", tmp_path), "cpu": 2, "memory_mb": 1024}
    with closing(kubernetes_site.open(tmp_path, **own)) as runtime:
        assert runtime.capacity().cpu == 2
        runtime.lead(1)
        runtime.start(launch(kubernetes_site, params={"report": "at work"}))
        told = until_seen(runtime, lambda seen: bool(seen.reports) and seen.cpu_s is not None)
        assert told.cpu_s is not None
        assert 0 < told.cpu_s < 60
        assert told.memory_bytes is not None
        assert told.memory_bytes > 1 << 20
        assert told.received_bytes
        assert told.sent_bytes
        assert "toy service" in runtime.logs("i1", 10)
        runtime.stop("i1", force=False)
        until_seen(runtime, lambda seen: seen.phase is Phase.EXITED)
        runtime.remove("i1")
    wanted = r'cannot list resource "nodes".*give the site.s account that right'
    with (
        closing(kubernetes_site.open(tmp_path, **{**own, "cpu": None})) as runtime,
        pytest.raises(RuntimeFailure, match=wanted),
    ):
        runtime.capacity()
    role["rules"][0]["verbs"].remove("create")
    kubernetes_site.kubectl("apply", "-f", "-", given=yaml.safe_dump(role))
    with (
        closing(kubernetes_site.open(tmp_path, **own)) as runtime,
        pytest.raises(RuntimeFailure, match=r'lacks a right: .* cannot create resource "pods"'),
    ):
        until(lambda: runtime.start(launch(kubernetes_site, "i2")))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"kubeconfig": "/nowhere/config"}, "there is no file /nowhere/config"),
        ({"context": "nobody"}, "nobody"),
        ({"kubeconfig": None}, "the orchestrator runs in no cluster: name a file in the option 'kubeconfig'"),
    ],
)
def test_what_cannot_be_reached_is_refused_when_it_is_opened(
    kubernetes_site: KubernetesSite, tmp_path: Path, given: dict[str, Any], words: str
) -> None:
    with pytest.raises(RuntimeFailure, match=re.escape(words)):
        kubernetes_site.open(tmp_path, **given)


def test_a_namespace_that_is_not_there_is_named(kubernetes_site: KubernetesSite, tmp_path: Path) -> None:
    with (
        closing(kubernetes_site.open(tmp_path, namespace="nobodys")) as runtime,
        pytest.raises(RuntimeFailure, match=r'namespaces "nobodys" not found'),
    ):
        runtime.start(launch(kubernetes_site))


def test_an_api_server_that_is_silent_says_nothing_of_what_runs(
    kubernetes_site: KubernetesSite, tmp_path: Path
) -> None:
    away = tmp_path / "config"
    text = Path(kubernetes_site.kubeconfig).read_text()
    away.write_text(re.sub(r"server: .*", "server: https://127.0.0.1:1", text))
    begun = time.monotonic()
    with closing(kubernetes_site.open(tmp_path, kubeconfig=str(away))) as runtime:
        with pytest.raises(RuntimeFailure, match=r"the API server https://127\.0\.0\.1:1 does not answer"):
            runtime.observe()
        assert time.monotonic() - begun < 10
