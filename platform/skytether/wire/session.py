"""One end of one session: puts the parts together and keeps its time."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Hashable, Sequence

from . import control
from .clock import ClockOffset
from .config import Config
from .control import Goodbye, Ping, Report
from .crypto import KEY_SIZE
from .epoch import CONTROL, CONTROL_PRIORITY, Epoch, SendTopic
from .events import Connected, Disconnected, Event, MessageReceived, PeerMoved, Refused
from .handshake import NO_KEYS, Doorkeeper, Hello, Outcome, Resume, cut
from .ledger import Ledger
from .measure import Outbound
from .packet import HEADER_SIZE, HELLO, WELCOME
from .path import LossMeter, Path, Transmit
from .receiver import Receiver
from .redundancy import FixedRedundancy
from .seeker import Seeker, patience
from .sender import INNER, Sender
from .stats import PathStats, SessionStats
from .table import ANY, index_topics
from .topic import Role, Topic

PING_SPACING = 0.02
"""Least time between pings sent as answers, so that replayed packets cannot ask for many."""
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
        self._path = Path(0, self._config, now)
        self._redundancy = FixedRedundancy(self._config)
        self._sender = Sender(session_id, self._config, self._redundancy)
        self._receiver = Receiver(
            session_id, self._config, self._find_epoch, self._on_message, self._on_handshake, self._on_expired
        )
        self._ledger = Ledger(role)
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
        self._echo: tuple[float, float] | None = None
        """Peer's latest time stamp, and when it arrived."""
        self._ping_at = math.inf
        self._pinged_at = -math.inf
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

        Returns:
            False if it was dropped: no session is up, or the peer's table does not have the topic.

        Raises:
            KeyError: The topic is not in this end's table, or this end does not send it.
            ValueError: The payload is larger than ``Config.max_message``.
        """
        epoch = self._epoch
        sender = epoch.send.get(topic) if epoch is not None else None
        if sender is None or not self._connected:
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
        sender.counters.offered += 1
        self._sender.put(sender, payload, now)
        return True

    def set_peer(self, address: Hashable) -> None:
        """Where the robot's end speaks to from now on (the service was restarted elsewhere)."""
        if self._door is None and not self._closed:
            self._seeker.look_at(address, connected=self._epoch is not None)
        self._path.address = address

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
        path, clock = self._path, self._clock
        table = dict(self._table)
        if self._epoch is not None:
            for receiver in self._epoch.receive.values():
                receiver.settle(now)
            table.update((t.name, t) for t in self._epoch.topics)
        table.pop(ANY, None)
        rejected = Counter(self._receiver.rejected)
        if self._receiver.messages.evicted:
            rejected["evicted"] = self._receiver.messages.evicted
        paths = PathStats(
            path.id, path.address, path.rtt, path.rtts.minimum, path.rtts.quantile(0.5), path.loss_out,
            path.arrivals.loss, path.arrivals.burst, path.packets_sent, path.packets_received, path.bytes_sent,
            path.bytes_received, path.pacer.rate * 8, self._ledger.overhead(),
        )  # fmt: skip
        return SessionStats(
            self._connected, self._ledger.stats(table), (paths,), dict(rejected), clock.offset,
            clock.error, self._handshakes, now - self._last_heard,
        )  # fmt: skip

    # --- what the owner of the socket calls

    def receive(
        self, data: memoryview | bytes, address: Hashable, now: float, *, segment: int | None = None, path: int = 0
    ) -> None:
        """Take one datagram, or a batch of datagrams of ``segment`` bytes each (the last may be shorter).

        Never raises, whatever the bytes. ``data`` may be reused after the call.
        """
        if not self._closed and path == self._path.id:
            self._receiver.receive(memoryview(data), address, self._path, now, segment)

    def transmit(self, now: float) -> list[Transmit]:
        """What may be sent now, at most a burst; call again until it returns nothing."""
        sent = self._sender.transmit(self._path, now)
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
        due = min(self._sender.next_timer(), self._seeker.due, self._ping_at, self._report_at, self._check_at)
        return due if due < math.inf else None

    def handle_timer(self, now: float) -> None:
        """Do what is due."""
        if self._closed:
            return
        if now >= self._check_at:
            self._check(now)
        if now >= self._seeker.due:
            self._seek(now)
        if now >= self._ping_at:
            self._ping(now)
            self._receiver.sweep(now)
            quiet = patience(self._config, now - self._last_heard)
            self._ping_at = now + (self._config.keepalive if self._connected else quiet)
        if now >= self._report_at:
            self._path.arrivals.evaluate()
            self._report(now)
            self._report_at = now + self._config.report_interval

    # --- handshake

    def _seek(self, now: float) -> None:
        """The robot's end: ask for the service, or whether it still knows us."""
        held = None if self._epoch is None else self._epoch.ciphers
        hello = self._seeker.seek(held, self._last_heard, now)
        if hello is not None:
            self._send_raw(hello.common, hello.message, self._seeker.peer)
            if held is not None:
                self._ping(now)

    def _on_handshake(self, kind: int, common: bytes, message: bytes, address: Hashable, now: float) -> None:
        if kind == HELLO and self._door is not None:
            self._on_hello(self._door, common, message, address, now)
        elif kind == WELCOME and self._seeker.hello is not None:
            self._on_welcome(self._seeker.hello, common, message, address, now)
        else:
            self._receiver.rejected["unasked"] += 1

    def _on_hello(self, door: Doorkeeper, common: bytes, message: bytes, address: Hashable, now: float) -> None:
        held = NO_KEYS if self._epoch is None else self._epoch.ciphers.resume
        taken = {e.id for e in (self._epoch, self._previous) if e is not None}
        answer = door.answer(common, message, held, taken, now)
        if isinstance(answer, str):
            self._receiver.rejected[answer] += 1
        elif isinstance(answer, Resume):
            if now >= self._pinged_at + PING_SPACING:
                self._ping(now)
        else:
            if answer.outcome is not None and answer.epoch is None:
                answer.epoch = self._make_epoch(answer.outcome)
            if answer.reason and answer.reason != self._refusal:
                self._refuse(answer.reason)
            self._send_raw(answer.common, answer.message, address)

    def _on_welcome(self, hello: Hello, common: bytes, message: bytes, address: Hashable, now: float) -> None:
        welcome = hello.open(common, message)
        if welcome is None:
            self._receiver.rejected["welcome_forged"] += 1
            return
        if welcome.outcome is None:
            if welcome.reason != self._refusal:
                self._refuse(welcome.reason)
            self._seeker.rest(now + self._config.hello_retry_max)
            return
        self._start_epoch(self._make_epoch(welcome.outcome), address, now)
        if hello.sent == 1:  # else nobody knows which one was answered, and the first ping will tell more
            t1, t2, t3 = welcome.times
            self._clock.exchange(t1, t2, t3, now)
            self._echo = t3, now
        self._ping(now)

    def _refuse(self, reason: str) -> None:
        self._refusal = reason
        self._events.append(Refused(reason))

    def _make_epoch(self, outcome: Outcome) -> Epoch:
        send, receive = self._ledger.topics(outcome.topics)
        return Epoch(outcome.epoch, outcome.ciphers, tuple(t for _, t in outcome.topics), send, receive)

    def _find_epoch(self, epoch_id: int) -> Epoch | None:
        epoch = self._epoch
        if epoch is not None and epoch.id == epoch_id:
            return epoch
        if self._previous is not None and self._previous.id == epoch_id:
            return self._previous
        return self._door.pending(epoch_id) if self._door is not None else None

    def _start_epoch(self, epoch: Epoch, address: Hashable, now: float) -> None:
        """Use the keys of a new handshake; those before stay for what is on its way."""
        self._drop_previous()
        if self._epoch is not None:
            self._previous, self._previous_until = self._epoch, now + self._config.old_keys
        self._epoch = epoch
        self._control = SendTopic(0, CONTROL, Outbound(), CONTROL_PRIORITY)
        self._sender.start_epoch(epoch)
        self._ledger.start_epoch(epoch)
        self._clock = ClockOffset()
        self._echo = None
        path = self._path
        path.address = address
        path.arrivals = LossMeter()
        path.loss_out = path.burst_out = math.nan
        self._handshakes += 1
        self._refusal = ""
        self._last_heard = now
        self._ping_at = now
        self._report_at = now + self._config.report_interval
        self._seeker.found(now, epoch.id)
        self._connect(epoch.topics, now)

    def _end_epoch(self, now: float) -> None:
        """The peer said goodbye."""
        self._drop_previous()
        self._epoch = None
        self._sender.start_epoch(None)
        self._ping_at = self._report_at = math.inf
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

    def _connect(self, topics: tuple[Topic, ...], now: float) -> None:
        self._connected = True
        self._check_at = now + self._config.silence
        self._events.append(Connected(topics))

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
        self, epoch: Epoch, index: int, plaintext: bytes, newest: bool, address: Hashable, now: float
    ) -> None:
        """One authentic message, the first time that it is complete."""
        if epoch is not self._epoch and epoch is not self._previous:  # the robot confirms a handshake
            if self._door is not None:
                self._door.confirm()
            self._start_epoch(epoch, address, now)
        if epoch is self._epoch and self._seeker.counts(address):
            self._last_heard = now
            if newest and address != self._path.address:
                self._path.address = address
                self._events.append(PeerMoved(address))
            if not self._connected:
                self._connect(epoch.topics, now)
            if self._seeker.hello is not None:
                self._seeker.found(now, epoch.id)
        sequence, micros = INNER.unpack_from(plaintext)
        if index == 0:
            self._on_control(epoch, plaintext[INNER.size :], micros, now)
            return
        topic, clock = epoch.receive[index], self._clock
        if epoch is self._epoch and clock.known:
            sent_at, error = micros / 1e6 - clock.offset, clock.error
        else:
            sent_at, error = now, math.inf
        size = len(plaintext) - INNER.size
        if topic.arrived(sequence, size, now - sent_at, error, self._outdated(epoch, index), now):
            payload = plaintext[INNER.size :] if size <= COPY_BELOW else memoryview(plaintext)[INNER.size :]
            self._events.append(MessageReceived(topic.name, payload, sequence, sent_at, error, now))

    def _outdated(self, epoch: Epoch, index: int) -> bool:
        """Whether a message of the keys before comes after a newer one under the present keys."""
        if epoch is self._epoch or self._epoch is None:
            return False
        present = self._epoch.receive.get(index)
        return present is not None and present.newest >= 0

    def _on_control(self, epoch: Epoch, data: bytes, micros: int, now: float) -> None:
        message = control.pull_control(data)
        if message is None:
            self._receiver.rejected["control"] += 1
        elif epoch is not self._epoch:
            return
        elif isinstance(message, Ping):
            self._on_ping(message, micros / 1e6, now)
        elif isinstance(message, Report):
            self._ledger.take(message, epoch, now)
            self._path.loss_out, self._path.burst_out = message.loss, message.burst
        elif isinstance(message, Goodbye):
            self._end_epoch(now)

    def _on_ping(self, ping: Ping, sent_at: float, now: float) -> None:
        first = self._echo is None
        if self._echo is None or sent_at > self._echo[0]:
            self._echo = sent_at, now
        if first and now >= self._pinged_at + PING_SPACING:
            self._ping(now)  # so that the peer need not wait for its first exchange of time stamps
        if ping.echo is None:
            return
        t1, hold = ping.echo / 1e6, ping.hold / 1e6
        rtt = now - t1 - hold
        if rtt >= 0:
            self._clock.exchange(t1, sent_at - hold, sent_at, now)
            self._path.rtt = rtt
            self._path.rtts.add(rtt)

    def _on_expired(self, index: int) -> None:
        topic = self._epoch.receive.get(index) if self._epoch is not None else None
        if topic is not None:
            topic.counters.expired += 1

    # --- sending of our own accord

    def _ping(self, now: float) -> None:
        self._pinged_at = now
        if self._echo is None:
            ping = Ping(None, 0)
        else:
            sent_at, arrived_at = self._echo
            ping = Ping(round(sent_at * 1e6), int((now - arrived_at) * 1e6))
        self._say(control.push_ping(ping), now)

    def _report(self, now: float) -> None:
        if self._epoch is None:
            return
        meter = self._path.arrivals
        rows = self._ledger.rows(self._epoch, now)
        for message in control.push_reports(meter.loss, meter.burst, *rows):
            self._say(message, now)

    def _say(self, message: bytes, now: float) -> None:
        """Queue a control message, once: the next one of its kind makes up for its loss."""
        self._sender.put(self._control, message, now, extra=0)

    def _send_raw(self, common: bytes, message: bytes, address: Hashable) -> None:
        if len(self._raw) >= MAX_RAW:
            return
        packets, size = cut(common, message, self._config.mtu - HEADER_SIZE, self._redundancy)
        path = self._path
        path.pacer.spend(len(packets))
        path.packets_sent += -(-len(packets) // size)
        path.bytes_sent += len(packets)
        self._raw.append(Transmit(path.id, address, packets, size if len(packets) > size else None))
