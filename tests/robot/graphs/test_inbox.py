"""Where readings wait: none pushes out another's, and a press is never lost."""

import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.messages import Bool, Joy, LaserScan, PointCloud2, Range, encode
from skytether.robot.graphs.inbox import Inbox, Topics

TOPICS = Topics(
    {"scan": LaserScan, "cloud": PointCloud2, "joy": Joy, "estop": Bool, "bumper": Bool, "cliff": Range},
    {
        "estop": lambda message: message.data,
        "bumper": lambda message: not message.data,
        "cliff": lambda message: message.range > 0.1,
    },
)


class Box:
    def __init__(self, encoding: str = "cdr") -> None:
        self.told: dict[str, str] = {}
        self.encoding = encoding
        self.inbox = Inbox(TOPICS, encoding, lambda kind, sentence: self.told.setdefault(kind, sentence))

    def put(self, topic, message) -> None:
        self.inbox.put(topic, encode(message, self.encoding))


def scan(distance: float) -> LaserScan:
    return LaserScan(ranges=np.full(10, distance, dtype=np.float32))


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_a_press_among_hundreds_of_scans_and_releases_is_kept(encoding):
    box = Box(encoding)
    for i in range(300):
        box.put("scan", scan(float(i)))
    box.put("estop", Bool(data=True))
    for i in range(300):
        box.put("scan", scan(float(i)))
        box.put("estop", Bool(data=False))
    assert [(topic, message.data) for topic, message in box.inbox.drain_stops()] == [("estop", True), ("estop", False)]
    assert box.inbox.drain_stops() == []
    # Of the scans, the newest.
    assert [message.ranges[0] for _, message in box.inbox.drain()] == [299.0]


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(["estop", "bumper", "cliff"]), st.booleans()), max_size=40))
def test_whatever_the_order_a_press_is_among_what_is_taken_and_the_newest_word_is_last(said):
    box = Box()
    for topic, value in said:
        box.put(topic, Range(range=0.5 if value else 0.05) if topic == "cliff" else Bool(data=value))
    taken = box.inbox.drain_stops()
    for topic, is_stop in TOPICS.stops.items():
        words = [message for its, message in taken if its == topic]
        expected = [value if topic != "bumper" else not value for its, value in said if its == topic]
        assert any(map(is_stop, words)) == any(expected)
        assert len(words) <= 2
        if expected:
            assert bool(is_stop(words[-1])) is expected[-1]


def test_a_joystick_is_not_pushed_out_by_scans():
    box = Box()
    box.put("joy", Joy(buttons=np.array([1], dtype=np.int32)))
    for _ in range(100):
        box.put("scan", scan(1.0))
    for i in range(30):
        box.put("joy", Joy(buttons=np.array([i], dtype=np.int32)))
    taken = box.inbox.drain()
    assert [topic for topic, _ in taken] == ["scan"] + ["joy"] * 16
    assert taken[-1][1].buttons[0] == 29


def test_what_is_no_message_or_too_large_is_told_and_not_used():
    box = Box()
    box.inbox.put("estop", b"\1")
    box.inbox.put("scan", b"\1\2\3")
    box.inbox.put("cloud", bytes((16 << 20) + 1))
    assert box.inbox.drain_stops() == []
    assert box.inbox.drain() == []
    assert set(box.told) == {"sensors:estop:bytes", "sensors:scan:bytes", "sensors:cloud:bytes"}


def test_presses_from_many_threads_are_all_seen():
    box = Box()
    pressed = encode(Bool(data=True))

    def press() -> None:
        for _ in range(200):
            box.inbox.put("estop", pressed)

    threads = [threading.Thread(target=press) for _ in range(4)]
    for thread in threads:
        thread.start()
    seen = []
    while any(thread.is_alive() for thread in threads):
        seen.append(len(box.inbox.drain_stops()))
    for thread in threads:
        thread.join()
    seen.append(len(box.inbox.drain_stops()))
    assert sum(seen) >= 1
    assert max(seen) <= 2, "of a topic its last press, and its last word"
