"""Where datagrams go: a path, or a host and a port."""

from __future__ import annotations

import os
import socket


def address(text: str) -> str | tuple[str, int]:
    """A socket's address: a path, or host and port.

    Raises:
        ValueError: It is neither.
    """
    kind, _, rest = text.partition(":")
    if kind == "unix" and rest:
        if len(os.fsencode(rest)) > 100:
            raise ValueError(f"'{text}' is longer than the 100 bytes that a socket's path may have")
        return rest
    host, _, port = rest.rpartition(":")
    if kind == "udp" and host and port.isascii() and port.isdigit() and 0 < int(port) < 65536:
        return host.strip("[]"), int(port)
    raise ValueError(f"must be unix:PATH or udp:HOST:PORT, not '{text}'")


def numeric(where: str | tuple[str, int]) -> str | tuple[str, int]:
    """The same with the address of a host instead of its name: who writes to it must not wait for a name server.

    Raises:
        OSError: The name is not known.
    """
    if isinstance(where, str):
        return where
    found = socket.getaddrinfo(*where, type=socket.SOCK_DGRAM)[0][4]
    return str(found[0]), where[1]
