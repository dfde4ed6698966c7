"""What follows a cluster's changes, where the API server does not keep to its part."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from skytether.orchestrator.runtimes.kubernetes.nodes import Nodes
from skytether.orchestrator.runtimes.kubernetes.watch import Watch


class Answer:
    connection = None

    def stream(self, _: int) -> Iterator[bytes]:
        return iter(())


class Hasty:
    """An API server that ends each watch at once, as a proxy does that knows no answers that go on."""

    def __init__(self) -> None:
        self.watches = 0
        self.watched = threading.Event()

    def path(self, kind: str) -> str:
        return f"/{kind}"

    def get(self, path: str, **query: str | int) -> Any:
        return {"items": [], "metadata": {"resourceVersion": "5"}}

    @contextmanager
    def stream(self, path: str, silence_s: float, **query: str | int) -> Iterator[Any]:
        self.watches += 1
        self.watched.set()
        yield Answer()


@pytest.mark.parametrize("follow", [lambda cluster: Watch(cluster, "o1"), Nodes])
def test_a_watch_that_ends_at_once_is_not_begun_again_and_again(follow: Callable[[Any], Any]) -> None:
    cluster = Hasty()
    watch = follow(cluster)
    watch.start()
    assert cluster.watched.wait(10)
    threading.Event().wait(0.3)  # in which there would be thousands
    watch.close()
    assert cluster.watches <= 2


class Idle:
    """A watch of which nothing comes before ``ended``."""

    connection = None

    def __init__(self, ended: threading.Event) -> None:
        self._ended = ended

    def stream(self, _: int) -> Iterator[bytes]:
        self._ended.wait(60)
        return iter(())


class Slow(Hasty):
    """An API server whose answer to a watch comes only when whoever follows was told to end."""

    def __init__(self) -> None:
        super().__init__()
        self.cut, self.ended = threading.Event(), threading.Event()

    @contextmanager
    def stream(self, path: str, silence_s: float, **query: str | int) -> Iterator[Any]:
        self.watched.set()
        self.cut.wait(10)
        yield Idle(self.ended)


def test_who_ends_while_a_watch_is_being_begun_does_not_wait_for_that() -> None:
    cluster = Slow()

    class Followed(Nodes):
        def _cut(self) -> None:
            super()._cut()
            cluster.cut.set()

    nodes = Followed(cluster)  # type: ignore[arg-type]
    nodes.start()
    assert cluster.watched.wait(10)
    nodes.close()
    left = [one.name for one in threading.enumerate() if one.name == "kubernetes-nodes"]
    cluster.ended.set()
    assert left == []
