"""A ROS 2 robot (played, at a real Zenoh router) and a service that is a real ROS 1 graph, over a real bridge."""

import pytest
from ros1_graph import wait_for
from ros2_graph import cdr_string, shared_router, stage

from skytether.api.manifest import TopicSpec
from skytether.bridge import Bridge, SessionSpec, topics_from_api
from skytether.messages import String, hash_of
from skytether.ros import notes
from skytether.ros.names import Names
from skytether.ros.ros1.node import Node
from skytether.ros.ros1.port import Ros1Port
from skytether.ros.ros1.subscription import Listener
from skytether.ros.ros2.port import Ros2Port
from skytether.ros.translate import Translated
from skytether.wire.topic import Role

__all__ = ["shared_router", "stage"]
pytestmark = [pytest.mark.ros1, pytest.mark.slow]

MD5, RIHS, DDS = hash_of(String.TYPE, "ros1"), hash_of(String.TYPE, "cdr"), "std_msgs::msg::dds_::String_"


def test_messages_go_both_ways_between_ros_2_and_ros_1(graph, stage):
    specs = [
        TopicSpec(name="said", type=String.TYPE, direction="in"),
        TopicSpec(name="answer", type=String.TYPE, direction="out"),
    ]
    table = topics_from_api(specs)
    names = Names(specs, "/bot", "/brain")
    robot = stage.rmw("robot")
    say = robot.publisher("/bot/said", DDS, RIHS)
    answers = robot.subscribe("/brain/answer", DDS, RIHS)
    told = []
    with Node("skytether", graph.uri, look_s=0.2) as ours, Node("brain", graph.uri, look_s=0.2) as brain:
        brain.subscribe("/bot/said", "std_msgs/String", MD5, Listener(lambda data, _: told.append(bytes(data))))
        answer = brain.advertise("/brain/answer", "std_msgs/String", MD5)
        noted = (*table, *notes.topics())
        ros1 = Ros1Port(ours, Role.SERVICE, names, noted)
        service = Bridge(SessionSpec(5, bytes(32), Role.SERVICE, noted), Translated(ros1, "ros1", noted))
        with service:
            ros2 = Ros2Port(stage.ours(), table, Role.ROBOT, name_of=names.of)
            with Bridge(SessionSpec(5, bytes(32), Role.ROBOT, table), ros2, peer=service.address):
                wait_for(lambda: say(cdr_string("hello")) or told, "ROS 1 to hear ROS 2")
                assert told[0] == b"\5\0\0\0hello"
                wait_for(lambda: answer.publish(b"\3\0\0\0yes") or answers.samples, "ROS 2 to hear ROS 1")
                assert answers.payloads[0] == cdr_string("yes")
            ros2.close()
        ros1.close()
