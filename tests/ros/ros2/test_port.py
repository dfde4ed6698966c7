"""A session with an end that is a ROS 2 graph: real bridges, a real router, played ROS 2 nodes."""

import os
import struct

import pytest

from skytether.api.manifest import TopicSpec
from skytether.bridge import Bridge, CallError, GraphPort, LocalGraph, SessionSpec, topics_from_api
from skytether.messages import (
    Header,
    TFMessage,
    Time,
    TransformStamped,
    Twist,
    Vector3,
    decode,
    encode,
    hash_of,
)
from skytether.ros import notes
from skytether.ros.ros2.port import Ros2Port
from skytether.ros.translate import Translated
from skytether.wire.events import Connected, MessageReceived
from skytether.wire.topic import ANY, Direction, Role, Topic

pytestmark = pytest.mark.slow

TWIST, DDS_TWIST, RIHS_TWIST = "geometry_msgs/msg/Twist", "geometry_msgs::msg::dds_::Twist_", ""
RIHS_TWIST = "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a"
STRING, DDS_STRING = "std_msgs/msg/String", "std_msgs::msg::dds_::String_"
RIHS_STRING = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
TRIGGER, DDS_TRIGGER = "std_srvs/srv/Trigger", "std_srvs::srv::dds_::Trigger_"
RIHS_TRIGGER = "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"

# A velocity in both encodings, by hand: six float64; CDR has four bytes before them.
NUMBERS = struct.pack("<6d", 0.5, 0, 0, 0, 0, -0.25)
CDR_TWIST, ROS1_TWIST = b"\0\1\0\0" + NUMBERS, NUMBERS


def rows(*specs, encoding="cdr"):
    return topics_from_api(TopicSpec(**{"encoding": encoding, **s}) for s in specs)


STATUS = {"name": "status", "type": STRING, "direction": "in", "reliable": True, "latched": True}
CMD_VEL = {"name": "cmd_vel", "type": TWIST, "direction": "out"}
STOP = {"name": "stop", "kind": "call", "type": TRIGGER, "direction": "in"}
RESET = {"name": "reset", "kind": "call", "type": TRIGGER, "direction": "out"}


class Ends:
    """Two bridges on the loopback interface."""

    def __init__(self):
        self.id, self.key = int.from_bytes(os.urandom(8)), os.urandom(32)
        self.bridges = []
        self.ports = []

    def start(self, role, topics, port, peer=None):
        bridge = Bridge(SessionSpec(self.id, self.key, role, topics), port, peer=peer)
        bridge.start()
        self.bridges.append(bridge)
        return bridge

    def close(self):
        for bridge in reversed(self.bridges):
            bridge.stop()


@pytest.fixture
def ends():
    made = Ends()
    yield made
    made.close()


class Local:
    """The other end: a graph in this process."""

    def __init__(self, topics, role):
        self.graph, self.events, self.got = LocalGraph(), [], []
        self.port = GraphPort(self.graph, topics, role, on_event=self.events.append)
        for t in topics:
            self.graph.subscribe(t.name, lambda payload, name=t.name: self.got.append((name, bytes(payload))))


def test_a_ros2_robot_and_a_service(stage, ends):
    table = rows(STATUS, CMD_VEL, STOP, RESET)
    service = Local(table, Role.SERVICE)
    listening = ends.start(Role.SERVICE, table, service.port)
    listening.answer("stop", lambda request: b"\0\1\0\0\1" + request)
    robot = stage.rmw("robot")
    wheels = robot.subscribe("/bot/cmd_vel", DDS_TWIST, RIHS_TWIST)
    resets = robot.serve("/bot/reset", DDS_TRIGGER, RIHS_TRIGGER, lambda request: request + b"reset")
    robot.publisher("/bot/status", DDS_STRING, RIHS_STRING, depth=1)(stage.cdr_string("ready"))
    node = stage.ours()
    port = Ros2Port(node, table, Role.ROBOT, name_of=lambda name: f"/bot/{name}")
    bridge = ends.start(Role.ROBOT, table, port, listening.address)

    stage.until(lambda: ("status", stage.cdr_string("ready")) in service.got, "the latched status did not come")
    stage.until(lambda: listening.publish("cmd_vel", CDR_TWIST) and wheels.samples, "no velocity came")
    assert wheels.payloads[0] == CDR_TWIST
    call = robot.client("/bot/stop", DDS_TRIGGER, RIHS_TRIGGER)
    stage.until(lambda: robot.sees("SS", "/bot/stop"), "our service does not show")
    assert call(b"\0\1\0\0\0", 3)[0] == b"\0\1\0\0\1\0\1\0\0\0"
    assert listening.call("reset", b"\0\1\0\0\0", 30) == b"\0\1\0\0\0reset"
    assert len(resets) == 1
    listening.answer("stop", lambda request: 1 / 0)
    with pytest.raises(RuntimeError, match="call 'stop': its handler failed: ZeroDivisionError"):
        call(b"\0\1\0\0\0", 4)
    assert port.refusals == {}
    assert stage.said == []
    bridge.stop()
    port.close()
    stage.until(lambda: not robot.sees("MP", "/bot/cmd_vel"), "we are still on the graph")


