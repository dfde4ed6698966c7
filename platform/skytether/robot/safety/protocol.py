"""Bytes between the agent and the gate on one machine, whose clock is the same for both, and where they meet."""

from __future__ import annotations

import os
import re
import struct
from dataclasses import dataclass
from enum import StrEnum
from hashlib import sha256
from pathlib import Path

from skytether.guard.velocity import Velocity
from skytether.robot.control.command import Command

_COMMAND = struct.Struct("<4sQQddd?")
_MAGIC = b"SkG2"
_STATE = struct.Struct("<4sdddd16s?")
_STATE_MAGIC = b"SkS2"
_REASON_BYTES = 200
"""Of a reason; the rest is cut off."""
COMMAND_SOCKET = "command.sock"
"""In the gate's folder: datagrams of `pack_command`."""
CONTROL_SOCKET = "control.sock"
"""In the gate's folder: one request and one answer, both JSON, on a connection."""
SENSORS_SOCKET = "sensors.sock"
ESTOP_SOCKET = "estop.sock"
WHEELS_SOCKET = "wheels.sock"
DISPLAY_SOCKET = "display.sock"
"""In the gate's folder: what the gate knows, for the process that draws it."""


@dataclass(frozen=True, slots=True)
class GateState:
    """What the gate tells the agent after each of its commands.

    Attributes:
        at: When it was said [s], by `skytether.guard.clock`.
        told: What the wheels were told last; standstill after a stall, a failed write, or with nobody there.
        told_at: When they were [s].
        stopped: Why the robot stands until a person resets it; empty: it does not.
        hand: Who drives: ``agent``, ``joystick``, ``nobody``.
        started: A person let the agent go on since it last had to be neutral.
    """

    at: float
    told: Velocity
    told_at: float
    stopped: str
    hand: str
    started: bool = False


def pack_state(state: GateState) -> bytes:
    """For the agent."""
    head = _STATE.pack(_STATE_MAGIC, state.at, *state.told, state.told_at, state.hand.encode(), state.started)
    return head + state.stopped.encode()[:_REASON_BYTES]


def unpack_state(data: bytes) -> GateState | None:
    """From the gate; None: the bytes are none."""
    if not _STATE.size <= len(data) <= _STATE.size + _REASON_BYTES or data[:4] != _STATE_MAGIC:
        return None
    _, at, linear, angular, told_at, hand, started = _STATE.unpack_from(data)
    reason = data[_STATE.size :].decode(errors="replace")
    name = hand.rstrip(b"\0").decode(errors="replace")
    return GateState(at, Velocity(linear, angular), told_at, reason, name, started)


def pack_command(epoch: int, sequence: int, sent_at: float, velocity: Velocity, decided: bool = True) -> bytes:
    """A velocity that the agent wants.

    Args:
        epoch: Higher for every start of the agent.
        sequence: Counts its commands.
        sent_at: By `skytether.guard.clock` [s].
        velocity: Wanted.
        decided: See `Command`.
    """
    return _COMMAND.pack(_MAGIC, epoch, sequence, sent_at, *velocity, decided)


def unpack_command(data: bytes, source: StrEnum, now: float) -> Command | None:
    """The command that arrived now from the agent; None: the bytes are none."""
    if len(data) != _COMMAND.size or data[:4] != _MAGIC:
        return None
    _, epoch, sequence, sent_at, linear, angular, decided = _COMMAND.unpack(data)
    return Command(source, linear, angular, epoch, sequence, sent_at, 0.0, now, decided=decided)


def default_folder() -> Path:
    """Where the sockets of a gate are unless it is told otherwise; ``SKYTETHER_GATE_FOLDER`` tells everybody.

    Never below a folder that all users share: another one could have been there before, and take a stop in our stead.
    """
    named = os.environ.get("SKYTETHER_GATE_FOLDER")
    return Path(named) if named else _usual_folder()


def _usual_folder() -> Path:
    if os.geteuid() == 0:
        return Path("/run/skytether")
    runtime = Path(os.environ.get("XDG_RUNTIME_DIR") or f"/run/user/{os.geteuid()}")
    if os.environ.get("XDG_RUNTIME_DIR") or runtime.is_dir():
        return runtime / "skytether"
    return _state_folder() / "gate"


def default_record() -> Path:
    """Where the event record is unless it is told otherwise: on a disk that a reboot leaves as it is.

    A gate in a folder of its own has one of its own: two in one file overwrite each other's events.
    """
    name = "safety-record"
    folder = default_folder().absolute()
    if folder != _usual_folder().absolute():
        told_apart = sha256(bytes(folder)).hexdigest()[:8]
        name = f"{name}-{re.sub('[^A-Za-z0-9_.-]', '_', folder.name)[:32]}-{told_apart}"
    if os.geteuid() == 0:
        return Path("/var/lib/skytether") / name
    own = os.environ.get("STATE_DIRECTORY")  # StateDirectory= of systemd: the service's own, and nobody else's
    if own:
        return Path(own.split(":")[0]) / name
    return _state_folder() / name


def _state_folder() -> Path:
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local/state") / "skytether"
