"""A robot that is a ROS 2 graph: real router, played nodes; the agent is left out but for what it asks of the graph."""

import pytest
from ros2_graph import shared_router, stage

from skytether.api.manifest import TopicSpec
from skytether.bridge import Bridge, GraphPort, LocalGraph, SessionSpec, topics_from_api
from skytether.messages import Header, Time, Twist, TwistStamped, Vector3, WrenchStamped, decode, encode, hash_of
from skytether.robot.graphs.ros2.robot import Ros2Robot, Ros2RobotConfig
from skytether.service.any_topics import AnyTopics
from skytether.service.any_topics import rows as any_rows
from skytether.service.mailbox import RawQueue
from skytether.wire.events import Connected
from skytether.wire.topic import ANY, Role

__all__ = ["shared_router", "stage"]
pytestmark = pytest.mark.slow

TWIST, STAMPED, WRENCH = Twist.TYPE, TwistStamped.TYPE, WrenchStamped.TYPE
FORWARD = Twist(Vector3(0.5))


def dds(name):
    package, kind, short = name.split("/")
    return f"{package}::{kind}::dds_::{short}_"


def subscribe(node, topic, name):
    return node.subscribe(topic, dds(name), hash_of(name, "cdr"))


def publisher(node, topic, name):
    return node.publisher(topic, dds(name), hash_of(name, "cdr"))


def test_readings_and_wheels_are_topics(stage):
    rmw = stage.rmw("base")
    wheels = subscribe(rmw, "/walker_1/cmd_vel", TWIST)
    force = publisher(rmw, "/walker_1/force", WRENCH)
    config = Ros2RobotConfig("walker-1", "virtual-trail", readings={"force": WRENCH})
    robot = Ros2Robot(config, stage.ours())
    stage.until(lambda: robot.base.write(FORWARD) or wheels.samples, "the wheels were told nothing")
    assert wheels.payloads[0] == encode(FORWARD, "cdr")
    message = WrenchStamped(Header(Time(1, 2), "handle"))

    def read():
        force(encode(message, "cdr"))
        return list(robot.base.read(0.0))

    assert stage.until(read, "no reading came") == [("force", message)]
    robot.close()
    stage.until(lambda: not rmw.sees("MP", "/walker_1/cmd_vel"), "still on the graph")


def test_wheels_that_take_stamped_velocities(stage):
    wheels = subscribe(stage.rmw("base"), "/cmd_vel", STAMPED)
    config = Ros2RobotConfig("bot", "x", namespace="/", cmd_vel_type=STAMPED, frame="base")
    robot = Ros2Robot(config, stage.ours(), clock=lambda: 12.5)
    stage.until(lambda: robot.base.write(FORWARD) or wheels.samples, "the wheels were told nothing")
    assert decode(TwistStamped, wheels.payloads[0]) == TwistStamped(Header(Time(12, 500_000_000), "base"), FORWARD)


def specs(*rows):
    return [TopicSpec(**row) for row in rows]


def test_the_table_of_a_session_and_what_goes_through(stage):
    """An action too: its calls and topics have hashes that nobody here knows; they are learned from the graph."""
    rihs, action = "RIHS01_" + "3" * 64, "my_msgs/action/Go"
    table = specs(
        {"name": "scan", "type": "sensor_msgs/msg/LaserScan", "direction": "in"},
        {"name": "cmd_vel", "type": TWIST, "direction": "out"},
        {"name": "path", "type": "nav_msgs/msg/Path", "direction": "out", "reliable": True},
        {"name": "go", "kind": "ros2_action", "type": action, "direction": "in"},
    )
    service_topics = topics_from_api(table)
    graph, got = LocalGraph(), {}
    for topic in service_topics:
        graph.subscribe(topic.name, lambda payload, name=topic.name: got.setdefault(name, bytes(payload)))
    key = bytes(32)
    service = Bridge(SessionSpec(7, key, Role.SERVICE, service_topics), GraphPort(graph, service_topics, Role.SERVICE))
    rmw = stage.rmw("nav")
    scan = rmw.publisher("/bot/scan", dds("sensor_msgs/msg/LaserScan"), hash_of("sensor_msgs/msg/LaserScan", "cdr"))
    feedback = rmw.subscribe("/x/go/_action/feedback", dds(f"{action}_FeedbackMessage"), rihs)
    status_type = "action_msgs/msg/GoalStatusArray"
    status = rmw.subscribe("/x/go/_action/status", dds(status_type), hash_of(status_type, "cdr"), depth=1)
    send = rmw.client("/x/go/_action/send_goal", dds(f"{action}_SendGoal"), rihs)
    path = rmw.subscribe("/x/path", dds("nav_msgs/msg/Path"), hash_of("nav_msgs/msg/Path", "cdr"))

    robot = Ros2Robot(Ros2RobotConfig("bot", "x"), stage.ours())
    topics, port = robot.open(table, "cmd_vel")
    assert {t.encoding for t in topics} == {"cdr"}
    assert {t.name for t in topics} == {t.name for t in service_topics}
    service.start()
    bridge = Bridge(SessionSpec(7, key, Role.ROBOT, topics), port, peer=service.address)
    bridge.start()
    service.answer("go/_action/send_goal", lambda request: request + b"accepted")
    try:
        stage.until(lambda: scan(b"\0\1\0\0scan") or "scan" in got, "no scan came")
        assert got["scan"] == b"\0\1\0\0scan"
        stage.until(lambda: service.publish("path", b"\0\1\0\0path") and path.samples, "no path came")
        stage.until(lambda: rihs in "".join(rmw.sees("SS", "/x/go/_action/send_goal")), "the action does not show")
        assert send(b"\0\1\0\0goal", 1)[0] == b"\0\1\0\0goalaccepted"
        service.publish("go/_action/status", b"\0\1\0\0status")
        stage.until(lambda: status.payloads == [b"\0\1\0\0status"], "no status came")
        stage.until(
            lambda: service.publish("go/_action/feedback", b"\0\1\0\0back") and feedback.samples, "no feedback came"
        )
        service.publish("cmd_vel", encode(FORWARD, "cdr"))
        assert rmw.sees("MP", "/bot/cmd_vel")  # the wheels', by way of the supervisor
        assert not rmw.sees("MP", "/x/cmd_vel")
        # The next session takes the graph over from the one before.
        _, another = robot.open(table[:1], "cmd_vel")
        assert another is not port
        stage.until(lambda: not rmw.sees("MP", "/x/path"), "the session before is still on the graph")
    finally:
        bridge.stop()
        service.stop()


