"""What waits to be sent, by priority (rule 4).

Strict between priorities; within one, topics (and copies that are due) take turns in the order in which they became
ready. Depth and lifespan drop messages here, before they are sealed: they leave no gap in the sequence.
"""

from __future__ import annotations

import heapq
from typing import Generic, TypeVar

from ..state.epoch import CONTROL_PRIORITY, SendTopic

_TURN_BITS = 56
Other = TypeVar("Other")


class SendQueue(Generic[Other]):
    """Messages by topic, and other items of a priority.

    Args:
        limit: Most payload bytes that may wait; beyond it the oldest message of the lowest priority is dropped.
    """

    __slots__ = ("_heap", "_limit", "_turn", "used")

    def __init__(self, limit: int) -> None:
        self._heap: list[tuple[int, SendTopic | Other]] = []
        self._limit = limit
        self._turn = 0
        self.used = 0
        """Payload bytes waiting."""

    def __len__(self) -> int:
        """Topics that have messages waiting, and other items."""
        return len(self._heap)

    @property
    def priority(self) -> int:
        """Highest priority waiting; -1 if nothing waits."""
        return CONTROL_PRIORITY - (self._heap[0][0] >> _TURN_BITS) if self._heap else -1

    def put(self, topic: SendTopic, payload: bytes, published_at: float, extra: int | None = None) -> None:
        """Queue a message; a full topic drops its oldest."""
        waiting = topic.waiting
        if len(waiting) >= topic.depth:
            self._replace(topic)
        waiting.append((payload, published_at, extra))
        self.used += len(payload)
        if not topic.ready:
            topic.ready = True
            self.put_other(topic.priority, topic)
        if self.used > self._limit:
            self._shed()

    def put_other(self, priority: int, item: SendTopic | Other) -> None:
        """Queue something else of that priority."""
        self._turn += 1
        heapq.heappush(self._heap, ((CONTROL_PRIORITY - priority) << _TURN_BITS | self._turn, item))

    def pop(self, now: float) -> tuple[SendTopic, bytes, float, int | None] | Other | None:
        """Take the next item of the highest priority.

        Returns:
            A message (topic, payload, time of publishing, extra packets), another item, or None if what waited is
            too old or there is nothing; ask again while `priority` is not negative.
        """
        if not self._heap:
            return None
        item = heapq.heappop(self._heap)[1]
        if not isinstance(item, SendTopic):
            return item
        waiting = item.waiting
        message = None
        while waiting and message is None:
            payload, published_at, extra = waiting.popleft()
            self.used -= len(payload)
            if published_at + item.lifespan < now:
                item.counters.expired += 1
            else:
                message = item, payload, published_at, extra
        if waiting:
            self.put_other(item.priority, item)
        else:
            item.ready = False
        return message

    def clear(self) -> None:
        """Drop everything, counted as expired."""
        for _, item in self._heap:
            if isinstance(item, SendTopic):
                item.counters.expired += len(item.waiting)
                item.waiting.clear()
                item.ready = False
        self._heap.clear()
        self.used = 0

    def _replace(self, topic: SendTopic) -> None:
        self.used -= len(topic.waiting.popleft()[0])
        topic.counters.replaced += 1

    def _shed(self) -> None:
        topics = [item for _, item in self._heap if isinstance(item, SendTopic) and item.waiting]
        for topic in sorted(topics, key=lambda t: t.priority):
            while topic.waiting and self.used > self._limit:
                self._replace(topic)
