"""A node of a real cluster is drained: what serves on it is moved before it ends, and whoever drains waits for that."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable
from typing import Any

import pytest
from kubernetes_site import LITTLE, KubernetesSite

from skytether.api.client import Client
from skytether.api.rest import RobotCreate, SiteCreate, State
from skytether.lab.demo import ROBOT, SERVICE, WalkerHardware
from skytether.lab.embedded import EmbeddedOrchestrator
from skytether.lab.trail import Trail
from skytether.lab.walk import World
from skytether.robot.agent.agent import Agent
from skytether.robot.agent.config import AgentConfig
from skytether.robot.control.command import Source

pytestmark = [pytest.mark.slow, pytest.mark.docker, pytest.mark.kubernetes, pytest.mark.whole_cluster]


def until(condition: Callable[[], Any]) -> Any:
    limit = time.monotonic() + 90
    while not (found := condition()):
        assert time.monotonic() < limit
        time.sleep(0.02)
    return found


def test_a_drain_waits_until_the_robot_has_been_handed_over(kubernetes_site: KubernetesSite) -> None:
    kubectl, space = kubernetes_site.kubectl, ("-n", kubernetes_site.namespace)
    with EmbeddedOrchestrator() as orchestrator, Client(orchestrator.url, orchestrator.operator_token) as operator:
        manifest = operator.get_service(SERVICE)
        needs = manifest.spec.needs.model_copy(update=LITTLE)
        spec = manifest.spec.model_copy(update={"image": kubernetes_site.images.name(SERVICE), "needs": needs})
        operator.put_service(SERVICE, manifest.model_copy(update={"spec": spec}))
        options = kubernetes_site.options()
        operator.create_site(SiteCreate(name="ward", tier="edge", runtime="kubernetes", options=options))
        operator.delete_site("local")
        token = operator.create_robot(RobotCreate(name=ROBOT, services=(SERVICE,))).token
        bind = ("0.0.0.0", 0)
        config = AgentConfig(robot=ROBOT, url=orchestrator.url, token=token, service=SERVICE, bind=bind, renew_s=0.5)

        def instance() -> Any:
            return agent.status().instance

        with Agent(config, WalkerHardware(World(Trail(), seed=1))) as agent:
            until(lambda: agent.source is Source.CLOUD)
            (pod,) = kubernetes_site.there("pods")
            node, first = pod["spec"]["nodeName"], instance().id
            kubectl("cordon", node)
            try:
                said = f"its node {node} is cordoned (kubectl uncordon {node} lets it take pods again)"
                stays = f"{said}, and nothing else takes it: ward: no node takes pods: {node} is cordoned"
                until(lambda: operator.get_instance(first).reason.startswith(stays))
                refused = evict(kubernetes_site, pod["metadata"]["name"])
                assert "Cannot evict pod as it would violate the pod's disruption budget" in refused
                operator.create_site(SiteCreate(name="yard", tier="edge", runtime="process"))
                chosen = f"--pod-selector=skytether.io/owner={kubernetes_site.owner}"
                drain = ["drain", node, chosen, "--force", "--delete-emptydir-data", "--timeout=90s"]
                command = ["kubectl", "--kubeconfig", kubernetes_site.kubeconfig, *drain]
                with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
                    while process.poll() is None:
                        # At no time is there none: how long commands lack at a hand-over `lab bench migrate` measures.
                        assert any(one.state is State.RUNNING for one in operator.instances())
                        time.sleep(0.02)
                    assert process.stdout
                    assert process.returncode == 0, process.stdout.read()
            finally:
                kubectl("uncordon", node)
            assert kubernetes_site.there("pods") == []
            until(lambda: agent.source is Source.CLOUD)
            assert instance().id != first
            assert instance().placement.site == "yard"
        budgets = json.loads(kubectl(*space, "get", "poddisruptionbudgets", "-o", "json"))["items"]
        assert [one["metadata"]["labels"]["skytether.io/owner"] for one in budgets] == [kubernetes_site.owner]
        until(lambda: all(one.state.final for one in operator.instances()))
        operator.delete_site("ward")
    assert json.loads(kubectl(*space, "get", "poddisruptionbudgets", "-o", "json"))["items"] == []


def evict(site: KubernetesSite, pod: str) -> str:
    """Ask for it as who drains a node does; what the cluster says against it."""
    body = {"apiVersion": "policy/v1beta1", "kind": "Eviction", "metadata": {"name": pod, "namespace": site.namespace}}
    path = f"/api/v1/namespaces/{site.namespace}/pods/{pod}/eviction"
    command = ["kubectl", "--kubeconfig", site.kubeconfig, "create", "--raw", path, "-f", "-"]
    return subprocess.run(command, capture_output=True, text=True, input=json.dumps(body)).stderr
