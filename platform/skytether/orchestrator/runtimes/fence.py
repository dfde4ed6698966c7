"""Who may act at a process site, and who is just acting on which instance: by files that all orchestrators share.

An empty file has the epoch of the last leader that was here as its name; there may be earlier ones beside it. So to
lead nobody waits for anybody, who may be frozen. Another file is empty and only locked: for each instance one byte of
it, by whoever acts on that instance. An act takes its byte first, then reads the epoch, and keeps the byte until it is
done; so an act of an earlier leader is either over when the next one acts on the same instance, or refused. A leader
that is frozen in the middle of an act holds up that instance alone.

The locks are of the open file (fcntl(2), OFD): those of a program that was killed end with it, and two runtimes of one
program keep each other out, too. A process that is being started holds its starter's lock until it is itself.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from .base import OvertakenError, SiteSilentError

WAIT_S = 2.0
"""How long an act waits for another orchestrator's on the same instance: one that lasts longer hangs."""
_HUNG_S = 0.2
"""The same once it was seen that it hangs, for everything else at the site waits as well."""
_AGAIN_S = 0.005
_LOCK = "hhqqi4x"
"""``struct flock``: type, whence, start, length, process."""


class Fence:
    """That of one site, as one of its runtimes meets it."""

    def __init__(
        self,
        folder: Path,
        wait_s: float = WAIT_S,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """``folder``: of the site, the same for all orchestrators; ``wait_s``: patience with who acts [s]."""
        self._clock, self._sleep = clock, sleep
        self._epochs = folder / "epochs"
        self._locks = folder / "acts.lock"
        self._wait_s = wait_s
        self._epoch = 0
        """Of the leader who acts here; 0: whoever it is."""
        self._hung: set[int] = set()
        """Bytes that another orchestrator held for longer than it was waited."""

    def lead(self, epoch: int) -> None:
        """From now on act for the leader of this epoch, and let nobody act for an earlier one.

        Raises:
            OvertakenError: A leader of a later epoch was here.
            SiteSilentError: It cannot be written.
        """
        self._epoch = epoch
        self.must_lead()
        try:
            self._epochs.mkdir(mode=0o700, exist_ok=True)
            (self._epochs / str(epoch)).touch(mode=0o600)
            for earlier in self._told():
                if earlier < epoch:
                    (self._epochs / str(earlier)).unlink(missing_ok=True)
        except OSError as error:
            raise SiteSilentError(f"cannot write {self._epochs}, by which one leads here: {error}") from error
        self.must_lead()

    def must_lead(self) -> None:
        """See whether another leader was here.

        Raises:
            OvertakenError: One of a later epoch.
            SiteSilentError: It cannot be read.
        """
        try:
            latest = max(self._told(), default=0)
        except OSError as error:
            raise SiteSilentError(f"cannot read {self._epochs}, by which one leads here: {error}") from error
        if self._epoch and latest > self._epoch:
            raise OvertakenError.by_leader(self._epochs / str(latest), latest)

    def _told(self) -> list[int]:
        try:
            return [int(name) for name in os.listdir(self._epochs) if name.isdecimal()]
        except FileNotFoundError:
            return []

    @contextlib.contextmanager
    def acting(self, instance: str) -> Iterator[None]:
        """Around an act on an instance: nobody else acts on it meanwhile.

        Raises:
            OvertakenError: Another orchestrator leads by now.
            SiteSilentError: Another orchestrator is at it, and hangs.
        """
        with self._held(_byte_of(instance)):
            self.must_lead()
            yield

    def busy(self, instance: str) -> bool:
        """Whether anybody is acting on an instance."""
        asked = struct.pack(_LOCK, fcntl.F_WRLCK, os.SEEK_SET, _byte_of(instance), 1, 0)
        try:
            with self._locks.open("rb+") as file:
                told = fcntl.fcntl(file, fcntl.F_OFD_GETLK, asked)
        except FileNotFoundError:
            return False
        return bool(struct.unpack(_LOCK, told)[0] != fcntl.F_UNLCK)

    @contextlib.contextmanager
    def _held(self, byte: int) -> Iterator[None]:
        wanted = struct.pack(_LOCK, fcntl.F_WRLCK, os.SEEK_SET, byte, 1, 0)
        try:
            opened = os.open(self._locks, os.O_RDWR | os.O_CREAT, 0o600)
        except OSError as error:
            raise SiteSilentError(f"cannot open {self._locks}, without which nobody acts here: {error}") from error
        with open(opened, "rb+") as file:
            wait_s = min(self._wait_s, _HUNG_S) if byte in self._hung else self._wait_s
            deadline = self._clock() + wait_s
            while True:
                try:
                    fcntl.fcntl(file, fcntl.F_OFD_SETLK, wanted)
                    break
                except BlockingIOError:
                    pass
                if self._clock() > deadline:
                    self._hung.add(byte)
                    raise SiteSilentError(
                        f"another orchestrator has been at this instance for {self._wait_s:g} s: if it hangs, end it"
                    )
                self._sleep(_AGAIN_S)
            self._hung.discard(byte)
            yield


def _byte_of(instance: str) -> int:
    return 1 + int.from_bytes(hashlib.blake2b(instance.encode(), digest_size=7).digest(), "big")
