"""What the bridge's counters say about the link, over a recent window. Pure: time is an argument."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import isfinite, nan

from skytether.wire.stats import SessionStats, TopicStats
from skytether.wire.topic import Direction


@dataclass(frozen=True, slots=True)
class _Count:
    sent: int = 0
    arrived: int = 0
    lost: int = 0


class LinkMonitor:
    """Loss of messages over a window, and the best path's round trip.

    A topic that the robot sends and that nothing at all is reported of for a whole window is lost altogether: when only
    the way to the service is broken, its answers still come, and no gap tells it that something is missing.

    Args:
        window_s: How far back the loss looks [s].
        least: Messages that a topic must have sent within the window to have a loss at all.
    """

    def __init__(self, window_s: float = 2.0, least: int = 20) -> None:
        self._window_s = window_s
        self._least = least
        self._samples: deque[tuple[float, dict[tuple[str, str], _Count]]] = deque()

    def sample(self, stats: SessionStats, now: float) -> tuple[float, float]:
        """Take in a snapshot; meant for several calls in each window.

        Returns:
            Round trip [s] and share of messages lost, that of the topic with the largest; NaN where unknown.
        """
        counts = {(topic.topic, topic.direction): _count(topic) for topic in stats.topics}
        self._samples.append((now, counts))
        while len(self._samples) > 1 and self._samples[1][0] <= now - self._window_s:
            self._samples.popleft()
        began, before = self._samples[0]
        whole = now - began >= self._window_s
        losses = [self._loss(before.get(key, _Count()), count, whole, key[1]) for key, count in counts.items()]
        rtts = [path.rtt for path in stats.paths if isfinite(path.rtt)]
        return min(rtts, default=nan), max((loss for loss in losses if isfinite(loss)), default=nan)

    def _loss(self, before: _Count, after: _Count, whole: bool, direction: str) -> float:
        arrived = max(0, after.arrived - before.arrived)
        lost = max(0, after.lost - before.lost)  # a late arrival takes back a loss that was counted before the window
        total = arrived + lost
        if total >= self._least:
            return lost / total
        silent = total == 0 and after.sent - before.sent >= self._least
        return 1.0 if silent and whole and direction == Direction.IN else nan


def _count(topic: TopicStats) -> _Count:
    return _Count(topic.sent, topic.delivered + topic.superseded, topic.lost)
