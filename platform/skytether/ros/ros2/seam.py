"""A node of ours on a ROS 2 graph, whatever joins it: ROS 2's own rclpy (`native`), or a Zenoh router (`node`)."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Collection, Iterable
from math import inf
from typing import Protocol

from .dialect import Endpoint, Kind

_log = logging.getLogger(__name__)

MAX_SAID = 1000
"""Troubles that are remembered, so that each is told once."""


class Ros2Error(Exception):
    """The node cannot be what it was told to be; the text says what to change."""


class Handle(Protocol):
    """One endpoint of ours.

    Attributes:
        endpoint: What it is; its type hash may be learned later.
        refused: Why nothing is carried: a sentence, or empty.
        passed: Messages of a topic that were given on: to the graph, or from it.
        dropped: Messages that could not be given on.
    """

    endpoint: Endpoint
    refused: str
    passed: int
    dropped: int

    def close(self) -> None:
        """Leave the graph; from any thread, and again."""
        ...


class Publication(Handle, Protocol):
    """A publisher."""

    @property
    def stuck(self) -> bool:
        """Whether what was put before waits for longer than it may, see `GraphNode.publish`; then none is taken."""
        ...

    @property
    def unread_s(self) -> float:
        """For how long somebody who listens has not acknowledged what is published, where that is known [s]."""
        ...

    @property
    def heard(self) -> bool:
        """Whether somebody listens, and is known to hear; true where that cannot be known.

        A node that has just been found may miss the first messages for a second or two.
        """
        ...

    @property
    def renewed(self) -> int | None:
        """How often somebody began to listen who is to hear a first word; None: it is not known."""
        ...

    @property
    def lost(self) -> bool:
        """Whether the last of those with ``fresh_s`` is known not to have been published, and never to be."""
        ...

    @property
    def left_at(self) -> float:
        """When the last was put that is known to have been published, of those with ``fresh_s`` [s]."""
        ...

    @property
    def heard_at(self) -> float:
        """The same, and to have been acknowledged by all who do that in time [s]."""
        ...

    def put(
        self, payload: bytes | memoryview, until: float = inf, renewed: int | None = None, *, first: bool = False
    ) -> bool:
        """Publish one serialised message; from any thread, returns at once. False if it was dropped.

        Args:
            payload: The message.
            until: After that it is not published any more, where it has ``fresh_s`` [s].
            renewed: Nor once more have come than that, or may have, for a moment; None: those that are known now, if
                somebody hears.
            first: It is good as a first word, and goes to whoever listens.
        """
        ...


class Client(Handle, Protocol):
    """A client of a service."""

    def call(self, request: bytes, timeout: float) -> bytes:
        """Ask, and wait.

        Args:
            request: Serialised.
            timeout: Seconds.

        Raises:
            CallError: No answer; the text says why.
        """
        ...


class GraphNode(Protocol):
    """Our node; every method may be called from any thread."""

    def publish(
        self,
        endpoint: Endpoint,
        *,
        waits: bool = False,
        farewell: bytes = b"",
        farewell_after_s: float = 0.0,
        fresh_s: float = inf,
        stuck_s: float | None = None,
        awaited: Collection[str] = (),
    ) -> Publication:
        """Be a publisher.

        Args:
            endpoint: Which; a type hash that is not known is learned from subscriptions on the graph.
            waits: No message is dropped because there is no room for it now, unless very many wait.
            farewell: Published when this process ends, however it ends, where the way to the graph can do that.
            farewell_after_s: So much later: who else speaks there comes first [s].
            fresh_s: Where another process has the way to the graph: what waits there for longer than this is never
                published [s].
            stuck_s: The same of what waits behind something that waits for longer than this, and none is taken until
                then [s]; None: as ``fresh_s``.
            awaited: Full names of the nodes that it is for, as `Publication.renewed` counts them; empty: any that
                listens.
        """
        ...

    def subscribe(
        self,
        endpoint: Endpoint,
        take: Callable[[bytes], object],
        *,
        lose: Callable[[int], object] | None = None,
        every_kept: bool = False,
    ) -> Handle:
        """Be a subscription.

        Args:
            endpoint: Which.
            take: Gets each serialised message, one at a time, and must return at once.
            lose: Told how many messages, since it was last called, came too quickly to be taken.
            every_kept: Take what some publishers keep for newcomers where others keep nothing, too: then messages of
                those that do come twice.
        """
        ...

    def serve(self, endpoint: Endpoint, answer: Callable[[bytes], bytes]) -> Handle:
        """Be a service; the function answers, in threads of its own, and raises `CallError` where it cannot."""
        ...

    def client(self, endpoint: Endpoint) -> Client:
        """Be a client of a service."""
        ...

    def wait_until_joined(self, timeout: float) -> bool:
        """Whether the graph was reached within so many seconds."""
        ...

    def endpoints(self, name: str | None = None, kind: Kind | None = None) -> list[Endpoint]:
        """What others have on the graph now."""
        ...

    def lives(self, name: str, kind: Kind, nodes: Collection[str] = ()) -> set[str]:
        """Something for each endpoint of a name and kind that is another after it was away; of these nodes, if any."""
        ...

    def definition(self, type_name: str) -> str | None:
        """Text of a type's definition, with all that it is made of; empty: nobody knows it; None: not known yet."""
        ...

    @property
    def troubles(self) -> tuple[str, ...]:
        """What is wrong now, a sentence each."""
        ...

    def report(self, key: str, text: str) -> None:
        """Tell a trouble once: again only after `settle`."""
        ...

    def settle(self, key: str) -> None:
        """A trouble is over; nothing is said."""
        ...

    @property
    def sim_time(self) -> bool:
        """Whether our node uses simulated time (``use_sim_time``)."""
        ...

    @property
    def log_level(self) -> int:
        """Of our node's logger, in numbers of `logging`, which are ROS 2's."""
        ...

    def start(self) -> None:
        """Begin to join the graph; returns at once."""
        ...

    def close(self) -> None:
        """Leave the graph, and wait until that is done."""
        ...


class Troubles:
    """What is wrong, each told once; every method may be called from any thread.

    Args:
        say: Told each sentence; by default it is logged.
    """

    def __init__(self, say: Callable[[str], object] | None = None) -> None:
        self._report = say or _log.warning
        self._lock = threading.Lock()
        self._said: dict[str, str] = {}

    def report(self, key: str, text: str) -> None:
        """See `GraphNode.report`."""
        with self._lock:
            if key in self._said or len(self._said) >= MAX_SAID:
                return
            self._said[key] = text
        self._report(text)

    def settle(self, key: str, text: str = "") -> None:
        """A trouble is over, if there was one; ``text`` says so."""
        with self._lock:
            known = self._said.pop(key, None)
        if known is not None and text:
            self._report(text)

    def keep(self, name: str, sentences: Iterable[str]) -> None:
        """These are all that is wrong with a name of the graph."""
        keys = {f"{name} {sentence}": sentence for sentence in sentences}
        for key, sentence in keys.items():
            self.report(key, sentence)
        with self._lock:
            for key in [k for k in self._said if k.startswith(f"{name} ") and k not in keys]:
                self._said.pop(key)

    @property
    def texts(self) -> tuple[str, ...]:
        """What is wrong now."""
        with self._lock:
            return tuple(self._said.values())
