"""One end of one session: puts the parts together and keeps its time."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Container, Hashable, Sequence

from .codec import frames
from .codec.ciphers import HandshakeTags
from .codec.compression import Compressed, compress
from .codec.crypto import KEY_SIZE, TAG_SIZE
from .codec.frames import Forward, Goodbye, Ping, Report
from .codec.negotiation import index_topics
from .codec.plaintext import INNER
from .config import Config
from .connect.handshake import HandshakeResponder
from .connect.handshake_driver import HandshakeDriver, HandshakeMessage
from .connect.paths import Paths
from .connect.reconnect import Reconnector
from .events import Connected, Disconnected, Event, MessageReceived
from .path.path import Path, Transmit
from .receive.delivery import Delivery
from .receive.receiver import AuthenticMessage, Receiver
from .send.sender import Sender
from .state.epoch import Epoch
from .state.epochs import Epochs
from .state.reliable_topics import ReliableTopics
from .state.topic_counters import TopicCounters
from .stats import SessionStats
from .topic import ANY, Role, Topic

GOODBYES = 3
"""Nobody asks for a lost goodbye."""


class Session:
    """Sans-IO: whoever owns it feeds datagrams and time, drains `next_event`, sends what `transmit` returns.

    After every call: drain `next_event` until None, call `transmit` until it returns nothing, then arrange for
    `handle_timer` (and again these two) at `next_timer`. Not thread-safe.
    """

    def __init__(
        self,
        role: Role,
        session_id: int,
        key: bytes,
        topics: Sequence[Topic],
        *,
        config: Config | None = None,
        entropy: Callable[[int], bytes],
        now: float,
    ) -> None:
        """Make one end; the robot's begins to speak once it has an address (`set_peer`).

        Args:
            role: Which end.
            session_id: 64 bits, the same at both ends.
            key: 32 bytes, the same at both ends.
            topics: This end's table. A service's row named ``*`` takes any topic a robot offers.
            config: Settings of this end.
            entropy: Cryptographically strong random bytes (``os.urandom``).
            now: Seconds of a monotonic clock, not negative.

        Raises:
            ValueError: Id, key or topics cannot be used.
        """
        if not 0 <= session_id < 2**64:
            raise ValueError("session id must have 64 bits")
        if len(key) != KEY_SIZE:
            raise ValueError(f"session key must have {KEY_SIZE} bytes, not {len(key)}")
        self.role = role
        self.session_id = session_id
        self._table = index_topics(topics)
        self._config = config or Config()
        self._events: deque[Event] = deque()
        first = Path(0, self._config, now)
        self._sender = Sender(self._config, first)
        self._paths = Paths(self._config, first, self._sender, self._events, entropy, now)
        self._peer: Hashable | None = None
        self._rejected: Counter[str] = Counter()
        self._delivery = Delivery(self._config.max_message, self._events, self._rejected)
        service = role is Role.SERVICE
        hello_tags, welcome_tags = HandshakeTags(key, b"hello"), HandshakeTags(key, b"welcome")
        self._receiver = Receiver(
            session_id if service else None, hello_tags if service else welcome_tags, self._config, self._paths.get,
            self._find_epoch, self._delivery.expired, self._rejected,
        )  # fmt: skip
        self._counters = TopicCounters(role)
        self._reliable = ReliableTopics(role, topics, self._config.queue_limit, self._counters)
        self._responder = HandshakeResponder(key, self._table, entropy) if service else None
        self._reconnector = Reconnector(session_id, key, topics, self._config, entropy)
        self._driver = HandshakeDriver(
            self._responder, self._reconnector, self._paths, self._sender, self._counters,
            welcome_tags if service else hello_tags, self._events, self._rejected,
        )  # fmt: skip

        self._epochs = Epochs(self._config.old_keys)
        self._connected = False
        self._closed = False
        self._handshakes = 0
        self._last_heard = math.nan
        self._sweep_at = math.inf
        self._report_at = math.inf
        self._rekey_at = math.inf
        self._check_at = math.inf

    # --- what the application calls

    def publish(self, topic: str, payload: bytes | memoryview, now: float) -> bool:
        """Queue one message; ``now`` is its time of publishing.

        A message of a reliable topic is kept until the peer has it or its lifespan is over, also when no session is up.

        Returns:
            False if it was dropped: no session is up, the peer's table does not have the topic, or a reliable
            topic is full of messages that the peer has not acknowledged.

        Raises:
            KeyError: The topic is not in this end's table, or this end does not send it.
            ValueError: The payload is larger than ``Config.max_message``.
        """
        epoch = self._epochs.current
        sender = epoch.send.get(topic) if epoch is not None else None
        reliable = (
            self._reliable.sender(topic) if epoch is None else sender.reliable_sender if sender is not None else None
        )
        if self._closed or (reliable is None and (sender is None or not self._connected)):
            ours = self._table.get(topic)
            if ours is None or ours.direction.sender is not self.role:
                raise KeyError(f"topic '{topic}' is not one that this end ({self.role}) sends")
            self._counters.refuse(topic)
            return False
        if not isinstance(payload, bytes):
            payload = bytes(payload)
        if len(payload) > self._config.max_message:
            raise ValueError(
                f"topic '{topic}': {len(payload)} bytes are more than a message may have, {self._config.max_message}"
            )
        row = sender or reliable
        if row is not None and row.topic.compression and not isinstance(payload, Compressed):
            payload = compress(payload)
        if reliable is not None:
            accepted = self._reliable.put(reliable, payload, now)
            self._queue_woken()
            return accepted
        if sender is not None:
            sender.counters.offered += 1
            self._sender.queue_message(sender, payload, now)
        return True

    def set_peer(self, address: Hashable, path: int | None = None) -> None:
        """Where the robot's end speaks to from now on (the service was restarted elsewhere).

        Args:
            address: Of the service's end.
            path: As seen from this path only; None: from all, those to come included.
        """
        if path is None:
            self._peer = address
        for each in self._paths:
            if path in (None, each.id):
                each.peer = each.address = address
                each.validation.clear()
        if self._responder is None and not self._closed:
            self._reconnector.set_peers({p.peer for p in self._paths}, connected=self._epochs.current is not None)

    def open_path(self, path: int, now: float, *, cost: int = 0, peer: Hashable | None = None) -> None:
        """Add a path from the robot's end, or change its cost; path 0 is there from the beginning.

        Raising the cost of the path in use is a planned switch: traffic goes over both paths for a while.

        Args:
            path: 0 to 255; an id used before should not come again soon.
            now: Time.
            cost: 0 to 255; of paths that are as good as each other the cheapest is used.
            peer: Where the service is, seen from this path, if not where `set_peer` says.

        Raises:
            ValueError: A number is out of its range.
        """
        if not (0 <= path < 256 and 0 <= cost < 256):
            raise ValueError(f"path and cost must be 0 to 255, not {path} and {cost}")
        known = self._paths.get(path) is not None
        opened = self._paths.open(path, cost, now)
        if not known:
            opened.peer = opened.address = self._peer if peer is None else peer
            self._reconnector.peers.add(opened.peer)
        for each in self._paths:
            self._paths.ping(each, now)
        self._paths.choose(now)

    def rekey(self, now: float) -> None:
        """Ask for new keys at once; the robot's end does so by itself as ``Config.rekey_after`` and others say.

        Raises:
            ValueError: This is the service's end, which never asks.
        """
        if self._responder is not None:
            raise ValueError("only the robot's end asks for new keys")
        self._reconnector.rekey(now)

    def close_path(self, path: int, now: float) -> None:
        """The path is gone. The last one stays until another is opened."""
        self._paths.close(path, now)

    def heard_at(self, path: int) -> float:
        """When the peer was heard by a path, or it was opened; minus infinity: there is no such path."""
        known = self._paths.get(path)
        return known.heard_at if known is not None else -math.inf

    def shrink(self, path: int, size: int, now: float) -> None:
        """The system refused to send a datagram of ``size`` bytes: too large for the path."""
        known = self._paths.get(path)
        if known is not None:
            known.mtu.refuse(size, now)

    def close(self, now: float) -> None:
        """Say goodbye. Call `transmit` once more to send it; then the session is over."""
        if self._closed:
            return
        if self._epochs.current is not None:
            self._report(now)
            for _ in range(GOODBYES):
                self._sender.queue_frame(frames.push_goodbye(), now)
        self._closed = True
        if self._connected:
            self._disconnect("closed")

    def stats(self, now: float) -> SessionStats:
        """A snapshot of all counters, both directions."""
        clock = self._delivery.clock
        table = dict(self._table)
        if self._epochs.current is not None:
            for receiver in self._epochs.current.receive.values():
                receiver.settle(now)
            table.update((t.name, t) for t in self._epochs.current.topics)
        table.pop(ANY, None)
        rejected = Counter(self._rejected)
        if self._receiver.messages.evicted:
            rejected["evicted"] = self._receiver.messages.evicted
        paths = self._paths.stats(*self._counters.overhead(), now)
        return SessionStats(
            self._connected, self._counters.stats(table), paths, dict(rejected), clock.offset,
            clock.error_at(now), self._handshakes, now - self._last_heard, self._receiver.memory,
        )  # fmt: skip

    # --- what the owner of the socket calls

    def receive(
        self,
        data: memoryview | bytes,
        address: Hashable,
        now: float,
        *,
        segment: int | None = None,
        path: int | None = None,
        waited: float = 0.0,
    ) -> None:
        """Take one datagram, or a batch of datagrams of ``segment`` bytes each (the last may be shorter).

        Never raises, whatever the bytes. ``data`` may be reused after the call. ``path`` is that of the socket; None
        (the service's end has one socket for all) takes the packets' word for it. ``waited`` are the seconds for which
        it lay in this machine before: they are not the path's.
        """
        if not self._closed:
            for received in self._receiver.receive(memoryview(data), address, path, now, segment, waited):
                if isinstance(received, AuthenticMessage):
                    self._on_message(received)
                else:
                    self._on_handshake(received)
            if self._connected:
                self._paths.report_arrivals(now)

    def transmit(self, now: float, full: Container[int] = ()) -> list[Transmit]:
        """What may be sent now, at most a burst by each path that is not ``full``; call again until it is nothing."""
        sent: list[Transmit] = []
        for waiting in (self._driver.waiting, self._sender.astray):
            sent += waiting
            waiting.clear()
        for path in self._paths:
            if path.id not in full:
                batches = self._sender.transmit(path, now)
                sent += batches
                if path.validation:
                    sent += path.shared(batches)
        return sent

    def next_event(self) -> Event | None:
        """The oldest event not yet taken."""
        while self._events:
            event = self._events.popleft()
            taken = self._delivery.unpack(event) if isinstance(event, MessageReceived) else event
            if taken is not None:
                return taken
        return None

    def next_timer(self, full: Container[int] = ()) -> float | None:
        """When to call `handle_timer` and `transmit`, if nothing happens before; None: not by itself.

        What waits for a path that is ``full`` waits for that, not for a time.
        """
        if self._closed:
            return None
        due = min(
            self._sender.next_timer(full), self._reconnector.due, self._paths.next_timer(), self._reliable.due,
            self._sweep_at, self._report_at, self._check_at, self._rekey_at,
        )  # fmt: skip
        return due if due < math.inf else None

    def handle_timer(self, now: float) -> None:
        """Do what is due."""
        if self._closed:
            return
        if now >= self._check_at:
            self._check(now)
        if now >= self._rekey_at:
            self._rekey_at = math.inf
            self._reconnector.rekey(now)
        if now >= self._reconnector.due:
            self._driver.send_hello(self._epochs.current, self._last_heard, now)
        self._paths.handle_timer(now, now - self._last_heard, self._connected)
        if now >= self._sweep_at:
            self._receiver.sweep(now)
            self._sweep_at = now + self._config.keepalive
        if now >= self._reliable.due:
            for message in self._reliable.handle_timer(now):
                self._sender.queue_frame(message, now)
            self._queue_woken()
        if now >= self._report_at:
            self._report(now)
            self._report_at = now + self._config.report_interval
            if (
                self._responder is None
                and self._epochs.current is not None
                and self._epochs.current.volume >= self._config.rekey_bytes
            ):
                self._reconnector.rekey(now)

    # --- keys

    def _on_handshake(self, received: HandshakeMessage) -> None:
        welcomed = self._driver.handle_handshake(received, self._epochs.current, self._epochs.previous)
        if welcomed is not None:
            self._start_epoch(welcomed.epoch, received.now)
            times = welcomed.times
            if times is not None:
                self._delivery.clock.exchange(*times, received.now)
            self._paths.welcomed(received.path, times[2] if times is not None else None, received.now)

    def _find_epoch(self, packet_id: int) -> Epoch | None:
        epoch = self._epochs.find(packet_id)
        return self._responder.pending(packet_id) if epoch is None and self._responder is not None else epoch

    def _start_epoch(self, epoch: Epoch, now: float) -> None:
        """Use the keys of a new handshake; those before stay for what is on its way."""
        goes_on = self._epochs.start(epoch, now)
        self._handshakes += 1
        self._driver.done()
        self._last_heard = now
        self._rekey_at = now + self._config.rekey_after if self._responder is None else math.inf
        self._reconnector.found(now, epoch.id)
        if goes_on:
            self._sender.change_keys(epoch)
            self._delivery.change_keys(epoch)
            self._check_at = min(self._check_at, self._epochs.previous_until)
            if not self._connected:
                self._connect(epoch.topics, now)
            return
        self._sender.start_epoch(epoch)
        self._counters.start_epoch(epoch)
        restarted = self._reliable.start_epoch(epoch, now)
        self._queue_woken()
        self._delivery.start_epoch(epoch)
        self._paths.start_epoch(now)
        self._sweep_at = now + self._config.keepalive
        self._report_at = now + self._config.report_interval
        self._connect(epoch.topics, now, restarted)

    def _end_epoch(self, now: float) -> None:
        """The peer said goodbye."""
        self._epochs.end()
        self._sender.start_epoch(None)
        self._delivery.end_epoch()
        self._reliable.start_epoch(None, now)
        self._paths.end_epoch()
        self._sweep_at = self._report_at = self._rekey_at = math.inf
        if self._responder is None:
            self._reconnector.pause(now + self._config.hello_retry)
        if self._connected:
            self._disconnect("goodbye")

    # --- connection

    def _connect(self, topics: tuple[Topic, ...], now: float, restarted: bool = False) -> None:
        self._connected = True
        self._check_at = now + self._config.silence
        self._events.append(Connected(topics, restarted))
        self._reliable.resume(now)
        self._queue_woken()

    def _disconnect(self, reason: str) -> None:
        self._connected = False
        self._events.append(Disconnected(reason))

    def _check(self, now: float) -> None:
        """What depends on how long ago something happened; sets itself again."""
        self._check_at = math.inf
        if self._connected:
            silent_at = self._last_heard + self._config.silence
            if now >= silent_at:
                self._disconnect("silent")
            else:
                self._check_at = silent_at
        self._check_at = min(self._check_at, self._epochs.check(now))

    # --- messages

    def _on_message(self, received: AuthenticMessage) -> None:
        epoch, index, plaintext, number, path, address, now = received
        asked_from: Hashable | None = None
        epochs = self._epochs
        if epoch is not epochs.current and epoch is not epochs.previous:  # the robot confirms a handshake
            if self._responder is not None:
                asked_from = self._responder.confirm(epoch)
            self._start_epoch(epoch, now)
        came_by = self._paths.get(path)
        if came_by is None and self._responder is not None:
            said = frames.pull_frame(plaintext[INNER.size :]) if index == 0 else None
            came_by = self._paths.admit(path, said, now)
        if epoch is epochs.current and self._reconnector.counts(address):
            self._last_heard = now
            if came_by is not None:
                size = len(plaintext) + TAG_SIZE
                self._paths.heard(came_by, number, address, size, now, proven=address == asked_from)
            if not self._connected:
                self._connect(epoch.topics, now)
            if self._reconnector.hello is not None and not self._reconnector.rekeying:
                self._reconnector.found(now, epoch.id)
        sequence, stamp = INNER.unpack_from(plaintext)
        if index == 0:
            self._on_frame(epoch, plaintext[INNER.size :], stamp, came_by, address, now)
            return
        self._delivery.deliver_message(epoch, epoch.receive[index], plaintext, sequence, stamp, now)

    def _on_frame(
        self, epoch: Epoch, data: bytes, micros: int, path: Path | None, address: Hashable, now: float
    ) -> None:
        message = frames.pull_frame(data)
        if message is None:
            self._rejected["control"] += 1
        elif not epoch.belongs_with(self._epochs.current):
            return
        elif isinstance(message, Ping):
            if path is not None and path.id == message.path:
                if self._responder is not None:
                    path.cost = message.cost
                exchange = self._paths.handle_ping(message, path, micros / 1e6, address, now)
                if exchange is not None:
                    if path is self._paths.choice.active:
                        self._reliable.rtt.add(path.rtt)
                    self._delivery.clock.exchange(*exchange, now)
        elif isinstance(message, Report):
            self._counters.apply_report(message, epoch, now)
        elif isinstance(message, Goodbye):
            self._end_epoch(now)
        elif isinstance(message, Forward):
            self._delivery.forward(message, epoch, now)
        else:
            self._reliable.on_frame(message, epoch, now)
            self._queue_woken()

    # --- sending of our own accord

    def _report(self, now: float) -> None:
        if self._epochs.current is None:
            return
        for message in frames.push_reports(*self._counters.rows(self._epochs.current, now)):
            self._sender.queue_frame(message, now)

    def _queue_woken(self) -> None:
        """Queue the reliable topics that have something to send."""
        woken = self._reliable.woken
        while woken:
            self._sender.queue_reliable(woken.popleft())
