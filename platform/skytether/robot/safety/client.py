"""What others say to the gate: the agent its velocities, people stop, reset and how is it."""

from __future__ import annotations

import errno
import json
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from skytether.guard.clock import now as boottime
from skytether.guard.descriptors import receive, refuse
from skytether.guard.folder import ROOM, check_listener, objection, peer, sender, trusted
from skytether.guard.protocol import STOP_SOCKET
from skytether.guard.requests import readable
from skytether.guard.velocity import Velocity

from .protocol import COMMAND_SOCKET, CONTROL_SOCKET, GateState, pack_command, unpack_state

_LARGEST_ANSWER = 256 * 1024
_LONGEST_REASON = 500
"""Characters that are sent; fewer are kept. Whatever they are, the request is smaller than what guard and gate read."""
_GUARD_S = 1.0
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
        self._folder = str(folder)
        self._address = str(folder / COMMAND_SOCKET)
        self._clock = clock
        self._epoch = time.monotonic_ns()
        self._sequence = 0
        self._state: GateState | None = None
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        refuse(self._socket)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        self._trusted: tuple[int, ...] = ()
        """Who may be the gate; empty: its folder has not been looked at."""
        self._socket.bind("")  # the kernel gives it a name, for the gate to answer to

    def send(self, velocity: Velocity, decided: bool = True) -> None:
        """Ask the gate for a velocity.

        Args:
            velocity: Wanted.
            decided: Whether a standstill is what somebody wants. One that is told because nothing better is known does
                not let this source drive after a reset.

        Raises:
            OSError: There is no gate, its queue is full, or anybody could be it.
        """
        if not self._trusted:
            if why := objection(self._folder):
                raise PermissionError(errno.EPERM, why)
            self._trusted = trusted(self._folder)
        check_listener(self._address, "the wheels")
        self.state()  # what is not taken in time would leave no room for newer ones
        self._sequence += 1
        self._socket.sendto(pack_command(self._epoch, self._sequence, self._clock(), velocity, decided), self._address)

    def state(self) -> GateState | None:
        """The newest that the gate answered; None: nothing yet. Its ``at`` says how old it is. Never waits."""
        for _ in range(_MOST_STATES):
            try:
                data, ancillary, name = receive(self._socket, _LARGEST_STATE, ROOM)
            except OSError:  # nothing waits
                break
            # The name of our socket is open to everybody; the gate's is not, but for who has folders of his own.
            if name == self._address and sender(ancillary)[0] in self._trusted:
                self._state = unpack_state(data) or self._state
        return self._state

    def now(self) -> float:
        """Now by the clock of guard and gate [s]."""
        return self._clock()

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def listens(folder: Path) -> bool:
    """Whether somebody has the folder's control socket: a gate, even if it hangs. Does not wait."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link:
        link.setblocking(False)
        try:
            link.connect(str(folder / CONTROL_SOCKET))
        except BlockingIOError:  # its queue is full
            return True
        except PermissionError:
            return True
        except OSError:
            return False
        return not _stranger(folder, link)


def ask(folder: Path, request: dict[str, Any], timeout: float = 3.0) -> dict[str, Any]:
    """Put a request to the gate: ``{"do": "status"}``, ``"reset"``, ``"start"``, or ``"stop"`` with a ``"reason"``.

    Returns:
        The gate's status; under ``guard`` the guard's, or None if that does not answer. Of a stop, the status of
        whoever keeps it, and a ``note`` if it is in effect but could not be kept.

    Raises:
        GateError: It does not answer, or answers no.
    """
    if request.get("do") == "stop":
        return stop(folder, str(request.get("reason") or ""), timeout)
    answer = _ask(folder / CONTROL_SOCKET, request, timeout)
    if request.get("do") == "status":
        try:
            answer["guard"] = _ask(folder / STOP_SOCKET, request, min(timeout, _GUARD_S))
        except GateError:
            answer["guard"] = None
    return answer


def stop(folder: Path, reason: str = "", timeout: float = 3.0) -> dict[str, Any]:
    """Emergency stop: asks guard and gate at once, so that one of them suffices.

    Returns:
        What the first says that has kept it; a ``note`` in it says that it is in effect, but could not be kept.

    Raises:
        GateError: Neither took it.
    """
    # In UTF-8: as escapes of JSON they would be twelve bytes each, and a request that is cut off is none.
    request = json.dumps({"do": "stop", "reason": reason[:_LONGEST_REASON]}, ensure_ascii=False).encode(
        errors="replace"
    )
    links: dict[socket.socket, Path] = {}
    errors: list[GateError] = []
    for path in (folder / STOP_SOCKET, folder / CONTROL_SOCKET):
        link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        link.setblocking(False)
        try:
            link.connect(str(path))
            link.send(request)  # in any case: to be asked to stop harms nobody
        except OSError as error:
            link.close()
            errors.append(_explained(path, error))
            continue
        if why := _stranger(folder, link):
            link.close()
            errors.insert(0, GateError(f"a stop was asked for, but whoever took it may not be the gate: {why}"))
        else:
            links[link] = path
    noted: dict[str, Any] | None = None
    end = time.monotonic() + timeout
    try:
        while links and (left := end - time.monotonic()) > 0:
            for link in readable(list(links), left):
                path = links.pop(link)
                with link:
                    try:
                        answer = _checked(path, link.recv(_LARGEST_ANSWER))
                    except (OSError, ValueError, GateError) as error:
                        errors.append(error if isinstance(error, GateError) else _explained(path, error))
                        continue
                if "note" not in answer:
                    return answer
                noted = answer
    finally:
        for link in links:
            link.close()
    if noted is not None:
        return noted
    raise errors[0] if errors else GateError(f"neither guard nor gate in {folder} answers within {timeout:g} s")


def _ask(path: Path, request: dict[str, Any], timeout: float) -> dict[str, Any]:
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link:
            link.settimeout(timeout)
            link.connect(str(path))
            if why := _stranger(path.parent, link):
                raise GateError(f"whoever listens at {path} may not be the gate: {why}")
            with suppress(BrokenPipeError):  # it may have refused us already, and said why
                link.send(json.dumps(request).encode())
            return _checked(path, link.recv(_LARGEST_ANSWER))
    except (OSError, ValueError) as error:
        raise _explained(path, error) from error


def _stranger(folder: Path, link: socket.socket) -> str:
    """Why the other end may not be the gate or the guard; empty: it is."""
    if why := objection(str(folder)):
        return why
    user = peer(link)
    return "" if user in trusted(str(folder)) else f"it is the user {user}, to whom {folder} does not belong"


def _checked(path: Path, data: bytes) -> dict[str, Any]:
    answer = json.loads(data)
    if not isinstance(answer, dict) or "refused" in answer:
        raise GateError(str(answer["refused"]) if isinstance(answer, dict) else f"{path} answers no JSON object")
    return answer


def _explained(path: Path, error: Exception) -> GateError:
    if isinstance(error, PermissionError):
        return GateError(f"{path} is not open to you: only the user that the gate runs as may ask it")
    if isinstance(error, FileNotFoundError | ConnectionRefusedError):
        return GateError(f"no gate listens at {path}; start it with: skytether robot gate robot.yaml")
    return GateError(f"the gate at {path} does not answer: {error}")