def test_a_ros1_robot_and_a_ros2_service(stage, ends):
    specs = (
        {**STATUS, "latched": False},
        CMD_VEL,
        RESET,
        {"name": "marker", "type": "shape_msgs/msg/SolidPrimitive", "direction": "in"},
    )
    table = rows(*specs)
    planner = stage.rmw("planner")
    heard = planner.subscribe("/status", DDS_STRING, RIHS_STRING)
    drive = planner.publisher("/cmd_vel", DDS_TWIST, RIHS_TWIST)
    reset = planner.client("/reset", DDS_TRIGGER, RIHS_TRIGGER)
    port = Translated(Ros2Port(stage.ours(), table, Role.SERVICE), "cdr", table, say=stage.said.append)
    listening = ends.start(Role.SERVICE, table, port)

    theirs = tuple(
        Topic(t.name, t.type, t.direction, type_hash=hash_of(t.type, "ros1"), encoding="ros1", reliable=t.reliable)
        for t in rows(*specs, encoding="ros1")
    )
    robot = Local(theirs, Role.ROBOT)
    bridge = ends.start(Role.ROBOT, theirs, robot.port, listening.address)
    bridge.answer("reset", lambda request: b"\1\2\0\0\0ok" if request == b"" else b"")
    stage.until(lambda: any(isinstance(e, Connected) for e in robot.events), "no session")
    stage.until(
        lambda: bridge.publish("status", b"\5\0\0\0ready") and heard.samples, "the status did not reach the ROS 2 graph"
    )
    assert heard.payloads[0] == stage.cdr_string("ready")
    stage.until(lambda: drive(CDR_TWIST) or robot.got, "no velocity came")
    assert (
        robot.got[0]
        == ("cmd_vel", ROS1_TWIST)
        == ("cmd_vel", encode(Twist(Vector3(0.5), Vector3(0, 0, -0.25)), "ros1"))
    )
    stage.until(lambda: planner.sees("SS", "/reset"), "our service does not show")
    assert reset(b"\0\1\0\0\0", 1)[0] == bytes([0, 1, 0, 0, 1, 0, 0, 0, 3, 0, 0, 0]) + b"ok\0"
    assert list(port.refusals) == ["marker"]
    (said,) = stage.said
    assert said.startswith("marker: shape_msgs/msg/SolidPrimitive cannot be turned from ROS 1 into ROS 2")
    # What cannot be read is dropped and told once.
    stage.until(lambda: bridge.publish("status", b"rubbish") and len(stage.said) > 1, "nothing was said")
    assert "status: a message was dropped" in stage.said[1]


def test_a_service_of_a_ros2_graph_takes_any_topic(stage, ends):
    table = rows({"name": "*", "type": "*", "direction": "in"})
    port = Ros2Port(stage.ours(), table, Role.SERVICE, name_of=lambda name: f"/bot/{name}")
    listening = ends.start(Role.SERVICE, table, port)
    offered = (Topic("odd", STRING, Direction.IN), Topic("not a name", STRING, Direction.IN))
    robot = Local(offered, Role.ROBOT)
    heard = stage.rmw("recorder").subscribe("/bot/odd", DDS_STRING, RIHS_STRING)
    bridge = ends.start(Role.ROBOT, offered, robot.port, listening.address)
    stage.until(lambda: bridge.publish("odd", stage.cdr_string("x")) and heard.samples, "nothing came")
    assert heard.payloads[0] == stage.cdr_string("x")
    assert "'/bot/not a name' is not a valid name of ROS 2" in port.refusals["not a name"]


def test_a_service_of_a_ros2_graph_takes_a_topic_whose_type_comes_late(stage):
    table = (*rows({"name": "*", "type": "*", "direction": "in"}), notes.row(Role.ROBOT))
    port = Ros2Port(stage.ours(), table, Role.SERVICE, name_of=lambda name: f"/bot/{name}")
    port.attach(FakeBridge())
    heard = stage.rmw("recorder").subscribe("/bot/late", DDS_STRING, RIHS_STRING, depth=1)
    row = Topic("late", ANY, Direction.IN, reliable=True, latched=True)
    port.notify(Connected((row, notes.row(Role.ROBOT))))

    def deliver(topic, payload):
        port.deliver(MessageReceived(topic, payload, 0, 0.0, 0.0, 0.0))

    deliver("late", stage.cdr_string("early"))
    deliver(notes.NOTES[Role.ROBOT], notes.Notes({"late": notes.TypeNote(STRING, RIHS_STRING)}).pack())
    stage.until(lambda: heard.payloads == [stage.cdr_string("early")], "what came early was lost")
    assert port.refusals == {}


