"""Names to addresses, without waiting longer than one can: half a minute, for a name server that does not answer.

Who asks here keeps leases and sessions, and has no half minute.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable

Address = tuple[str, int]
_MOST_ASKED = 8
"""Names that are asked for at the same time; a robot has one service, at one or two addresses."""


class Resolver:
    """Asks in threads of its own.

    Args:
        timeout: How long one answer is waited for [s]. An answer that comes later is there for the next who asks.
        ask: Finds the address of a host; raises OSError if there is none.
    """

    def __init__(self, timeout: float = 2.0, ask: Callable[[str], str] | None = None) -> None:
        self._timeout = timeout
        self._ask = ask or _ask
        self._lock = threading.Lock()
        self._asked: dict[str, _Question] = {}

    def address(self, host: str, port: int) -> Address:
        """The address of a host, anew each time; an address is given back as it is.

        Raises:
            ValueError: It has none, or nobody said so in time; the text says which.
        """
        if _is_address(host):
            return host, port
        with self._lock:
            question = self._asked.get(host)
            if question is None:
                if len(self._asked) >= _MOST_ASKED:
                    raise ValueError(
                        f"{host}: the name server does not answer, and was asked for too many names already"
                    )
                question = self._asked[host] = _Question(host, self._ask)
        if not question.answered.wait(self._timeout):
            raise ValueError(f"{host}: the name server does not answer; it is waited for in the background")
        with self._lock:
            self._asked.pop(host, None)
        if question.address is None:
            raise ValueError(f"{host} has no address: {question.error}")
        return question.address, port


class _Question:
    def __init__(self, host: str, ask: Callable[[str], str]) -> None:
        self.answered = threading.Event()
        self.address: str | None = None
        self.error = ""
        self._host, self._ask = host, ask
        threading.Thread(target=self._run, name="resolver", daemon=True).start()

    def _run(self) -> None:
        try:
            self.address = self._ask(self._host)
        except OSError as error:
            self.error = error.strerror or str(error)
        except UnicodeError:
            self.error = "it is not a valid name"
        self.answered.set()


def _ask(host: str) -> str:
    return str(socket.getaddrinfo(host, None, type=socket.SOCK_DGRAM)[0][4][0])


def _is_address(host: str) -> bool:
    try:
        socket.getaddrinfo(host, None, flags=socket.AI_NUMERICHOST)
    except (OSError, UnicodeError):
        return False
    return True
