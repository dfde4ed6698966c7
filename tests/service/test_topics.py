from __future__ import annotations

import logging
import math
import threading

import pytest

from skytether.messages import EncodeError, Float64, LaserScan, Twist, Vector3, encode
from skytether.service import AnyInput, Input, NoParams, Output, Service
from skytether.service.mailbox import Mailbox, RawQueue
from skytether.testing.service import Harness
from skytether.wire.events import MessageReceived
from skytether.wire.topic import Topic


class Echo(Service[NoParams]):
    rate_hz = 10.0
    value = Input(Float64)
    speed = Input(Twist, topic="robot/speed")
    reply = Output(Twist, topic="cmd_vel")

    def step(self, now: float) -> None:
        pass


class Listener(Service[NoParams]):
    rate_hz = 10.0
    value = Input(Float64)
    rest = AnyInput()

    def step(self, now: float) -> None:
        pass


def arrive(payload: bytes, sequence: int = 0, *, sent_at: float = 10.0, error: float = 0.001) -> MessageReceived:
    return MessageReceived("value", payload, sequence, sent_at, error, 10.5)


def mailbox() -> Mailbox[Float64]:
    return Mailbox("value", Float64, logging.getLogger("test"))


def test_mailbox_is_empty_at_first() -> None:
    box = mailbox()
    assert box.latest is None
    assert box.take() is None


def test_a_message_that_is_too_large_is_passed_over_and_counted() -> None:
    box = Mailbox("value", Float64, logging.getLogger("test"), max_bytes=100)
    box.put(arrive(encode(Float64(1.0))), "cdr")
    assert box.latest is not None
    box.put(arrive(encode(Float64(2.0)) + bytes(100), 1), "cdr")
    assert box.latest is not None
    assert (box.latest.message.data, box.undecodable) == (1.0, 1)


def test_an_input_says_how_large_its_messages_may_be() -> None:
    class Small(Service[NoParams]):
        rate_hz = 10.0
        value = Input(Float64, max_bytes=4)

        def step(self, now: float) -> None:
            pass

    harness = Harness(Small)
    harness.send("value", Float64(1.0))
    assert harness.service.value.take() is None
    assert harness.service.value.undecodable == 1


def test_latest_stays_and_take_is_once() -> None:
    box = mailbox()
    box.put(arrive(encode(Float64(1.0))), "cdr")
    box.put(arrive(encode(Float64(2.0)), 4), "cdr")
    for _ in range(2):
        assert box.latest is not None
        assert (box.latest.message.data, box.latest.sequence) == (2.0, 4)
    assert box.take() is box.latest
    assert box.take() is None
    assert box.latest is not None
    box.put(arrive(encode(Float64(3.0), "ros1"), 5), "ros1")
    taken = box.take()
    assert taken is not None
    assert taken.message == Float64(3.0)


def test_age_counts_from_publishing_once_the_clocks_are_known() -> None:
    box = mailbox()
    box.put(arrive(encode(Float64())), "cdr")
    assert box.latest is not None
    assert box.latest.age(11.0) == 1.0
    box.put(arrive(encode(Float64()), error=math.inf), "cdr")
    assert box.latest.age(11.0) == 0.5


def test_undecodable_is_counted_logged_once_and_leaves_the_last_good_one(caplog: pytest.LogCaptureFixture) -> None:
    box = mailbox()
    box.put(arrive(encode(Float64(1.0))), "cdr")
    assert box.take() is not None
    for sequence in range(3):
        box.put(arrive(b"\x00\x01\x00\x00junk", sequence), "cdr")
        assert box.take() is None
    assert box.latest is not None
    assert box.latest.message.data == 1.0
    assert box.undecodable == 3
    assert len(caplog.records) == 1
    assert "topic value: 8 bytes are no std_msgs/msg/Float64 in cdr" in caplog.text


def test_raw_queue_keeps_order_and_bytes() -> None:
    queue = RawQueue(10, 1000)
    for sequence in range(3):
        queue.put(arrive(bytes([sequence]), sequence), "acme_msgs/msg/X", "ros1")
    assert len(queue) == 3
    first = queue.take()
    assert first is not None
    assert (first.topic, first.type, first.encoding, first.payload, first.sequence, first.sent_at) == (
        "value",
        "acme_msgs/msg/X",
        "ros1",
        b"\x00",
        0,
        10.0,
    )
    rest = [queue.take(), queue.take()]
    assert [r.sequence for r in rest if r is not None] == [1, 2]
    assert queue.take() is None


@pytest.mark.parametrize(("queue", "kept"), [(RawQueue(4, 1000), 4), (RawQueue(100, 35), 3)])
def test_raw_queue_drops_the_oldest_beyond_its_bounds(queue: RawQueue, kept: int) -> None:
    for sequence in range(10):
        queue.put(arrive(bytes(10), sequence), "t", "cdr")
    assert len(queue) == kept
    assert queue.dropped == 10 - kept
    oldest = queue.take()
    assert oldest is not None
    assert oldest.sequence == 10 - kept
    queue.put(arrive(bytes(10), 10), "t", "cdr")
    assert queue.dropped == 10 - kept, "what was taken made room"


