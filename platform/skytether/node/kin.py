"""Which containers could have been handed folders of which others' volumes.

Two that have a volume in common, or a network, reach each other by a socket in there, and give open folders away by it.
Whoever was given one may give it on. So all that met, directly or through others, is kin, and stays so as long as one
of its containers runs: a folder is held by whoever runs, whatever became of the one who gave it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Set

MOST = 1 << 15
"""Things that are known at a time: a container has 64 volumes at most. If there are more, nobody knows who met whom."""


class Kin:
    """Of things by their names: containers, each of which stands for its network too, and volumes."""

    def __init__(self, most: int = MOST) -> None:
        """``most``: things that are known at a time."""
        self.lost = False
        """Nobody knows who met whom: anybody may be kin of anything, until nobody runs any more."""
        self._most = most
        self._groups: dict[str, set[str]] = {}
        """By each thing all that are its kin, itself too: one object for all of these."""

    def has_room(self, things: Iterable[str]) -> bool:
        """Whether so many more may be known."""
        return len(self._groups) + len(set(things) - self._groups.keys()) <= self._most

    def meet(self, things: Iterable[str]) -> None:
        """These are kin from now on, and all that theirs are; none are known where there is no room for them."""
        things = set(things)
        if not self.has_room(things):
            self.lose()
        if self.lost:
            return
        met: set[str] = set()
        for thing in things:
            group = self._groups.get(thing) or {thing}
            if group is met:
                continue
            small, met = sorted((group, met), key=len)
            met |= small
            self._groups.update(dict.fromkeys(small, met))
            self._groups[thing] = met

    def lose(self) -> None:
        """Who met whom is not known any more."""
        self.lost, self._groups = True, {}

    def leave(self, container: str) -> None:
        """It does not run: it holds nothing, and its kin need not be asked for it any more."""
        if (group := self._groups.pop(container, None)) is not None:
            group.discard(container)

    def all(self) -> Set[str]:
        """That are known."""
        return self._groups.keys()

    def of(self, things: Iterable[str]) -> Set[str]:
        """All kin of these, which are among them."""
        return {one for thing in things for one in self._groups.get(thing, (thing,))}

    def forget(self, things: Iterable[str]) -> None:
        """All kin of these, of which none runs: what they held is let go of."""
        for one in self.of(things):
            self._groups.pop(one, None)

    def keep(self, running: Collection[str]) -> None:
        """Forget all that has no kin that run."""
        kept = self.of(running)
        self.lost = self.lost and bool(running)
        self._groups = {one: group for one, group in self._groups.items() if one in kept}
