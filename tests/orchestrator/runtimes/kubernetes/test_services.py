"""The Services of a Kubernetes site, with an API server that is a dictionary and a clock that a test turns."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import pytest

from skytether.orchestrator.runtimes.base import OvertakenError, SiteSilentError
from skytether.orchestrator.runtimes.kubernetes.cluster import Cluster
from skytether.orchestrator.runtimes.kubernetes.objects import balanced_address, service
from skytether.orchestrator.runtimes.kubernetes.options import KubernetesOptions
from skytether.orchestrator.runtimes.kubernetes.services import Services


def options(**given: Any) -> KubernetesOptions:
    return KubernetesOptions.model_validate({"kubeconfig": "/k", "reach": "loadbalancer", **given})


class DictCluster:
    """Keeps Services, and counts how often they are listed."""

    namespace = "skytether"

    def __init__(self) -> None:
        self.there: dict[str, dict[str, Any]] = {}
        self.listed = 0

    def path(self, kind: str, name: str = "") -> str:
        return f"{kind}/{name}"

    def apply(self, path: str, body: Mapping[str, Any]) -> Any:
        return self.there.setdefault(path, dict(body))

    def labelled(self, kind: str, selector: str) -> list[Any]:
        assert (kind, selector) == ("services", "skytether.io/owner=o1")
        self.listed += 1
        return list(self.there.values())

    def delete(self, path: str) -> None:
        self.there.pop(path, None)

    def give(self, instance: str, **ingress: str) -> None:
        """What a cloud does."""
        self.there[f"services/skytether-o1-{instance}"]["status"] = {"loadBalancer": {"ingress": [ingress]}}


class Scene:
    def __init__(self, **given: Any) -> None:
        self.cluster = DictCluster()
        self.now = 100.0
        self.leads = True
        cluster = cast(Cluster, self.cluster)
        self.services = Services(cluster, options(**given), "o1", self._must_lead, clock=lambda: self.now)

    def _must_lead(self) -> None:
        if not self.leads:
            raise OvertakenError("another one leads")


def test_what_a_cluster_is_asked_for() -> None:
    given = {"load_balancer_class": "metallb", "service_annotations": {"cloud": "udp"}}
    assert service("i1", "o1", options(**given)) == {
        "apiVersion": "v1",
        "kind": "Service",
        "metadata": {
            "name": "skytether-o1-i1",
            "labels": {
                "app.kubernetes.io/managed-by": "skytether",
                "app.kubernetes.io/part-of": "skytether",
                "skytether.io/owner": "o1",
                "skytether.io/instance": "i1",
            },
            "annotations": {"cloud": "udp"},
        },
        "spec": {
            "type": "LoadBalancer",
            "loadBalancerClass": "metallb",
            "externalTrafficPolicy": "Local",
            "selector": {"skytether.io/owner": "o1", "skytether.io/instance": "i1"},
            "ports": [{"port": 7600, "protocol": "UDP"}],
        },
    }
    spread = service("i1", "o1", options(reach="nodeport", external_traffic_policy="Cluster"))
    assert (spread["spec"]["type"], spread["spec"]["externalTrafficPolicy"]) == ("NodePort", "Cluster")
    assert "annotations" not in spread["metadata"]


@pytest.mark.parametrize(
    ("ingress", "told"),
    [
        (None, None),
        ([], None),
        ([{"ip": "203.0.113.9"}], ("203.0.113.9", 7600)),
        ([{"hostname": "a.elb.example.org"}], ("a.elb.example.org", 7600)),
        ([{}, {"ip": "203.0.113.9"}], ("203.0.113.9", 7600)),
    ],
)
def test_where_a_load_balancer_passes_on(ingress: Any, told: Any) -> None:
    made = service("i1", "o1", options()) | {"status": {"loadBalancer": {"ingress": ingress} if ingress else {}}}
    assert balanced_address(made) == told
    assert balanced_address(service("i1", "o1", options())) is None


def test_an_instance_waits_for_its_address_with_a_reason_and_not_for_ever() -> None:
    scene = Scene(load_balancer_timeout_s=60)
    assert scene.services.make("i1") is None
    assert scene.services.reconcile({"i1"}, {"i1"}) == []
    scene.now += 25
    why = scene.services.balancer("i1")
    assert why == (
        "the cluster's load balancer has given its Service no address yet, for 20 s: "
        "'kubectl -n skytether describe service skytether-o1-i1' says why"
    )
    scene.now += 36
    assert scene.services.reconcile({"i1"}, {"i1"}) == ["i1"]
    scene.cluster.give("i1", ip="203.0.113.9")
    assert scene.services.reconcile({"i1"}, {"i1"}) == []
    assert scene.services.balancer("i1") == ("203.0.113.9", 7600)


def test_services_are_listed_while_one_waits_and_else_once_a_minute() -> None:
    scene = Scene()
    scene.services.make("i1")
    scene.cluster.give("i1", ip="203.0.113.9")
    for _ in range(3):
        scene.services.reconcile({"i1"}, {"i1"})
    assert scene.cluster.listed == 1
    scene.services.make("i2")
    for _ in range(3):
        scene.services.reconcile({"i1", "i2"}, {"i1", "i2"})
    assert scene.cluster.listed == 4
    scene.cluster.give("i2", ip="203.0.113.10")
    scene.services.reconcile({"i1", "i2"}, {"i1", "i2"})
    scene.now += 59
    scene.services.reconcile({"i1", "i2"}, {"i1", "i2"})
    assert scene.cluster.listed == 5


def test_one_that_somebody_removed_is_made_again_and_one_of_nobody_goes() -> None:
    scene = Scene()
    scene.services.make("gone")
    scene.services.reconcile({"i1"}, {"i1"})
    assert list(scene.cluster.there) == ["services/skytether-o1-i1"]
    scene.services.make("gone")
    scene.leads = False
    scene.now += 61
    with pytest.raises(OvertakenError):
        scene.services.reconcile({"i1"}, {"i1"})


def test_one_of_an_instance_that_has_ended_goes_though_its_pods_stay_for_their_logs() -> None:
    scene = Scene()
    for instance in ("ended", "crashed"):
        scene.services.make(instance)
    scene.now += 60
    scene.services.reconcile({"ended", "crashed"}, set(), idle={"ended", "crashed"})
    assert len(scene.cluster.there) == 2  # the next run of one that has crashed is reached as the one before
    scene.now += 30
    scene.services.reconcile({"ended", "crashed"}, {"crashed"}, idle={"ended"})
    scene.now += 30
    scene.services.reconcile({"ended", "crashed"}, {"crashed"}, idle={"ended"})
    assert list(scene.cluster.there) == ["services/skytether-o1-crashed"]


def test_one_that_is_being_removed_is_not_taken_for_the_next() -> None:
    scene = Scene()
    scene.services.make("i1")
    scene.cluster.there["services/skytether-o1-i1"]["metadata"]["deletionTimestamp"] = "2026-11-25T07:00:00Z"
    with pytest.raises(SiteSilentError, match="not gone yet"):
        scene.services.make("i1")


def test_a_site_that_needs_no_services_asks_for_none() -> None:
    scene = Scene(reach="pod")
    assert scene.services.make("i1") is None
    assert scene.services.balancer("i1") is None
    scene.services.reconcile({"i1"}, {"i1"})
    scene.services.clear()
    assert (scene.cluster.there, scene.cluster.listed) == ({}, 0)