class FakeBridge:
    """Takes what a port publishes."""

    def __init__(self):
        self.published = []
        self.answers = {}

    def publish(self, topic, payload):
        self.published.append((topic, bytes(payload)))
        return True

    def call(self, name, payload, timeout):
        raise CallError(f"{name} within {timeout:g}")

    def answer(self, name, handler):
        self.answers[name] = handler


def test_what_comes_before_the_robot_waits_until_it_tells_its_encoding(stage, monkeypatch):
    (row,) = rows({**STATUS, "direction": "out"})
    node, heard = stage.ours(), []
    subscribe = node.subscribe
    monkeypatch.setattr(
        node,
        "subscribe",
        lambda endpoint, take, **more: subscribe(endpoint, lambda data: (take(data), heard.append(data)), **more),
    )
    bridge, port = FakeBridge(), Translated(Ros2Port(node, [row], Role.SERVICE), "cdr", [row])
    port.attach(bridge)
    rmw = stage.rmw("service")
    publish = rmw.publisher("/status", DDS_STRING, RIHS_STRING, depth=1)
    publish(stage.cdr_string("old"))
    publish(stage.cdr_string("ready"))
    stage.until(lambda: heard[-1:] == [stage.cdr_string("ready")], "nothing came")
    assert bridge.published == []
    (agreed,) = rows({**STATUS, "direction": "out"}, encoding="ros1")
    port.notify(Connected((agreed,)))
    assert bridge.published == [("status", b"\5\0\0\0ready")]


def test_static_transforms_of_several_nodes_are_one_latched_message(stage):
    (row,) = rows({**STATUS, "name": "/tf_static", "type": TFMessage.TYPE})
    bridge, port = FakeBridge(), Ros2Port(stage.ours(), [row], Role.ROBOT)
    port.attach(bridge)
    dds, rihs = "tf2_msgs::msg::dds_::TFMessage_", hash_of(TFMessage.TYPE, "cdr")
    transforms = [TransformStamped(Header(Time(1), "base"), child) for child in ("laser", "camera")]
    for i, transform in enumerate(transforms):
        node = stage.rmw(f"broadcaster_{i}")
        node.publisher("/tf_static", dds, rihs, depth=1)(encode(TFMessage([transform]), "cdr"))

    def frames():
        newest = decode(TFMessage, bridge.published[-1][1], "cdr") if bridge.published else TFMessage()
        return sorted(t.child_frame_id for t in newest.transforms)

    stage.until(lambda: frames() == ["camera", "laser"], "they are not together")


def test_a_ways_end(stage):
    """Nothing is raised whatever comes."""
    table = rows(CMD_VEL, RESET)
    port = Ros2Port(stage.ours(), table, Role.ROBOT, skip={"cmd_vel"})
    with pytest.raises(TypeError, match="needs a bridge that makes and answers calls"):
        port.attach(type("Half", (), {"publish": lambda self, topic, payload: True})())
    bridge = FakeBridge()
    port.attach(bridge)
    for topic in ("cmd_vel", "unknown", "reset/request"):
        port.deliver(MessageReceived(topic, b"", 0, 0.0, 0.0, 0.0))
    with pytest.raises(CallError, match="/reset"):
        bridge.answers["reset"](b"")
    assert port.topics() == [], "what is skipped, or in no row, is not joined"
    assert port.refusals == {}


def test_a_hash_in_the_row_is_taken_for_topics_and_calls(stage):
    rihs = "RIHS01_" + "4" * 64
    given = (
        {"name": "own", "type": "my_msgs/msg/Own", "direction": "out", "type_hash": rihs},
        {"name": "ask", "kind": "call", "type": "my_msgs/srv/Ask", "direction": "in", "type_hash": rihs},
    )
    port = Ros2Port(stage.ours(), rows(*given), Role.ROBOT)
    port.attach(FakeBridge())
    rmw = stage.rmw("node")
    stage.until(lambda: [t for t in rmw.sees("MP", "/own") if rihs in t], "the topic has another hash")
    stage.until(lambda: [t for t in rmw.sees("SS", "/ask") if rihs in t], "the service has another hash")


@pytest.mark.parametrize(
    ("row", "text"),
    [
        ({"name": "a b", "type": STRING}, "topic 'a b': '/a b' is not a valid name of ROS 2"),
        ({"name": "a", "type": "String"}, "topic 'a': 'String' is no type of ROS 2"),
        ({"name": "a", "kind": "call", "type": "Ask"}, "topic 'a': 'Ask' is no type of ROS 2"),
    ],
)
def test_a_row_that_cannot_be_is_named(stage, row, text):
    with pytest.raises(ValueError, match=text):
        Ros2Port(stage.ours(), rows({"direction": "in", **row}), Role.ROBOT)
