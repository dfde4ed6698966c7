"""A program that removes the sandboxes of pods that are deleted: ``node_sweeper.py KUBECONFIG``.

A node of Kubernetes 1.20 looks for them once a minute, and a pod is gone only when its sandbox is. Whoever waits for
that (a Deployment that makes the next pod, a port of the node, a claim) would wait for half a minute in the mean.
"""

from __future__ import annotations

import subprocess
import sys
import time
from contextlib import closing, suppress
from http import HTTPStatus
from typing import Any

import docker
from docker.errors import DockerException

from skytether.orchestrator.runtimes.base import RuntimeFailure
from skytether.orchestrator.runtimes.kubernetes.cluster import Cluster, RefusedError
from skytether.orchestrator.runtimes.kubernetes.options import KubernetesOptions

_EVERY_S = 0.5
_SILENT_S = 60.0
"""After so long without an answer there is no cluster any more."""
_SANDBOX = "io.kubernetes.docker.type=podsandbox"


def begin(kubeconfig: str) -> int:
    """Start it, as nobody's child: whoever is the last to need it ends it. Its process id."""
    command = ["sh", "-c", '"$@" >/dev/null 2>&1 & echo $!', "sh", sys.executable, __file__, kubeconfig]
    return int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def _run(kubeconfig: str) -> None:
    options = KubernetesOptions(kubeconfig=kubeconfig)
    with closing(docker.from_env()) as engine, closing(Cluster(options)) as cluster:
        answered_at = time.monotonic()
        while time.monotonic() - answered_at < _SILENT_S:
            time.sleep(_EVERY_S)
            with suppress(DockerException, RuntimeFailure):
                cluster.get("/version")
                answered_at = time.monotonic()
                for one in engine.api.containers(all=True, filters={"status": "exited", "label": _SANDBOX}):
                    if _is_deleted(cluster, one["Labels"]):
                        engine.api.remove_container(one["Id"])


def _is_deleted(cluster: Cluster, labels: dict[str, str]) -> bool:
    pod, space = labels["io.kubernetes.pod.name"], labels["io.kubernetes.pod.namespace"]
    try:
        there: Any = cluster.get(f"/api/v1/namespaces/{space}/pods/{pod}")
    except RefusedError as error:
        return error.status == HTTPStatus.NOT_FOUND
    meta = there["metadata"]
    return meta["uid"] != labels["io.kubernetes.pod.uid"] or "deletionTimestamp" in meta


if __name__ == "__main__":
    _run(sys.argv[1])
