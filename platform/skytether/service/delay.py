"""How long messages take from the robot to its service."""

from __future__ import annotations

import math

from .mailbox import Arrived

_SMOOTH = 0.1
"""Weight of a new delay in the mean of those before."""
_LONGEST = 10.0
"""A message that seems to have been on its way for longer was of another clock, s."""


class MeanDelay:
    """Mean over the last messages. Those to the robot take as long, as far as a service can know.

    Attributes:
        seconds: It; 0 at first.
    """

    def __init__(self) -> None:
        self.seconds = 0.0

    def note(self, message: Arrived) -> None:
        """Take one; it is left out while the robot's clock is not known."""
        taken = message.received_at - message.sent_at
        if math.isfinite(message.sent_at_error) and 0 <= taken < _LONGEST:
            self.seconds += _SMOOTH * (taken - self.seconds)
