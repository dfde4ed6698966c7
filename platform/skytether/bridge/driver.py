"""What runs in a bridge's thread: a session, its sockets, its timer and its graph. Nothing here is thread-safe."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, cast

from skytether.wire import Session, Transmit
from skytether.wire.events import Connected, Disconnected, Event, MessageReceived
from skytether.wire.stats import SessionStats
from skytether.wire.topic import Role, Topic

from .calls import Calls
from .datagrams import Address, DatagramSocket
from .port import Port

_log = logging.getLogger(__name__)

_TURN = 8
"""Batches (of up to 64 kB) taken from the socket before something is sent again, and bursts sent before the socket is
looked at again: what the peer says of those before decides how the next are sent."""
OTHER_PORT_S = 5.0
"""Seconds of silence after which a path of the robot's end goes on from another port. A router, firewall or load
balancer that has noted the old one as leading nowhere keeps to that for as long as packets come from it."""


class Driver:
    """Drives a session: feed what came in, pass on events, send what may be sent, set the timer again.

    The robot's end has a socket for each path, the service's end one for all.

    Attributes:
        agreed: Topics that both ends know, by name; empty while no session is up. May be read from any thread.
    """

    def __init__(
        self, session: Session, sock: DatagramSocket, port: Port, calls: Calls, loop: asyncio.AbstractEventLoop
    ) -> None:
        """Prepare; `begin` starts the session in the loop's thread."""
        self.agreed: dict[str, Topic] = {}
        self._session = session
        self._sockets = {0: sock}
        self._service = session.role is Role.SERVICE
        self._port = port
        self._calls = calls
        self._loop = loop
        self._timer: asyncio.TimerHandle | None = None
        self._unsent: dict[int, deque[Transmit]] = {}
        """What a socket whose buffer is full has not taken yet."""
        self._errors: Counter[str] = Counter()
        """Of sockets that are closed."""
        self._complained: set[tuple[str, type[Exception]]] = set()
        self._silence_timer: asyncio.TimerHandle | None = None
        self._ports_since: dict[int, float] = {}
        """By path, when its socket took the place of another."""

    def begin(self) -> None:
        """First call, in the loop's thread."""
        if 0 in self._sockets:
            self._loop.add_reader(self._sockets[0], self._on_readable, 0)
        if not self._service:
            self._silence_timer = self._loop.call_later(OTHER_PORT_S, self._on_silence)
        self._advance()

    def open_path(self, path: int, sock: DatagramSocket, cost: int, peer: Address | None) -> None:
        """Use another network, by a socket that is closed with its path."""
        self._sockets[path] = sock
        self._loop.add_reader(sock, self._on_readable, path)
        self._session.open_path(path, time.monotonic(), cost=cost, peer=peer)
        self._advance()

    def close_path(self, path: int) -> None:
        """A network is gone."""
        self._close(path)
        self._session.close_path(path, time.monotonic())
        self._advance()

    def set_cost(self, path: int, cost: int) -> None:
        """Prefer a path less or more."""
        if path in self._sockets:
            self._session.open_path(path, time.monotonic(), cost=cost)
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
        if self._silence_timer is not None:
            self._silence_timer.cancel()
        for path in list(self._sockets):
            self._close(path)

    def stats(self) -> SessionStats:
        """A snapshot; what the system refused to send or receive is among the rejected packets."""
        stats = self._session.stats(time.monotonic())
        errors = sum((s.errors for s in self._sockets.values()), self._errors)
        refused = {f"socket_{name.lower()}": count for name, count in errors.items()}
        return replace(stats, rejected={**stats.rejected, **refused})

    def _close(self, path: int) -> None:
        sock = self._sockets.pop(path, None)
        self._unsent.pop(path, None)
        self._ports_since.pop(path, None)
        if sock is not None:
            self._loop.remove_reader(sock)
            self._loop.remove_writer(sock)
            self._errors += sock.errors
            sock.close()

    def _on_silence(self) -> None:
        """Have the paths on which nobody answers go on from other ports."""
        now = time.monotonic()
        due = now + OTHER_PORT_S
        for path in list(self._sockets):
            since = max(self._session.heard_at(path), self._ports_since.get(path, -math.inf))
            if now < since + OTHER_PORT_S:
                due = min(due, since + OTHER_PORT_S)
            elif (other := self._sockets[path].another()) is not None:
                self._close(path)
                self._sockets[path] = other
                self._ports_since[path] = now
                self._loop.add_reader(other, self._on_readable, path)
        self._silence_timer = self._loop.call_at(due, self._on_silence)
        self._advance()

    def _on_readable(self, path: int) -> None:
        by = None if self._service else path
        for left in reversed(range(_TURN)):
            sock = self._sockets.get(path)
            if sock is None or (batch := sock.receive(ahead=left > 0)) is None:
                break
            data, address, segment = batch
            self._session.receive(data, address, time.monotonic(), segment=segment, path=by, waited=sock.waited)
            self._pass_events()
            if sock.drained:
                break
        self._advance()

    def _on_timer(self) -> None:
        self._timer = None
        self._session.handle_timer(time.monotonic())
        self._advance()

    def _on_writable(self, path: int) -> None:
        self._loop.remove_writer(self._sockets[path])
        unsent = self._unsent.pop(path)
        while unsent:
            rest = self._send(path, unsent.popleft())
            if rest is not None:
                unsent.appendleft(rest)
                self._unsent[path] = unsent
                break
        self._advance()

    def _advance(self) -> None:
        """What every turn ends with."""
        self._pass_events()
        self._set_timer(self._transmit())

    def _pass_events(self) -> None:
        while (event := self._session.next_event()) is not None:
            if isinstance(event, MessageReceived):
                if not self._calls.deliver(event):
                    self._call(self._port.deliver, event)
                continue
            self._calls.notify(event)
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

    def _transmit(self) -> float | None:
        """Send what the session wants to send, as long as the socket takes it; returns when it wants to do more.

        While its buffer is full the session keeps the rest, so that what waits still waits by priority and age.
        """
        session, full = self._session, self._unsent
        for _ in range(_TURN):
            now = time.monotonic()
            batches = session.transmit(now, full)
            for batch in batches:
                path = 0 if self._service else batch.path
                if path in full:
                    full[path].append(batch)
                elif (rest := self._send(path, batch)) is not None:
                    full[path] = deque((rest,))
            due = session.next_timer(full)
            if not batches or due is None or due > now:
                break
        return due

    def _send(self, path: int, batch: Transmit) -> Transmit | None:
        """Hand a batch to a path's socket; returns what that does not take yet."""
        sock = self._sockets.get(path)
        if sock is None:
            return None
        done = sock.send(batch.data, cast(Address, batch.address), batch.segment)
        if sock.too_large is not None:
            self._session.shrink(batch.path, sock.too_large, time.monotonic())
            sock.too_large = None
        if done == len(batch.data):
            return None
        self._loop.add_writer(sock, self._on_writable, path)
        return batch._replace(data=memoryview(batch.data)[done:])

    def _set_timer(self, due: float | None) -> None:
        if self._timer is not None:
            if self._timer.when() == due:
                return
            self._timer.cancel()
            self._timer = None
        if due is not None:
            self._timer = self._loop.call_at(due, self._on_timer)
