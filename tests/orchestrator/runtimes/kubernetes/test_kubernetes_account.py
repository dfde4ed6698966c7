"""An orchestrator that is a service account of the cluster, with the rights of docs/kubernetes.md and no others."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from docker_runs import launch, until
from kubernetes_site import KubernetesSite

from skytether.orchestrator.runtimes.base import Phase, RuntimeFailure

pytestmark = [pytest.mark.slow, pytest.mark.docker, pytest.mark.kubernetes]


class Tokens:
    """Tokens of the account, each of which is good as long as its Secret is there."""

    def __init__(self, site: KubernetesSite, file: Path) -> None:
        self._site = site
        self._file = file

    def renew(self, name: str) -> None:
        """Another one, in the same file."""
        space = self._site.namespace
        self._site.kubectl("-n", space, "create", "secret", "generic", name)
        made = json.loads(self._site.kubectl("-n", space, "get", "secret", name, "-o", "json"))
        bound = {"apiVersion": "v1", "kind": "Secret", "name": name, "uid": made["metadata"]["uid"]}
        asked = {
            "apiVersion": "authentication.k8s.io/v1",
            "kind": "TokenRequest",
            "spec": {"audiences": [], "expirationSeconds": 600, "boundObjectRef": bound},
        }
        path = f"/api/v1/namespaces/{space}/serviceaccounts/skytether/token"
        said = json.loads(self._site.kubectl("create", "--raw", path, "-f", "-", given=json.dumps(asked)))
        self._file.write_text(said["status"]["token"])

    def revoke(self, name: str) -> None:
        self._site.kubectl("-n", self._site.namespace, "delete", "secret", name)

    def kubeconfig(self) -> Path:
        """That names the file."""
        config = json.loads(self._site.kubectl("config", "view", "--raw", "-o", "json"))
        config["users"] = [{"name": "own", "user": {"tokenFile": str(self._file)}}]
        for one in config["contexts"]:
            one["context"]["user"] = "own"
        path = self._file.with_name("kubeconfig")
        path.write_text(json.dumps(config))
        return path


def test_a_token_that_has_ended_and_is_renewed_costs_no_instance(
    kubernetes_site: KubernetesSite, tmp_path: Path
) -> None:
    kubernetes_site.give_account(kubernetes_site.role("skytether"))
    tokens = Tokens(kubernetes_site, tmp_path / "token")
    tokens.renew("first")
    own = {"kubeconfig": str(tokens.kubeconfig()), "cpu": 2, "memory_mb": 1024}
    with closing(kubernetes_site.open(tmp_path, **own)) as runtime:
        runtime.lead(1)
        runtime.start(launch(kubernetes_site))
        until(lambda: runtime.observe()["i1"].phase is Phase.RUNNING, 90.0)
        before = [one["metadata"]["uid"] for one in kubernetes_site.there("pods", "skytether.io/instance=i1")]
        tokens.revoke("first")

        def told() -> str:
            try:
                runtime.tidy()
            except RuntimeFailure as error:
                return str(error)
            return ""

        # The API server remembers for some seconds whom it knows.
        until(lambda: "the token or certificate is wrong or expired" in told(), 60.0)
        tokens.renew("second")
        until(lambda: told() == "", 60.0)
        until(lambda: runtime.observe()["i1"].phase is Phase.RUNNING, 60.0)
        after = [one["metadata"]["uid"] for one in kubernetes_site.there("pods", "skytether.io/instance=i1")]
        assert after == before
        runtime.start(launch(kubernetes_site, "i2"))
        until(lambda: runtime.observe()["i2"].phase is Phase.RUNNING, 90.0)


class InCluster:
    """An orchestrator in a pod, and its command line."""

    def __init__(self, site: KubernetesSite, image: str) -> None:
        self._site = site
        container = {
            "name": "orchestrator",
            "image": image,
            "imagePullPolicy": "Never",
            "args": ["--host", "127.0.0.1"],
        }
        body = {
            "apiVersion": "v1",
            "kind": "Pod",
            "metadata": {"name": "orchestrator"},
            "spec": {"serviceAccountName": "skytether", "containers": [container], "terminationGracePeriodSeconds": 5},
        }
        site.kubectl("-n", site.namespace, "apply", "-f", "-", given=json.dumps(body))
        site.kubectl("-n", site.namespace, "wait", "pod/orchestrator", "--for=condition=Ready", "--timeout=90s")
        until(self._answers, 60.0)

    def _answers(self) -> bool:
        try:
            return bool(self("site", "list"))
        except AssertionError as error:
            # It wants a token of who looked for one before it was there.
            if re.search("does not answer|no orchestrator|cannot be reached|refused|wants a token", str(error)):
                return False
            raise

    def __call__(self, *words: str, given: str | None = None) -> str:
        """What ``skytether`` says there."""
        command = ("exec", "-i", "orchestrator", "--", "skytether", *words)
        return self._site.kubectl("-n", self._site.namespace, *command, given=given)

    def close(self) -> None:
        self._site.kubectl("-n", self._site.namespace, "delete", "pod", "orchestrator", "--wait=false")


@pytest.fixture
def inside(kubernetes_site: KubernetesSite, orchestrator_image: str) -> Iterator[InCluster]:
    kubernetes_site.give_account(kubernetes_site.role("skytether"))
    with closing(InCluster(kubernetes_site, orchestrator_image)) as inside:
        yield inside


def test_an_orchestrator_in_a_pod_needs_no_kubeconfig_and_no_right_beyond_its_namespace(
    kubernetes_site: KubernetesSite, inside: InCluster
) -> None:
    given = {"namespace": kubernetes_site.namespace, "owner": kubernetes_site.owner, "pull": "never", "reach": "pod"}
    options = [f"--option={key}={value}" for key, value in {**given, "cpu": 2, "memory_mb": 1024}.items()]
    inside("site", "add", "ward", "--tier", "edge", "--runtime", "kubernetes", *options)
    inside("robot", "add", "walker")
    spec = {"image": kubernetes_site.images.toy, "params": {"additionalProperties": True}}
    manifest = {"apiVersion": "skytether.io/v1", "kind": "Service", "metadata": {"name": "toy"}, "spec": spec}
    inside("apply", "-f", "-", given=json.dumps(manifest))
    made = json.loads(inside("instance", "create", "toy", "--robot", "walker", "--json").splitlines()[-1])
    (pod,) = kubernetes_site.there("pods", f"skytether.io/instance={made['id']}")
    told = json.loads(inside("instance", "show", made["id"], "--json"))
    assert (told["state"], told["session"]["host"]) == ("running", pod["status"]["podIP"])
    assert "toy service" in inside("instance", "logs", made["id"])
    inside("instance", "delete", made["id"])
    until(lambda: json.loads(inside("instance", "show", made["id"], "--json"))["state"] == "stopped", 60.0)
