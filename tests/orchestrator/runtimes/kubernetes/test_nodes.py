"""What nodes give and which of them take no more pods, as data and by a made-up cluster's watch."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import Any

import pytest

from skytether.orchestrator.runtimes.base import RuntimeFailure
from skytether.orchestrator.runtimes.kubernetes.cluster import RefusedError
from skytether.orchestrator.runtimes.kubernetes.nodes import Nodes, leaving, offered
from skytether.orchestrator.runtimes.kubernetes.options import KubernetesOptions

TAINT = {"key": "robots", "value": "yes", "effect": "NoSchedule"}


def options(**given: Any) -> KubernetesOptions:
    return KubernetesOptions.model_validate({"kubeconfig": "/k", **given})


def node(name: str = "n1", **spec: Any) -> dict[str, Any]:
    gives = {"cpu": "3920m", "memory": "8Gi", "nvidia.com/gpu": "1"}
    addresses = [{"type": "InternalIP", "address": "10.0.0.5"}, {"type": "ExternalIP", "address": "203.0.113.5"}]
    architecture = spec.pop("architecture", "amd64")
    status = {"allocatable": gives, "nodeInfo": {"architecture": architecture}, "addresses": addresses}
    return {"metadata": {"name": name, "labels": {"zone": spec.pop("zone", "a")}}, "spec": spec, "status": status}


def test_a_site_offers_what_the_nodes_give_that_its_pods_may_have() -> None:
    nodes = [node(), node("n2", zone="b"), node("n3", unschedulable=True), node("n4", taints=[TAINT])]
    told, closed = offered(nodes, options(node_selector={"zone": "a"}))
    assert (told.cpu, told.memory_mb, told.gpu, told.architecture) == (pytest.approx(3.92), 8192, 1, "amd64")
    assert closed == ""
    assert offered(nodes, options(tolerations=[TAINT]))[0].cpu == pytest.approx(3 * 3.92)
    assert offered([*nodes, node(architecture="arm64")], options())[0].architecture == ""
    assert offered([], options(cpu=4, memory_mb=100))[0].cpu == 4


def test_where_no_node_takes_pods_each_is_named_with_its_reason() -> None:
    nodes = [node(unschedulable=True), node("n2", taints=[TAINT])]
    told, closed = offered(nodes, options())
    assert told.cpu == pytest.approx(2 * 3.92)  # they may take some again: to wait is not hopeless
    assert closed == (
        "no node takes pods: n1 is cordoned (kubectl uncordon n1 lets it take pods again); "
        "n2 has the taint robots=yes:NoSchedule, which the option tolerations does not name"
    )
    assert offered(nodes, options(cpu=4, memory_mb=100))[1] == ""  # more may come: who told us so knows
    assert offered(nodes, options(node_selector={"zone": "b"}))[1] == (
        "no node has the labels of the option node_selector (zone=b)"
    )
    many = [node(f"n{n}", unschedulable=True) for n in range(5)]
    assert offered(many, options())[1].endswith("; and 2 more")


@pytest.mark.parametrize(
    "key",
    ["ToBeDeletedByClusterAutoscaler", "node.kubernetes.io/out-of-service", "aws-node-termination-handler/spot-itn"],
)
def test_a_node_that_is_about_to_go_is_known_by_its_taints(key: str) -> None:
    assert leaving(node(taints=[{"key": key, "effect": "NoSchedule"}])) == f"is about to go: it has the taint {key}"
    assert leaving(node(taints=[TAINT])) == ""


class Answer:
    """A watch: events as they are put."""

    connection = None

    def __init__(self) -> None:
        self.lines: list[bytes] = []
        self.over = threading.Event()

    def stream(self, _: int) -> Iterator[bytes]:
        while not self.over.wait(0.005):
            while self.lines:
                yield self.lines.pop(0)


class MadeUpCluster:
    def __init__(self) -> None:
        self.nodes = [node()]
        self.watch = Answer()
        self.may: set[str] = {"list", "watch"}
        self.lists = 0

    def get(self, path: str, **query: Any) -> Any:
        assert path == "/api/v1/nodes"
        self.lists += 1
        if "list" not in self.may:
            raise RefusedError('the site\'s account lacks a right: cannot list resource "nodes"', 403, "Forbidden")
        if "continue" in query:
            return {"items": self.nodes[1:], "metadata": {"resourceVersion": "5"}}
        return {"items": self.nodes[:1], "metadata": {"resourceVersion": "5", "continue": "c"}}

    @contextmanager
    def stream(self, *_: Any, **query: Any) -> Iterator[Any]:
        if "watch" not in self.may:
            raise RefusedError('cannot watch resource "nodes"', 403, "Forbidden")
        assert query["allowWatchBookmarks"] == "true"
        yield self.watch

    def tell(self, kind: str, document: Any) -> None:
        self.watch.lines.append(json.dumps({"type": kind, "object": document}).encode() + b"\n")


def until(condition: Callable[[], Any]) -> None:
    limit = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < limit
        time.sleep(0.005)


@pytest.fixture
def cluster() -> Iterator[Any]:
    made = MadeUpCluster()
    yield made
    made.watch.over.set()


def test_a_node_that_is_cordoned_is_seen_at_once(cluster: Any) -> None:
    cluster.nodes = [node(), node("n2")]
    with closing(Nodes(cluster)) as nodes:
        nodes.start()
        assert nodes.offered(options())[0].cpu == pytest.approx(2 * 3.92)
        assert nodes.address("n2") == "203.0.113.5"
        assert nodes.leaving("n1") == ""
        cluster.tell("MODIFIED", node(unschedulable=True))
        until(lambda: nodes.leaving("n1"))
        assert nodes.leaving("n1").startswith("its node n1 is cordoned")
        cluster.tell("DELETED", node("n2"))
        cluster.tell("ADDED", node("n3"))
        until(lambda: nodes.address("n3"))
        assert nodes.address("n2") == ""
        cluster.watch.over.set()
        assert cluster.lists == 2  # its two pages


def test_who_may_only_list_nodes_knows_them_all_the_same(cluster: Any) -> None:
    cluster.may = {"list"}
    with closing(Nodes(cluster)) as nodes:
        nodes.start()
        assert nodes.offered(options())[0].cpu == pytest.approx(3.92)


def test_who_may_not_list_nodes_has_to_be_told_what_there_is(cluster: Any, caplog: pytest.LogCaptureFixture) -> None:
    cluster.may = set()
    with closing(Nodes(cluster)) as nodes:
        nodes.start()
        with pytest.raises(RuntimeFailure, match="give the site's account that right, or the site the options cpu and"):
            nodes.offered(options())
        assert nodes.offered(options(cpu=2, memory_mb=512))[0].cpu == 2
        assert nodes.leaving("n1") == nodes.address("n1") == ""
        assert "nodes are not known, nor which of them are drained" in caplog.text
