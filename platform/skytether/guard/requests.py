"""A socket for people's requests within a loop that never waits: one request, one answer, both JSON.

Clients that say nothing cost nothing, and when there are too many the one that waited longest goes.
"""

from __future__ import annotations

import json
import os
import select
import socket
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress

from .descriptors import receive, refuse
from .folder import peer

_CLIENTS = 16
"""At the same time; people are few, and each needs a moment."""
_EACH_TURN = 4
"""Requests and new clients in one turn of a loop."""
_LARGEST = 4096
_STOP = b'{"do": "stop"'

Reply = Mapping[str, object]
Handler = Callable[[Mapping[str, object]], "Reply | Callable[[], Reply | None]"]
"""Gets a request; gives the answer, or something to be asked at every turn until it has one."""


def readable(sockets: Sequence[socket.socket], timeout_s: float) -> list[socket.socket]:
    """Those with something to take, or at their end. By `poll`: `select` knows no descriptor above 1,023."""
    looks = select.poll()
    by_number = {one.fileno(): one for one in sockets}
    for number in by_number:
        looks.register(number, select.POLLIN)
    return [by_number[number] for number, _ in looks.poll(timeout_s * 1000)]


class Requests:
    """The socket and its clients.

    Args:
        path: Of the socket; only the own user may open it.
        handle: What to do with a request.

    Raises:
        OSError: The path cannot be had.
    """

    def __init__(self, path: str, handle: Handler) -> None:
        self._handle = handle
        self._clients: dict[socket.socket, Callable[[], Reply | None] | None] = {}
        with suppress(FileNotFoundError):
            os.unlink(path)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.setblocking(False)
        refuse(self._listener)  # its clients are as it is
        before = os.umask(0o177)
        try:
            self._listener.bind(path)
        finally:
            os.umask(before)
        self._listener.listen(_CLIENTS)

    def sockets(self) -> list[socket.socket]:
        """What to wait for."""
        return [self._listener, *(client for client, pending in self._clients.items() if pending is None)]

    def turn(self) -> None:
        """Take what is there, answer what can be answered. Never waits."""
        for client, pending in list(self._clients.items()):
            answer = pending() if pending is not None else None
            if answer is not None:
                self._send(client, answer)
        for source in readable(self.sockets(), 0.0)[:_EACH_TURN]:
            if source is self._listener:
                self._accept()
            else:
                self._receive(source)

    def close(self) -> None:
        """Close all."""
        for client in [self._listener, *self._clients]:
            client.close()

    def _accept(self) -> None:
        for _ in range(_EACH_TURN):
            try:
                client, _ = self._listener.accept()
            except OSError:  # nobody more
                return
            client.setblocking(False)
            user = peer(client)
            if user not in (0, os.geteuid()):  # the path's mode says so too: two locks are better than one
                with suppress(OSError):
                    receive(client, _LARGEST)  # what was not read when a socket is closed takes the answer along
                self._send(client, {"refused": f"you are the user {user}, and only {os.geteuid()} and root may ask"})
                continue
            if len(self._clients) >= _CLIENTS:
                idle = [known for known, pending in self._clients.items() if pending is None]
                self._drop(next(iter(idle or self._clients)))
            self._clients[client] = None
            self._receive(client)

    def _receive(self, client: socket.socket) -> None:
        try:
            data, _, _ = receive(client, _LARGEST)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(client)
            return
        answer = self.answer(data)
        if callable(answer):
            self._clients[client] = answer
        else:
            self._send(client, answer)

    def answer(self, data: bytes) -> Reply | Callable[[], Reply | None]:
        """What a request gets; whatever it is, this does not raise."""
        try:
            asked = json.loads(data)
        except (ValueError, RecursionError):
            # Longer than what is read, perhaps; for its reason no stop is refused.
            asked = {"do": "stop"} if data.startswith(_STOP) else None
        if not isinstance(asked, dict) or not isinstance(asked.get("do"), str):
            return {"refused": 'the request must be JSON such as {"do": "status"}'}
        try:
            return self._handle(asked)
        except Exception as error:  # a bug in an answer must not stop the loop
            return {"refused": f"the request failed: {type(error).__name__}: {error}"}

    def _send(self, client: socket.socket, answer: Reply) -> None:
        with suppress(OSError, ValueError):  # who does not take the answer goes without
            client.send(json.dumps(answer, allow_nan=False).encode())
        self._drop(client)

    def _drop(self, client: socket.socket) -> None:
        self._clients.pop(client, None)
        client.close()
