"""Whether whoever listens to a publisher hears it, by what DDS says was acknowledged. Pure."""

from __future__ import annotations

from collections.abc import Callable, Collection

from .comers import Comers

Listener = tuple[str, bool]
"""Name of the node, empty where it is not known, and whether it acknowledges what it hears."""
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
        unread_s: For how long somebody who listens, and did, has not acknowledged what was published [s].
    """

    def __init__(self, awaited: Collection[str] = ()) -> None:
        self.heard = False
        self.unread_s = 0.0
        self._read_at: float | None = None
        """When all had been acknowledged last, where it was at some time [s]."""
        self._told_since: float | None = None
        """Since when somebody listens to what was published [s]."""
        self._listeners = 0
        self._read = False
        self._comers = Comers(awaited)

    def update(self, listeners: int, read: bool, now: float, nodes: Callable[[], Collection[Listener]]) -> None:
        """A message is about to be published.

        Who always takes longer to acknowledge one than it takes until the next is not known by it, and never counts.

        Args:
            listeners: How many there are.
            read: Whether they have acknowledged all that was published.
            now: Seconds.
            nodes: Gives those of them; asked where they are others.
        """
        before, self._listeners = self._listeners, listeners
        # Before: of who comes now it is not known.
        live = self._read or (self._read_at is not None and now - self._read_at <= LIVE_S)
        self._read = read
        looks = listeners != before or self._comers.unnamed
        back = looks and self._is_anybody_back(nodes(), live=live)
        if not listeners:
            self.heard, self._told_since = False, None
        elif back or (listeners > before and self.unread_s > SILENT_S):
            # The wheels' node may have been started again, beside somebody else.
            self.heard, self._told_since = False, now
        elif listeners >= before and self._told_since is not None and (read or now - self._told_since > HEARS_S):
            self.heard = True
        if read:
            self._read_at = now if listeners else None
        self.unread_s = 0.0 if self._read_at is None else now - self._read_at

    def _is_anybody_back(self, nodes: Collection[Listener], *, live: bool) -> bool:
        all_live = live and all(acknowledges for name, acknowledges in nodes if name)
        return self._comers.is_anybody_back([name for name, _ in nodes], all_live=all_live)

    def tell(self, listeners: int, now: float) -> None:
        """A message was published, with so many who listen."""
        if listeners and self._told_since is None:
            self._told_since = now
