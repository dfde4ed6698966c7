"""What our nodes on a ROS 2 graph share, whatever they join it by: who else is there, troubles, threads."""

from __future__ import annotations

import concurrent.futures
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Sequence
from types import TracebackType
from typing import Self

from .dialect import Endpoint, Kind, NodeName
from .seam import Troubles

MAX_WORKING = 64
"""Calls from the graph that are worked on or wait for it."""
WORKERS = 16
"""Of these at the same time: an action's result is a call that waits as long as the action."""


class NodeBase(ABC):
    """The part of `skytether.ros.ros2.seam.GraphNode` that is the same for all; from any thread.

    Args:
        name: Who we are.
        say: Told each trouble once, and its end; by default it is logged.
    """

    def __init__(self, name: NodeName | None, say: Callable[[str], object] | None) -> None:
        self._name = name or NodeName()
        self._troubles = Troubles(say)
        self._closing = threading.Event()
        self._joined = threading.Event()
        self._known: dict[str, Endpoint] = {}
        """Endpoints of others, by what tells one life of an endpoint from another; replaced, never changed."""
        self._working = threading.Semaphore(MAX_WORKING)
        self._workers: concurrent.futures.ThreadPoolExecutor | None = None
        self._threads: list[threading.Thread] = []

    @abstractmethod
    def _jobs(self) -> Sequence[Callable[[], None]]:
        """What the node's threads do until `_closing` is set."""

    @abstractmethod
    def _interrupt(self) -> None:
        """Wake the threads: `_closing` was set."""

    def start(self) -> None:
        """Begin to join the graph; returns at once."""
        self._workers = concurrent.futures.ThreadPoolExecutor(WORKERS, thread_name_prefix="ros2-call")
        for job in self._jobs():
            self._threads.append(threading.Thread(target=job, name=f"ros2{job.__name__}", daemon=True))
            self._threads[-1].start()

    def close(self) -> None:
        """Leave the graph, and wait until that is done."""
        self._closing.set()
        self._interrupt()
        for thread in self._threads:
            thread.join()
        if self._workers is not None:
            self._workers.shutdown(wait=False, cancel_futures=True)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def wait_until_joined(self, timeout: float) -> bool:
        """Whether the graph was reached within so many seconds; who else is there may take longer to see."""
        return self._joined.wait(timeout)

    def endpoints(self, name: str | None = None, kind: Kind | None = None) -> list[Endpoint]:
        """What others have on the graph now."""
        return [e for e in self._known.values() if name in (None, e.name) and kind in (None, e.kind)]

    def lives(self, name: str, kind: Kind, nodes: Collection[str] = ()) -> set[str]:
        """Something for each endpoint of a name and kind that is another after it was away; of these nodes, if any."""
        found = {key: e for key, e in self._known.items() if (e.name, e.kind) == (name, kind)}
        return {key for key, e in found.items() if not nodes or e.node in nodes}

    def definition(self, type_name: str) -> str | None:  # noqa: ARG002 - nodes that can tell do
        """Definition of a type, with all that it is made of: empty: nobody knows it; None: not yet."""
        return ""

    @property
    def troubles(self) -> tuple[str, ...]:
        """What is wrong now, a sentence each."""
        return self._troubles.texts

    def report(self, key: str, text: str) -> None:
        """Tell a trouble once: again only after `settle`."""
        self._troubles.report(key, text)

    def settle(self, key: str) -> None:
        """A trouble is over; nothing is said."""
        self._troubles.settle(key)

    def work(self, job: Callable[[], object]) -> bool:
        """Have something done in a worker's thread; False if too much is being done already."""
        if self._workers is None or not self._working.acquire(blocking=False):
            return False
        try:
            self._workers.submit(job).add_done_callback(lambda _: self._working.release())
        except RuntimeError:  # closing
            self._working.release()
            return False
        return True
