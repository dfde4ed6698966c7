"""What runs in the processes of a measurement: one end of a transport, or the emulator between them.

Each talks with the harness through one pipe and ends when that is closed, so none outlives the harness.
"""

from __future__ import annotations

import heapq
import os
import resource
import signal
import struct
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from skytether.emulator.link_model import LinkConditions
from skytether.emulator.udp_link import LinkEmulator, keep_time
from skytether.lab.netns import enter
from skytether.lab.tun import TunEmulator

from .rows import Notes
from .traffic import HEADER_BYTES, Flow
from .transports import EndSpec, Transport, load

_HEADER = struct.Struct("<Qd")
"""Sequence and time of sending, at the start of each payload."""
_CONNECT_S = 15.0
_LOOK_S = 0.01
_DRAIN_S = 1.0
"""What has not arrived this long after the last message was sent counts as lost."""


@dataclass(frozen=True, slots=True)
class Order:
    """One measurement: send from ``begin`` to ``end``; what is sent from ``start`` on counts (monotonic seconds)."""

    flows: tuple[Flow, ...]
    begin: float
    start: float
    end: float


def run_end(pipe: Connection, transport: str, spec: EndSpec, namespace: str | None) -> None:
    """Be one end: start, report ``started`` and ``connected``, then measure on each order until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the harness decides when this ends
    with suppress(EOFError, BrokenPipeError):
        try:
            if namespace is not None:
                enter(namespace)
            end = _End(transport, spec)
        except Exception as error:
            pipe.send(error)
            return
        try:
            end.serve(pipe)
        finally:
            end.transport.stop()


class _End:
    def __init__(self, transport: str, spec: EndSpec) -> None:
        self._spec = spec
        self._received: dict[int, list[tuple[int, float, float]]] = {i: [] for i in spec.receives}
        self.transport: Transport = load(transport)(spec, self._deliver)

    def serve(self, pipe: Connection) -> None:
        try:
            self.transport.start()
            pipe.send("started")
            deadline = time.monotonic() + _CONNECT_S
            while not self.transport.connected():
                if time.monotonic() > deadline:
                    raise TimeoutError(f"the {self._spec.role}'s end did not connect within {_CONNECT_S:.0f} s")
                time.sleep(_LOOK_S)
            pipe.send("connected")
            while True:
                pipe.send(self._measure(pipe.recv()))
        except (EOFError, BrokenPipeError):
            raise
        except Exception as error:
            pipe.send(error)

    def _deliver(self, index: int, payload: bytes | memoryview) -> None:
        now = time.monotonic()
        sequence, sent_at = _HEADER.unpack_from(payload)
        self._received[index].append((sequence, sent_at, now))

    def _measure(self, order: Order) -> Notes:
        for arrivals in self._received.values():
            arrivals.clear()
        cpu: list[float] = []
        sent = publish(order, self._spec.sends, self.transport.publish, lambda: cpu.append(_cpu_seconds()))
        used = _cpu_seconds() - cpu[0]
        time.sleep(max(0.0, order.end + _DRAIN_S - time.monotonic()))
        return Notes(sent, {i: list(arrivals) for i, arrivals in self._received.items()}, used)


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
    keep_time()
    flows = order.flows
    bodies = {i: os.urandom(flows[i].size - HEADER_BYTES) for i in indices}
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
        payload = _HEADER.pack(len(times), now) + bodies[index]
        times.append(now)
        send(index, payload)
        heapq.heapreplace(schedule, (first[index] + len(times) / flows[index].hz, index))


def _cpu_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def run_emulator(pipe: Connection, kind: str, link: LinkConditions, options: dict[str, Any]) -> None:
    """Be the link: report how to reach it, then answer each question with its counters until the pipe closes.

    ``tun`` reports the paths of the robot's and the service's namespace, ``user`` its address.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(OSError):  # a link does not wait for a processor; without the privilege it sometimes must
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    with suppress(EOFError, BrokenPipeError):
        try:
            emulator: LinkEmulator | TunEmulator
            if kind == "tun":
                emulator = TunEmulator(up=link, down=link)
                for namespace in (emulator.robot, emulator.service):
                    namespace.sysctl("net.ipv4.tcp_congestion_control", options["congestion"])
            else:
                emulator = LinkEmulator(options["target"], up=link, down=link)
        except Exception as error:
            pipe.send(error)
            return
        with emulator:
            if isinstance(emulator, TunEmulator):
                pipe.send((emulator.robot.path, emulator.service.path))
            else:
                pipe.send(emulator.address)
            while True:
                pipe.recv()
                pipe.send(emulator.counters())
