"""What stands behind a service's topics: mailboxes that the bridge's thread fills, senders that it empties.

The bridge's thread puts bytes into a mailbox and is gone; they are decoded when the service looks, in the service's
own thread. So a service that steps at 10 Hz does not pay for a topic of 100 Hz, and no large message delays the bridge.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

from skytether.messages import DecodeError, Encoding, Message, decode, encode
from skytether.wire.events import MessageReceived

if TYPE_CHECKING:
    from skytether.bridge.port import Publisher

M = TypeVar("M", bound=Message)


@dataclass(frozen=True, slots=True)
class Arrived:
    """When and as which one a message came. All times are seconds of this machine's monotonic clock."""

    sequence: int
    """Per topic and connection, from 0; gaps are what the link lost."""
    sent_at: float
    """When the robot published it; known to within ``sent_at_error``."""
    sent_at_error: float
    received_at: float

    @property
    def made_at(self) -> float:
        """When it was published, or arrived as long as the robot's clock is not known; never later than it arrived.

        What pretends to be of the future would be new for ever.
        """
        known = math.isfinite(self.sent_at_error)
        return min(self.sent_at, self.received_at) if known else self.received_at

    def age(self, now: float) -> float:
        """Seconds since it was published; since it arrived as long as the robot's clock is not known."""
        return now - (self.sent_at if math.isfinite(self.sent_at_error) else self.received_at)


@dataclass(frozen=True, slots=True)
class Received(Arrived, Generic[M]):
    """One message of a typed topic."""

    message: M


@dataclass(frozen=True, slots=True)
class RawReceived(Arrived):
    """One message of any topic, as the bytes that came."""

    topic: str
    type: str
    encoding: Encoding
    payload: bytes
    hash: str = ""
    """Of the type, as the robot says; empty if it does not."""
    definition: str = ""
    """Of a type that the robot's graph alone knows, as its publisher tells it."""


class Mailbox(Generic[M]):
    """The newest message of one topic."""

    def __init__(self, topic: str, cls: type[M], log: logging.Logger, max_bytes: int | None = None) -> None:
        self.topic = topic
        self.max_bytes = max_bytes
        """Larger messages are not decoded."""
        self.undecodable = 0
        """Messages looked at that were none of this type, or too large."""
        self._cls = cls
        self._log = log
        self._slot: tuple[MessageReceived, Encoding] | None = None  # the bridge's thread replaces it as a whole
        self._read: tuple[MessageReceived, Encoding] | None = None
        self._latest: Received[M] | None = None
        self._taken: Received[M] | None = None

    @property
    def latest(self) -> Received[M] | None:
        """The newest message that could be decoded, however old; None before the first."""
        slot = self._slot
        if slot is not None and slot is not self._read:
            self._read = slot
            self._decode(*slot)
        return self._latest

    def take(self) -> Received[M] | None:
        """The newest message if it was not taken yet, else None."""
        latest = self.latest
        if latest is self._taken:
            return None
        self._taken = latest
        return latest

    def put(self, message: MessageReceived, encoding: Encoding) -> None:
        """From the bridge's thread: replace what waits here."""
        self._slot = (message, encoding)

    def _decode(self, received: MessageReceived, encoding: Encoding) -> None:
        try:
            if self.max_bytes is not None and len(received.payload) > self.max_bytes:
                raise DecodeError(f"{len(received.payload)} bytes, more than the {self.max_bytes} that are looked at")
            message = decode(self._cls, received.payload, encoding)
        except DecodeError as error:
            self.undecodable += 1
            if self.undecodable == 1:
                self._log.warning("topic %s: %s; more of these are counted, not logged", self.topic, error)
            return
        self._latest = Received(
            received.sequence, received.sent_at, received.sent_at_error, received.received_at, message
        )


class RawQueue:
    """Everything that arrived and was not read yet, of every topic that no typed input takes."""

    def __init__(self, max_messages: int, max_bytes: int) -> None:
        self.dropped = 0
        """Oldest messages given up because nobody read in time."""
        self._max_messages = max_messages
        self._max_bytes = max_bytes
        self._put_bytes = 0
        self._taken_bytes = 0
        self._dropped_bytes = 0
        self._queue: deque[RawReceived] = deque()

    def __len__(self) -> int:
        return len(self._queue)

    def take(self) -> RawReceived | None:
        """The oldest unread message, or None."""
        try:
            message = self._queue.popleft()
        except IndexError:
            return None
        self._taken_bytes += len(message.payload)
        return message

    def put(
        self,
        received: MessageReceived,
        type_name: str,
        encoding: Encoding,
        type_hash: str = "",
        definition: str = "",
    ) -> None:
        """From the bridge's thread: append, and drop the oldest beyond the bounds."""
        payload = bytes(received.payload)
        self._put_bytes += len(payload)
        self._queue.append(
            RawReceived(
                received.sequence,
                received.sent_at,
                received.sent_at_error,
                received.received_at,
                received.topic,
                type_name,
                encoding,
                payload,
                type_hash,
                definition,
            )
        )
        # Each counter has one writing thread, so no lock: what the reader takes meanwhile only makes more room.
        while len(self._queue) > self._max_messages or self._waiting() > self._max_bytes:
            try:
                oldest = self._queue.popleft()
            except IndexError:
                break
            self._dropped_bytes += len(oldest.payload)
            self.dropped += 1

    def _waiting(self) -> int:
        """Bytes in the queue."""
        return self._put_bytes - self._taken_bytes - self._dropped_bytes


class Sender(Generic[M]):
    """The way out of one topic."""

    def __init__(self, topic: str, cls: type[M]) -> None:
        self.topic = topic
        self.encoding: Encoding | None = None
        """As the robot wants it; None while there is no robot, or one that does not take this topic."""
        self.publisher: Publisher | None = None
        """The bridge, once it is attached."""
        self._cls = cls

    @property
    def type_name(self) -> str:
        """Of its messages."""
        return self._cls.TYPE

    def publish(self, message: M) -> bool:
        """Send to the robot; encoded here, in the caller's thread.

        Returns:
            False if no robot is connected, or it does not take this topic.

        Raises:
            TypeError: The message is of another type than the topic.
            EncodeError: A value in it does not fit its type.
        """
        if type(message) is not self._cls:
            raise TypeError(f"topic {self.topic} carries {self._cls.TYPE}, not {type(message).__name__}")
        publisher, encoding = self.publisher, self.encoding
        if publisher is None or encoding is None:
            return False
        return publisher.publish(self.topic, encode(message, encoding))
