"""What is fuzzed: each target takes any bytes and raises only if a promise of the bridge is broken.

Everything is deterministic, so what breaks once breaks again. Several targets read a script from the bytes: what
arrives how, and when. Keys are known here: a peer that is authentic may still be hostile or mistaken.
"""

from __future__ import annotations

import contextlib
import math
import struct
import zlib
from collections.abc import Callable
from random import Random

import numpy as np
from insider import epoch_of

from skytether.bridge.relay_table import AMPLIFICATION, Prefix, RelayLimits, RelayTable, same_session
from skytether.wire import Config, Direction, Role, Session, Topic
from skytether.wire.codec import frames, packet
from skytether.wire.codec.negotiation import MAX_TOPICS, index_topics, pull_answer, pull_offer
from skytether.wire.connect.handshake import (
    _HELLO,
    _WELCOME,
    LIFE_SIZE,
    MAX_HANDSHAKE,
    MIN_HELLO,
    NO_KEYS,
    ROW_HELLO,
    HandshakeResponder,
    Hello,
    Pending,
    _key,
    _pack,
)
from skytether.wire.fec.fragment import MAX_SHARDS
from skytether.wire.fec.reassembly import Reassembly
from skytether.wire.send.message import Message

KEY = bytes(range(32))
SESSION_ID = 0x1122334455667788
TOPICS = (
    Topic("scan", "t/msg/S", Direction.IN, lifespan=0.2),
    Topic("log", "t/msg/L", Direction.IN, lifespan=1.0, depth=100, reliable=True, compression="zstd"),
    Topic("cmd_vel", "t/msg/V", Direction.OUT, priority=127),
    Topic("map", "t/msg/M", Direction.OUT, priority=1, lifespan=5.0, depth=3, reliable=True, latched=True),
)
CONFIG = Config(max_message=100_000, reassembly_limit=200_000, queue_limit=200_000)
HELLO_HEAD, WELCOME_HEAD = _HELLO.size - 4, _WELCOME.size - 4
LOOPS = 1000
"""Turns after which an end is taken to speak for ever."""


class Script:
    """Reads values from bytes; zeros after their end."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    @property
    def over(self) -> bool:
        return self._at >= len(self._data)

    def take(self, count: int) -> bytes:
        part = self._data[self._at : self._at + count]
        self._at += count
        return part

    def number(self, size: int = 1) -> int:
        return int.from_bytes(self.take(size).ljust(size, b"\0"))


def headers(data: bytes) -> None:
    """Codecs of the clear header, and how a relay splits a batch."""
    fields = packet.pull_header(data)
    assert (fields is None) == (packet.peek_id(data) is None) == (len(data) < packet.HEADER_SIZE)
    if fields is not None:
        common = packet.push_common(*fields[:6])
        assert common + packet.push_shard(*fields[6:]) == data[: packet.HEADER_SIZE]
    script = Script(data)
    segment, rest = script.number(2), data[2:]
    parts = list(same_session(memoryview(rest), segment or None))
    assert b"".join(part for part, _, _ in parts) == rest


def controls(data: bytes) -> None:
    """Codec of frames."""
    message = frames.pull_frame(data)
    if isinstance(message, frames.Ping):
        again = frames.pull_frame(frames.push_ping(message))
        assert again == message


def tables(data: bytes) -> None:
    """Codecs of the topic tables in handshakes, which are decompressed and parsed."""
    for text in (data, zlib.compress(data)):
        for pull in (pull_offer, lambda part: pull_answer(part, TOPICS)):
            with contextlib.suppress(ValueError):
                assert len(pull(text)) <= MAX_TOPICS


def hellos(data: bytes) -> None:
    """The service's answer to what a robot says that holds the key."""
    entropy = Random(1).randbytes
    responder = HandshakeResponder(KEY, index_topics(TOPICS), entropy)
    offer = zlib.compress(data[HELLO_HEAD:])
    text = data[:HELLO_HEAD].ljust(HELLO_HEAD, b"\0") + len(offer).to_bytes(4, "big") + offer
    salt = entropy(32)
    for plaintext in (data, text.ljust(MIN_HELLO, b"\0")):
        common, message = _pack(packet.HELLO, SESSION_ID, salt, _key(KEY, salt, b"hello"), plaintext)
        answer = responder.answer(common, message, NO_KEYS, set(), 1.0)
        again = responder.answer(common, message, NO_KEYS, set(), 2.0)
        assert type(again) is type(answer)
        if isinstance(answer, Pending):
            rows = text.count(b"[")
            assert answer.reason or len(answer.message) <= 3 * (len(message) + ROW_HELLO * rows)


