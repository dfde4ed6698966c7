"""Whether whoever listens to a publisher hears it, by what DDS says was acknowledged. Pure."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

from .comers import Comers

Listener = tuple[str, bool]
"""Name of the node, empty where it is not known, and whether it acknowledges what it hears."""
Nodes = Callable[[], Mapping[str, Listener]]
"""Gives those who listen, each under what is another's if it is another's subscription."""
LIVE_S = 0.25
"""Within which somebody has acknowledged something who was not killed and started again meanwhile."""
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
        self._read = False
        self._comers = Comers(awaited)

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
        if listeners == before and came is not None and came == came_before and not self._comers.unnamed:
            return False
        back = self._is_anybody_back(nodes(), now)
        if came is not None and came_before is not None and not self._comers.changed:
            back |= came - came_before > listeners - before  # one in another's place, whom the graph does not show yet
        if not listeners:
            self.heard, self._told_since = False, None
        elif not before:
            self.renewed += 1
        elif back or (listeners > before and self.unread_s > SILENT_S):
            # The wheels' node may have been started again, beside somebody else.
            self.heard, self._told_since = False, now
            self.renewed += 1
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
        self._read = read
        if not others and self._told_since is not None and (read or now - self._told_since > HEARS_S):
            self.heard = True
        if read:
            self._read_at = now if listeners else None
        self.unread_s = 0.0 if self._read_at is None else now - self._read_at

    def _is_anybody_back(self, nodes: Mapping[str, Listener], now: float) -> bool:
        live = self._read or (self._read_at is not None and now - self._read_at <= LIVE_S)  # who was there before
        all_live = live and all(acknowledges for name, acknowledges in nodes.values() if name)
        return self._comers.is_anybody_back({key: name for key, (name, _) in nodes.items()}, all_live=all_live)

    def tell(self, listeners: int, now: float) -> None:
        """A message was published, with so many who listen."""
        if listeners and self._told_since is None:
            self._told_since = now
