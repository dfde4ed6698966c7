"""Whether a subscription's messages come quicker than they are taken: told once, until that is over. Pure."""

from __future__ import annotations

WINDOW_S = 5.0
"""From the first message that is dropped until it is told how many were."""
QUIET_S = 30.0
"""Without any more it is over, and the next is told anew."""
NEWEST_SHARE = 0.1
"""Where only the newest waits, an older one gives way now and then, as it should: up to this share is not told."""


class Overrun:
    """Looks at two counters from time to time.

    Args:
        depth: Messages that may wait.

    Attributes:
        text: How many were dropped, in which time; empty: there is nothing to tell now.
    """

    def __init__(self, depth: int) -> None:
        self.text = ""
        self._depth = depth
        self._began = (0, 0, 0.0)
        """Taken, dropped and time [s] at the last look before the first message of this window was dropped."""
        self._dropped = 0
        self._at = 0.0

    def update(self, taken: int, dropped: int, now: float) -> str:
        """See how it stands now.

        Args:
            taken: Messages that were taken so far.
            dropped: Those that were not.
            now: Monotonic seconds.

        Returns:
            `text`.
        """
        if dropped != self._dropped:
            self._dropped, self._at = dropped, now
        taken_before, dropped_before, since = self._began
        if self.text:
            if now - self._at > QUIET_S:
                self.text, self._began = "", (taken, dropped, now)
        elif dropped == dropped_before:
            self._began = (taken, dropped, now)
        elif now - since >= WINDOW_S:
            lost = dropped - dropped_before
            came = lost + taken - taken_before
            if self._depth > 1 or lost > NEWEST_SHARE * came:
                self.text = f"{lost} of {came} were dropped in {now - since:.0f} s, for {self._depth} at most may wait"
            self._began = (taken, dropped, now)
        return self.text
