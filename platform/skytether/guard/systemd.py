"""What the service manager is told (sd_notify(3))."""

from __future__ import annotations

import os
import socket


class Systemd:
    """Tells the service manager how it is going; without one does nothing."""

    def __init__(self) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET", "").replace("@", "\0", 1)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if self._address else None
        if self._socket is not None:
            self._socket.setblocking(False)

    def notify(self, state: str) -> None:
        """``READY=1``, ``WATCHDOG=1``, ``STOPPING=1``."""
        if self._socket is not None:
            try:
                self._socket.sendto(state.encode(), self._address)
            except OSError:  # a watchdog that does not hear us acts on that
                return

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
