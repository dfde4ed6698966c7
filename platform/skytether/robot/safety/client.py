"""What others say to the gate: the agent its velocities, people stop, reset and how is it."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from skytether.guard.clock import now as boottime
from skytether.guard.velocity import Velocity

from .protocol import COMMAND_SOCKET, CONTROL_SOCKET, GateState, pack_command, unpack_state

_LARGEST_ANSWER = 256 * 1024
_LARGEST_STATE = 512
_MOST_STATES = 600
"""Taken in one call; the kernel keeps as many as net.unix.max_dgram_qlen says, 10 or 512."""


class GateError(Exception):
    """The gate cannot be asked; the text says why and what to do."""


class GateLink:
    """The agent's end: sends velocities and never waits.

    Args:
        folder: The gate's.
        clock: Of guard and gate; replaced by tests only.
    """

    def __init__(self, folder: Path, clock: Callable[[], float] = boottime) -> None:
        self._address = str(folder / COMMAND_SOCKET)
        self._clock = clock
        self._epoch = time.monotonic_ns()
        self._sequence = 0
        self._state: GateState | None = None
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.bind("")  # the kernel gives it a name, for the gate to answer to

    def send(self, velocity: Velocity) -> None:
        """Ask the gate for a velocity.

        Raises:
            OSError: There is no gate, or its queue is full.
        """
        self.state()  # what is not taken in time would leave no room for newer ones
        self._sequence += 1
        self._socket.sendto(pack_command(self._epoch, self._sequence, self._clock(), velocity), self._address)

    def state(self) -> GateState | None:
        """The newest that the gate answered; None: nothing yet. Its ``at`` says how old it is. Never waits."""
        for _ in range(_MOST_STATES):
            try:
                data, sender = self._socket.recvfrom(_LARGEST_STATE)
            except OSError:  # nothing waits
                break
            if sender == self._address:  # the name of our socket is open to everybody, the gate's is not
                self._state = unpack_state(data) or self._state
        return self._state

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def ask(folder: Path, request: dict[str, Any], timeout: float = 3.0) -> dict[str, Any]:
    """Put a request to the gate: ``{"do": "status"}``, ``"reset"``, ``"start"``, or ``"stop"`` with a ``"reason"``.

    Raises:
        GateError: It does not answer, or answers no.
    """
    path = folder / CONTROL_SOCKET
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link:
            link.settimeout(timeout)
            link.connect(str(path))
            link.send(json.dumps(request).encode())
            answer = json.loads(link.recv(_LARGEST_ANSWER))
    except PermissionError as error:
        raise GateError(f"{path} is not open to you: only the user that the gate runs as may ask it") from error
    except (FileNotFoundError, ConnectionRefusedError) as error:
        raise GateError(f"no gate listens at {path}; start it with: skytether robot gate robot.yaml") from error
    except (OSError, ValueError) as error:
        raise GateError(f"the gate at {path} does not answer: {error}") from error
    if not isinstance(answer, dict) or "refused" in answer:
        raise GateError(answer["refused"] if isinstance(answer, dict) else f"{path} answers no JSON object")
    return answer
