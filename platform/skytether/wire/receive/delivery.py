"""From authentic messages of topics to events: order, decompression, the sender's clock, counters.

What came by which path, and what a message tells about the peer's being there, is the session's business.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import replace

from ..codec.compression import FLAG, Packed, decompress, unpacked_size
from ..codec.frames import Forward
from ..codec.plaintext import INNER
from ..events import Event, MessageReceived
from ..measure.clock import ClockOffset
from ..state.epoch import Epoch, ReceiveTopic

COPY_BELOW = 4096
"""Payloads up to this size are handed over as bytes, larger ones as a view that saves the copy."""


class Delivery:
    """Hands the peer's messages to the application.

    Args:
        max_message: Bytes that a decompressed payload may have.
        events: Where messages go.
        rejected: Counters of what is refused.
    """

    def __init__(self, max_message: int, events: deque[Event], rejected: Counter[str]) -> None:
        self._max_message = max_message
        self._events = events
        self._rejected = rejected
        self._epoch: Epoch | None = None
        self.clock = ClockOffset()
        """The peer's, of the latest epoch."""

    def start_epoch(self, epoch: Epoch) -> None:
        """These keys are in use now; the peer may be another one, with another clock."""
        self._epoch = epoch
        self.clock = ClockOffset()

    def change_keys(self, epoch: Epoch) -> None:
        """The same peer has new keys."""
        self._epoch = epoch

    def end_epoch(self) -> None:
        """No keys are in use."""
        self._epoch = None

    def deliver_message(
        self, epoch: Epoch, topic: ReceiveTopic, plaintext: bytes, sequence: int, stamp: int, now: float
    ) -> None:
        """Take one authentic message, the first time that it is complete.

        Args:
            epoch: Under whose keys it came.
            topic: Its topic.
            plaintext: All of it.
            sequence: From its start.
            stamp: The same: time of publishing and whether it is compressed.
            now: Time.
        """
        if not topic.topic.reliable:
            size = len(plaintext) - INNER.size
            payload = plaintext[INNER.size :] if size <= COPY_BELOW else memoryview(plaintext)[INNER.size :]
            self._deliver(epoch, topic, sequence, stamp, payload, now)
        elif topic.reliable_receiver is None:
            self._rejected["epoch"] += 1
        else:
            for delivery in topic.reliable_receiver.receive_message(plaintext[INNER.size :], stamp, now):
                self._deliver(epoch, topic, *delivery, now)

    def forward(self, message: Forward, epoch: Epoch, now: float) -> None:
        """The sender gave up messages of a reliable topic: those after them need not wait any more."""
        topic = epoch.receive.get(message.topic)
        if topic is not None and topic.reliable_receiver is not None:
            topic.reliable_receiver.touch(now)
            for delivery in topic.reliable_receiver.forward(message.base):
                self._deliver(epoch, topic, *delivery, now)

    def expired(self, index: int) -> None:
        """A message of that topic stayed incomplete for too long."""
        topic = self._epoch.receive.get(index) if self._epoch is not None else None
        if topic is not None:
            topic.counters.expired += 1

    def _deliver(
        self, epoch: Epoch, topic: ReceiveTopic, sequence: int, stamp: int, payload: bytes | memoryview, now: float
    ) -> None:
        size = len(payload)
        if stamp & FLAG:
            grown = unpacked_size(payload, self._max_message)
            if grown is None:
                self._rejected["compressed"] += 1
                return
            payload, size = Packed(payload), grown
        micros, clock = stamp & ~FLAG, self.clock
        if epoch.belongs_with(self._epoch) and clock.known:
            sent_at = micros / 1e6 - clock.offset
            error = clock.error_at(sent_at)
        else:
            sent_at, error = now, math.inf
        if topic.topic.reliable:
            # How long ago a latched message was published tells nothing of the link.
            topic.delivered(size, now - sent_at, math.inf if topic.topic.latched else error, now)
        elif not topic.arrived(sequence, size, now - sent_at, error, self._outdated(epoch, topic.index), now):
            return
        self._events.append(MessageReceived(topic.name, payload, sequence, sent_at, error, now))

    def unpack(self, message: MessageReceived) -> MessageReceived | None:
        """The message as it was published; None (counted) if that cannot be had.

        Done when it is taken: of a thousand that a peer lets arrive at once, each of which grows to the largest that
        there is, one at a time is in memory.
        """
        if not isinstance(message.payload, Packed):
            return message
        whole = decompress(message.payload, self._max_message)
        if whole is None:
            self._rejected["compressed"] += 1
            return None
        return replace(message, payload=whole)

    def _outdated(self, epoch: Epoch, index: int) -> bool:
        """Whether a message of the keys before comes after a newer one under the present keys."""
        if self._epoch is None or epoch.belongs_with(self._epoch):
            return False
        present = self._epoch.receive.get(index)
        return present is not None and present.newest >= 0
