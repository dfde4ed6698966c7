"""What all sessions of one agent's life counted, together: sums that only go up. Safe from any thread.

A robot has one session after the other, and two while its service moves; each counts from zero. The orchestrator is
told the sums, so that a report that is lost, comes twice or comes late changes nothing in the end.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Hashable, Mapping
from weakref import WeakSet

from skytether.wire.stats import SessionStats, TopicStats

COUNTERS = (
    "refused", "offered", "sent", "delivered", "lost", "late", "unknown", "expired", "replaced", "superseded",
    "duplicate", "bytes_sent",
)  # fmt: skip
"""Of `skytether.wire.stats.TopicStats`; ``lost`` with those that came late after all, so that it only goes up, and
``unknown`` with those under way when their session ended."""

Key = tuple[str, str]
"""Topic and direction."""
_MOST_TOPICS = 4096
"""Of which sums are kept; a robot has some ten, and its services may change while it runs."""


class CounterTotals:
    """Sums over sessions.

    Args:
        life: Tells these sums from those of the agent's next start; nobody else's is the same.
    """

    def __init__(self, life: str) -> None:
        self.life = life
        self._lock = threading.Lock()
        self._past: dict[Key, Counter[str]] = {}
        self._open: dict[Hashable, dict[Key, Counter[str]]] = {}
        self._ended: WeakSet[Hashable] = WeakSet()
        self._priorities: dict[Key, int] = {}

    def update(self, session: Hashable, stats: SessionStats, *, last: bool = False) -> None:
        """Note what a session has counted by now.

        Args:
            session: Any object that stands for it; one that had its last look is not looked at again.
            stats: Its counters.
            last: It has ended.
        """
        with self._lock:
            if session in self._ended:
                return
            counted = self._open.setdefault(session, {})
            for topic in stats.topics:
                key = (topic.topic, topic.direction)
                if key not in self._priorities and len(self._priorities) >= _MOST_TOPICS:
                    continue
                self._priorities[key] = topic.priority
                counted[key] = counted.get(key, Counter()) | _counts(topic)
            if last:
                del self._open[session]
                self._ended.add(session)
                for key, counts in counted.items():
                    told = counts["delivered"] + counts["superseded"] + counts["lost"] - counts["late"]
                    counts["unknown"] = max(counts["unknown"], counts["sent"] - told)  # under way, and nobody will say
                    self._past.setdefault(key, Counter()).update(counts)

    def sums(self) -> Mapping[Key, tuple[int, Mapping[str, int]]]:
        """Priority and counters of each topic."""
        with self._lock:
            found = {key: Counter(self._past.get(key, ())) for key in self._priorities}
            for counted in self._open.values():
                for key, counts in counted.items():
                    found[key].update(counts)
            return {key: (self._priorities[key], counts) for key, counts in found.items()}


def _counts(topic: TopicStats) -> Counter[str]:
    counts = Counter({name: getattr(topic, name) for name in COUNTERS})
    counts["lost"] += topic.late
    return counts
