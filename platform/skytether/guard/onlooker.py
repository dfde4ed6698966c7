"""A process that only shows what others do: nothing depends on it, and nothing is ever waited for on its account."""

from __future__ import annotations

from collections.abc import Sequence

from .child import Child, StartError
from .descriptors import receive
from .log import Log

_LOOK_S = 0.5
_AGAIN_S = 10.0
"""Between starts."""
_PACKETS = 64


class Onlooker:
    """Starts it, and starts it anew.

    Args:
        name: For people.
        command: Its arguments; empty: there is none.
        config: File descriptor of its configuration.
        log: For people.
    """

    def __init__(self, name: str, command: Sequence[str], config: int, log: Log) -> None:
        self.trouble = ""
        """Why it does not run; empty: it does."""
        self._name = name
        self._command = command
        self._config = config
        self._log = log
        self._child: Child | None = None
        self._dead: list[Child] = []
        self._look_at = self._start_at = 0.0

    def turn(self, now: float) -> None:
        """Look after it now and then."""
        if not self._command or now < self._look_at:
            return
        self._look_at = now + _LOOK_S
        self._dead = [child for child in self._dead if not child.reaped()]
        if self._child is None:
            if now >= self._start_at:
                self._start_at = now + _AGAIN_S
                try:
                    self._child = Child(self._name, self._command, self._config, now)
                except StartError as error:
                    self.trouble = f"the {self._name} cannot be started: {error}"
                    self._log.trouble(self._name, self.trouble, now)
            return
        self._receive(self._child, now)
        why = self._child.ended(now)
        if why:
            self.trouble = f"the {self._name} {why}; the robot goes on, and it is started anew"
            self._log.trouble(self._name, self.trouble, now)
            self._child.end()
            self._dead.append(self._child)
            self._child = None

    def leave(self) -> None:
        """Have it end in order."""
        self._command = ()
        if self._child is not None:
            self._child.socket.close()

    def end(self) -> None:
        """End it."""
        if self._child is not None:
            self._child.end()

    def _receive(self, child: Child, now: float) -> None:
        for _ in range(_PACKETS):
            try:
                data = receive(child.socket, 1)[0]
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                child.gone = True
                return
            child.heard_at, self.trouble = now, ""
