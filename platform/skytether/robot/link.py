"""What the bridge's counters say about the link, over a recent window. Pure: time is an argument."""

from __future__ import annotations

from collections import deque
from math import isfinite, nan

from skytether.wire.stats import SessionStats, TopicStats

_ARRIVED_AND_LOST = tuple[int, int]


class LinkMonitor:
    """Loss of messages over a window, and the best path's round trip.

    Args:
        window_s: How far back the loss looks [s].
        least: Messages that a topic must have sent within the window to have a loss at all.
    """

    def __init__(self, window_s: float = 2.0, least: int = 20) -> None:
        self._window_s = window_s
        self._least = least
        self._samples: deque[tuple[float, dict[tuple[str, str], _ARRIVED_AND_LOST]]] = deque()

    def sample(self, stats: SessionStats, now: float) -> tuple[float, float]:
        """Take in a snapshot; meant for several calls in each window.

        Returns:
            Round trip [s] and share of messages lost, that of the topic with the largest; NaN where unknown.
        """
        counts = {(topic.topic, topic.direction): _count(topic) for topic in stats.topics}
        self._samples.append((now, counts))
        while len(self._samples) > 1 and self._samples[1][0] <= now - self._window_s:
            self._samples.popleft()
        before = self._samples[0][1]
        losses = [self._loss(before.get(key, (0, 0)), count) for key, count in counts.items()]
        rtts = [path.rtt for path in stats.paths if isfinite(path.rtt)]
        return min(rtts, default=nan), max((loss for loss in losses if isfinite(loss)), default=nan)

    def _loss(self, before: _ARRIVED_AND_LOST, after: _ARRIVED_AND_LOST) -> float:
        arrived = max(0, after[0] - before[0])
        lost = max(0, after[1] - before[1])  # a late arrival takes back a loss that was counted before the window
        total = arrived + lost
        return lost / total if total >= self._least else nan


def _count(topic: TopicStats) -> _ARRIVED_AND_LOST:
    return topic.delivered + topic.superseded, topic.lost