def welcomes(data: bytes) -> None:
    """What the robot makes of an answer from who holds the key."""
    entropy = Random(1).randbytes
    hello = Hello(SESSION_ID, KEY, TOPICS, 1, NO_KEYS, bytes(LIFE_SIZE), entropy, 0.0)
    agreed = zlib.compress(data[WELCOME_HEAD:])
    text = data[:WELCOME_HEAD].ljust(WELCOME_HEAD, b"\0") + len(agreed).to_bytes(4, "big") + agreed
    salt = entropy(32)
    key = _key(KEY, salt, b"welcome", hello.message)
    for plaintext in (data, text):
        welcome = hello.open(*_pack(packet.WELCOME, SESSION_ID, salt, key, plaintext))
        if welcome is not None and welcome.outcome is not None:
            assert {t.name for _, t in welcome.outcome.topics} <= {t.name for t in TOPICS}


def shards(data: bytes) -> None:
    """Reassembly of shards that anybody may have made up."""
    limit, script, now = 50_000, Script(data), 0.0
    store = Reassembly(limit, lambda topic: None)
    while not script.over:
        op = script.number()
        now += (op >> 4) * 0.05
        size, length = script.number(2) % 600, script.number(3)
        topic, block, count = op & 3, script.number() % 8, 1 + script.number() % 20
        common = packet.push_common(packet.DATA, SESSION_ID, 0, script.number(), topic, length)
        entry = store.entry(common, size, length, topic, block, 0.2, now)
        if entry is not None:
            step, first = script.number() % 5, script.number()
            indices = [(first + i * step) % MAX_SHARDS for i in range(count)]
            if op & 8:
                whole = store.add_all(entry, block, np.array(indices, np.uint8), np.zeros((count, size), np.uint8))
            else:
                whole = next(
                    (w for i in indices if entry.alive and (w := store.add(entry, block, i, bytes(size)))), None
                )
            assert whole is None or len(whole) == length
        assert 0 <= store.used <= limit
    store.expire_all(now + 1)
    assert store.used == len(store) == 0


class Ends:
    """A robot and a service that are connected, without any link in between."""

    def __init__(self) -> None:
        entropy = Random(1).randbytes
        self.now = 1.0
        self.ends = {
            role: Session(role, SESSION_ID, KEY, TOPICS, config=CONFIG, entropy=entropy, now=0.0) for role in Role
        }
        self.ends[Role.ROBOT].set_peer("service")
        for _ in range(8):
            for role in Role:
                self.ends[role].handle_timer(self.now)
                for sent in self.drain(role):
                    self.ends[other(role)].receive(sent.data, role.value, self.now, segment=sent.segment)
            self.now += 0.001
        assert all(end.stats(self.now).connected for end in self.ends.values())

    def drain(self, role: Role) -> list:
        """Events and packets of an end, as its owner would take them."""
        end, sent = self.ends[role], []
        for _ in range(LOOPS):
            if end.next_event() is None:
                break
        for _ in range(LOOPS):
            batch = end.transmit(self.now)
            if not batch:
                return sent
            sent += batch
        raise AssertionError("an end speaks for ever")

    def check(self, role: Role) -> None:
        """What holds whatever arrived."""
        end = self.ends[role]
        stats = end.stats(self.now)
        assert stats.reassembly_bytes <= CONFIG.reassembly_limit + 2 * MAX_HANDSHAKE
        for topic in stats.topics:
            assert min(topic.delivered, topic.late, topic.superseded, topic.duplicate, topic.expired) >= 0
        due = end.next_timer()
        assert due is None or not math.isnan(due)


def other(role: Role) -> Role:
    return Role.SERVICE if role is Role.ROBOT else Role.ROBOT


def strangers(data: bytes) -> None:
    """A live session to which anybody may send packets: nothing but counters may change, nobody is answered."""
    script = Script(data)
    ends = Ends()
    role = tuple(Role)[script.number() & 1]
    end = ends.ends[role]
    ends.drain(role)
    before = end.stats(ends.now)
    paths = [(p.packets_received, p.loss_in) for p in before.paths]
    packet_id, epoch = epoch_of(end).ciphers.packet_id, epoch_of(end).id
    while not script.over:
        op = script.number()
        body = script.take(script.number() * (8 if op & 64 else 1))
        if op & 1:
            header = (packet.DATA, packet.SHARD, packet.HELLO, packet.WELCOME)[op >> 1 & 3]
            length = len(body) if op & 8 else script.number(3)
            named = SESSION_ID if header == packet.HELLO else packet_id
            common = packet.push_common(header, named, epoch, script.number(), script.number() % 8, length)
            body = (
                common
                + packet.push_shard(script.number() % 3, script.number(), 0, script.number(4), script.number(2))
                + body
            )
        segment = None
        if op & 16 and body:
            segment = len(body)
            body = body * (1 + script.number() % 16)
            body = body[: len(body) - script.number() % segment]
        end.receive(body, "stranger", ends.now, segment=segment, path=0 if op & 32 else None)
        assert end.next_event() is None
        assert end.transmit(ends.now) == []
    after = end.stats(ends.now)
    assert (after.connected, after.handshakes, after.clock_offset) == (True, before.handshakes, before.clock_offset)
    assert [p.address for p in after.paths] == [p.address for p in before.paths]
    assert [(p.packets_received, p.loss_in) for p in after.paths] == paths
    assert after.reassembly_bytes == before.reassembly_bytes
    assert [(t.delivered, t.sent) for t in after.topics] == [(t.delivered, t.sent) for t in before.topics]
    ends.check(role)


