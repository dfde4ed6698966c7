"""Keeps a node registered, whatever becomes of the master: level-triggered, in a thread of its own.

Each round asks whether the master knows this node. A restarted master does not: everything is registered again. A
master that is away is waited for; that is said once, and so is its return.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Protocol

from .master import Master, MasterError, RefusedError

_log = logging.getLogger(__name__)

LOOK_S = 1.0
"""Between looks at the master."""
_CLOSE_S = 5.0
"""For saying goodbye."""


class Entry(Protocol):
    """One registration."""

    def register(self, master: Master) -> None:
        """Tell the master; raises MasterError."""
        ...

    def unregister(self, master: Master) -> None:
        """Take it back; raises MasterError."""
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
        self._wanted: list[Entry] = []
        self._done: list[Entry] = []
        self._said = ""
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
            if self._done and self._master.knows(self._node) != self._uri():
                _log.warning("the ROS master at %s was restarted; registering again", self._master.uri)
                self._done.clear()
            self._settle()
        except MasterError as error:
            self.present = False
            self._say(f"no ROS master answers: {error}; waiting for it")
            return
        if self._said:
            _log.warning("the ROS master at %s answers", self._master.uri)
        self.present, self._said = True, ""

    def _settle(self) -> None:
        with self._changed:
            missing = [entry for entry in self._wanted if entry not in self._done]
            surplus = [entry for entry in self._done if entry not in self._wanted]
        if not missing and not surplus and not self._done:
            self._master.knows(self._node)  # whether it is there at all
        for entry in surplus:
            entry.unregister(self._master)
            self._done.remove(entry)
        for entry in missing:
            try:
                entry.register(self._master)
            except RefusedError as error:
                _log.error("the ROS master refuses: %s", error)
            self._done.append(entry)

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

    def _say(self, sentence: str) -> None:
        if not self._said:
            _log.warning("%s", sentence)
        self._said = sentence
