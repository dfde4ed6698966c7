"""Velocities that were held back on their way: worse than none, for whoever has them drives on. Pure."""

from __future__ import annotations

from math import isinf

from skytether.messages import Twist, TwistStamped
from skytether.wire.events import MessageReceived
from skytether.wire.topic import Topic

VELOCITIES = frozenset({Twist.TYPE, TwistStamped.TYPE})
_ANOTHER_PATH_S = 1.0
"""For which all take longer than before: then it is the path that does, and nothing holds them back."""


class HeldBack:
    """Tells the messages of one row that were held back from those that were not.

    A path may take any time. But after an end, or a network, that stood still all that waited comes at once, and there
    may be nobody who says anything after it. So one that took longer than the one before it, by more than its lifespan,
    is late; and of the first, of which none tells how long the path takes, what took longer than its lifespan.
    """

    def __init__(self, row: Topic) -> None:
        self.reason = (
            f"{row.name}: velocities that come {row.lifespan:g} s (lifespan_ms) later than those before them are not "
            "published: the network, or one of the two ends, held them back"
        )
        """Why one that is late is not published, as a sentence."""
        self._judges = row.type in VELOCITIES
        self._lifespan = row.lifespan
        self._usual: float | None = None
        """How long the last that was not late took [s]."""
        self._since: float | None = None
        """When the first of those was received that are late without an interruption [s]."""

    @property
    def holds(self) -> bool:
        """Whether the last one was late."""
        return self._since is not None

    def is_late(self, message: MessageReceived) -> bool:
        """Whether a message was held back; of a row of another type none is."""
        if not self._judges or isinf(message.sent_at_error):
            return False
        took, now = message.received_at - message.sent_at, message.received_at
        if took - (self._usual or 0.0) > self._lifespan + message.sent_at_error:
            if self._since is None:
                self._since = now
            if now - self._since < _ANOTHER_PATH_S:
                return True
        self._usual, self._since = took, None
        return False
