"""What runs in a bridge's thread: a session, its socket, its timer and its graph. Nothing here is thread-safe."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, cast

from skytether.wire import Session
from skytether.wire.events import Connected, Disconnected, Event, MessageReceived
from skytether.wire.stats import SessionStats
from skytether.wire.topic import Topic

from .datagrams import Address, DatagramSocket
from .port import Port

_log = logging.getLogger(__name__)

_TURN = 8
"""Batches (of up to 64 kB) taken from the socket before something is sent again."""


class Driver:
    """Drives a session: feed what came in, pass on events, send what may be sent, set the timer again.

    Attributes:
        agreed: Topics that both ends know, by name; empty while no session is up. May be read from any thread.
    """

    def __init__(self, session: Session, sock: DatagramSocket, port: Port, loop: asyncio.AbstractEventLoop) -> None:
        """Prepare; `begin` starts the session in the loop's thread."""
        self.agreed: dict[str, Topic] = {}
        self._session = session
        self._socket = sock
        self._port = port
        self._loop = loop
        self._timer: asyncio.TimerHandle | None = None
        self._unsent: deque[tuple[memoryview, Address, int | None]] = deque()
        self._complained: set[tuple[str, type[Exception]]] = set()

    def begin(self) -> None:
        """First call, in the loop's thread."""
        self._loop.add_reader(self._socket, self._on_readable)
        self._advance()

    def publish(self, messages: Iterable[tuple[str, bytes, float]]) -> None:
        """Send messages: topic, payload, time of publishing."""
        for topic, payload, published_at in messages:
            self._session.publish(topic, payload, published_at)
        self._advance()

    def set_peer(self, address: Address) -> None:
        """Speak to another address."""
        self._session.set_peer(address)
        self._advance()

    def close(self) -> None:
        """Say goodbye and leave the loop."""
        self._session.close(time.monotonic())
        self._advance()
        self.agreed = {}
        if self._timer is not None:
            self._timer.cancel()
        self._loop.remove_reader(self._socket)
        self._loop.remove_writer(self._socket)

    def stats(self) -> SessionStats:
        """A snapshot; what the system refused to send or receive is among the rejected packets."""
        stats = self._session.stats(time.monotonic())
        refused = {f"socket_{name.lower()}": count for name, count in self._socket.errors.items()}
        return replace(stats, rejected={**stats.rejected, **refused})

    def _on_readable(self) -> None:
        for _ in range(_TURN):
            batch = self._socket.receive()
            if batch is None:
                break
            data, address, segment = batch
            self._session.receive(data, address, time.monotonic(), segment=segment)
            self._pass_events()
        self._advance()

    def _on_timer(self) -> None:
        self._timer = None
        self._session.handle_timer(time.monotonic())
        self._advance()

    def _on_writable(self) -> None:
        self._loop.remove_writer(self._socket)
        self._advance()

    def _advance(self) -> None:
        """What every turn ends with."""
        self._pass_events()
        self._transmit()
        self._set_timer()

    def _pass_events(self) -> None:
        while (event := self._session.next_event()) is not None:
            if isinstance(event, MessageReceived):
                self._call(self._port.deliver, event)
                continue
            if isinstance(event, Connected):
                self.agreed = {topic.name: topic for topic in event.topics}
            elif isinstance(event, Disconnected):
                self.agreed = {}
            self._call(self._port.notify, event)

    def _call(self, method: Callable[[Any], None], event: Event) -> None:
        """Call into the graph; its faults are its own."""
        try:
            method(event)
        except Exception as error:
            kind = (method.__name__, type(error))
            if kind not in self._complained:
                self._complained.add(kind)
                _log.exception("The graph's %s failed; the bridge goes on and does not repeat this", method.__name__)

    def _transmit(self) -> None:
        """Send what the session wants to send, as long as the socket takes it.

        While its buffer is full the session keeps the rest, so that what waits still waits by priority and age.
        """
        while True:
            while self._unsent:
                data, address, segment = self._unsent[0]
                done = self._socket.send(data, address, segment)
                if done < len(data):
                    self._unsent[0] = (data[done:], address, segment)
                    self._loop.add_writer(self._socket, self._on_writable)
                    return
                self._unsent.popleft()
            batches = self._session.transmit(time.monotonic())
            if not batches:
                return
            self._unsent.extend((memoryview(b.data), cast(Address, b.address), b.segment) for b in batches)

    def _set_timer(self) -> None:
        due = self._session.next_timer()
        if self._timer is not None:
            if self._timer.when() == due:
                return
            self._timer.cancel()
            self._timer = None
        if due is not None:
            self._timer = self._loop.call_at(due, self._on_timer)
