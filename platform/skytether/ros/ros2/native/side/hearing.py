"""Whether whoever listens to a publisher hears it, by what DDS says was acknowledged. Pure."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from math import inf
from typing import Any

from .comers import FINDS_S, Comers

Nodes = Mapping[Any, str]
"""Names of those who listen, empty where it is not known, each under what is its subscription's alone."""
COMES_S = 0.05
"""For DDS to connect somebody whom it shows."""
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
        began: Since when there is this publisher [s].

    Attributes:
        heard: Whether somebody listens, and is known to hear.
        renewed: How often somebody began to listen who is to hear a first word.
        unread_s: For how long somebody who listens, and did, has not acknowledged what was published [s].
    """

    def __init__(self, awaited: Collection[str] = (), began: float = -inf) -> None:
        self._began = began
        self.heard = False
        self.renewed = 0
        self.unread_s = 0.0
        self._read_at: float | None = None
        """When all had been acknowledged last, where it was at some time [s]."""
        self._told_since: float | None = None
        """Since when those who listen are told something, who came last too [s]; None: they are not yet."""
        self._listeners = 0
        self._came = 0
        self._comers = Comers(awaited)
        self._shown: set[Any] = set()
        self._pending: dict[Any, float] = {}
        """Whom the graph shows, and who does not listen yet, as far as is known; since when [s]."""
        self._is_one_coming = self._hidden = False
        """The second: one came in another's place, whom the graph does not show yet."""
        self._unshown = False
        """Whether the graph does not show the first who came yet; he is to hear a first word already."""
        self._doubted_at: float | None = None
        """Since when it is not known whether somebody who came is to hear a first word [s]."""

    @property
    def holds(self) -> bool:
        """Whether somebody came of whom it is not known yet whether he is to hear a first word."""
        return self._doubted_at is not None or self._is_one_coming

    def look(self, listeners: int, came: int | None, now: float, nodes: Nodes) -> bool:
        """See who listens.

        Args:
            listeners: How many do.
            came: How often anybody began to, since there is this publisher; None: this middleware does not tell.
            now: Seconds.
            nodes: Whom the graph shows: it may be before he listens, or after.

        Returns:
            Whether somebody left, or came who is to hear a first word.
        """
        before, self._listeners = self._listeners, listeners
        new = 0
        if came is not None:  # it is told after they are counted
            new = max(came - self._came, listeners - before, 0)
            self._came += new
        here = self._connected(nodes, listeners, now, told=came is None or new > 0)
        self._unshown = self._unshown and came is not None and not new
        young = now - self._began < FINDS_S and not self._unshown
        back = self._comers.is_anybody_back(here, young=young)
        self._unshown = self._unshown and not self._comers.changed
        self._hidden = not self._comers.changed and (self._hidden or new > max(0, listeners - before))
        if not self._comers.doubtful and not self._hidden and listeners <= len(here):
            self._doubted_at = None
        elif self._doubted_at is None:
            self._doubted_at = now
        back |= self._doubted_at is not None and now - self._doubted_at > DOUBT_S
        if not listeners:
            self.heard, self._told_since = False, None
        elif not before:
            self.renewed += 1
            self._settle()
            self._unshown = not here
        elif back or (listeners > before and self.unread_s > SILENT_S):
            # The wheels' node may have been started again, beside somebody else.
            self.heard, self._told_since = False, None
            self.renewed += 1
            self._settle()
        else:
            return listeners < before
        return True

    def _connected(self, nodes: Nodes, listeners: int, now: float, *, told: bool) -> Nodes:
        """Those of the graph's who listen: DDS shows somebody, connects him, and then tells that it did.

        One whom it never connects, as he asks for more than is offered, stays pending.
        """
        self._pending |= dict.fromkeys(nodes.keys() - self._shown, now)
        self._shown = set(nodes)
        pending = {key: at for key, at in self._pending.items() if key in nodes}
        self._pending = {} if told or listeners > len(nodes) - len(pending) else pending
        self._is_one_coming = any(now - at < COMES_S for at in self._pending.values())
        return {key: name for key, name in nodes.items() if key not in self._pending}

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
