"""What the benchmarks do with a Kubernetes cluster, by its command line and the site's own API."""

from __future__ import annotations

import os
import secrets
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from skytether.api.client import ApiError, Client
from skytether.api.rest import SiteCreate
from skytether.lab.bench.pair import BenchError
from skytether.lab.embedded import EmbeddedOrchestrator

_KUBECONFIG = Path.home() / ".kube/config"


@contextmanager
def kubernetes_site(orchestrator: EmbeddedOrchestrator, prefix: str, service: str) -> Iterator[None]:
    """Make the cluster of KUBECONFIG the only site, in a namespace of its own that is removed in the end.

    Raises:
        BenchError: There is no cluster, or it refuses.
    """
    kubeconfig = os.environ.get("KUBECONFIG", str(_KUBECONFIG))
    namespace = f"skytether-bench-{secrets.token_hex(4)}"
    options = {"kubeconfig": kubeconfig, "namespace": namespace, "pull": "never"}
    kubectl(kubeconfig, "create", "namespace", namespace)
    try:
        try:
            with Client(orchestrator.url, orchestrator.operator_token) as operator:
                manifest = operator.get_service(service)
                spec = manifest.spec.model_copy(update={"image": f"{prefix}{service}:1"})
                operator.put_service(service, manifest.model_copy(update={"spec": spec}))
                operator.create_site(SiteCreate(name="kubernetes", tier="edge", runtime="kubernetes", options=options))
                operator.delete_site("local")
        except ApiError as error:
            raise BenchError(str(error)) from error
        yield
    finally:
        orchestrator.stop()
        kubectl(kubeconfig, "delete", "namespace", namespace, "--wait=false")


def kubectl(kubeconfig: str, *arguments: str) -> str:
    """What the command says.

    Raises:
        BenchError: It failed, or there is none.
    """
    command = ["kubectl", "--kubeconfig", kubeconfig, *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        raise BenchError("the program 'kubectl' is missing: install kubernetes-client") from None
    if done.returncode:
        raise BenchError(f"kubectl {arguments[0]}: {done.stderr.strip()}")
    return done.stdout.strip()
