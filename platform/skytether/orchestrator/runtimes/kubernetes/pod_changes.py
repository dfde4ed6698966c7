"""What is changed in a cluster for one pod: each of these is one or two requests, and remembers nothing."""

from __future__ import annotations

from http import HTTPStatus
from typing import Any

from ..base import Launch, RuntimeFailure
from .cluster import Cluster, RefusedError
from .objects import FAILURE, claim
from .options import KubernetesOptions

NETWORKING = "networking.k8s.io/v1"


def hold_claim(cluster: Cluster, launch: Launch, options: KubernetesOptions, owner: str) -> None:
    """Have what keeps the data of a service, as it was made before or anew.

    Raises:
        RuntimeFailure: The cluster refuses it, or does not answer.
    """
    body = claim(launch, options, owner)
    try:
        made = cluster.create(cluster.path("persistentvolumeclaims"), body)
    except RefusedError as error:
        if error.reason == "AlreadyExists":
            return
        raise RuntimeFailure(f"the cluster refuses it: {error}") from error
    if not made["spec"].get("storageClassName"):
        cluster.delete(cluster.path("persistentvolumeclaims", body["metadata"]["name"]))
        raise RuntimeFailure(
            "data is to be kept (option 'keep_data'), and the cluster has no default StorageClass: name one in the "
            "site's option 'storage_class'"
        )


def put(cluster: Cluster, kind: str, body: dict[str, Any], group: str = "") -> None:
    """Create what belongs to a pod, in the place of what an earlier pod of its name has left."""
    try:
        cluster.create(cluster.path(kind, group=group), body)
    except RefusedError as error:
        if error.reason != "AlreadyExists":
            raise
        cluster.delete(cluster.path(kind, body["metadata"]["name"], group=group))
        cluster.create(cluster.path(kind, group=group), body)


def end_pod(cluster: Cluster, name: str, uid: str, failure: str = "") -> Any:
    """SIGTERM, and after `GRACE_S` SIGKILL; the pod and its log stay.

    Returns:
        The pod as it is then; None: it is gone, or another one has its name by now.
    """
    notes = {"annotations": {FAILURE: failure}} if failure else {}
    body = {"metadata": {"uid": uid, **notes}, "spec": {"activeDeadlineSeconds": 1}}
    try:
        return cluster.merge(cluster.path("pods", name), body)
    except RefusedError as error:
        if error.status not in (HTTPStatus.NOT_FOUND, HTTPStatus.CONFLICT):
            raise
        return None


def remove_pod(cluster: Cluster, name: str, uid: str, *, grace_s: int) -> None:
    """With its log; one that has the name by now is left alone."""
    try:
        cluster.delete(cluster.path("pods", name), gracePeriodSeconds=grace_s, preconditions={"uid": uid})
    except RefusedError as error:
        if error.status != HTTPStatus.CONFLICT:
            raise