def test_raw_queue_between_two_threads_neither_loses_nor_doubles() -> None:
    queue = RawQueue(50, 10**6)
    count = 20_000
    taken: list[int] = []

    def feed() -> None:
        for sequence in range(count):
            queue.put(arrive(b"x", sequence), "t", "cdr")

    feeder = threading.Thread(target=feed)
    feeder.start()
    while feeder.is_alive() or len(queue):
        message = queue.take()
        if message is not None:
            taken.append(message.sequence)
    feeder.join()
    assert len(taken) + queue.dropped == count
    assert taken == sorted(set(taken))


def test_names_are_the_attributes_unless_given() -> None:
    assert [(d.topic, d.direction, d.type_name) for d in Echo.declared] == [
        ("value", "in", "std_msgs/msg/Float64"),
        ("robot/speed", "in", "geometry_msgs/msg/Twist"),
        ("cmd_vel", "out", "geometry_msgs/msg/Twist"),
    ]


def test_two_instances_share_nothing() -> None:
    first, second = Harness(Echo), Harness(Echo)
    first.send("value", Float64(1.0))
    assert first.service.value.latest is not None
    assert second.service.value.latest is None


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_messages_go_both_ways_in_the_robots_encoding(encoding) -> None:
    harness = Harness(Echo, encoding=encoding)
    harness.send("robot/speed", Twist(Vector3(x=0.2)), age=0.03)
    received = harness.service.speed.latest
    assert received is not None
    assert received.message.linear.x == 0.2
    assert received.age(harness.now) == pytest.approx(0.03)
    assert harness.service.reply.publish(Twist(Vector3(x=0.1)))
    assert harness.newest("cmd_vel") == Twist(Vector3(x=0.1))


def test_an_agreed_encoding_is_compiled_once_and_before_the_next_step_not_in_the_bridges_thread(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    warmed: list[tuple[str, str]] = []
    monkeypatch.setattr(
        "skytether.service.port.warm",
        lambda types, encoding: warmed.extend((cls.__name__, encoding) for cls in types),
    )
    harness = Harness(Echo, encoding="ros1")
    assert warmed == []
    harness.step()
    harness.step()
    assert sorted(warmed) == [("Float64", "ros1"), ("Twist", "ros1"), ("Twist", "ros1")]


def test_publish_without_a_robot_is_false() -> None:
    harness = Harness(Echo)
    harness.disconnect()
    assert not harness.service.reply.publish(Twist())
    assert harness.newest("cmd_vel") is None
    assert not Echo(NoParams()).reply.publish(Twist())


def test_publish_of_another_type_or_value_is_the_authors_fault() -> None:
    harness = Harness(Echo)
    with pytest.raises(TypeError, match=r"topic cmd_vel carries geometry_msgs/msg/Twist, not LaserScan"):
        harness.service.reply.publish(LaserScan())
    with pytest.raises(EncodeError):
        harness.service.reply.publish(Twist(Vector3(x="fast")))


def test_any_input_takes_what_no_other_input_does() -> None:
    harness = Harness(Listener)
    harness.connect(Topic("camera", "sensor_msgs/msg/CompressedImage", "in", encoding="ros1"))
    harness.send("camera", b"\xff\xd8")
    harness.send("value", Float64(1.0))
    harness.send("never agreed", b"")
    raw = harness.service.rest.take()
    assert raw is not None
    assert (raw.topic, raw.type, raw.encoding, raw.payload) == (
        "camera",
        "sensor_msgs/msg/CompressedImage",
        "ros1",
        b"\xff\xd8",
    )
    assert harness.service.rest.take() is None
    assert harness.service.value.latest is not None


def test_an_encoding_that_nobody_knows_is_logged_and_its_topic_left_out(caplog: pytest.LogCaptureFixture) -> None:
    harness = Harness(Listener)
    harness.connect(Topic("odd", "x/msg/Y", "in", encoding="xml"))
    harness.send("odd", b"<y/>")
    assert harness.service.rest.take() is None
    assert "topic odd: the robot's encoding 'xml' is not known here" in caplog.text


def test_declaring_a_topic_twice_is_refused() -> None:
    with pytest.raises(TypeError, match="topic 'value' is declared twice"):

        class Twice(Echo):
            again = Input(Float64, topic="value")


def test_a_trigger_must_be_an_input() -> None:
    with pytest.raises(TypeError, match=r"trigger 'cmd_vel' is no Input; there are value, robot/speed"):

        class Wrong(Echo):
            trigger = "cmd_vel"


def test_a_subclass_may_replace_a_declaration() -> None:
    class Renamed(Echo):
        value = Input(Float64, topic="other")

    assert [d.topic for d in Renamed.declared] == ["other", "robot/speed", "cmd_vel"]
