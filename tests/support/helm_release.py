"""Releases of the chart on the real cluster, by Helm's own engine."""

from __future__ import annotations

import base64
import json
import subprocess
import time
from contextlib import suppress
from typing import Any

from docker_site import Images
from helm_chart import CHART, Values, helm_python

from skytether.api.client import ApiError, Client, Unreachable
from skytether.api.rest import Instance, InstanceCreate, RobotCreate

PATIENCE = 180
"""Seconds."""
_KINDS = "all,configmaps,secrets,serviceaccounts,roles,rolebindings,poddisruptionbudgets,networkpolicies,ingresses,"
_KINDS += "persistentvolumeclaims,horizontalpodautoscalers"
_EVERYWHERE = "clusterroles,clusterrolebindings"


class HelmRelease:
    """One release, called `demo`, in a namespace of its own."""

    def __init__(self, images: Images, kubeconfig: str, namespace: str, values: Values) -> None:
        """``values`` beside the images, which the nodes have."""
        self.namespace = namespace
        self.values: Values = {
            "image": {"repository": images.name("orchestrator").rpartition(":")[0], "pullPolicy": "Never"},
            "orchestrator": {"service": {"type": "NodePort"}, "resources": {"requests": {"cpu": "50m"}}},
            "relay": {"resources": {"requests": {"cpu": "50m"}}},
            **values,
        }
        self._kubeconfig = kubeconfig
        self._helm = helm_python.Config(kubeconfig_path=kubeconfig, namespace=namespace)

    def install(self) -> None:
        self._helm.install(CHART, "demo", self.values, create_namespace=True, wait="watcher", timeout=PATIENCE)

    def upgrade(self, changes: Values) -> None:
        values = self.values | changes
        self._helm.upgrade(CHART, "demo", values, wait="watcher", timeout=PATIENCE)

    def rollback(self) -> None:
        self._helm.rollback("demo", wait="watcher", timeout=PATIENCE)

    def uninstall(self) -> None:
        self._helm.uninstall("demo", wait="watcher", timeout=PATIENCE, ignore_not_found=True)

    def revisions(self) -> list[int]:
        return [one["revision"] for one in self._helm.history("demo")]

    def close(self) -> None:
        """Remove the namespace too."""
        try:
            self.uninstall()
        finally:
            self._helm.close()
            self.kubectl("delete", "namespace", self.namespace, "--wait=false", "--ignore-not-found")

    def kubectl(self, *arguments: str) -> str:
        command = ["kubectl", "--kubeconfig", self._kubeconfig, "-n", self.namespace, *arguments]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    def get(self, *what: str) -> Any:
        return json.loads(self.kubectl("get", *what, "-o", "json"))

    def secret(self, key: str) -> str:
        data = self.get("secret", "demo-skytether-secrets")["data"]
        return base64.b64decode(data[key]).decode().strip()

    def secrets(self) -> dict[str, str]:
        return dict(self.get("secret", "demo-skytether-secrets")["data"])

    def pods(self, label: str) -> list[str]:
        """Their uids, without those that are to go."""
        found = self.get("pods", "-l", label)["items"]
        return [one["metadata"]["uid"] for one in found if "deletionTimestamp" not in one["metadata"]]

    def client(self, token: str) -> Client:
        """At a port of the node."""
        port = self.get("service", "demo-skytether-orchestrator")["spec"]["ports"][0]["nodePort"]
        return Client(f"http://{self.node()}:{port}", token, insecure_http=True)

    def node(self) -> str:
        addresses = self.get("nodes")["items"][0]["status"]["addresses"]
        return next(one["address"] for one in addresses if one["type"] == "InternalIP")

    def leader(self) -> str:
        """The name of the orchestrator's pod that leads."""
        token = self.secret("operator.token")
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            for pod in self.get("pods", "-l", "app.kubernetes.io/component=orchestrator")["items"]:
                port = pod["spec"]["containers"][0]["ports"][0]["containerPort"]
                where = f"http://{pod['status'].get('podIP')}:{port}"
                with suppress(ApiError, Unreachable), Client(where, token, insecure_http=True) as one:
                    if "\nskytether_leader_epoch{} 0.0\n" not in one.metrics():
                        return str(pod["metadata"]["name"])
        raise AssertionError("none of the orchestrators leads")

    def robot(self, name: str) -> Client:
        """As whom a robot asks."""
        with self.client(self.secret("operator.token")) as operator:
            return self.client(operator.create_robot(RobotCreate(name=name)).token)

    def ask(self, robot: Client, name: str, service: str) -> Instance:
        asked = robot.create_instance(InstanceCreate(robot=name, service=service, lease_s=600))
        return robot.wait_running(asked.id, PATIENCE)

    def until_it_answers(self) -> Client:
        """The operator's client, as soon as a node passes requests on to the pod that is there now."""
        operator = self.client(self.secret("operator.token"))
        deadline = time.monotonic() + PATIENCE
        while True:
            try:
                operator.sites()
            except (ApiError, Unreachable):
                assert time.monotonic() < deadline
                time.sleep(0.2)
            else:
                return operator

    def left(self) -> list[str]:
        """What is there of this release or its instances, once what is to go is gone."""
        deadline = time.monotonic() + PATIENCE
        while (names := self._there()) and time.monotonic() < deadline:
            time.sleep(0.5)
        return names

    def _there(self) -> list[str]:
        """All but what every namespace has."""
        found = self.get(_KINDS)["items"]
        found += [one for one in self.get(_EVERYWHERE)["items"] if self.namespace in one["metadata"]["name"]]
        # A pod that is deleted is gone: its node alone takes half a minute to say so.
        gone = [one for one in found if one["kind"] == "Pod" and "deletionTimestamp" in one["metadata"]]
        names = [f"{one['kind']}/{one['metadata']['name']}" for one in found if one not in gone]
        every = ("ConfigMap/kube-root-ca.crt", "ServiceAccount/default", "Secret/default-token-")
        return [name for name in names if not name.startswith(every)]
