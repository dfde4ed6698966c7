"""What waits for the socket: who goes first, and what is lost where it is slow."""

import socket

import pytest
from ros2_nodes import until

from skytether.ros.ros2.native.side import outbox as module
from skytether.ros.ros2.native.side.frames import HEAD, Frame, Kind, control, pull_frame
from skytether.ros.ros2.native.side.outbox import Outbox, Sender


def data(channel, body=b"x"):
    return Frame(Kind.DATA, channel, body)


@pytest.fixture
def outbox():
    made = Outbox()
    made.set(1, 10, 2)
    made.set(2, 10, 2)
    made.set(3, 100, 1)
    return made


def drain(outbox):
    return [(f.channel, f.body) for f in iter(outbox.pop, None)]


def test_a_full_queue_loses_its_own_oldest_and_counts_it(outbox):
    assert [outbox.put(1, data(1, b"%d" % i)) for i in range(4)] == [0, 0, 1, 1]
    assert outbox.put(2, data(2)) == 0
    assert outbox.dropped() == {1: 2}
    assert drain(outbox) == [(1, b"2"), (2, b"x"), (1, b"3")]


def test_what_matters_more_goes_first_and_equals_take_turns(outbox):
    for channel in (1, 1, 2, 2, 3):
        outbox.put(channel, data(channel))
    outbox.put(0, control(do="close"))
    assert [channel for channel, _ in drain(outbox)] == [0, 3, 1, 2, 1, 2]


def test_a_topic_holds_so_many_bytes_and_always_its_newest(outbox, monkeypatch):
    monkeypatch.setattr(module, "MAX_BYTES", 10)
    assert outbox.put(1, data(1, bytes(6))) == 0
    assert outbox.put(1, data(1, bytes(7))) == 1
    assert outbox.put(1, data(1, bytes(20))) == 1
    assert [len(body) for _, body in drain(outbox)] == [20]


def test_a_closed_channel_takes_nothing(outbox):
    outbox.put(1, data(1))
    outbox.remove(1)
    assert outbox.put(1, data(1)) == 1
    assert drain(outbox) == []
    outbox.set(1, 10, 1)
    assert outbox.put(1, data(1)) == 0


def test_a_side_that_does_not_read_costs_its_topics_old_messages_only():
    ours, its = socket.socketpair()
    sender = Sender(ours)
    sender.set(1, 1, 1)
    sender.set(2, 2, 1)
    sender.put(data(1, bytes(10_000_000)))
    assert its.recv(1)  # the sender is at it, and stuck
    for i in range(100):
        sender.put(data(1, b"%d" % i))
    sender.put(data(2, b"stop"))
    assert sender.dropped() == {1: 99}
    with its.makefile("rb") as stream:
        assert len(stream.read(HEAD.size - 1 + 10_000_000)) > 10_000_000
        assert [pull_frame(stream).body for _ in range(2)] == [b"stop", b"99"]
    its.close()
    until(lambda: sender.put(data(1)), "the loss to be seen")
    ours.close()