def peers(data: bytes) -> None:
    """A live session whose peer seals any bytes with the right keys, from any address, at any time."""
    script = Script(data)
    ends = Ends()
    role = tuple(Role)[script.number() & 1]
    end = ends.ends[role]
    peer = epoch_of(ends.ends[other(role)])
    number = peer.next_number + 1000
    while not script.over:
        op = script.number()
        kind = op & 7
        if kind == 0:
            ends.now += script.number() * 0.02
            end.handle_timer(ends.now)
        elif kind == 1:
            topics = ("cmd_vel", "map") if role is Role.SERVICE else ("scan", "log")
            end.publish(topics[op >> 3 & 1], bytes(script.number(2)), ends.now)
        else:
            number += 1
            topic = 0 if kind < 5 else script.number() % 6
            stamp = script.number(8) if op & 8 else round(ends.now * 1e6)
            sequence = script.number(4) if op & 16 else number % 1000
            plaintext = struct.pack(">IQ", sequence, stamp) + script.take(script.number())
            path = script.number() if op & 32 else 0
            message = Message(peer.ciphers, peer.id, number, topic, plaintext)
            if op & 128:
                shards = message.shards(script.number(2) % 1200 + 240)
                whole = bytes(shards.make_packets(1 + script.number() % shards.remaining, path, number, 0))
                end.receive(whole, "elsewhere", ends.now, segment=shards.packet_size)
                continue
            whole = message.packet(path, number, 0)
            end.receive(whole, "elsewhere" if op & 64 else other(role).value, ends.now)
        ends.drain(role)
        ends.check(role)
    for _ in range(3):
        ends.now += 0.6
        end.handle_timer(ends.now)
        ends.drain(role)
        ends.check(role)


def relays(data: bytes) -> None:
    """A relay's table: bounds hold, nobody gets what is not theirs, every leg is handed back once."""
    limits = RelayLimits(sessions=2, addresses=2, newcomers=3, rate_bps=8e5, idle=20.0)
    table, script, now = RelayTable(limits), Script(data), 0.0
    targets = ("service", 1), ("other", 1)
    for text, target in (("*", targets[0]), ("01*", targets[1])):
        table.add(Prefix.parse(text), target, now)
    came: dict[int, int] = {}
    went: dict[int, int] = {}
    opened = []
    while not script.over:
        op = script.number()
        kind, size = op & 3, script.number(2) % 1500
        hello = kind == 1 and not op & 128
        first = b"\x21" if hello else b"\x20"
        body = (first + bytes([op >> 2 & 3]) + bytes(6) + bytes([op >> 4])).ljust(size, b"x")[:size]
        if kind == 0:
            now += size / 100
            table.expire(now)
        elif kind == 1 or not table.legs:
            leg = table.up(body, (f"robot{script.number() % 8}", 5), now)
            if leg is not None:
                if leg not in opened:
                    opened.append(leg)
                assert leg.route.prefix.holds(leg.session_id)
                came[id(leg)] = came.get(id(leg), 0) + size
        elif kind == 2:
            leg = table.legs[script.number() % len(table.legs)]
            new = leg.session_id not in table.sessions
            if table.down(leg, body, targets[script.number() & 1], now):
                went[id(leg)] = went.get(id(leg), 0) + size
                assert not new or went[id(leg)] <= AMPLIFICATION * came[id(leg)]
        elif not table.remove(Prefix.parse("01*")):
            table.add(Prefix.parse("01*"), targets[1], now)
        assert len(table.sessions) <= limits.sessions
        assert all(1 <= len(s.legs) <= limits.addresses for s in table.sessions.values())
        assert all(len(r.newcomers) <= limits.newcomers for r in table.routes)
    table.expire(now + 100)
    assert not table.legs
    assert not table.sessions
    assert len(table.closed) == len(opened)


TARGETS: dict[str, Callable[[bytes], None]] = {
    f.__name__: f for f in (headers, controls, tables, hellos, welcomes, shards, strangers, peers, relays)
}
