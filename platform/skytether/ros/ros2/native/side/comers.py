"""Who begins to listen to a topic, and may be somebody who is back: the wheels' node, started again. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection

MOST = 256
"""Names of those who left that are known."""


class Comers:
    """Knows who listens to one topic, by the names of nodes.

    Args:
        awaited: Names of the nodes that it is about; empty: it may be anybody.
    """

    def __init__(self, awaited: Collection[str] = ()) -> None:
        self._awaited = frozenset(awaited)
        self._here: Counter[str] = Counter()
        self._away: dict[str, None] = {}
        """Who left and has not come back, the one who left first at first; empty: somebody whose name nobody knew."""

    @property
    def unnamed(self) -> bool:
        """Whether somebody is there whose name is not known yet."""
        return "" in self._here

    def is_anybody_back(self, names: Collection[str], *, all_live: bool = False) -> bool:
        """Whether somebody came who may have been there before, or is awaited.

        Whoever comes may be one who left by another name. A name that is there twice is of one who was killed, too, and
        whose node the graph still shows.

        Args:
            names: Of all who listen now, one for each subscription; empty where it is not known.
            all_live: Everybody who was there is: who comes without a name yet is nobody who was killed.
        """
        if self._awaited:
            return self._is_one_new(names, all_live)
        here = Counter(names)
        came, gone = here - self._here, self._here - here
        unnamed = gone.pop("", 0)
        named = min(unnamed, came.total() - came[""])  # of those who were there, by now
        if unnamed > named:
            gone[""] = unnamed - named
        self._away |= dict.fromkeys(gone)
        new = came.total() > named
        back = (new and bool(self._away)) or any(name in self._here if name else not all_live for name in came)
        for name in (*came, *([""] if new else [])):
            self._away.pop(name, None)
        while len(self._away) > MOST:
            del self._away[next(iter(self._away))]
        self._here = here
        return back

    def _is_one_new(self, names: Collection[str], all_live: bool) -> bool:
        here = Counter(name for name in names if not name or name in self._awaited)
        came = here - self._here
        unnamed = came.pop("", 0)
        new = bool(came) or (unnamed > 0 and not (all_live and any(self._here)))
        self._here = here
        return new
