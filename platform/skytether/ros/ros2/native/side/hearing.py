"""Whether whoever listens to a publisher hears it, by what DDS says was acknowledged. Pure."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

from .comers import Comers

Nodes = Callable[[], Mapping[str, str]]
"""Gives names of those who listen, empty where it is not known, each under what is its subscription's alone."""
DOUBT_S = 0.5
"""For the name of who came to be known; by then he counts as one who is to hear a first word."""
SILENT_S = 0.5
"""Without an acknowledgement of somebody who listens: who begins to listen then may come in his place."""
HEARS_S = 3.0
"""For who listens to acknowledge a first message; then it counts as heard: one who hangs must not hold the robot."""


class Hearing:
    """Of one publisher.

    Args:
        awaited: Names of the nodes that it is for; empty: any that listens.

    Attributes:
        heard: Whether somebody listens, and is known to hear.
        renewed: How often somebody began to listen who is to hear a first word.
        unread_s: For how long somebody who listens, and did, has not acknowledged what was published [s].
    """

    def __init__(self, awaited: Collection[str] = ()) -> None:
        self.heard = False
        self.renewed = 0
        self.unread_s = 0.0
        self._read_at: float | None = None
        """When all had been acknowledged last, where it was at some time [s]."""
        self._told_since: float | None = None
        """Since when somebody listens to what was published [s]."""
        self._listeners = 0
        self._came: int | None = 0
        self._comers = Comers(awaited)
        self._hidden = False
        """Whether somebody came whom the graph does not show yet."""
        self._doubted_at: float | None = None
        """Since when it is not known whether somebody who came is to hear a first word [s]."""

    @property
    def holds(self) -> bool:
        """Whether somebody came of whom it is not known yet whether he is to hear a first word."""
        return self._doubted_at is not None

    def look(self, listeners: int, came: int | None, now: float, nodes: Nodes) -> bool:
        """See who listens.

        Args:
            listeners: How many do.
            came: How often anybody began to, since there is this publisher; None: this middleware does not tell.
            now: Seconds.
            nodes: Asked where they may be others.

        Returns:
            Whether somebody left, or came who is to hear a first word.
        """
        before, self._listeners = self._listeners, listeners
        came_before, self._came = self._came, came
        quiet = listeners == before and came is not None and came == came_before
        if quiet and not self._comers.unnamed and not self._hidden:
            return False
        back = self._comers.is_anybody_back(nodes())
        new = came - came_before if came is not None and came_before is not None else 0
        if self._comers.changed:
            self._hidden = False
        elif new > 0:
            self._hidden = True
            back |= new > listeners - before  # one in another's place
        if not self._comers.doubtful and not self._hidden:
            self._doubted_at = None
        elif self._doubted_at is None:
            self._doubted_at = now
        back |= self._doubted_at is not None and now - self._doubted_at > DOUBT_S
        if not listeners:
            self.heard, self._told_since = False, None
        elif not before:
            self.renewed += 1
            self._settle()
        elif back or (listeners > before and self.unread_s > SILENT_S):
            # The wheels' node may have been started again, beside somebody else.
            self.heard, self._told_since = False, now
            self.renewed += 1
            self._settle()
        else:
            return listeners < before
        return True

    def update(self, listeners: int, came: int | None, read: bool, now: float, nodes: Nodes) -> None:
        """A message is about to be published.

        Who always takes longer to acknowledge one than it takes until the next is not known by it, and never counts.

        Args:
            listeners: See `look`.
            came: See `look`.
            read: Whether they have acknowledged all that was published.
            now: Seconds.
            nodes: See `look`.
        """
        others = self.look(listeners, came, now, nodes)
        if not others and self._told_since is not None and (read or now - self._told_since > HEARS_S):
            self.heard = True
        if read:
            self._read_at = now if listeners else None
        self.unread_s = 0.0 if self._read_at is None else now - self._read_at

    def _settle(self) -> None:
        """Who is here has heard a first word, or is about to."""
        self._comers.settle()
        self._hidden, self._doubted_at = False, None

    def tell(self, listeners: int, now: float, *, first: bool = False) -> None:
        """A message was published, with so many who listen; ``first``: it is good as a first word."""
        if listeners and self._told_since is None:
            self._told_since = now
        if first:
            self._settle()
