"""What the guard is told when it starts: checked by the command that starts it, and frozen."""

from __future__ import annotations

import fcntl
import json
import os
from typing import NamedTuple

from .kinematics import Bounds
from .wheels import Address

_LARGEST = 1 << 20
_SEALS = fcntl.F_SEAL_SEAL | fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_WRITE


class Settings(NamedTuple):
    """All of it."""

    folder: str
    """Of the sockets and the emergency stop."""
    record: str
    """File of the event record."""
    period_s: float
    """Of the gate's loop [s]."""
    patience_s: float
    """Of guard, gate and writer with each other [s]."""
    bounds: Bounds
    wheels: Address | None
    """Where the guard writes velocities to; None: a writer does."""
    estop: Address | None
    """Where drivers send stops, for the gate; None: they are topics."""
    gate: tuple[str, ...]
    """The gate's command."""
    writer: tuple[str, ...]
    """The writer's command; empty: there is none."""
    config: int
    """File descriptor of the configuration of gate and writer."""
    enable: tuple[str, ...] = ()
    """Line of the enable signal, see `enable.open_line`; ``topic``: the writer publishes it; empty: there is none."""
    enable_after_s: float = 0.0
    """From the standstill that is told to the end of the enable signal [s]."""
    display: tuple[str, ...] = ()
    """Command of the process that shows people what the gate knows; empty: there is none."""
    say: tuple[str, ...] = ()
    """What the command that checked the configuration has to say; by the log, which is never waited for."""


def dump(settings: Settings) -> str:
    """As JSON."""
    return json.dumps(settings._asdict() | {"bounds": settings.bounds._asdict()}, allow_nan=False)


def load(text: str) -> Settings:
    """From `dump`.

    Raises:
        ValueError, TypeError, KeyError: It is not that.
    """
    found = json.loads(text)
    return Settings(
        folder=str(found["folder"]),
        record=str(found["record"]),
        period_s=float(found["period_s"]),
        patience_s=float(found["patience_s"]),
        bounds=Bounds(**{key: float(value) for key, value in found["bounds"].items()}),
        wheels=_address(found["wheels"]),
        estop=_address(found["estop"]),
        gate=tuple(found["gate"]),
        writer=tuple(found["writer"]),
        config=int(found["config"]),
        enable=tuple(found["enable"]),
        enable_after_s=float(found["enable_after_s"]),
        display=tuple(found["display"]),
        say=tuple(found["say"]),
    )


def _address(found: object) -> Address | None:
    if isinstance(found, list):
        return str(found[0]), int(found[1])
    return None if found is None else str(found)


def freeze(name: str, text: str) -> int:
    """A file in memory that nobody can change any more, for children too.

    Raises:
        OSError: The kernel does not make it.
    """
    file = os.memfd_create(name, os.MFD_ALLOW_SEALING)
    data = memoryview(text.encode())
    while data:
        data = data[os.write(file, data) :]
    fcntl.fcntl(file, fcntl.F_ADD_SEALS, _SEALS)
    os.set_inheritable(file, True)
    return file


def thaw(file: int) -> str:
    """What is in it; it may be read again."""
    data, size = b"", os.fstat(file).st_size
    while len(data) < min(size, _LARGEST):
        data += os.pread(file, _LARGEST, len(data))
    return data.decode()
