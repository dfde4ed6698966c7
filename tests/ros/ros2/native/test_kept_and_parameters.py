"""Two graphs of real ROS 2 joined by a bridge: what is kept for who comes late, and parameters of nodes."""

from contextlib import ExitStack

import pytest
from ros2_nodes import far_nodes, ros2_nodes, until

from skytether.api.manifest import TopicSpec
from skytether.bridge import Bridge, SessionSpec, topics_from_api
from skytether.ros.ros2.dialect import NodeName
from skytether.ros.ros2.native.node import RclpyNode
from skytether.ros.ros2.port import Ros2Port
from skytether.wire.topic import Role

__all__ = ["far_nodes", "ros2_nodes"]
pytestmark = [pytest.mark.slow, pytest.mark.ros2]


@pytest.fixture
def join(ros2_nodes, far_nodes):
    """Joins the two graphs with these rows; returns the bridges."""
    with ExitStack() as stack:

        def join(*rows):
            table = topics_from_api([TopicSpec(**row) for row in rows])
            made, peer = [], None
            for role, nodes in ((Role.SERVICE, far_nodes), (Role.ROBOT, ros2_nodes)):
                node = stack.enter_context(RclpyNode(NodeName("/", "skytether"), domain=nodes.domain))
                port = Ros2Port(node, table, role)
                bridge = Bridge(SessionSpec(7, bytes(range(32)), role, table), port, peer=peer)
                stack.enter_context(bridge)
                stack.callback(port.close)
                made.append(bridge)
                peer = bridge.address
            until(lambda: all(bridge.stats().connected for bridge in made), "the session")
            return made

        yield join


# Texts stand for static transforms: tf2_msgs is none of the packages that this ROS 2 has.
KEEPS = """
from std_msgs.msg import String
kept = node.create_publisher(String, "/{topic}", qos(latched=True, depth=1))
kept.publish(String(data=NAME))
"""
HEARS = """
from std_msgs.msg import String
node.create_subscription(String, "/{topic}", lambda m: say(m.data), qos(latched=True))
"""
LATCHED = {"type": "std_msgs/msg/String", "reliable": True, "latched": True}


def test_what_is_kept_reaches_who_comes_late_at_the_other_end_both_ways(join, ros2_nodes, far_nodes):
    join({"name": "there", "direction": "in", **LATCHED}, {"name": "back", "direction": "out", **LATCHED})
    ros2_nodes.start(KEEPS.format(topic="there"), "robot")
    far_nodes.start(KEEPS.format(topic="back"), "service")
    for nodes, topic, kept in ((far_nodes, "there", "robot"), (ros2_nodes, "back", "service")):
        assert nodes.start(HEARS.format(topic=topic), f"early_{topic}").next() == kept
        assert nodes.start(HEARS.format(topic=topic), f"late_{topic}").next() == kept


def test_parameters_of_a_node_are_read_and_set_from_the_other_end(join, ros2_nodes, far_nodes):
    """Its services are as any other service."""
    names = ("get_parameters", "set_parameters", "list_parameters", "describe_parameters")
    types = ("GetParameters", "SetParameters", "ListParameters", "DescribeParameters")
    rows = [
        {"name": f"planner/{name}", "kind": "call", "type": f"rcl_interfaces/srv/{kind}", "direction": "out"}
        for name, kind in zip(names, types, strict=True)
    ]
    join(*rows)
    ros2_nodes.start('node.declare_parameter("max_speed", 0.5)\n', "planner")
    caller = far_nodes.start(
        """
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
def ask(kind, name, **fields):
    client = node.create_client(kind, "/planner/" + name)
    client.wait_for_service()
    while True:
        future, done = client.call_async(kind.Request(**fields)), threading.Event()
        future.add_done_callback(lambda _: done.set())
        if done.wait(2.0):
            return future.result()
def work():
    say("max_speed" in ask(ListParameters, "list_parameters").result.names)
    say(ask(DescribeParameters, "describe_parameters", names=["max_speed"]).descriptors[0].type)
    say(ask(GetParameters, "get_parameters", names=["max_speed"]).values[0].double_value)
    value = Parameter(name="max_speed", value=ParameterValue(type=3, double_value=0.25))
    say(ask(SetParameters, "set_parameters", parameters=[value]).results[0].successful)
    say(ask(GetParameters, "get_parameters", names=["max_speed"]).values[0].double_value)
threading.Thread(target=work, daemon=True).start()
""",
        "caller",
    )
    assert [caller.next() for _ in range(5)] == [True, 3, 0.5, True, 0.25]
