"""Where orchestrators are. A name that takes long to be resolved holds up nobody but whoever asks for it."""

from __future__ import annotations

import asyncio
import socket
from concurrent.futures import Future, ThreadPoolExecutor


class Names:
    """Resolves names, in threads of its own: for what an engine is asked there are few.

    Args:
        most: Names that are resolved at a time.
    """

    def __init__(self, most: int) -> None:
        self._threads = ThreadPoolExecutor(most, thread_name_prefix="names")
        self._asked: dict[str, Future[list[str]]] = {}

    @property
    def asked(self) -> set[str]:
        """Those that are being resolved, or wait for that."""
        return {name for name, one in self._asked.items() if not one.done()}

    async def find(self, host: str) -> list[str]:
        """Addresses of a name; of one it is asked once at a time, whoever waits no more.

        Raises:
            OSError: It has none.
        """
        asked = self._asked.get(host)
        if asked is None or asked.done():
            self._asked = {name: one for name, one in self._asked.items() if not one.done()}
            asked = self._asked[host] = self._threads.submit(_addresses, host)
        found = asyncio.wrap_future(asked)
        found.add_done_callback(lambda done: done.cancelled() or done.exception())  # nobody may wait by then
        return await asyncio.shield(found)

    def close(self) -> None:
        """Ask for nothing more."""
        self._threads.shutdown(wait=False, cancel_futures=True)


def _addresses(host: str) -> list[str]:
    found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    return list(dict.fromkeys(str(row[4][0]) for row in found))
