"""A publisher whose messages reach somebody in time or never: none waits for longer, neither here nor in DDS."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Collection
from functools import partial
from typing import Any

from rclpy.duration import Duration

from . import graph
from .frames import FIRST_WORD, FOR_ALL, DealtWith, Frame, dealt_with
from .hearing import Hearing

FAREWELL_S = 0.3
"""Within which whoever listens has acknowledged the last word, or is not waited for."""
_LISTENS = 3
"""Lifespans, of 1.5 periods. Whoever speaks says something each second period at least."""
_LATE = 20
"""Lifespans. Nobody has started another gate so soon; whose wheels hear nothing for longer, they have stopped."""
_AT_ONCE = Duration(seconds=0)
Speaking = Callable[[], contextlib.AbstractContextManager[None]]


class FreshPublisher:
    """One.

    DDS keeps a message for who has not acknowledged it, and sends it again, however old it is by then: when the network
    is there again, say, or this process goes on. So it has a lifespan, after which DDS has it no more.

    Args:
        node: Of rclpy, which has the publisher.
        publisher: Reliable or not.
        lifespan_s: Its messages' [s].
        came: How often anybody began to listen, as `Hearing.look` has it.
        awaited: See `Hearing`.
        speaking: Entered while it is looked whether a message is still fresh, and while it is published.
        now: The clock that the agent has, too [s].
    """

    def __init__(
        self,
        node: Any,
        publisher: Any,
        lifespan_s: float,
        came: Callable[[], int | None],
        awaited: Collection[str],
        speaking: Speaking,
        now: Callable[[], float],
    ) -> None:
        self._node, self._publisher, self._lifespan_s = node, publisher, lifespan_s
        self._speaking, self._now = speaking, now
        self._hearing = Hearing(awaited, now())
        self._lock = threading.Lock()
        """Of what is known of who hears, and was published."""
        self._nodes = partial(graph.listeners, node, publisher.topic_name)
        self._shown = partial(node.count_subscribers, publisher.topic_name)
        self._came = came
        self._published, self._published_at = 0, now()
        self._number = self._newest = self._read = self._heard = 0
        """Of the last message that was dealt with, that was published, that DDS says was acknowledged, and that was by
        all who do that."""

    def publish(self, number: int, until: float, renewed: int, body: bytes) -> None:
        """Publish a message.

        Args:
            number: What the agent calls it.
            until: Not after that [s].
            renewed: It is no first word for who came after so many, or may have; or `FOR_ALL`, or `FIRST_WORD`.
            body: The message, serialised.
        """
        published = False
        try:
            published = self._publish(until, renewed, body)
        finally:
            with self._lock:
                self._number = number
                if published:
                    self._published, self._newest = self._published + 1, number

    def _publish(self, until: float, renewed: int, body: bytes) -> bool:
        hearing, publisher, now = self._hearing, self._publisher, self._now()
        with self._lock:
            self._see_read()
            shown, came, there = self._shown(), self._came(), self._nodes()
            listeners = publisher.get_subscription_count()
            hearing.update(listeners, came, self._read == self._newest, now, there)
            if not hearing.unread_s:
                self._heard = self._newest
        with self._speaking():
            known = renewed in (FOR_ALL, FIRST_WORD) or (
                renewed == hearing.renewed
                and not hearing.holds
                and there.keys() == self._nodes().keys()  # DDS shows who comes, connects him, and then counts that
                and came == self._came()
                and shown == self._shown()  # to name them takes as long as some milliseconds, to count them none
                and listeners == publisher.get_subscription_count()
            )
            new = bool(known and self._now() <= until)
            if new:
                at = self._now()
                publisher.publish(body)
                self._published_at = at
        if new:
            with self._lock:
                hearing.tell(publisher.get_subscription_count(), self._now(), first=renewed == FIRST_WORD)
        return new

    def look(self) -> bool:
        """See who listens, while perhaps nothing is published; whether that is somebody who is to hear a first word."""
        with self._lock:
            before = self._hearing.renewed
            self._hearing.look(self._publisher.get_subscription_count(), self._came(), self._now(), self._nodes())
            return self._hearing.renewed != before

    def hear(self) -> bool:
        """See whether all has been acknowledged that was published, and whether that is new."""
        with self._lock:
            heard = self._heard
            self._see_read()
            self._heard = max(heard, self._read)
            return self._heard != heard

    def _see_read(self) -> None:
        """Ask DDS whether all was acknowledged; of what it has let go of it says so, too."""
        at = self._published_at
        if self._read == self._newest or not _has_been_read(self._publisher, _AT_ONCE):
            return
        if at == self._published_at and self._now() - at < self._lifespan_s:
            self._read = self._newest

    def answer(self, channel: int) -> Frame:
        """What the agent is told of what was dealt with."""
        hearing = self._hearing
        with self._lock:
            told = self._heard, self._published, hearing.unread_s, hearing.heard, hearing.renewed
            return dealt_with(channel, DealtWith(self._number, self._newest, *told))

    def say_farewell(self, body: bytes, after_s: float, page: Callable[[], bytes]) -> None:
        """Publish a last word until it is acknowledged.

        This process may stand still at any moment, and go on when others have told the wheels something for long.

        Args:
            body: The word.
            after_s: So much after now, unless somebody else speaks by then [s]; 0: at once, whoever does.
            page: What those who speak write down in the same moment.
        """
        before = b""
        if after_s:
            listen_s = _LISTENS * self._lifespan_s
            time.sleep(max(0.0, after_s - listen_s))
            before = page()
            time.sleep(listen_s)
            if self._is_followed():
                return
        until = time.monotonic() + FAREWELL_S
        latest = self._published_at + after_s + _LATE * self._lifespan_s
        while time.monotonic() < until:
            with self._speaking():
                if after_s and (page() != before or self._now() > latest):
                    return
                self._publisher.publish(body)
            if _has_been_read(self._publisher, Duration(seconds=min(FAREWELL_S, self._lifespan_s / 2))):
                return

    def _is_followed(self) -> bool:
        """Whether another node of our name publishes the topic by now."""
        ours = (self._node.get_name(), self._node.get_namespace())
        infos = self._node.get_publishers_info_by_topic(self._publisher.topic_name)
        return [(info.node_name, info.node_namespace) for info in infos].count(ours) > 1


def _has_been_read(publisher: Any, within: Duration) -> bool:
    """Whether all who listen have acknowledged all."""
    try:
        return bool(publisher.wait_for_all_acked(within))
    except Exception:  # this middleware does not tell
        return True
