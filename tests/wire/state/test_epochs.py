"""The keys in use and those before them: which open a packet, and for how long."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

from skytether.wire.state.epoch import Epoch
from skytether.wire.state.epochs import Epochs

OLD_KEYS = 2.0


class Receiver:
    """Of one topic; notes when its losses were made final."""

    def __init__(self) -> None:
        self.index, self.settled_at = 0, list[float]()

    def settle(self, now: float) -> None:
        self.settled_at.append(now)


def epoch(packet_id: int, life: bytes = b"a") -> Any:
    receiver: Any = Receiver()
    ciphers: Any = SimpleNamespace(packet_id=packet_id)
    return Epoch(packet_id % 256, ciphers, (), [], [receiver], life)


def test_packets_of_both_keys_are_opened_and_of_no_others():
    epochs = Epochs(OLD_KEYS)
    assert epochs.find(1) is None
    first, second = epoch(1), epoch(2)
    assert not epochs.start(first, 0.0)  # there is nothing before it
    assert epochs.start(second, 10.0)
    assert [epochs.find(packet_id) for packet_id in (1, 2, 3)] == [first, second, None]
    third = epoch(3)
    epochs.start(third, 11.0)
    assert [epochs.find(packet_id) for packet_id in (1, 2, 3)] == [None, second, third]
    epochs.end()
    assert [epochs.find(packet_id) for packet_id in (1, 2, 3)] == [None] * 3


def test_keys_before_are_kept_for_as_long_as_packets_come_by_them():
    epochs = Epochs(OLD_KEYS)
    first = epoch(1)
    epochs.start(first, 0.0)
    assert epochs.check(1.0) == math.inf
    epochs.start(epoch(2), 10.0)
    assert epochs.check(10.0) == 12.0
    first.heard_at = 11.5
    assert epochs.check(12.0) == 13.5
    assert epochs.previous is first
    assert epochs.check(13.5) == math.inf
    assert epochs.previous is None


def test_losses_are_final_once_the_keys_of_another_peer_are_dropped_but_not_those_of_the_same():
    epochs = Epochs(OLD_KEYS)
    same, other = epoch(1), epoch(3, life=b"b")
    receivers: Any = same.receive
    epochs.start(same, 0.0)
    epochs.start(epoch(2), 1.0)
    epochs.check(9.0)
    assert receivers[0].settled_at == []  # the keys after it go on with its topics
    assert not epochs.start(other, 10.0)
    assert epochs.check(12.0) == math.inf
    assert receivers[0].settled_at == [math.inf]
