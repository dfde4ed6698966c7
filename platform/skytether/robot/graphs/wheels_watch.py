"""Who else publishes what the wheels listen to: whoever does drives past gate and supervisor.

Looked at in a thread of its own, for the answer may be long in coming; nobody waits for it.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable, Collection
from typing import NamedTuple, Protocol, runtime_checkable

_log = logging.getLogger(__name__)

LOOK_S = 1.0
"""Between looks."""
MOST = 16
"""Names that are kept; more than one is one too many already."""
LEFT_BEHIND = 30
"""Looks. So long a graph may show a node of ours that was killed, beside the one that is there instead."""
UNNAMED = "somebody whose name is not told"


class Others(NamedTuple):
    """Who else there is.

    Attributes:
        names: Of the nodes that publish the wheels' topic now.
        noticed: How often one more was noticed since the start.
    """

    names: tuple[str, ...] = ()
    noticed: int = 0


NOBODY = Others()


@runtime_checkable
class WatchesWheels(Protocol):
    """A graph that knows who else tells the wheels."""

    @property
    def others(self) -> Others:
        """From any thread; never waits."""
        ...


@runtime_checkable
class KnowsTheDeaf(Protocol):
    """A graph that knows who listens to the velocities and is told none."""

    @property
    def troubles(self) -> tuple[str, ...]:
        """Why: sentences; from any thread, and without waiting."""
        ...


def strangers(found: Collection[str], own: Collection[str]) -> tuple[str, ...]:
    """Who of the publishers found has a name that is none of ours.

    Args:
        found: Names of nodes, one for each publisher; empty where the graph does not tell it.
        own: Ours.
    """
    return tuple(sorted({*found} - {*own, ""})[:MOST])


def unnamed(found: Collection[str], own: Collection[str]) -> int:
    """How many publishers without a name there are, beyond those of ours that may be among them."""
    return max(0, sum(not name for name in found) - len({*own} - {*found}))


class Doubles:
    """Who has a name of ours, or none, and is none of ours: as another gate of the same configuration is. Pure.

    Args:
        own: Names of the nodes that may publish the topic, once each; as many unnamed ones are taken for ours.
    """

    def __init__(self, own: Collection[str]) -> None:
        self._own = own
        self._looks: dict[str, tuple[int, int]] = {}
        """By name, how many there are too many, and for how many looks there were so many."""

    def poll(self, found: Collection[str]) -> tuple[str, ...]:
        """In words, those that are there for longer than one of ours that was killed is shown.

        Where several were killed one after the other, how many are shown changes again and again.
        """
        counts = Counter(found)
        more = {name: counts[name] - 1 for name in self._own} | {"": unnamed(found, self._own)}
        seen = {name: self._looks.get(name, (0, 0)) for name in more}
        self._looks = {name: (n, seen[name][1] + 1 if seen[name][0] == n else 1) for name, n in more.items() if n > 0}
        there = sorted(name for name, (_, looks) in self._looks.items() if looks > LEFT_BEHIND)
        return tuple(f"another {name}" if name else UNNAMED for name in there)


class WheelsWatch:
    """Looks again and again until closed.

    Args:
        topic: What the wheels listen to.
        own: Names of the nodes that may publish it.
        find: Gives the names of all nodes that publish it now; may wait, and raise.
        look_s: Between looks.
    """

    def __init__(
        self, topic: str, own: Collection[str], find: Callable[[], Collection[str]], look_s: float = LOOK_S
    ) -> None:
        self.others = NOBODY
        self._topic = topic
        self._own = own
        self._doubles = Doubles(own)
        self._find = find
        self._look_s = look_s
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="wheels-watch", daemon=True)
        self._thread.start()

    def poll(self) -> None:
        """Once."""
        try:
            found = self._find()
        except Exception as error:  # a graph that does not answer tells nothing new
            _log.debug("who publishes %s is not known now", self._topic, exc_info=error)
            return
        names = (*strangers(found, self._own), *self._doubles.poll(found))
        new = [name for name in names if name not in self.others.names]
        for name in new:
            _log.error("%s", sentence(self._topic, [name]))
        for name in set(self.others.names) - set(names):
            _log.warning("%s publishes %s no more", name, self._topic)
        self.others = Others(names, self.others.noticed + len(new))

    def close(self) -> None:
        """End; a look that takes long is not waited for."""
        self._ended.set()

    def _run(self) -> None:
        while not self._ended.wait(self._look_s):
            self.poll()


def sentence(topic: str, names: Collection[str]) -> str:
    """What to tell people."""
    return (
        f"{', '.join(names)} publishes {topic} too, past supervisor and gate; end it, or let it publish another topic "
        "and the wheels listen to one of their own"
    )
