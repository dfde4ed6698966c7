"""Where the audit goes: a file that only grows and in which each line vouches for the one before, syslog, journald.

A line holds its number, the hash of the line before and its own, so that nobody changes or takes away one in the middle
unseen. Who may write to the file can still cut off its end or write all of it anew: a sink elsewhere, or the last hash
noted elsewhere, shows that.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import logging
import os
import re
import socket
import stat
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from skytether.guard.folder import check_listener

log = logging.getLogger(__name__)

START = "0" * 64
"""What the first line has as the hash of the one before."""
_FULL = 10_000_000
"""Bytes of a file; the next line begins another one. None is ever deleted here."""
_LONGEST = 65_536
"""Bytes of a line; ours are far shorter."""
_JOURNAL = "/run/systemd/journal/socket"
_NOTICE = 5
"""Severity of syslog and journald: normal, and of interest."""
_AUTHPRIV = 10
"""Facility of syslog: who did what."""


class AuditError(Exception):
    """A file of the audit is not what was written; the text says where."""


@dataclass(frozen=True)
class Checked:
    """What was found to be whole."""

    lines: int
    first: int
    """Number of the first line; more than 1: the files before it are elsewhere."""
    last_hash: str


def sealed(fields: dict[str, Any], number: int, before: str) -> dict[str, Any]:
    """A line that vouches for the one before."""
    line = {"n": number, "before": before, **fields}
    return {**line, "hash": _digest(line)}


def verify(file: Path, noted: str | None = None) -> Checked:
    """Look through an audit file and those that were full before it.

    Args:
        file: The newest.
        noted: A hash that one of the lines must have.

    Raises:
        AuditError: Something was changed, taken away or put in, or cannot be read.
    """
    try:
        return _verify(file, noted)
    except OSError as error:
        raise AuditError(f"{file} cannot be read: {error.strerror}") from error


def _verify(file: Path, noted: str | None) -> Checked:
    number, before, first = 0, "", 0
    seen = noted is None
    for path in (*_full(file), file):
        with path.open("rb") as lines:
            for at, text in enumerate(lines, start=1):
                line = _parsed(text)
                place = f"{path}, line {at}"
                if line is None or line["hash"] != _digest({k: v for k, v in line.items() if k != "hash"}):
                    raise AuditError(f"{place}: not as it was written")
                if text.removesuffix(b"\n") != _text(line):  # a key twice, say: the hash is of what JSON makes of it
                    raise AuditError(f"{place}: not as it was written")
                if not first:
                    first = line["n"]
                    if first == 1 and line["before"] != START:
                        raise AuditError(f"{place}: not as it was written")
                elif line["n"] != number + 1 or line["before"] != before:
                    raise AuditError(f"{place}: something is missing before it, or was put in")
                number, before = line["n"], line["hash"]
                seen = seen or before == noted
    if not first:
        raise AuditError(f"{file} holds no line")
    if not seen:
        raise AuditError(f"{file} holds no line with the hash {noted}: its end was cut off, or all of it written anew")
    return Checked(number - first + 1, first, before)


class ChainFile(logging.Handler):
    """The file. Mode 0600; only ever added to; a full one gets the next number as its ending, and none is deleted."""

    def __init__(self, path: Path, full: int = _FULL) -> None:
        """Open it and go on where it ends.

        Raises:
            OSError: It cannot be written, or another orchestrator writes it.
        """
        super().__init__()
        self._path = path
        self._most = full
        self._file = self._open()
        try:
            self._number, self._before = self._end()
        except OSError:
            self._file.close()
            raise

    def emit(self, record: logging.LogRecord) -> None:
        """Add a line; what cannot be written goes to the log, and the chain goes on without a gap."""
        try:
            if self._file.tell() >= self._most:
                self._next()
            line = sealed(json.loads(self.format(record)), self._number + 1, self._before)
            self._write(_text(line) + b"\n")
            self._number, self._before = line["n"], line["hash"]
        except OSError as error:
            log.error("the audit file %s takes no line (%s): %s", self._path, error.strerror, record.getMessage())

    def close(self) -> None:
        """Let go of it."""
        self._file.close()
        super().close()

    def _open(self) -> BinaryIO:
        flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
        file = open(os.open(self._path, flags, 0o600), "r+b", buffering=0)  # noqa: SIM115 (for as long as it runs)
        try:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise OSError(errno.EINVAL, "it is no plain file")
            os.fchmod(file.fileno(), 0o600)
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.close()
            raise OSError(error.errno, "another orchestrator writes it") from error
        except OSError:
            file.close()
            raise
        file.seek(0, os.SEEK_END)
        return file

    def _end(self) -> tuple[int, str]:
        """Number and hash of the last line; a file of another kind is put aside, half a line is taken off."""
        size = self._file.tell()
        self._file.seek(max(0, size - _LONGEST))
        tail = self._file.read(_LONGEST)
        whole, _, half = tail.rpartition(b"\n")
        if half:
            self._file.truncate(size - len(half))  # the machine went down while it was written
            log.warning("the last line of the audit file %s was cut off; it is taken away", self._path)
        self._file.seek(0, os.SEEK_END)
        if not whole:
            full = _full(self._path)
            line = _last(full[-1]) if full else None
            return (line["n"], line["hash"]) if line else (0, START)
        line = _parsed(whole.rpartition(b"\n")[2])
        if line is not None:
            return line["n"], line["hash"]
        aside = self._path.with_name(f"{self._path.name}.before-chain")
        self._path.replace(aside)
        log.warning("%s was written by an older version, and is %s now", self._path, aside)
        self._file.close()
        self._file = self._open()
        return 0, START

    def _next(self) -> None:
        names = _full(self._path)
        number = 1 + (_number_of(names[-1]) if names else 0)
        self._path.rename(self._path.with_name(f"{self._path.name}.{number:06d}"))
        self._file.close()
        self._file = self._open()

    def _write(self, line: bytes) -> None:
        """All of it, or nothing."""
        size = self._file.tell()
        if os.write(self._file.fileno(), line) != len(line):
            with suppress(OSError):
                self._file.truncate(size)
            self._file.seek(0, os.SEEK_END)
            raise OSError(errno.ENOSPC, "no space left")
        self._file.seek(0, os.SEEK_END)


class Sink(logging.Handler):
    """Datagrams to a log of the system or of another machine. Never waits: what is not taken is counted and told."""

    def __init__(self, address: str | tuple[str, int]) -> None:
        """``address``: of a socket of this machine, or an IP address and port.

        Raises:
            OSError: There is nobody.
        """
        super().__init__()
        self._address = address
        self._lost = 0
        self._socket = self._connected()

    def emit(self, record: logging.LogRecord) -> None:
        """Send a line; one attempt to find a log that was started anew."""
        data = self._datagram(self.format(record))
        for again in (True, False):
            try:
                self._socket.send(data)
            except OSError as error:
                if again and not isinstance(error, BlockingIOError):
                    with suppress(OSError):
                        self._socket.close()
                        self._socket = self._connected()
                    continue
                self._lost += 1
                if self._lost & (self._lost - 1) == 0:  # the 1st, 2nd, 4th, 8th
                    log.error("%d lines of the audit were not taken by %s", self._lost, self._address)
            return

    def close(self) -> None:
        """Let go of it."""
        self._socket.close()
        super().close()

    def _connected(self) -> socket.socket:
        family = socket.AF_UNIX if isinstance(self._address, str) else socket.AF_INET
        if not isinstance(self._address, str) and ":" in self._address[0]:
            family = socket.AF_INET6
        made = socket.socket(family, socket.SOCK_DGRAM)
        made.setblocking(False)
        try:
            if isinstance(self._address, str):
                check_listener(self._address, "the audit")
            made.connect(self._address)
        except OSError:
            made.close()
            raise
        return made

    def _datagram(self, text: str) -> bytes:
        """RFC 3164, as the C library writes to ``/dev/log`` and every syslog takes."""
        return f"<{_AUTHPRIV * 8 + _NOTICE}>skytether-audit: {text}".encode(errors="replace")


class Journal(Sink):
    """journald's own: https://systemd.io/JOURNAL_NATIVE_PROTOCOL/."""

    def __init__(self, address: str = _JOURNAL) -> None:
        """``address``: of its socket.

        Raises:
            OSError: It is not there.
        """
        super().__init__(address)

    def _datagram(self, text: str) -> bytes:
        fields = {
            "PRIORITY": str(_NOTICE),
            "SYSLOG_FACILITY": str(_AUTHPRIV),
            "SYSLOG_IDENTIFIER": "skytether-audit",
            **{
                f"SKYTETHER_{k.upper()}": str(v)
                for k, v in json.loads(text).items()
                if k in ("who", "address", "status")
            },
        }
        plain = "".join(f"{key}={value}\n" for key, value in fields.items() if "\n" not in value)
        return f"{plain}MESSAGE={text}\n".encode(errors="replace")


def _full(file: Path) -> list[Path]:
    """The files that were full, the oldest first."""
    name = re.compile(re.escape(file.name) + r"\.[0-9]{6,}")
    return sorted((path for path in file.parent.iterdir() if name.fullmatch(path.name)), key=_number_of)


def _number_of(path: Path) -> int:
    return int(path.name.rpartition(".")[2])


def _last(file: Path) -> dict[str, Any] | None:
    with file.open("rb") as lines:
        lines.seek(max(0, file.stat().st_size - _LONGEST))
        return _parsed(lines.read().rstrip(b"\n").rpartition(b"\n")[2])


def _parsed(text: bytes) -> dict[str, Any] | None:
    """A line; None: it is none of ours."""
    try:
        line = json.loads(text)
    except (ValueError, RecursionError):
        return None
    ours = isinstance(line, dict) and isinstance(line.get("n"), int)
    return line if ours and isinstance(line.get("hash"), str) and isinstance(line.get("before"), str) else None


def _text(line: dict[str, Any]) -> bytes:
    return json.dumps(line).encode()


def _digest(line: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(line, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
