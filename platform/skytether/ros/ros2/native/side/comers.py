"""Who begins to listen to a topic, and may be somebody who is back: the wheels' node, started again. Pure."""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping

MOST = 256
"""Names of those who left that are known."""


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
        """Those of them who came without a name, and did not count as back."""
        self._away: dict[str, None] = {}
        """Who left and has not come back, the one who left first at first; empty: somebody whose name nobody knew."""

    @property
    def unnamed(self) -> bool:
        """Whether somebody is there whose name is not known yet."""
        return "" in self._here.values()

    def is_anybody_back(self, listeners: Mapping[Hashable, str], *, all_live: bool = False) -> bool:
        """Whether somebody came who may have been there before, or is awaited.

        Whoever comes may be one who left by another name. A name that is there twice is of one who was killed, too, and
        whose node the graph still shows.

        Args:
            listeners: Names of all who listen now, each under what is its subscription's alone; empty where it is not
                known.
            all_live: Everybody who was there is: who comes without a name yet is nobody who was killed.
        """
        before, self._here = self._here, dict(listeners)
        self.changed = before.keys() != listeners.keys()
        new = listeners.keys() - before.keys()
        came = {key: name for key, name in listeners.items() if key in new or (name and key in self._open)}
        self._away |= dict.fromkeys(name for key, name in before.items() if key not in listeners)
        back = self._is_one_awaited(came, all_live) if self._awaited else self._is_one_back(came, before, new, all_live)
        self._open = set() if back else {key for key in new | self._open if listeners.get(key) == ""}
        for name in (*came.values(), *([""] if new else [])):
            self._away.pop(name, None)
        while len(self._away) > MOST:
            del self._away[next(iter(self._away))]
        return back

    def _is_one_back(
        self, came: Mapping[Hashable, str], before: Mapping[Hashable, str], new: Collection[Hashable], all_live: bool
    ) -> bool:
        names = {name for key, name in before.items() if key not in came}
        return bool(new and self._away) or any(name in names if name else not all_live for name in came.values())

    def _is_one_awaited(self, came: Mapping[Hashable, str], all_live: bool) -> bool:
        there = any(name in self._awaited for key, name in self._here.items() if key not in came)
        return any(name in self._awaited if name else not (all_live and there) for name in came.values())
