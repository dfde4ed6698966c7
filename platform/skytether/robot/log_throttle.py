"""Troubles that may show at every tick are named once, not a hundred times a second. Pure: time is an argument."""

from __future__ import annotations

import logging
from math import inf

_MOST = 64
"""Kinds of trouble that are told apart; kinds are bounded, this is for the day that one is not."""


class LogThrottle:
    """Logs each kind of trouble when it begins, and again only when it comes back after having been gone.

    Args:
        log: Where to.
        quiet_s: A trouble that did not show for this long [s] is over: the next is a new one.
    """

    def __init__(self, log: logging.Logger, quiet_s: float = 30.0) -> None:
        self._log = log
        self._quiet_s = quiet_s
        self._seen: dict[str, float] = {}

    def warn(self, kind: str, sentence: str, now: float) -> bool:
        """A trouble shows now [monotonic s]; True if it was logged."""
        before = self._seen.get(kind, -inf)
        if kind not in self._seen and len(self._seen) >= _MOST:
            return False
        self._seen[kind] = now
        if 0 <= now - before <= self._quiet_s:
            return False
        if now < before:  # the clock went back; that is no news about this trouble
            return False
        self._log.warning("%s", sentence)
        return True
