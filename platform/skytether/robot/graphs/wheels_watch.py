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


def strangers(found: Collection[str], own: Collection[str]) -> tuple[str, ...]:
    """Who of the publishers found is none of ours.

    Args:
        found: Names of nodes, one for each publisher; empty where the graph does not tell it.
        own: Ours; as many unnamed ones are taken for ours.
    """
    left = Counter(found)
    unnamed = left.pop("", 0)
    hidden = sum(1 for name in own if name not in left)
    names = sorted(name for name in left if name not in own)
    return tuple(names[:MOST] + ([UNNAMED] if unnamed > hidden else []))


class Doubles:
    """Who has a name of ours and is none of ours: another gate for the same wheels, of the same configuration. Pure.

    Args:
        own: Names of the nodes that may publish the topic, once each.
    """

    def __init__(self, own: Collection[str]) -> None:
        self._own = own
        self._looks: dict[str, int] = {}

    def poll(self, found: Collection[str]) -> tuple[str, ...]:
        """Names, in words, of those that are there twice for longer than one that was killed is shown."""
        counts = Counter(found)
        self._looks = {name: self._looks.get(name, 0) + 1 for name in self._own if counts[name] > 1}
        return tuple(sorted(f"another {name}" for name, looks in self._looks.items() if looks > LEFT_BEHIND))


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
