"""What the bridge's counters say about the link, over a recent window. Pure: time is an argument."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import isfinite, nan
from typing import NamedTuple

from skytether.wire.stats import SessionStats, TopicStats
from skytether.wire.topic import Direction


class Quality(NamedTuple):
    """Both directions, over the window; NaN where unknown.

    Attributes:
        rtt: Round trip of the best path [s].
        loss: Share of messages lost, that of the topic with the largest.
        late: Share of messages that were too old before they were through, that of the topic with the largest.
        lossy_topic: Whose ``loss`` it is.
        late_topic: Whose ``late`` it is.
    """

    rtt: float = nan
    loss: float = nan
    late: float = nan
    lossy_topic: str = ""
    late_topic: str = ""


@dataclass(frozen=True, slots=True)
class _Count:
    offered: int = 0
    sent: int = 0
    arrived: int = 0
    lost: int = 0
    late: int = 0


class LinkMonitor:
    """Loss and lateness of messages over a window, and the best path's round trip.

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

    def sample(self, stats: SessionStats, now: float) -> Quality:
        """Take in a snapshot; meant for several calls in each window."""
        counts = {(topic.topic, topic.direction): _count(topic) for topic in stats.topics}
        self._samples.append((now, counts))
        while len(self._samples) > 1 and self._samples[1][0] <= now - self._window_s:
            self._samples.popleft()
        began, before = self._samples[0]
        whole = now - began >= self._window_s
        losses, lates = [], []
        for key, count in counts.items():
            losses.append((self._loss(before.get(key, _Count()), count, whole, key[1]), key[0]))
            lates.append((self._late(before.get(key, _Count()), count), key[0]))
        loss, lossy_topic = _worst(losses)
        late, late_topic = _worst(lates)
        rtts = [path.rtt for path in stats.paths if isfinite(path.rtt)]
        return Quality(min(rtts, default=nan), loss, late, lossy_topic, late_topic)

    def _loss(self, before: _Count, after: _Count, whole: bool, direction: str) -> float:
        arrived = max(0, after.arrived - before.arrived)
        lost = max(0, after.lost - before.lost)  # a late arrival takes back a loss that was counted before the window
        total = arrived + lost
        if total >= self._least:
            return lost / total
        silent = total == 0 and after.sent - before.sent >= self._least
        return 1.0 if silent and whole and direction == Direction.IN else nan

    def _late(self, before: _Count, after: _Count) -> float:
        late = max(0, after.late - before.late)
        total = max(after.offered - before.offered, after.arrived - before.arrived + late)
        return min(1.0, late / total) if total >= self._least else nan


def _worst(shares: list[tuple[float, str]]) -> tuple[float, str]:
    return max(((share, topic) for share, topic in shares if isfinite(share)), default=(nan, ""))


def _count(topic: TopicStats) -> _Count:
    arrived = topic.delivered + topic.superseded
    return _Count(topic.offered, topic.sent, arrived, topic.lost, topic.expired + topic.late)
