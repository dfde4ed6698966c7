"""How many messages a second each topic has, from the bridge's counters."""

from __future__ import annotations

from collections import deque

from skytether.wire.stats import SessionStats, TopicStats
from skytether.wire.topic import Direction

WINDOW_S = 2.0
"""How far back a rate looks."""
Key = tuple[str, str]
"""Topic and direction."""


class Rates:
    """Rates over the last `WINDOW_S`; not safe for several threads, but for `now`."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, dict[Key, int]]] = deque()
        self.now: dict[Key, float] = {}
        """Messages a second; replaced, never changed."""

    def sample(self, stats: SessionStats, now: float) -> None:
        """Take in a snapshot; meant for several calls in each window. Another session counts from zero."""
        counts = {(topic.topic, topic.direction): _count(topic) for topic in stats.topics}
        if self._samples and any(counts.get(key, 0) < count for key, count in self._samples[-1][1].items()):
            self._samples.clear()
        self._samples.append((now, counts))
        while len(self._samples) > 1 and self._samples[1][0] <= now - WINDOW_S:
            self._samples.popleft()
        began, before = self._samples[0]
        if now > began:
            self.now = {key: (count - before.get(key, 0)) / (now - began) for key, count in counts.items()}


def _count(topic: TopicStats) -> int:
    """What the robot sees itself: what its graph published, whether or not there is a session; what has arrived."""
    return topic.published if topic.direction == Direction.IN else topic.delivered
