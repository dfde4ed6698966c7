"""Bytes between the agent, the gate and the guard on one machine, whose monotonic clock is the same for all."""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from skytether.control.admittance import Velocity
from skytether.robot.command import Command

_COMMAND = struct.Struct("<4sQQddd")
_MAGIC = b"SkG1"
_BEAT = struct.Struct("<4sddd")
COMMAND_SOCKET = "command.sock"
"""In the gate's folder: datagrams of `pack_command`."""
CONTROL_SOCKET = "control.sock"
"""In the gate's folder: one request and one answer, both JSON, on a connection."""
SENSORS_SOCKET = "sensors.sock"
WHEELS_SOCKET = "wheels.sock"


@dataclass(frozen=True, slots=True)
class Beat:
    """What the gate tells the guard at every turn."""

    at: float
    velocity: Velocity


def pack_command(epoch: int, sequence: int, sent_at: float, velocity: Velocity) -> bytes:
    """A velocity that the agent wants.

    Args:
        epoch: Higher for every start of the agent.
        sequence: Counts its commands.
        sent_at: Monotonic seconds.
        velocity: Wanted.
    """
    return _COMMAND.pack(_MAGIC, epoch, sequence, sent_at, *velocity)


def unpack_command(data: bytes, source: StrEnum, now: float) -> Command | None:
    """The command that arrived now from the agent; None: the bytes are none."""
    if len(data) != _COMMAND.size or data[:4] != _MAGIC:
        return None
    _, epoch, sequence, sent_at, linear, angular = _COMMAND.unpack(data)
    return Command(source, linear, angular, epoch, sequence, sent_at, 0.0, now)


def pack_beat(beat: Beat) -> bytes:
    """For the guard."""
    return _BEAT.pack(_MAGIC, beat.at, *beat.velocity)


def unpack_beat(data: bytes) -> Beat | None:
    """From the gate; None: the bytes are none."""
    if len(data) != _BEAT.size or data[:4] != _MAGIC:
        return None
    _, at, linear, angular = _BEAT.unpack(data)
    return Beat(at, Velocity(linear, angular))


def default_folder() -> Path:
    """Where the sockets of a gate are unless it is told otherwise."""
    if os.geteuid() == 0:
        return Path("/run/skytether")
    return Path(os.environ.get("XDG_RUNTIME_DIR") or f"/tmp/skytether-{os.geteuid()}") / "skytether"  # noqa: S108
