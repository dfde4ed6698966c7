"""Who begins to listen to a topic, and may be somebody who is back: the wheels' node, started again. Pure."""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping
from typing import Any

MOST = 256
"""Names of those who left that are known."""
FINDS_S = 30.0
"""After its start a publisher that is in another's place finds who was told something by that one."""


class Comers:
    """Knows who listens to one topic, by the names of nodes.

    Args:
        awaited: Names of the nodes that it is about; empty: it may be anybody.

    Attributes:
        changed: Whether they were others at the last look than before.
    """

    def __init__(self, awaited: Collection[str] = ()) -> None:
        self.changed = False
        self._awaited = frozenset(awaited)
        self._here: dict[Hashable, str] = {}
        self._open: set[Hashable] = set()
        """Those of them who came without a name, and may be back."""
        self._away: dict[str, None] = {}
        """Who left and has not come back, the one who left first at first; empty: somebody whose name nobody knew."""

    @property
    def doubtful(self) -> bool:
        """Whether somebody came whose name is not known yet, and who may be back."""
        return bool(self._open)

    def settle(self) -> None:
        """Whoever is here may be back, and has been told so."""
        self._open.clear()

    def is_anybody_back(self, listeners: Mapping[Any, str], *, young: bool = False) -> bool:
        """Whether somebody came who may have been there before, or is awaited.

        Whoever comes may be one who left by another name. A name that is there twice is of one who was killed, too, and
        whose node the graph still shows.

        Args:
            listeners: Names of all who listen now, each under what is its subscription's alone; empty where it is not
                known: that is seen later.
            young: Who comes may have been there before this one was, see `FINDS_S`.
        """
        before, self._here = self._here, dict(listeners)
        self.changed = before.keys() != listeners.keys()
        new = listeners.keys() - before.keys()
        came = {key: name for key, name in listeners.items() if key in new or (name and key in self._open)}
        self._away |= dict.fromkeys(name for key, name in before.items() if key not in listeners)
        names = {name for name in came.values() if name}
        if self._awaited:
            back = not names.isdisjoint(self._awaited)
        else:
            there = {name for key, name in before.items() if key not in came}
            back = bool(new and (young or self._away)) or not names.isdisjoint(there)
        self._open = set() if back else {key for key in new | self._open if listeners.get(key) == ""}
        for name in (*came.values(), *([""] if new else [])):
            self._away.pop(name, None)
        while len(self._away) > MOST:
            del self._away[next(iter(self._away))]
        return back
