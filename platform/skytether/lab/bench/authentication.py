"""What authentic packets cost: processor time of a message at both ends, and how much of it its tags take.

Two sessions in this process, in made-up time, with no sockets between them. The tags are made and checked again by
themselves, in the same batches, for what they take.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from random import Random

import numpy as np

from skytether.wire import Config, Direction, MessageReceived, Role, Session, Topic
from skytether.wire.codec.crypto import KEY_SIZE, TAG_SIZE, Aead
from skytether.wire.codec.packet import DATA, HEADER_SIZE, SHARD
from skytether.wire.codec.tags import SECRET_SIZE, Tags

from .pair import BenchError

SIZES = (100, 47_611, 1_000_000)
"""Bytes: a command, the thesis's laser scan as it was published there, a picture."""
_TOPIC = Topic("data", "std_msgs/msg/String", Direction.IN, priority=100, lifespan=60.0)
_CONFIG = Config(rate_bps=1e9)
_LEARN_S = 2.0
"""Of made-up time, for the handshake and the search for the largest packet."""
_REST_S = 0.05
_NONCE = bytes(12)


@dataclass(frozen=True, slots=True)
class AuthenticationRow:
    """One size of message.

    Attributes:
        size: Bytes.
        packets: Of one message.
        n: Messages.
        sender_us: Processor time at the sender, the least of all messages: what else the machine does only adds.
        sender_tags_us: Of it to make the tags; of a message in one packet, to seal it, which encrypts it, too.
        receiver_us: The same at the receiver.
        receiver_tags_us: To check the tags, or open the packet.
    """

    size: int
    packets: int
    n: int
    sender_us: float
    sender_tags_us: float
    receiver_us: float
    receiver_tags_us: float

    def document(self) -> dict[str, object]:
        """For ``--json``."""
        return asdict(self)


class _Pair:
    """Both ends, and what was sent from the robot's end since somebody looked.

    Args:
        clock: Processor time [s].
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        entropy = Random(0).randbytes
        key = entropy(KEY_SIZE)
        self._ends = {
            role: Session(role, 1, key, (_TOPIC,), config=_CONFIG, entropy=entropy, now=0.0)
            for role in (Role.ROBOT, Role.SERVICE)
        }
        self._ends[Role.ROBOT].set_peer("service")
        self._clock = clock
        self._now = 0.0
        self.sent: list[tuple[bytes, int]] = []
        """Datagrams, and the size of the packets in them."""
        self.spent = dict.fromkeys(Role, 0.0)
        self.arrived = 0

    def publish(self, payload: bytes) -> None:
        """One message from the robot's end."""
        begun = self._clock()
        if not self._ends[Role.ROBOT].publish("data", payload, self._now):
            raise BenchError("the session is not up")
        self.spent[Role.ROBOT] += self._clock() - begun

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Let time pass."""
        end = self._now + seconds
        while not until():
            for role, other in ((Role.ROBOT, Role.SERVICE), (Role.SERVICE, Role.ROBOT)):
                self._carry(role, other)
            timers = [due for one in self._ends.values() if (due := one.next_timer()) is not None]
            if not timers or min(timers) > end:
                break
            self._now = max(self._now, min(timers))
            for role, one in self._ends.items():
                begun = self._clock()
                one.handle_timer(self._now)
                self.spent[role] += self._clock() - begun
        else:
            return
        self._now = end

    def _carry(self, role: Role, other: Role) -> None:
        receiver = self._ends[other]
        while True:
            begun = self._clock()
            batches = self._ends[role].transmit(self._now)
            self.spent[role] += self._clock() - begun
            if not batches:
                return
            for _, _, data, segment in batches:
                copied = bytes(data)
                if role is Role.ROBOT:
                    self.sent.append((copied, segment or len(copied)))
                begun = self._clock()
                receiver.receive(copied, role.name, self._now, segment=segment)
                while (event := receiver.next_event()) is not None:
                    self.arrived += isinstance(event, MessageReceived)
                self.spent[other] += self._clock() - begun


def bench_authentication(
    n: int,
    sizes: Sequence[int] = SIZES,
    clock: Callable[[], float] = time.thread_time,
    patience_s: float = 10.0,
) -> list[AuthenticationRow]:
    """Send messages of each size, one after the other.

    Args:
        n: Messages of each size.
        sizes: Bytes of a message.
        clock: Processor time of this thread [s].
        patience_s: Made-up seconds that a message gets to arrive.

    Raises:
        BenchError: A message did not arrive.
    """
    pair = _Pair(clock)
    pair.run(_LEARN_S)
    return [_measure(pair, size, n, clock, patience_s) for size in sizes]


def _measure(pair: _Pair, size: int, n: int, clock: Callable[[], float], patience_s: float) -> AuthenticationRow:
    payload = Random(size).randbytes(size)
    again = _Again(clock)
    found, packets = [], 0
    for number in range(n):
        pair.run(_REST_S)
        pair.sent.clear()
        pair.spent = dict.fromkeys(Role, 0.0)
        pair.arrived = 0
        pair.publish(payload)
        pair.run(patience_s, lambda: pair.arrived > 0)
        if not pair.arrived:
            raise BenchError(f"message {number} of {size} bytes did not arrive")
        batches = [one for one in pair.sent if one[0][0] in (DATA, SHARD)]
        packets = sum(-(-len(data) // segment) for data, segment in batches)
        found.append((pair.spent[Role.ROBOT], again.make(batches), pair.spent[Role.SERVICE], again.check(batches)))
    least = [1e6 * min(times) for times in zip(*found, strict=True)]
    return AuthenticationRow(size, packets, n, *least)


class _Again:
    """Tags of packets that were sent, made and checked by themselves, under a key of its own.

    Args:
        clock: Processor time [s].
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._tags = Tags(bytes(SECRET_SIZE))
        self._aead = Aead(bytes(KEY_SIZE))

    def make(self, batches: Sequence[tuple[bytes, int]]) -> float:
        """Seconds for the tags of what was sent."""
        copies = [(data if data[0] == DATA else bytearray(data), segment) for data, segment in batches]
        begun = self._clock()
        for data, segment in copies:
            if isinstance(data, bytes):
                self._sealed(data)
                continue
            for part, size in _parts(len(data), segment):
                self._tags.put(np.frombuffer(data, np.uint8)[part].reshape(-1, size))
        return self._clock() - begun

    def check(self, batches: Sequence[tuple[bytes, int]]) -> float:
        """Seconds to check them."""
        ours = [(self._sealed(data) if data[0] == DATA else data, segment) for data, segment in batches]
        begun = self._clock()
        for data, segment in ours:
            if data[0] == DATA:
                self._aead.open(_NONCE, data[HEADER_SIZE:], data[:HEADER_SIZE])
                continue
            for part, size in _parts(len(data), segment):
                if part.stop - part.start > size:
                    self._tags.check(np.frombuffer(data, np.uint8)[part].reshape(-1, size))
                else:
                    self._tags.check_one(data[part])
        return self._clock() - begun

    def _sealed(self, data: bytes) -> bytes:
        """A packet with a whole message, as this key seals it."""
        header = data[:HEADER_SIZE]
        return header + self._aead.seal(_NONCE, data[HEADER_SIZE:-TAG_SIZE], header)


def _parts(length: int, segment: int) -> list[tuple[slice, int]]:
    """Of a batch the packets of one size, and the shorter one at its end."""
    whole = length - length % segment
    return [part for part in ((slice(0, whole), segment), (slice(whole, length), length - whole)) if part[1]]
