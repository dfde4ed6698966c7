"""The handshake (rule 1): one round trip, both ends contribute randomness, the topic tables are joined.

Messages (each is 32 clear random bytes, then a text sealed under a key derived from them and the session key)::

    HELLO    robot -> service   X25519 key, life, epoch proposed, name of keys still held, time t1, topics offered
    WELCOME  service -> robot   X25519 key, life, epoch chosen, times t1, t2, t3, topics agreed or why they are refused

A life is 8 random bytes that name one end from its start to its end, so that the peer knows a restarted one.

Their packets have tags under a key derived from the session key, so that nobody else's shard is taken for one of them.
HELLO has the session's id, by which relays find the way; WELCOME has the one that packets under the new keys have.
WELCOME's key depends on HELLO, so it answers this one only. HELLO is padded so that WELCOME is at most three
times as long. The service answers a repeated HELLO with the same WELCOME and keeps its old keys until a
message sealed with the new ones arrives, so a replayed HELLO disturbs nothing. If the service still holds the keys
that HELLO names, nothing was lost but packets: it says so by a ping, and no new keys are made.
"""

from __future__ import annotations

import hashlib
import struct
from collections import Counter, OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from ..codec import crypto
from ..codec.ciphers import Ciphers, HandshakeTags
from ..codec.negotiation import TablesDifferError, negotiate, pull_answer, pull_offer, push_answer, push_offer
from ..codec.packet import HELLO, WELCOME, push_common
from ..fec.fragment import Shape, Shards, shape_for
from ..state.epoch import Epoch
from ..topic import Topic

_HELLO = struct.Struct(">32s8s8sBQI")
"""Public key, name of keys held, life of the robot's end, epoch proposed, t1, length of the table."""
_WELCOME = struct.Struct(">32s8sBBQQQI")
"""Public key, life of the service's end, epoch, refused, t1, t2, t3, length of what follows."""
LIFE_SIZE = 8
MIN_HELLO = 400
"""Length of HELLO's text at least, so that the answer is at most three times as long."""
ROW_HELLO = 32
"""The same for each topic."""
MAX_HANDSHAKE = 256 * 1024
"""Sealed length above which a handshake message is not even assembled."""
MAX_REASON = 300
NO_KEYS = bytes(crypto.RESUME_SIZE)
Entropy = Callable[[int], bytes]


def _micros(seconds: float) -> int:
    return int(seconds * 1e6)


def _key(key: bytes, salt: bytes, label: bytes, hello: bytes = b"") -> bytes:
    return crypto.derive(key, salt, label + hashlib.sha256(hello).digest())


def _pack(kind: int, packet_id: int, salt: bytes, key: bytes, plaintext: bytes) -> tuple[bytes, bytes]:
    length = len(salt) + len(plaintext) + crypto.TAG_SIZE
    common = push_common(kind, packet_id, 0, int.from_bytes(salt[:6], "big"), 0, length)
    return common, salt + crypto.seal_once(key, plaintext, common)


def cut(
    common: bytes, message: bytes, room: int, parity: Callable[[int, int, float], int], tags: HandshakeTags
) -> tuple[memoryview, int]:
    """Packets of a handshake message, one after the other, and their size. Their numbers are 0: no path yet."""
    whole = len(message) <= room
    shape = Shape(len(message), len(message)) if whole else shape_for(len(message), room)
    padded = memoryview(message.ljust(shape.shards * shape.size, b"\0"))
    more = 0 if whole else parity(shape.block_k(0), shape.blocks, 0.9)
    shards = Shards(common, padded, shape, more, tags)
    return shards.make_packets(shards.remaining, 0, 0, 0), shards.packet_size


@dataclass(frozen=True, slots=True)
class Outcome:
    """What both ends know after a handshake."""

    epoch: int
    ciphers: Ciphers
    topics: list[tuple[int, Topic]]
    """Agreed topics by index."""
    life: bytes
    """The peer's."""


