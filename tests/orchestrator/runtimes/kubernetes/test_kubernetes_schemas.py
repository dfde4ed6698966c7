"""All that a Kubernetes site asks an API server to keep, held against the schemas of Kubernetes itself."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from typing import Any

import kubernetes_validate
import pytest

from skytether.api.grant import Grant
from skytether.api.manifest import Opening, ServiceSpec
from skytether.orchestrator.runtimes.base import Launch
from skytether.orchestrator.runtimes.kubernetes.objects import (
    claim,
    disruption_budget,
    leader,
    openings_policy,
    pod,
    secret,
    service,
    site_policy,
)
from skytether.orchestrator.runtimes.kubernetes.options import KubernetesOptions

VERSIONS = kubernetes_validate.utils.all_versions()
"""From 1.25 on; what is older is looked at by the real API server of the other tests."""
EVERYTHING = {
    "node_selector": {"zone": "a"},
    "tolerations": [{"key": "robots", "operator": "Exists", "effect": "NoSchedule"}],
    "priority_class": "high",
    "image_pull_secrets": ["registry"],
    "environment": {"TZ": "UTC"},
    "labels": {"team": "a"},
    "egress": ["*"],
    "service_annotations": {"cloud": "udp"},
}


def options(**given: Any) -> KubernetesOptions:
    return KubernetesOptions.model_validate({"kubeconfig": "/k", **given})


def objects() -> Iterator[dict[str, Any]]:
    needs = {"cpu": 0.5, "memory_mb": 64, "gpu": 1, "egress": ["db.example.org:5432"]}
    key = base64.b64encode(bytes(32)).decode()
    grant = Grant(instance="i1", service="toy", robot="walker", session_id="0" * 16, session_key=key, topics=())
    launch = Launch(1, ServiceSpec.model_validate({"image": "toy:1", "needs": needs}), grant)
    openings = {
        Opening("db.example.org", 5432): ("192.0.2.7", "2001:db8::7"),
        Opening("10.0.0.0/8", 53, "udp"): ("10.0.0.0/8",),
    }
    yield pod(launch, options(), "o1", 20_000, {})
    made = pod(launch, options(**EVERYTHING, reach="nodeport"), "o1", None, openings, node_port=30_000, epoch=3)
    yield made
    made["metadata"]["uid"] = "u1"
    kept = options(keep_data=True, storage_class="fast")
    yield claim(launch, kept, "o1")
    yield pod(launch, kept, "o1", None, {})
    yield secret(launch, "o1", made)
    yield openings_policy(openings, made, "o1")
    yield site_policy("o1")
    yield disruption_budget("o1", "policy/v1")
    yield leader("o1", 3)
    yield service("i1", "o1", options(reach="nodeport"))
    yield service("i1", "o1", options(**EVERYTHING, reach="loadbalancer", load_balancer_class="metallb"))


@pytest.mark.parametrize("version", [VERSIONS[0], VERSIONS[-1]])
def test_every_object_is_one_of_kubernetes_and_no_field_is_made_up(version: str) -> None:
    for document in objects():
        assert kubernetes_validate.validate(document, version, strict=True) in version


def test_a_field_that_does_not_exist_would_be_found() -> None:
    document = next(objects())
    document["spec"]["containers"][0]["hostport"] = 1
    with pytest.raises(kubernetes_validate.ValidationError, match="hostport"):
        kubernetes_validate.validate(document, VERSIONS[-1], strict=True)
