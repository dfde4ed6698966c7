"""Keeps a node registered, whatever becomes of the master: level-triggered, in a thread of its own.

Each round asks whether the master knows this node. A restarted master does not: everything is registered again. A
master that is away is waited for; that is said once, and so is its return. What it answers nonsense for is named once
and asked again each round, and does not keep the rest from being registered. What is missed is registered again, too:
the master then tells the others of it anew.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from functools import partial
from typing import Protocol

from .master import Master, MasterError, NonsenseError, RefusedError

_log = logging.getLogger(__name__)

LOOK_S = 1.0
"""Between looks at the master."""
_CLOSE_S = 5.0
"""For saying goodbye."""


class Entry(Protocol):
    """One registration."""

    @property
    def name(self) -> str:
        """Of its topic or service."""
        ...

    def register(self, master: Master) -> None:
        """Tell the master; raises MasterError."""
        ...

    def unregister(self, master: Master) -> None:
        """Take it back; raises MasterError."""
        ...

    def is_missed(self, master: Master) -> bool:
        """Whether other nodes are to hear of it anew, by its being registered again; raises MasterError."""
        ...


class Registry:
    """Keeps what is wanted registered, in a thread of its own.

    Attributes:
        present: Whether the master answered when it was last asked; None before.

    Args:
        master: The master.
        node: Name of the node.
        uri: Address of the node, once it has one.
        look_s: Between looks.
    """

    def __init__(self, master: Master, node: str, uri: Callable[[], str], look_s: float = LOOK_S) -> None:
        self.present: bool | None = None
        self._master = master
        self._node = node
        self._uri = uri
        self._look_s = look_s
        self._changed = threading.Condition()
        self._dirty = False
        self._closing = False
        self._held = False
        self._wanted: list[Entry] = []
        self._done: list[Entry] = []
        self._said: set[str] = set()
        self._thread = threading.Thread(target=self._run, name="ros1-master", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def want(self, entry: Entry) -> None:
        """Have it registered, now and after each restart of the master; from any thread."""
        with self._changed:
            self._wanted.append(entry)
            self._wake()

    def drop(self, entry: Entry) -> None:
        """Have it taken back; from any thread."""
        with self._changed:
            if entry in self._wanted:
                self._wanted.remove(entry)
            self._wake()

    def hold(self) -> None:
        """Register nothing any more: the name is another node's now; from any thread."""
        self._held = True

    def close(self) -> None:
        """Take everything back, if the master is there, and end."""
        with self._changed:
            self._wanted.clear()
            self._closing = True
            self._wake()
        self._thread.join(_CLOSE_S)

    def step(self) -> None:
        """One round."""
        try:
            if self._done and not self._held and (known := self._master.knows(self._node)) != self._uri():
                why = f"knows {self._node} at {known[:200]}: end that node" if known else "was restarted"
                _log.warning("the ROS master at %s %s; registering again", self._master.uri, why)
                self._done.clear()
            wrong = self._settle()
        except MasterError as error:
            self.present = False
            self._log_once("", f"no ROS master answers: {error}; waiting for it")
            return
        for name, nonsense in wrong.items():
            self._log_once(name, f"the ROS master answers nonsense for {name}: {nonsense}; it is asked again")
        if self._said and not wrong:
            _log.warning("the ROS master at %s answers", self._master.uri)
            self._said.clear()
        self.present = not wrong

    def _settle(self) -> dict[str, NonsenseError]:
        """Tell the master what it does not know yet. Returns what it answers nonsense for, by name."""
        with self._changed:
            missing = [] if self._held else [entry for entry in self._wanted if entry not in self._done]
            surplus = [entry for entry in self._done if entry not in self._wanted]
        if not missing and not surplus and not self._done:
            self._master.knows(self._node)  # whether it is there at all
        wrong: dict[str, NonsenseError] = {}
        for entry in surplus:
            if self._call_master(entry.unregister, entry.name, wrong):
                self._done.remove(entry)
        for entry in missing:
            if self._call_master(entry.register, entry.name, wrong):
                self._done.append(entry)
        for entry in () if self._held else self._done:
            self._call_master(partial(_register_if_missed, entry), entry.name, wrong)
        return wrong

    def _call_master(self, tell: Callable[[Master], None], name: str, wrong: dict[str, NonsenseError]) -> bool:
        """Whether the master has heard it, be it that it refuses."""
        try:
            tell(self._master)
        except RefusedError as error:
            _log.error("the ROS master refuses: %s", error)
        except NonsenseError as error:
            wrong[name] = error
            return False
        return True

    def _run(self) -> None:
        while True:
            with self._changed:
                self._dirty = False
                last = self._closing  # seen before the round: what is taken back at the end is taken back in it
            self.step()
            if last:
                return
            with self._changed:
                self._changed.wait_for(lambda: self._dirty, self._look_s)

    def _wake(self) -> None:
        self._dirty = True
        self._changed.notify_all()

    def _log_once(self, about: str, sentence: str) -> None:
        """Once for each name, and for the master, until all is well again."""
        if about not in self._said:
            _log.warning("%s", sentence)
        self._said.add(about)


def _register_if_missed(entry: Entry, master: Master) -> None:
    if entry.is_missed(master):
        entry.register(master)