class Hello:
    """The robot's end of one handshake. Valid for as long as the robot repeats it."""

    def __init__(
        self,
        session_id: int,
        key: bytes,
        topics: Sequence[Topic],
        epoch: int,
        held: bytes,
        life: bytes,
        entropy: Entropy,
        now: float,
    ) -> None:
        """Make HELLO.

        Args:
            session_id: Of the session.
            key: Session key.
            topics: The robot's table.
            epoch: Proposed; not the one in use.
            held: Name of the keys still held, or `NO_KEYS`.
            life: Of this end.
            entropy: Source of random bytes.
            now: t1.
        """
        salt = entropy(crypto.SALT_SIZE)
        self._private = entropy(crypto.KEY_SIZE)
        self._key = key
        self._topics = topics
        self.made_at = now
        self.sent = 0
        """How many times it was sent."""
        offer = push_offer(topics)
        plaintext = _HELLO.pack(crypto.public_of(self._private), held, life, epoch, _micros(now), len(offer)) + offer
        plaintext = plaintext.ljust(max(MIN_HELLO, ROW_HELLO * len(topics)), b"\0")
        self.common, self.message = _pack(HELLO, session_id, salt, _key(key, salt, b"hello"), plaintext)

    def open(self, common: bytes, message: bytes) -> Welcome | None:
        """Read an answer; None if it is not an authentic answer to this HELLO."""
        salt = message[: crypto.SALT_SIZE]
        plaintext = crypto.open_once(
            _key(self._key, salt, b"welcome", self.message), message[crypto.SALT_SIZE :], common
        )
        if plaintext is None or len(plaintext) < _WELCOME.size:
            return None
        public, life, epoch, refused, t1, t2, t3, length = _WELCOME.unpack_from(plaintext)
        text = plaintext[_WELCOME.size : _WELCOME.size + length]
        times = (t1 / 1e6, t2 / 1e6, t3 / 1e6)
        if refused:
            return Welcome(None, text.decode(errors="replace"), times)
        shared = crypto.exchange(self._private, public)
        if shared is None:
            return None
        try:
            topics = pull_answer(text, self._topics)
        except ValueError:
            return None
        to_service, to_robot, name = crypto.data_keys(self._key, shared, self.message, message)
        packet_id = crypto.packet_id(self._key, shared, self.message)
        return Welcome(Outcome(epoch, Ciphers(to_service, to_robot, name, packet_id), topics, life), "", times)


@dataclass(frozen=True, slots=True)
class Welcome:
    """The service's answer as the robot reads it."""

    outcome: Outcome | None
    """None: refused."""
    reason: str
    times: tuple[float, float, float]
    """t1, t2, t3 in seconds, the first by the robot's clock."""


@dataclass(slots=True)
class Pending:
    """A handshake that the service answered and the robot has not confirmed."""

    common: bytes
    message: bytes
    outcome: Outcome | None
    """None: refused."""
    reason: str
    life: bytes
    """The robot's."""
    made_at: float
    """t2 and t3."""
    epoch: Epoch | None = None
    """What the session made of the outcome."""
    askers: set[Hashable] = field(default_factory=set)
    """Where HELLO came from; of many addresses two."""

    def asked(self, address: Hashable) -> None:
        """WELCOME goes to that address."""
        if len(self.askers) < 2:
            self.askers.add(address)


@dataclass(frozen=True, slots=True)
class Resume:
    """HELLO of a robot that still holds the service's keys."""


class _Hello(NamedTuple):
    public: bytes
    held: bytes
    """Name of the keys that the robot holds."""
    life: bytes
    epoch: int
    """Proposed."""
    t1: int
    offer: bytes


