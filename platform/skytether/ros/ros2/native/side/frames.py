"""What goes over the socket between the agent and the node: frames of a kind, for a channel.

A channel is one publisher, subscription, service or client; the agent numbers them from 1. Layout, little-endian:
uint32 length of the body, uint8 kind, uint32 channel, body. Bodies by kind:

- CONTROL: a JSON object; from the agent what to do, from the node what is;
- DATA: one serialised message;
- REQUEST, RESPONSE: uint64 number of the call, serialised request or response;
- FAILURE: uint64 number of the call, why it failed as UTF-8;
- FRESH: uint64 number of the message, float64 time of CLOCK_BOOTTIME, int64 for whom, serialised message, which is
  published until then or never, and to nobody who came later: for whom is how often somebody had come who is to hear a
  first word, or `FOR_ALL` or `FIRST_WORD`; from the node what `DealtWith` has, in this order: that message, and those
  before it, wait no more. A velocity of a subscription comes from the node as others go to it, and is taken until then
  or never.
"""

from __future__ import annotations

import json
import struct
from enum import IntEnum
from typing import Any, NamedTuple, Protocol

HEAD = struct.Struct("<IBI")
NUMBER = struct.Struct("<Q")
FOR_ALL, FIRST_WORD = -1, -2
"""Messages that go to whoever listens; the second is good as the first that somebody hears."""
FRESH = struct.Struct("<Qdq")
_DEALT_WITH = struct.Struct("<QQQQd?q")
SHUT_DOWN = 3
"""Exit code of the program whose ROS 2 was shut down under it."""
MAX_BODY = 512 * 1024 * 1024
"""Bytes; the largest message that a socket may carry."""


class Kind(IntEnum):
    """What a frame holds."""

    CONTROL = 0
    DATA = 1
    REQUEST = 2
    RESPONSE = 3
    FAILURE = 4
    FRESH = 5


class Frame(NamedTuple):
    """One frame."""

    kind: Kind
    channel: int
    body: bytes


class DealtWith(NamedTuple):
    """How far a node has come with the messages of `fresh` of a topic."""

    number: int
    """Of the last that it is done with, and with all before it."""
    newest: int
    """Of the last of those that was published; 0: none was."""
    heard: int
    """Of the last of these that all who listen have acknowledged, as far as they do that; 0: none is."""
    published: int
    """How many were."""
    unread_s: float
    """For how long all before are not acknowledged [s]."""
    hears: bool
    """Whether somebody listens, and everybody who does is known to hear, or has had the time to begin."""
    renewed: int
    """How often somebody began to listen who is to hear a first word."""


class Readable(Protocol):
    """A buffered stream of bytes."""

    def read(self, size: int, /) -> bytes:
        """So many bytes, or fewer at the end."""
        ...


def push_head(frame: Frame) -> bytes:
    """What goes before the body."""
    return HEAD.pack(len(frame.body), frame.kind, frame.channel)


def pull_frame(stream: Readable) -> Frame | None:
    """The next frame; None at the end, or where it is no frame."""
    head = stream.read(HEAD.size)
    if len(head) < HEAD.size:
        return None
    size, kind, channel = HEAD.unpack(head)
    if kind > max(Kind) or size > MAX_BODY:
        return None
    body = stream.read(size)
    return Frame(Kind(kind), channel, body) if len(body) == size else None


def control(**what: Any) -> Frame:
    """A frame of control."""
    return Frame(Kind.CONTROL, 0, json.dumps(what).encode())


def numbered(kind: Kind, channel: int, number: int, body: bytes) -> Frame:
    """A frame of a call."""
    return Frame(kind, channel, NUMBER.pack(number) + body)


def fresh(channel: int, number: int, until: float, renewed: int, body: bytes) -> Frame:
    """A frame of a message that is published until then [s], or never; and to nobody who came after so many."""
    return Frame(Kind.FRESH, channel, FRESH.pack(number, until, renewed) + body)


def pull_fresh(body: bytes) -> tuple[int, float, int, bytes]:
    """Number, time, for whom, and message of `fresh`."""
    return *FRESH.unpack_from(body), body[FRESH.size :]


def dealt_with(channel: int, done: DealtWith) -> Frame:
    """A frame of the node."""
    return Frame(Kind.FRESH, channel, _DEALT_WITH.pack(*done))


def pull_dealt_with(body: bytes) -> DealtWith:
    """What `dealt_with` has."""
    return DealtWith(*_DEALT_WITH.unpack(body))


def pull_number(body: bytes) -> tuple[int, bytes]:
    """Number and rest of a frame of a call."""
    return NUMBER.unpack_from(body)[0], body[NUMBER.size :]
