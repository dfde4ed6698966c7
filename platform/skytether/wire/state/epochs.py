"""The keys in use, and those before the latest handshake, which open packets that were on their way."""

from __future__ import annotations

import math

from .epoch import Epoch


class Epochs:
    """Two epochs at most.

    Args:
        old_keys: How long those before are kept after the last packet that came by them [s].
    """

    __slots__ = ("_old_keys", "current", "previous", "previous_until")

    def __init__(self, old_keys: float) -> None:
        self._old_keys = old_keys
        self.current: Epoch | None = None
        """None: there are no keys."""
        self.previous: Epoch | None = None
        self.previous_until = math.inf
        """Until then the previous ones are kept in any case."""

    def find(self, packet_id: int) -> Epoch | None:
        """Whose packets have that id."""
        epoch = self.current
        if epoch is not None and epoch.ciphers.packet_id == packet_id:
            return epoch
        if self.previous is not None and self.previous.ciphers.packet_id == packet_id:
            return self.previous
        return None

    def start(self, epoch: Epoch, now: float) -> bool:
        """Use other keys. Returns whether they go on where those before end: same topics, numbers and counters."""
        before = self.current
        goes_on = before is not None and epoch.take_over(before)
        self._drop_previous()
        if before is not None:
            self.previous, self.previous_until = before, now + self._old_keys
        self.current = epoch
        return goes_on

    def end(self) -> None:
        """Have no keys any more."""
        self._drop_previous()
        self.current = None

    def check(self, now: float) -> float:
        """Drop the previous ones when their time is over; returns when to check again, inf for never."""
        if self.previous is None:
            return math.inf
        until = max(self.previous_until, self.previous.heard_at + self._old_keys)
        if now < until:
            return until
        self._drop_previous()  # a large message that was on its way is there, or will never be
        return math.inf

    def _drop_previous(self) -> None:
        if self.previous is not None:
            if not self.previous.belongs_with(self.current):
                for receiver in self.previous.receive.values():
                    receiver.settle(math.inf)
            self.previous = None
