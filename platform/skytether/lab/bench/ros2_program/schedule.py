"""When messages are sent, and what every payload begins with: the same for each transport, under any Python."""

from __future__ import annotations

import heapq
import os
import resource
import struct
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

HEADER = struct.Struct("<Qd")
"""Sequence and time of sending, at the start of each payload."""
DRAIN_S = 1.0
"""What has not arrived this long after the last message was sent counts as lost."""


class Paced(Protocol):
    """What the schedule asks of a flow."""

    @property
    def size(self) -> int:
        """Payload in bytes."""

    @property
    def hz(self) -> float:
        """Messages a second."""


@dataclass(frozen=True)
class Order:
    """One measurement: send from ``begin`` to ``end``; what is sent from ``start`` on counts (monotonic seconds)."""

    flows: Sequence[Paced]
    begin: float
    start: float
    end: float


def publish(
    order: Order, indices: Sequence[int], send: Callable[[int, bytes], None], on_start: Callable[[], None]
) -> dict[int, list[float]]:
    """Send flows on their schedules from ``order.begin`` to ``order.end``.

    A message that is late is sent late, and none is left out while there is time.

    Args:
        order: What to send, and when.
        indices: Which of its flows to send.
        send: Called with index and payload.
        on_start: Called at ``order.start``.

    Returns:
        When each message was handed over, by flow and sequence.
    """
    flows = order.flows
    bodies = {i: os.urandom(flows[i].size - HEADER.size) for i in indices}
    sent: dict[int, list[float]] = {i: [] for i in indices}
    # The first messages are spread over the period, so that the topics do not march in step.
    first = {i: order.begin + i / len(flows) / flows[i].hz for i in indices}
    schedule = [(first[i], i) for i in indices]
    heapq.heapify(schedule)
    started = False
    while True:
        now = time.monotonic()
        if not started and now >= order.start:
            started = True
            on_start()
        if now >= order.end:
            return sent
        wake = order.end if started else order.start
        due, index = schedule[0] if schedule else (wake, -1)
        if due > now or index < 0:
            time.sleep(min(due, wake) - now)
            continue
        times = sent[index]
        payload = HEADER.pack(len(times), now) + bodies[index]
        times.append(now)
        send(index, payload)
        heapq.heapreplace(schedule, (first[index] + len(times) / flows[index].hz, index))


class Journal:
    """What one end notes of one measurement after the other.

    Attributes:
        received: Sequence, time sent and time received [s] of each arrival, by flow.
    """

    def __init__(self, receives: Sequence[int]) -> None:
        """For the flows that this end receives."""
        self.received: dict[int, list[tuple[int, float, float]]] = {i: [] for i in receives}

    def deliver(self, index: int, payload: bytes | memoryview, offset: int = 0) -> None:
        """Note an arrival; ``offset`` is where the payload begins."""
        now = time.monotonic()
        sequence, sent_at = HEADER.unpack_from(payload, offset)
        self.received[index].append((sequence, sent_at, now))

    def measure(
        self, order: Order, indices: Sequence[int], send: Callable[[int, bytes], None]
    ) -> tuple[dict[int, list[float]], float]:
        """Send what is ordered and wait for what is on the way.

        Returns:
            When each message was handed over, by flow; processor seconds of this process from start to end.
        """
        for arrivals in self.received.values():
            arrivals.clear()
        cpu: list[float] = []
        sent = publish(order, indices, send, lambda: cpu.append(_cpu_seconds()))
        used = _cpu_seconds() - cpu[0]
        time.sleep(max(0.0, order.end + DRAIN_S - time.monotonic()))
        return sent, used


def _cpu_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime
