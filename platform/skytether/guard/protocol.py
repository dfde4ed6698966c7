"""Bytes between guard, gate and writer: whole packets on socket pairs, and a velocity for the wheels. Pure.

All times are `clock.now` [s]. What the wheels were told is not in here, but on the board (`board.Board`).
"""

from __future__ import annotations

import struct
from math import nan
from typing import NamedTuple

from .velocity import STANDSTILL, Velocity

FIRST_ACT = "nobody has reset the robot since the machine was started"
"""Why a robot stands that nobody stopped."""
REASON_BYTES = 200
"""Of a reason; the rest is cut off."""
LARGEST = 512
"""Bytes of a packet between guard, gate and writer."""
NOTE_BYTES = 400
STOP_SOCKET = "stop.sock"
"""In the gate's folder: the guard's own way to stop the robot; one request and one answer, both JSON."""

_BEAT = struct.Struct("<4sdddIB")
_ANSWER = struct.Struct("<4sdIB")
_TWIST = struct.Struct("<4s6d")
_BEAT_MAGIC, _ANSWER_MAGIC, _NOTE_MAGIC = b"SkB3", b"SkA3", b"SkN3"
_ENABLE = (b"SkE3\x00", b"SkE3\x01")
_LITTLE_ENDIAN_CDR = b"\x00\x01\x00\x00"


class LastCommand(NamedTuple):
    """What the wheels were told last, and when; ``at`` is NaN if they never were."""

    velocity: Velocity = STANDSTILL
    at: float = nan


class Beat(NamedTuple):
    """What the gate tells the guard at every turn, and the guard a writer."""

    at: float
    velocity: Velocity
    """Wanted."""
    seen: int = 0
    """The newest generation of the emergency stop that the sender knows."""
    reset: bool = False
    """A person wants the emergency stop ``seen`` to end, and the button allows it."""
    stopped: str = ""
    """The sender's own emergency stop; empty: it has none."""


class Answer(NamedTuple):
    """What the guard answers, and a writer the guard."""

    at: float
    generation: int = 0
    """Counts the changes of the emergency stop."""
    kept: bool = True
    """The emergency stop is on disk as it is."""
    stopped: str = ""
    """Why the robot stands until a person resets it; of a writer why the wheels stand; empty: they need not."""


def pack_beat(beat: Beat) -> bytes:
    """For the guard or a writer."""
    head = _BEAT.pack(_BEAT_MAGIC, beat.at, *beat.velocity, beat.seen & 0xFFFFFFFF, beat.reset)
    return head + cut(beat.stopped, REASON_BYTES)


def unpack_beat(data: bytes) -> Beat | None:
    """None: the bytes are none."""
    if not _BEAT.size <= len(data) <= _BEAT.size + REASON_BYTES or data[:4] != _BEAT_MAGIC:
        return None
    _, at, linear, angular, seen, reset = _BEAT.unpack_from(data)
    return Beat(at, Velocity(linear, angular), seen, reset == 1, _text(data[_BEAT.size :]))


def pack_answer(answer: Answer) -> bytes:
    """For the gate or the guard."""
    head = _ANSWER.pack(_ANSWER_MAGIC, answer.at, answer.generation & 0xFFFFFFFF, answer.kept)
    return head + cut(answer.stopped, REASON_BYTES)


def unpack_answer(data: bytes) -> Answer | None:
    """None: the bytes are none."""
    if not _ANSWER.size <= len(data) <= _ANSWER.size + REASON_BYTES or data[:4] != _ANSWER_MAGIC:
        return None
    _, at, generation, kept = _ANSWER.unpack_from(data)
    return Answer(at, generation, kept == 1, _text(data[_ANSWER.size :]))


def pack_note(text: str) -> bytes:
    """Something that the gate wants in the guard's event record."""
    return _NOTE_MAGIC + cut(text, NOTE_BYTES)


def unpack_note(data: bytes) -> str | None:
    """None: the bytes are none."""
    return _text(data[4 : 4 + NOTE_BYTES]) if data[:4] == _NOTE_MAGIC else None


def pack_enable(*, high: bool) -> bytes:
    """A level of the enable signal, for the writer."""
    return _ENABLE[high]


def unpack_enable(data: bytes) -> bool | None:
    """None: the bytes are none."""
    return _ENABLE.index(data) == 1 if data in _ENABLE else None


def pack_twist(velocity: Velocity) -> bytes:
    """A geometry_msgs/msg/Twist as CDR, little endian."""
    return _TWIST.pack(_LITTLE_ENDIAN_CDR, velocity.linear, 0.0, 0.0, 0.0, 0.0, velocity.angular)


def cut(text: str, most: int) -> bytes:
    """At most so many bytes of UTF-8, whole characters; what is none (a lone surrogate) becomes a question mark."""
    return text.encode(errors="replace")[:most].decode(errors="ignore").encode()


def _text(data: bytes) -> str:
    return data.decode(errors="replace")
