"""The gate's end: a snapshot now and then, which costs a turn little and is never waited for."""

from __future__ import annotations

import socket
from collections.abc import Callable

from skytether.guard.folder import check_listener

from .snapshot import Snapshot, pack

_MISSED_S = 10.0
"""Until nobody taking them is a trouble: a process that starts takes a second or two."""


class Feed:
    """Datagrams to the process that draws.

    Args:
        path: Where that listens.
        rate_hz: At most so many a second.
        now: [s]
    """

    def __init__(self, path: str, rate_hz: float, now: float) -> None:
        self.trouble = ""
        """Why nothing is shown; empty: all is well."""
        self._path = path
        self._period = 1 / rate_hz
        self._due = self._taken_at = now
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def turn(self, make: Callable[[], Snapshot], now: float) -> None:
        """Send one if it is time. Never raises."""
        if now < self._due:
            return
        self._due = now + self._period
        try:
            shown = pack(make())
            check_listener(self._path, "what the gate sees")
            self._socket.sendto(shown, self._path)
            self._taken_at, self.trouble = now, ""
        except Exception as error:  # whatever it is, the robot goes on
            if now - self._taken_at > _MISSED_S:
                why = getattr(error, "strerror", None) or str(error)
                self.trouble = f"zones are not shown (safety.display): the process that draws them takes nothing: {why}"

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
