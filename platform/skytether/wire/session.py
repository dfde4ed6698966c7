"""One end of one session: puts the parts together and keeps its time."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Container, Hashable, Sequence

from . import control
from .clock import ClockOffset
from .compression import FLAG, Compressed, compress, decompress
from .config import MIN_MTU, Config
from .control import Forward, Goodbye, Ping, Report
from .crypto import KEY_SIZE
from .epoch import CONTROL, CONTROL_PRIORITY, Epoch, ReceiveTopic, SendTopic
from .events import Connected, Disconnected, Event, MessageReceived, PathSwitched, PeerMoved, Refused
from .handshake import NO_KEYS, Doorkeeper, Hello, Outcome, Resume, cut
from .ledger import Ledger
from .measure import Outbound
from .packet import HEADER_SIZE, HELLO, WELCOME
from .path import Path, Transmit
from .paths import Choice, Paths
from .receiver import Receiver
from .seeker import Seeker
from .sender import INNER, Sender
from .stats import SessionStats
from .streams import Streams
from .table import ANY, index_topics
from .topic import Role, Topic

GOODBYES = 3
"""Nobody asks for a lost goodbye."""
COPY_BELOW = 4096
"""Payloads up to this size are handed over as bytes, larger ones as a view that saves the copy."""
MAX_RAW = 8
"""Handshake messages waiting to be sent: answers to a flood of repeated HELLOs stop here."""


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
        self._paths = Paths(self._config, self._say_by, self._on_choice, now)
        self._peer: Hashable | None = None
        self._sender = Sender(session_id, self._config, self._paths.choice.active)
        self._receiver = Receiver(
            session_id, self._config, self._paths.get, self._find_epoch, self._on_message, self._on_handshake,
            self._on_expired,
        )  # fmt: skip
        self._ledger = Ledger(role)
        self._streams = Streams(role, topics, self._config.queue_limit, self._ledger, self._sender.put_outbox)
        self._clock = ClockOffset()
        self._raw: deque[Transmit] = deque()
        """Handshake packets and goodbye, on their way before everything else."""

        self._epoch: Epoch | None = None
        self._previous: Epoch | None = None
        """Keys before the latest handshake; they open packets that were on their way until ``_previous_until``."""
        self._previous_until = math.inf
        self._connected = False
        self._closed = False
        self._handshakes = 0
        self._last_heard = math.nan
        self._sweep_at = math.inf
        self._report_at = math.inf
        self._check_at = math.inf
        self._control = SendTopic(0, CONTROL, Outbound(), CONTROL_PRIORITY)

        self._door = Doorkeeper(session_id, key, self._table, entropy) if role is Role.SERVICE else None
        self._seeker = Seeker(session_id, key, topics, self._config, entropy)
        self._refusal = ""
        """Latest reason told, so that it is told once."""

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
        epoch = self._epoch
        sender = epoch.send.get(topic) if epoch is not None else None
        outbox = self._streams.outbox(topic) if epoch is None else sender.outbox if sender is not None else None
        if self._closed or (outbox is None and (sender is None or not self._connected)):
            ours = self._table.get(topic)
            if ours is None or ours.direction.sender is not self.role:
                raise KeyError(f"topic '{topic}' is not one that this end ({self.role}) sends")
            return False
        if not isinstance(payload, bytes):
            payload = bytes(payload)
        if len(payload) > self._config.max_message:
            raise ValueError(
                f"topic '{topic}': {len(payload)} bytes are more than a message may have, {self._config.max_message}"
            )
        row = sender or outbox
        if row is not None and row.topic.compression and not isinstance(payload, Compressed):
            payload = compress(payload)
        if outbox is not None:
            return self._streams.put(outbox, payload, now)
        if sender is not None:
            sender.counters.offered += 1
            self._sender.put(sender, payload, now)
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
        if self._door is None and not self._closed:
            self._seeker.look_at({p.peer for p in self._paths}, connected=self._epoch is not None)

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
            self._seeker.peers.add(opened.peer)
        for each in self._paths:
            self._paths.ping(each, now)
        self._paths.choose(now)

    def close_path(self, path: int, now: float) -> None:
        """The path is gone. The last one stays until another is opened."""
        self._paths.close(path, now)

    def shrink(self, path: int, size: int, now: float) -> None:
        """The system refused to send a datagram of ``size`` bytes: too large for the path."""
        known = self._paths.get(path)
        if known is not None:
            known.mtu.refuse(size, now)

    def close(self, now: float) -> None:
        """Say goodbye. Call `transmit` once more to send it; then the session is over."""
        if self._closed:
            return
        if self._epoch is not None:
            self._report(now)
            for _ in range(GOODBYES):
                self._say(control.push_goodbye(), now)
        self._closed = True
        if self._connected:
            self._disconnect("closed")

    def stats(self, now: float) -> SessionStats:
        """A snapshot of all counters, both directions."""
        clock = self._clock
        table = dict(self._table)
        if self._epoch is not None:
            for receiver in self._epoch.receive.values():
                receiver.settle(now)
            table.update((t.name, t) for t in self._epoch.topics)
        table.pop(ANY, None)
        rejected = Counter(self._receiver.rejected)
        if self._receiver.messages.evicted:
            rejected["evicted"] = self._receiver.messages.evicted
        paths = self._paths.stats(*self._ledger.overhead(), now)
        return SessionStats(
            self._connected, self._ledger.stats(table), paths, dict(rejected), clock.offset,
            clock.error_at(now), self._handshakes, now - self._last_heard,
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
    ) -> None:
        """Take one datagram, or a batch of datagrams of ``segment`` bytes each (the last may be shorter).

        Never raises, whatever the bytes. ``data`` may be reused after the call. ``path`` is that of the socket; None
        (the service's end has one socket for all) takes the packets' word for it.
        """
        if not self._closed:
            self._receiver.receive(memoryview(data), address, path, now, segment)
            if self._connected:
                self._paths.tell(now)

    def transmit(self, now: float, full: Container[int] = ()) -> list[Transmit]:
        """What may be sent now, at most a burst by each path that is not ``full``; call again until it is nothing."""
        sent: list[Transmit] = []
        for path in self._paths:
            if path.id not in full:
                sent += self._sender.transmit(path, now)
        if self._raw:
            sent = [*self._raw, *sent]
            self._raw.clear()
        return sent

    def next_event(self) -> Event | None:
        """The oldest event not yet taken."""
        return self._events.popleft() if self._events else None

    def next_timer(self) -> float | None:
        """When to call `handle_timer` and `transmit`, if nothing happens before; None: not by itself."""
        if self._closed:
            return None
        due = min(
            self._sender.next_timer(), self._seeker.due, self._paths.next_timer(), self._sweep_at, self._report_at,
            self._check_at, self._streams.due,
        )  # fmt: skip
        return due if due < math.inf else None

    def handle_timer(self, now: float) -> None:
        """Do what is due."""
        if self._closed:
            return
        if now >= self._check_at:
            self._check(now)
        if now >= self._seeker.due:
            self._seek(now)
        self._paths.handle_timer(now, now - self._last_heard, self._connected)
        if now >= self._sweep_at:
            self._receiver.sweep(now)
            self._sweep_at = now + self._config.keepalive
        if now >= self._streams.due:
            for message in self._streams.handle_timer(now):
                self._say(message, now)
        if now >= self._report_at:
            self._report(now)
            self._report_at = now + self._config.report_interval

    # --- handshake

    def _seek(self, now: float) -> None:
        """The robot's end: ask for the service, or whether it still knows us."""
        held = None if self._epoch is None else self._epoch.ciphers
        hello = self._seeker.seek(held, self._last_heard, now)
        if hello is not None:
            for path in self._paths:
                if path.peer is not None:
                    self._send_raw(hello.common, hello.message, path, path.peer)
                if held is not None:
                    self._paths.ping(path, now)

    def _on_handshake(self, kind: int, common: bytes, message: bytes, path: int, address: Hashable, now: float) -> None:
        if kind == HELLO and self._door is not None:
            self._on_hello(self._door, common, message, path, address, now)
        elif kind == WELCOME and self._seeker.hello is not None:
            self._on_welcome(self._seeker.hello, common, message, path, address, now)
        else:
            self._receiver.rejected["unasked"] += 1

    def _on_hello(
        self, door: Doorkeeper, common: bytes, message: bytes, path: int, address: Hashable, now: float
    ) -> None:
        held = NO_KEYS if self._epoch is None else self._epoch.ciphers.resume
        taken = {e.id for e in (self._epoch, self._previous) if e is not None}
        answer = door.answer(common, message, held, taken, now)
        if isinstance(answer, str):
            self._receiver.rejected[answer] += 1
        elif isinstance(answer, Resume):
            for each in self._paths:
                self._paths.ping_soon(each, now)
            self._answer(self._paths.get(path) or self._paths.choice.active, address, now)
        else:
            if answer.outcome is not None and answer.epoch is None:
                answer.epoch = self._make_epoch(answer.outcome)
            if answer.reason and answer.reason != self._refusal:
                self._refuse(answer.reason)
            self._send_raw(answer.common, answer.message, self._paths.choice.active, address)

    def _on_welcome(
        self, hello: Hello, common: bytes, message: bytes, path: int, address: Hashable, now: float
    ) -> None:
        welcome = hello.open(common, message)
        if welcome is None:
            self._receiver.rejected["welcome_forged"] += 1
            return
        if welcome.outcome is None:
            if welcome.reason != self._refusal:
                self._refuse(welcome.reason)
            self._seeker.rest(now + self._config.hello_retry_max)
            return
        self._start_epoch(self._make_epoch(welcome.outcome), now)
        came_by = self._paths.get(path)
        if came_by is not None:
            came_by.address = address
        if hello.sent == 1:  # else nobody knows which one was answered, and the first ping will tell more
            t1, t2, t3 = welcome.times
            self._clock.exchange(t1, t2, t3, now)
            if came_by is not None:
                came_by.echo = t3, now
        for each in self._paths:
            self._paths.ping(each, now)

    def _answer(self, path: Path, address: Hashable, now: float) -> None:
        """Tell a robot that holds the keys, where it asks for them.

        Somebody may have been faster than the robot with one of its own packets, and be taken for it since.
        """
        if address == path.address or len(self._raw) >= MAX_RAW:
            return
        ping = control.push_ping(Ping(path.id, path.cost, False, 0, None, 0, path.feedback(now)))
        packet = self._sender.packet(self._control, ping, path, now)
        if packet is not None:
            path.packets_sent += 1
            path.bytes_sent += len(packet)
            self._raw.append(Transmit(path.id, address, packet, None))

    def _refuse(self, reason: str) -> None:
        self._refusal = reason
        self._events.append(Refused(reason))

    def _make_epoch(self, outcome: Outcome) -> Epoch:
        send, receive = self._ledger.topics(outcome.topics)
        return Epoch(outcome.epoch, outcome.ciphers, tuple(t for _, t in outcome.topics), send, receive, outcome.life)

    def _find_epoch(self, epoch_id: int) -> Epoch | None:
        epoch = self._epoch
        if epoch is not None and epoch.id == epoch_id:
            return epoch
        if self._previous is not None and self._previous.id == epoch_id:
            return self._previous
        return self._door.pending(epoch_id) if self._door is not None else None

    def _start_epoch(self, epoch: Epoch, now: float) -> None:
        """Use the keys of a new handshake; those before stay for what is on its way."""
        self._drop_previous()
        if self._epoch is not None:
            self._previous, self._previous_until = self._epoch, now + self._config.old_keys
        self._epoch = epoch
        self._control = SendTopic(0, CONTROL, Outbound(), CONTROL_PRIORITY)
        self._sender.start_epoch(epoch)
        self._ledger.start_epoch(epoch)
        restarted = self._streams.start_epoch(epoch, now)
        self._clock = ClockOffset()
        self._paths.start_epoch(now)
        self._handshakes += 1
        self._refusal = ""
        self._last_heard = now
        self._sweep_at = now + self._config.keepalive
        self._report_at = now + self._config.report_interval
        self._seeker.found(now, epoch.id)
        self._connect(epoch.topics, now, restarted)

    def _end_epoch(self, now: float) -> None:
        """The peer said goodbye."""
        self._drop_previous()
        self._epoch = None
        self._sender.start_epoch(None)
        self._streams.start_epoch(None, now)
        self._paths.end_epoch()
        self._sweep_at = self._report_at = math.inf
        if self._door is None:
            self._seeker.rest(now + self._config.hello_retry)
        if self._connected:
            self._disconnect("goodbye")

    def _drop_previous(self) -> None:
        if self._previous is not None:
            for receiver in self._previous.receive.values():
                receiver.settle(math.inf)
            self._previous = None

    # --- connection

    def _connect(self, topics: tuple[Topic, ...], now: float, restarted: bool = False) -> None:
        self._connected = True
        self._check_at = now + self._config.silence
        self._events.append(Connected(topics, restarted))
        self._streams.resume(now)

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
        if self._previous is not None:
            if now >= self._previous_until:
                self._drop_previous()
            else:
                self._check_at = min(self._check_at, self._previous_until)

    # --- messages

    def _on_message(
        self, epoch: Epoch, index: int, plaintext: bytes, number: int, path: int, address: Hashable, now: float
    ) -> None:
        """One authentic message, the first time that it is complete."""
        if epoch is not self._epoch and epoch is not self._previous:  # the robot confirms a handshake
            if self._door is not None:
                self._door.confirm()
            self._start_epoch(epoch, now)
        came_by = self._paths.get(path)
        if came_by is None:
            came_by = self._on_new_path(index, plaintext, path, now)
        if epoch is self._epoch and self._seeker.counts(address):
            self._last_heard = now
            if came_by is not None:
                self._on_heard(came_by, number, address, now)
            if not self._connected:
                self._connect(epoch.topics, now)
            if self._seeker.hello is not None:
                self._seeker.found(now, epoch.id)
        sequence, stamp = INNER.unpack_from(plaintext)
        if index == 0:
            self._on_control(epoch, plaintext[INNER.size :], stamp, came_by, now)
            return
        topic = epoch.receive[index]
        if not topic.topic.reliable:
            size = len(plaintext) - INNER.size
            payload = plaintext[INNER.size :] if size <= COPY_BELOW else memoryview(plaintext)[INNER.size :]
            self._deliver(epoch, topic, sequence, stamp, payload, now)
        elif topic.inbox is None:
            self._receiver.rejected["epoch"] += 1
        else:
            for delivery in topic.inbox.take(plaintext[INNER.size :], stamp, now):
                self._deliver(epoch, topic, *delivery, now)

    def _deliver(
        self, epoch: Epoch, topic: ReceiveTopic, sequence: int, stamp: int, payload: bytes | memoryview, now: float
    ) -> None:
        if stamp & FLAG:
            whole = decompress(payload, self._config.max_message)
            if whole is None:
                self._receiver.rejected["compressed"] += 1
                return
            payload = whole
        micros, clock = stamp & ~FLAG, self._clock
        if epoch is self._epoch and clock.known:
            sent_at, error = micros / 1e6 - clock.offset, clock.error_at(now)
        else:
            sent_at, error = now, math.inf
        if topic.topic.reliable:
            # How long ago a latched message was published tells nothing of the link.
            topic.delivered(len(payload), now - sent_at, math.inf if topic.topic.latched else error, now)
        elif not topic.arrived(sequence, len(payload), now - sent_at, error, self._outdated(epoch, topic.index), now):
            return
        self._events.append(MessageReceived(topic.name, payload, sequence, sent_at, error, now))

    def _on_new_path(self, index: int, plaintext: bytes, path: int, now: float) -> Path | None:
        """The robot speaks by a path that is not known yet: its ping says so, or there is none other."""
        if self._door is None:
            return None
        ping = control.pull_control(plaintext[INNER.size :]) if index == 0 else None
        if self._paths.addressed and not (isinstance(ping, Ping) and ping.path == path):
            return None
        return self._paths.open(path, 0, now)

    def _on_heard(self, path: Path, number: int, address: Hashable, now: float) -> None:
        """A path is alive; of its messages the newest tells where the peer is."""
        if number > path.newest:
            path.newest = number
            if address != path.address:
                moved = path.address is not None
                path.address = address
                if moved:
                    path.mtu.restart(now)
                    self._events.append(PeerMoved(address))
                self._paths.choose(now)
        self._paths.heard(path, now)

    def _on_choice(self, choice: Choice, reason: str, now: float) -> None:
        self._sender.use(self._paths, choice.active, choice.other, choice.doubled, now)
        if reason:
            self._events.append(PathSwitched(choice.active.id, reason))

    def _outdated(self, epoch: Epoch, index: int) -> bool:
        """Whether a message of the keys before comes after a newer one under the present keys."""
        if epoch is self._epoch or self._epoch is None:
            return False
        present = self._epoch.receive.get(index)
        return present is not None and present.newest >= 0

    def _on_control(self, epoch: Epoch, data: bytes, micros: int, path: Path | None, now: float) -> None:
        message = control.pull_control(data)
        if message is None:
            self._receiver.rejected["control"] += 1
        elif epoch is not self._epoch:
            return
        elif isinstance(message, Ping):
            if path is not None and path.id == message.path:
                if self._door is not None:
                    path.cost = message.cost
                exchange = self._paths.take(message, path, micros / 1e6, now)
                if exchange is not None:
                    if path is self._paths.choice.active:
                        self._streams.round_trip.add(path.rtt)
                    self._clock.exchange(*exchange, now)
        elif isinstance(message, Report):
            self._ledger.take(message, epoch, now)
        elif isinstance(message, Goodbye):
            self._end_epoch(now)
        elif isinstance(message, Forward):
            self._on_forward(message, epoch, now)
        else:
            self._streams.on_control(message, epoch, now)

    def _on_forward(self, message: Forward, epoch: Epoch, now: float) -> None:
        topic = epoch.receive.get(message.topic)
        if topic is not None and topic.inbox is not None:
            topic.inbox.touch(now)
            for delivery in topic.inbox.forward(message.base):
                self._deliver(epoch, topic, *delivery, now)

    def _on_expired(self, index: int) -> None:
        topic = self._epoch.receive.get(index) if self._epoch is not None else None
        if topic is not None:
            topic.counters.expired += 1

    # --- sending of our own accord

    def _report(self, now: float) -> None:
        if self._epoch is None:
            return
        for message in control.push_reports(*self._ledger.rows(self._epoch, now)):
            self._say(message, now)

    def _say(self, message: bytes, now: float) -> None:
        """Queue a control message, once: the next one of its kind makes up for its loss."""
        self._sender.put(self._control, message, now, extra=0)

    def _say_by(self, path: Path, message: bytes, now: float) -> None:
        """Send a control message by one path, at once."""
        self._sender.say(self._control, message, path, now)

    def _send_raw(self, common: bytes, message: bytes, path: Path, address: Hashable) -> None:
        if len(self._raw) >= MAX_RAW:
            return
        packets, size = cut(common, message, MIN_MTU - HEADER_SIZE, path.redundancy.parity)
        path.pacer.spend(len(packets))
        path.packets_sent += -(-len(packets) // size)
        path.bytes_sent += len(packets)
        self._raw.append(Transmit(path.id, address, packets, size if len(packets) > size else None))
