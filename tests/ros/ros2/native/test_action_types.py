"""An action of real ROS 2 whose parts have other type hashes than this end's: refused both ways, with both hashes."""

import pytest
from ros2_nodes import ros2_nodes, until

from skytether.api.manifest import TopicSpec
from skytether.bridge.calls import CallError
from skytether.bridge.spec import topics_from_api
from skytether.messages import hash_of
from skytether.ros.ros2 import graph
from skytether.ros.ros2 import port as ports
from skytether.ros.ros2.native.node import RclpyNode
from skytether.ros.ros2.port import Ros2Port
from skytether.wire.topic import Role

__all__ = ["ros2_nodes"]
pytestmark = [pytest.mark.slow, pytest.mark.ros2]

FIBONACCI = "test_msgs/action/Fibonacci"
WRONG = "RIHS01_" + "0" * 64
PEER = """
from rclpy.action import ActionClient, ActionServer
from test_msgs.action import Fibonacci
made = {made}
takers, makers = node.get_subscriptions_info_by_topic, node.get_publishers_info_by_topic
def work():
    sys.stdin.readline()
    for part, look, topic in (
        ("SendGoal_Request", {asked}, "rq/compute/_action/send_goalRequest"),
        ("GetResult_Request", {asked}, "rq/compute/_action/get_resultRequest"),
        ("FeedbackMessage", {told}, "rt/compute/_action/feedback"),
    ):
        (found,) = [str(i.topic_type_hash) for i in look(topic, no_mangle=True) if i.node_name == NAME]
        say([part, found])
threading.Thread(target=work, daemon=True).start()
"""
SERVER = PEER.format(
    made='ActionServer(node, Fibonacci, "/compute", lambda _: say("a goal was taken"))', asked="takers", told="makers"
)
CLIENT = PEER.format(made='ActionClient(node, Fibonacci, "/compute")', asked="makers", told="takers")


class Bridge:
    """Takes what a port publishes and how it answers."""

    def __init__(self):
        self.answers, self.published = {}, []

    def publish(self, topic, payload):
        self.published.append(topic)
        return True

    def call(self, name, payload, timeout):
        raise AssertionError(f"{name} was asked of the peer")

    def answer(self, name, handler):
        self.answers[name] = handler


@pytest.mark.parametrize(("role", "code", "who"), [(Role.SERVICE, SERVER, "service"), (Role.ROBOT, CLIENT, "client")])
def test_an_action_of_another_type_hash_is_refused_with_both_hashes(ros2_nodes, monkeypatch, role, code, who):
    """This end's hashes are made others, for peers have the same ROS 2."""

    def ours(kind, encoding):
        return WRONG if kind.startswith(FIBONACCI) else hash_of(kind, encoding)

    monkeypatch.setattr(graph, "hash_of", ours)
    monkeypatch.setattr(ports, "hash_of", ours)
    peer = ros2_nodes.start(code)
    row = {"name": "compute", "kind": "ros2_action", "type": FIBONACCI, "direction": "in"}
    topics = topics_from_api([TopicSpec.model_validate(row)])
    bridge, said = Bridge(), []
    with RclpyNode(say=said.append) as node:
        port = Ros2Port(node, topics, role)
        port.attach(bridge)
        until(lambda: len(port.refusals) == 3, "the refusals")
        peer.tell("hashes")
        real = dict(peer.next() for _ in range(3))
        of_topic = {"service": "publisher", "client": "subscription"}[who]
        expected = {
            f"compute/_action/{name}": f"/compute/_action/{name.removesuffix('/request')}: the {kind} of /peer has "
            f"{FIBONACCI}_{part} with type hash {real[part]}, this end's is {WRONG}; it is not joined"
            for name, kind, part in (
                ("send_goal/request", who, "SendGoal_Request"),
                ("get_result/request", who, "GetResult_Request"),
                ("feedback", of_topic, "FeedbackMessage"),
            )
        }
        assert all(text.startswith("RIHS01_") and text != WRONG for text in real.values())
        assert port.refusals == expected
        assert sorted(said) == sorted(node.troubles) == sorted(expected.values()), "each once"
        if who == "service":
            with pytest.raises(CallError, match=f"with type hash {real['SendGoal_Request']}, this end's is {WRONG}"):
                bridge.answers["compute/_action/send_goal"](bytes(64))
        port.close()
    assert "a goal was taken" not in peer.all()
