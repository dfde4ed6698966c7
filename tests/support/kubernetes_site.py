"""The sites of the tests with a real Kubernetes cluster, whose nodes have the images of the Docker engine."""

from __future__ import annotations

import base64
import json
import re
import secrets
import subprocess
from pathlib import Path
from typing import Any

import yaml
from docker_site import Images

from skytether.orchestrator.runtimes.kubernetes import KubernetesRuntime
from skytether.orchestrator.runtimes.kubernetes.options import KubernetesOptions

LITTLE = {"cpu": 0.05}
"""What services of tests need: all have one node of two cores together, and a pod counts until it is gone."""


class KubernetesSite:
    """Kubernetes sites of the tests, in a namespace of their own, and nothing left of them at the end."""

    def __init__(self, images: Images, kubeconfig: str) -> None:
        self.images = images
        self.kubeconfig = kubeconfig
        self.namespace = f"skytether-test-{secrets.token_hex(4)}"
        self.owner = ""
        self.kubectl("create", "namespace", self.namespace)

    def begin(self) -> None:
        """Another site: pods of the one before may take a minute to be gone."""
        self.owner = f"test-{secrets.token_hex(4)}"

    def options(self, **changes: object) -> dict[str, object]:
        """The site's options, as over REST."""
        return {
            "kubeconfig": self.kubeconfig,
            "namespace": self.namespace,
            "owner": self.owner,
            "pull": "never",
        } | changes

    def open(self, folder: Path, **changes: object) -> KubernetesRuntime:
        return KubernetesRuntime("cluster", folder, KubernetesOptions.model_validate(self.options(**changes)))

    def kubectl(self, *arguments: str, given: str | None = None) -> str:
        """Ask the cluster; what it says."""
        command = ["kubectl", "--kubeconfig", self.kubeconfig, *arguments]
        done = subprocess.run(command, capture_output=True, text=True, input=given)
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    def role(self, name: str) -> dict[str, Any]:
        """The Role of this name that docs/kubernetes.md gives, for our namespace."""
        page = (Path(__file__).parents[2] / "docs" / "kubernetes.md").read_text()
        blocks = re.findall("```\n(apiVersion: rbac.*?)```", page, re.DOTALL)
        roles = [one for block in blocks for one in yaml.safe_load_all(block) if one["kind"] == "Role"]
        found: dict[str, Any] = next(one for one in roles if one["metadata"]["name"] == name)
        found["metadata"]["namespace"] = self.namespace
        return found

    def give_account(self, role: dict[str, Any]) -> None:
        """Make a service account with the name of a Role, and the rights of that."""
        named = {"name": role["metadata"]["name"], "namespace": self.namespace}
        account = {"apiVersion": "v1", "kind": "ServiceAccount", "metadata": named}
        binding = {
            "apiVersion": "rbac.authorization.k8s.io/v1",
            "kind": "RoleBinding",
            "metadata": named,
            "roleRef": {"apiGroup": "rbac.authorization.k8s.io", "kind": "Role", "name": named["name"]},
            "subjects": [{"kind": "ServiceAccount", **named}],
        }
        for document in (role, account, binding):
            self.kubectl("apply", "-f", "-", given=json.dumps(document))

    def kubeconfig_of(self, account: str, folder: Path) -> str:
        """A file with which one is a service account of the namespace."""
        secret = next(one for one in self.there("secrets") if one["metadata"]["name"].startswith(f"{account}-token"))
        token = base64.b64decode(secret["data"]["token"]).decode()
        config = json.loads(self.kubectl("config", "view", "--raw", "-o", "json"))
        config["users"] = [{"name": "own", "user": {"token": token}}]
        for one in config["contexts"]:
            one["context"]["user"] = "own"
        path = folder / f"{account}.kubeconfig"
        path.write_text(json.dumps(config))
        return str(path)

    def there(self, kind: str, *labels: str) -> list[dict[str, Any]]:
        """Objects of a kind, with these labels, but for those that are removed and not yet gone."""
        selector = ["-l", ",".join(labels)] if labels else []
        said = self.kubectl("-n", self.namespace, "get", kind, *selector, "-o", "json")
        rows: list[dict[str, Any]] = json.loads(said)["items"]
        return [one for one in rows if "deletionTimestamp" not in one["metadata"]]

    def clean(self) -> None:
        """Remove what the tests have made."""
        kinds = "pods,services,secrets,configmaps,networkpolicies,poddisruptionbudgets,persistentvolumeclaims"
        chosen = ["-l", "app.kubernetes.io/managed-by=skytether", "--grace-period=1", "--wait=false"]
        self.kubectl("-n", self.namespace, "delete", kinds, *chosen)

    def close(self) -> None:
        """Remove the namespace too."""
        self.kubectl("delete", "namespace", self.namespace, "--wait=false")
