"""A service's graph for robots of the other generation: every way, without a graph and without a bridge."""

import struct

import pytest

from skytether.api.manifest import TopicSpec
from skytether.bridge import CallError, topics_from_api
from skytether.ros import notes
from skytether.ros.translate import Translated
from skytether.wire.events import Connected, Disconnected, MessageReceived

NUMBERS = struct.pack("<6d", 0.5, 0, 0, 0, 0, -0.25)
CDR, ROS1 = b"\0\1\0\0" + NUMBERS, NUMBERS
CDR_EMPTY, ROS1_EMPTY = b"\0\1\0\0\0", b""
CDR_OK, ROS1_OK = bytes([0, 1, 0, 0, 1, 0, 0, 0, 3, 0, 0, 0]) + b"ok\0", b"\1\2\0\0\0ok"
TWIST = "geometry_msgs/msg/Twist"
SPECS = (
    {"name": "seen", "type": TWIST, "direction": "in"},
    {"name": "cmd_vel", "type": TWIST, "direction": "out"},
    {"name": "path", "type": TWIST, "direction": "out", "reliable": True, "depth": 3},
    {"name": "stop", "kind": "call", "type": "std_srvs/srv/Trigger", "direction": "in"},
    {"name": "reset", "kind": "call", "type": "std_srvs/srv/Trigger", "direction": "out"},
    {"name": "marker", "type": "shape_msgs/msg/SolidPrimitive", "direction": "in"},
    {"name": "ask", "kind": "call", "type": "my_msgs/srv/Ask", "direction": "in"},
)


def table(encoding):
    return (*topics_from_api(TopicSpec(**s, encoding=encoding) for s in SPECS), *notes.topics())


class Ends:
    """Both a bridge and a graph's port, that remember."""

    def __init__(self, own):
        self.said, self.published, self.delivered, self.events, self.asked = [], [], [], [], []
        self.answers = {}
        self.port = Translated(self, own, table(own), say=self.said.append)
        self.port.attach(self)

    def attach(self, publisher):
        self.graph = publisher

    def deliver(self, message):
        self.delivered.append((message.topic, bytes(message.payload)))

    def notify(self, event):
        self.events.append(event)

    def publish(self, topic, payload):
        self.published.append((topic, bytes(payload)))
        return True

    def call(self, name, payload, timeout):
        self.asked.append((name, bytes(payload), timeout))
        return self.response

    def answer(self, name, handler):
        self.answers[name] = handler

    def comes(self, topic, payload):
        self.port.deliver(MessageReceived(topic, payload, 0, 0.0, 0.0, 0.0))


@pytest.fixture(params=["cdr", "ros1"])
def both(request):
    """Ends whose graph is of one generation, and what the graph and the robot of the other have."""
    own, theirs = request.param, "ros1" if request.param == "cdr" else "cdr"
    forms = {"cdr": (CDR, CDR_EMPTY, CDR_OK), "ros1": (ROS1, ROS1_EMPTY, ROS1_OK)}
    return Ends(own), theirs, forms[own], forms[theirs]


def test_messages_and_calls_both_ways(both):
    ends, theirs, (mine, empty, good), (other, their_empty, their_good) = both
    assert ends.graph.publish("path", mine)  # before there is a robot: waits
    assert ends.published == []
    connected = Connected(table(theirs))
    ends.port.notify(connected)
    assert ends.events == [connected]
    assert ends.graph.publish("cmd_vel", mine)
    assert ends.published == [("path", other), ("cmd_vel", other)]
    ends.comes("seen", other)
    assert ends.delivered == [("seen", mine)]
    # A node of this graph asks the robot.
    ends.response = their_good
    assert ends.graph.call("reset", empty, 3.0) == good
    assert ends.asked == [("reset", their_empty, 3.0)]
    # The robot asks a node of this graph.
    got = []
    ends.graph.answer("stop", lambda request: got.append(request) or good)
    assert ends.answers["stop"](their_empty) == their_good
    assert got == [empty]


def test_what_cannot_be_translated_is_named_once_and_left_out(both):
    ends, theirs, *_ = both
    for _ in range(2):
        ends.port.notify(Connected(table(theirs)))
    assert sorted(ends.port.refusals) == ["ask/request", "ask/response", "marker"]
    assert len(ends.said) == 3
    assert any("shape_msgs/msg/SolidPrimitive cannot be turned" in sentence for sentence in ends.said)
    ends.comes("marker", b"x")
    assert ends.delivered == []
    ends.graph.answer("ask", bytes)
    with pytest.raises(CallError, match="my_msgs/srv/Ask_Request cannot be turned"):
        ends.answers["ask"](b"")


def test_rubbish_is_dropped_and_told_once(both):
    ends, theirs, (_, empty, _), _ = both
    ends.port.notify(Connected(table(theirs)))
    for _ in range(3):
        ends.comes("seen", b"rubbish")
    assert ends.delivered == []
    assert len([s for s in ends.said if "seen: a message was dropped" in s]) == 1
    assert not ends.graph.publish("cmd_vel", b"rubbish")
    ends.response = b"rubbish"
    with pytest.raises(CallError, match="reset: 7 bytes are no std_srvs/srv/Trigger_Response"):
        ends.graph.call("reset", empty, 1.0)


def test_a_robot_of_the_same_generation_and_what_is_no_message_pass_as_they_are():
    ends = Ends("cdr")
    ends.graph.publish("cmd_vel", b"not kept")
    ends.port.notify(Connected(table("cdr")))
    payload = bytes(5)
    ends.comes("marker", payload)
    ends.comes(notes.NOTES["robot"], b"{}")
    ends.graph.publish("unknown", payload)
    assert ends.delivered == [("marker", payload), (notes.NOTES["robot"], b"{}")]
    assert ends.published == [("cmd_vel", b"not kept"), ("unknown", payload)]
    assert ends.said == []
    ends.port.notify(Disconnected("silent"))
    assert len(ends.events) == 2


def test_what_waits_for_a_robot_is_bounded_and_keeps_its_order():
    ends = Ends("cdr")
    for i in range(9):
        ends.graph.publish("path", bytes([i]))
    ends.port.notify(Connected(table("cdr")))
    assert ends.published == [("path", bytes([i])) for i in (6, 7, 8)]
