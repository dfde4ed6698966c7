"""Datagram sockets of this machine to listen at.

The one at which stops arrive is bound by the guard, once, and handed to each gate; the guard does not read it. A press
that waits in it while a gate dies is thus there for the next one.
"""

from __future__ import annotations

import os
import socket
from contextlib import suppress

from .descriptors import refuse
from .wheels import Address, family_of

MODE = 0o660
"""Of a path: for the user and the group; who of the group is heard, `folder.Known` says."""


def bind(address: Address, mode: int = MODE) -> socket.socket:
    """A socket that never waits, and is told who sends.

    A path that is left from before is taken over, and has its mode from the beginning.

    Raises:
        OSError: The address cannot be had.
    """
    family = family_of(address)
    made = socket.socket(family, socket.SOCK_DGRAM)
    made.setblocking(False)
    if family == socket.AF_UNIX:
        refuse(made)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
    try:
        if isinstance(address, str):
            with suppress(FileNotFoundError):
                os.unlink(address)
            before = os.umask(0o777 & ~mode)
            try:
                made.bind(address)
            finally:
                os.umask(before)
        else:
            made.bind(address)
    except OSError:
        made.close()
        raise
    return made