def test_a_service_that_takes_any_topic_gets_those_that_are_named_as_they_come(stage):
    """A recorder in little: one topic is there, one comes late, one with a type that nobody knows."""
    node, rmw = stage.ours(), stage.rmw("camera")
    odom = publisher(rmw, "/bot/odom", "nav_msgs/msg/Odometry")
    stage.until(lambda: node.endpoints("/bot/odom"), "not seen")
    robot = Ros2Robot(Ros2RobotConfig("bot", "recorder", topics=("odom", "/late", "/odd")), node)
    everything = specs({"name": "*", "type": "*", "direction": "in", "reliable": True, "depth": 100})
    topics, port = robot.open(everything, "cmd_vel")
    assert [(t.name, t.type) for t in topics[:-1]] == [
        ("/bot/odom", "nav_msgs/msg/Odometry"),
        ("/late", ANY),
        ("/odd", ANY),
    ]
    queue = RawQueue(100, 2**20)
    any_topics = AnyTopics(queue)
    table = (*topics_from_api(everything), *any_rows([ANY]))
    key = bytes(32)
    recorder = Bridge(SessionSpec(8, key, Role.SERVICE, table), AnyPort(any_topics))
    recorder.start()
    bridge = Bridge(SessionSpec(8, key, Role.ROBOT, topics), port, peer=recorder.address)
    bridge.start()
    got = {}

    def has(name):
        while (message := queue.take()) is not None:
            got.setdefault(message.topic, message)
        return name in got

    try:
        stage.until(lambda: odom(b"\0\1\0\0odom") or has("/bot/odom"), "no odometry came")
        assert ("/late", "any") in {(topic.graph, topic.type) for topic in robot.topics()}
        rihs = "RIHS01_" + "5" * 64
        late, odd = publisher(rmw, "/late", WRENCH), rmw.publisher("/odd", dds("acme_msgs/msg/Odd"), rihs)
        stage.until(lambda: late(b"\0\1\0\0late") or odd(b"\0\1\0\0odd") or (has("/late") and has("/odd")), "nothing")
        assert (got["/late"].type, got["/late"].hash) == (WRENCH, hash_of(WRENCH, "cdr"))
        assert (got["/odd"].type, got["/odd"].hash, got["/odd"].payload) == ("acme_msgs/msg/Odd", rihs, b"\0\1\0\0odd")
        assert ("/late", WRENCH, ("/camera",)) in {(topic.graph, topic.type, topic.nodes) for topic in robot.topics()}
        robot.close()
        stage.until(lambda: not rmw.sees("MS", "/late"), "still on the graph")
    finally:
        bridge.stop()
        recorder.stop()


class AnyPort:
    """The end of a service that takes any topic."""

    encoding = "cdr"

    def __init__(self, topics):
        self.topics = topics

    def attach(self, publisher):
        pass

    def deliver(self, message):
        self.topics.put(message, "cdr")

    def notify(self, event):
        if isinstance(event, Connected):
            self.topics.agree(event.topics)