class HandshakeResponder:
    """The service's end of all handshakes of a session."""

    MAX_PENDING = 4
    MAX_USED = 1024
    """HELLOs remembered so as not to be answered again."""
    MAX_LIVES = 1024
    """Lives of robots whose newest HELLO is remembered: whoever makes another waits for no answer to one before."""
    PENDING_TIME = 10.0
    """Seconds until an unconfirmed handshake is forgotten. The robot makes a new HELLO sooner than that."""

    def __init__(self, key: bytes, topics: Mapping[str, Topic], entropy: Entropy) -> None:
        self._key = key
        self._topics = topics
        self._entropy = entropy
        self._life = entropy(LIFE_SIZE)
        self._pending: OrderedDict[bytes, Pending] = OrderedDict()
        self._used: OrderedDict[bytes, None] = OrderedDict()
        self._newest: OrderedDict[bytes, int] = OrderedDict()
        """t1 of the newest HELLO, by life."""

    def answer(self, common: bytes, message: bytes, held: bytes, taken: set[int], now: float) -> Pending | Resume | str:
        """Read a HELLO.

        Args:
            common: Common part of its header.
            message: The assembled message.
            held: Name of the keys in use, or `NO_KEYS`.
            taken: Epochs in use.
            now: t2.

        Returns:
            What to answer (the same object for a repeated HELLO), or the reason why not.
        """
        self.forget(now)
        name = hashlib.sha256(message).digest()
        known = self._pending.get(name)
        if known is not None:
            return known
        if name in self._used:
            return "hello_replayed"
        hello = self._open_hello(common, message)
        if isinstance(hello, str):
            return hello
        newest = self._newest.get(hello.life, -1)
        if hello.held == held != NO_KEYS:
            self._note(hello.life, max(hello.t1, newest))
            return Resume()
        if hello.t1 <= newest:
            return "hello_replayed"
        try:
            offered = pull_offer(hello.offer)
        except ValueError:
            return "hello_malformed"
        private = self._entropy(crypto.KEY_SIZE)
        shared = crypto.exchange(private, hello.public)
        if shared is None:
            return "hello_malformed"
        self._note(hello.life, hello.t1)
        self._make_room()
        busy = taken | {p.outcome.epoch for p in self._pending.values() if p.outcome}
        epoch = next(e % 256 for e in range(hello.epoch, hello.epoch + 256) if e % 256 not in busy)
        try:
            agreed, reason = negotiate(offered, self._topics), ""
        except TablesDifferError as error:
            agreed, reason = [], str(error)[:MAX_REASON]
        pending = self._pending[name] = self._welcome(hello, message, private, shared, epoch, agreed, reason, now)
        return pending

    def _open_hello(self, common: bytes, message: bytes) -> _Hello | str:
        salt = message[: crypto.SALT_SIZE]
        plaintext = crypto.open_once(_key(self._key, salt, b"hello"), message[crypto.SALT_SIZE :], common)
        if plaintext is None:
            return "hello_forged"
        if len(plaintext) < MIN_HELLO:
            return "hello_malformed"
        public, held, life, epoch, t1, length = _HELLO.unpack_from(plaintext)
        return _Hello(public, held, life, epoch, t1, plaintext[_HELLO.size : _HELLO.size + length])

    def _welcome(
        self,
        hello: _Hello,
        message: bytes,
        private: bytes,
        shared: bytes,
        epoch: int,
        agreed: list[tuple[int, Topic]],
        reason: str,
        now: float,
    ) -> Pending:
        """Seal the answer to a HELLO; with a reason it is a refusal."""
        text = reason.encode()[:MAX_REASON] if reason else push_answer(agreed)
        head = _WELCOME.pack(
            crypto.public_of(private), self._life, epoch, bool(reason), hello.t1, _micros(now), _micros(now), len(text)
        )
        salt = self._entropy(crypto.SALT_SIZE)
        key = _key(self._key, salt, b"welcome", message)
        packet_id = crypto.packet_id(self._key, shared, message)
        welcome_common, welcome = _pack(WELCOME, packet_id, salt, key, head + text)
        outcome = None
        if not reason:
            to_service, to_robot, resume = crypto.data_keys(self._key, shared, message, welcome)
            outcome = Outcome(epoch, Ciphers(to_robot, to_service, resume, packet_id), agreed, hello.life)
        return Pending(welcome_common, welcome, outcome, reason, hello.life, now)

    def pending(self, packet_id: int) -> Epoch | None:
        """The epoch whose packets have that id, of a handshake not confirmed yet."""
        for pending in self._pending.values():
            if pending.epoch is not None and pending.epoch.ciphers.packet_id == packet_id:
                return pending.epoch
        return None

    def confirm(self, epoch: Epoch) -> Hashable | None:
        """A message sealed with a pending handshake's keys arrived: all HELLOs so far are used up.

        Returns:
            The only address that WELCOME was sent to: who confirms got it there. None if there were several.
        """
        asker: Hashable | None = None
        for name, pending in list(self._pending.items()):
            if pending.epoch is epoch and len(pending.askers) == 1:
                (asker,) = pending.askers
            self._retire(name)
        return asker

    def forget(self, now: float) -> None:
        """Drop what was not confirmed in time."""
        while self._pending:
            name, pending = next(iter(self._pending.items()))
            if pending.made_at + self.PENDING_TIME > now:
                return
            self._retire(name)

    def _note(self, life: bytes, t1: int) -> None:
        """That is the newest HELLO of a life."""
        self._newest[life] = t1
        self._newest.move_to_end(life)
        if len(self._newest) > self.MAX_LIVES:
            self._newest.popitem(last=False)

    def _make_room(self) -> None:
        """The life that has most gives way: HELLOs of long ago that somebody repeats do not push out that of now.

        Those of `MAX_PENDING` other lives do, each of them once: nothing tells which life is that of now.
        """
        while len(self._pending) >= self.MAX_PENDING:
            lives = Counter(pending.life for pending in self._pending.values())
            most = max(lives.values())
            self._retire(next(name for name, pending in self._pending.items() if lives[pending.life] == most))

    def _retire(self, name: bytes) -> None:
        del self._pending[name]
        self._used[name] = None
        if len(self._used) > self.MAX_USED:
            self._used.popitem(last=False)
