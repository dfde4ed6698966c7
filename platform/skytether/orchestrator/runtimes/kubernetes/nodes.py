"""What is known of a cluster's nodes: what they give, where they are reached, and which of them take no more pods."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from http import HTTPStatus

from typing_extensions import override

from ..base import Capacity, RuntimeFailure
from .cluster import Cluster, RefusedError
from .follow import AGAIN_S, Document, Follower
from .objects import capacity, external_address, tolerated
from .options import KubernetesOptions

log = logging.getLogger(__name__)

_FORBIDDEN_S = 30.0
"""Between two attempts where the account may not; and between two lists where it may list and not watch."""
_CORDONED = "is cordoned (kubectl uncordon {node} lets it take pods again)"
_GOING = (
    "ToBeDeletedByClusterAutoscaler",
    "karpenter.sh/disrupted",
    "karpenter.sh/disruption",
    "aws-node-termination-handler/",
    "cloud.google.com/impending-node-termination",
    "node.cloudprovider.kubernetes.io/shutdown",
    "node.kubernetes.io/out-of-service",
)
"""How taints begin with which others say that a node is about to go."""


def leaving(node: Document) -> str:
    """Why what runs on a node should go elsewhere, in words that continue its name; empty: it need not."""
    for taint in node["spec"].get("taints") or ():
        if taint["key"].startswith(_GOING):
            return f"is about to go: it has the taint {taint['key']}"
    return _CORDONED.format(node=node["metadata"]["name"]) if node["spec"].get("unschedulable") else ""


def closed(node: Document, options: KubernetesOptions) -> str:
    """Why a node takes no pods of the site, in words that continue its name; empty: it takes them."""
    if why := leaving(node):
        return why
    for taint in node["spec"].get("taints") or ():
        if not tolerated(taint, options):
            value = f"={taint['value']}" if taint.get("value") else ""
            return f"has the taint {taint['key']}{value}:{taint['effect']}, which the option tolerations does not name"
    return ""


def offered(nodes: Iterable[Document], options: KubernetesOptions) -> tuple[Capacity, str]:
    """What the nodes give that may have pods of the site, and why none takes any at present (empty: one does)."""
    meant = [node for node in nodes if _is_meant(node, options)]
    whys = {node["metadata"]["name"]: closed(node, options) for node in meant}
    open_ = [node for node in meant if not whys[node["metadata"]["name"]]]
    total = capacity(open_ or meant, options)
    if open_ or (options.cpu is not None and options.memory_mb is not None):  # which may count on nodes to come
        return total, ""
    if not meant:
        wanted = ", ".join(f"{key}={value}" for key, value in options.node_selector.items())
        return total, f"no node has the labels of the option node_selector ({wanted})" if wanted else "it has no node"
    told = "; ".join(f"{name} {why}" for name, why in list(whys.items())[:3])
    return total, f"no node takes pods: {told}{f'; and {len(whys) - 3} more' if len(whys) > 3 else ''}"


def _is_meant(node: Document, options: KubernetesOptions) -> bool:
    labels = node["metadata"].get("labels") or {}
    return all(labels.get(key) == value for key, value in options.node_selector.items())


def _slim(node: Document) -> Document:
    """What is looked at of a node: all images that it has, and more, are told of it."""
    meta, spec, status = node["metadata"], node.get("spec") or {}, node.get("status") or {}
    return {
        "metadata": {key: meta.get(key) for key in ("name", "labels")},
        "spec": {key: spec.get(key) for key in ("unschedulable", "taints")},
        "status": {
            "allocatable": status.get("allocatable") or {"cpu": "0", "memory": "0"},
            "nodeInfo": status.get("nodeInfo") or {"architecture": ""},
            "addresses": status.get("addresses") or (),
        },
    }


class Nodes(Follower):
    """Follows a cluster's nodes, in a thread of its own. Safe from any thread."""

    def __init__(self, cluster: Cluster) -> None:
        super().__init__(cluster, "/api/v1/nodes", "kubernetes-nodes")
        self._nodes: dict[str, Document] = {}

    def offered(self, options: KubernetesOptions) -> tuple[Capacity, str]:
        """See :func:`offered`; waits for the first list only.

        Raises:
            RuntimeFailure: The API server does not answer, or the account may not list nodes and the site is not told
                what it has.
        """
        self._looked.wait(options.timeout_s)
        failure = self._failure
        if isinstance(failure, RefusedError):
            if options.cpu is None or options.memory_mb is None:
                raise RuntimeFailure(
                    f"{failure}: give the site's account that right, or the site the options cpu and memory_mb"
                ) from failure
        elif failure is not None and not self._nodes:
            raise type(failure)(*failure.args)
        return offered(list(self._nodes.values()), options)

    def address(self, name: str) -> str:
        """At which others reach a node; empty: it is not known."""
        node = self._nodes.get(name)
        return external_address(node) if node is not None else ""

    def leaving(self, name: str) -> str:
        """Why what runs on a node should go elsewhere, as a sentence; empty: it need not, as far as is known."""
        node = self._nodes.get(name)
        why = leaving(node) if node is not None else ""
        return f"its node {name} {why}" if why else ""

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                version = self._list()
                while version and not self._closing.is_set():
                    version = self._follow(version)
                wait = 0.0
            except RefusedError as error:
                wait = _FORBIDDEN_S
                self._fail(error)
            except RuntimeFailure as error:
                wait = AGAIN_S
                self._fail(error)
            except Exception:
                wait = AGAIN_S
                log.exception("following a cluster's nodes failed")
            self._closing.wait(wait)

    def _fail(self, error: RuntimeFailure) -> None:
        if str(error) != str(self._failure) and not self._closing.is_set():
            log.warning("nodes are not known, nor which of them are drained: %s", error)
        self._failure = error
        self._looked.set()

    def _list(self) -> str:
        found: dict[str, Document] = {}

        def add(node: Document) -> None:
            found[node["metadata"]["name"]] = _slim(node)

        version = self._read(add)
        self._nodes, self._failure = found, None
        self._looked.set()
        return version

    @override
    def _on_event(self, document: Document, *, gone: bool) -> None:
        name = document["metadata"]["name"]
        if gone:
            self._nodes = {n: one for n, one in self._nodes.items() if n != name}
        else:
            self._nodes = {**self._nodes, name: _slim(document)}

    @override
    def _watch(self, version: str) -> str:
        try:
            return super()._watch(version)
        except RefusedError as error:
            if error.status != HTTPStatus.FORBIDDEN:
                raise
            self._closing.wait(_FORBIDDEN_S)  # it may list: so that is how it is seen
            return ""
