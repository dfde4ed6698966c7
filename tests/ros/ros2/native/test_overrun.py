"""A publisher of real ROS 2 that is quicker than we are: what is dropped is told once, and counted."""

import time

import pytest
from ros2_nodes import ros2_nodes, until

from skytether.api.manifest import TopicSpec
from skytether.bridge import Bridge, SessionSpec
from skytether.bridge.spec import topics_from_api
from skytether.ros.ros2.native import overrun
from skytether.ros.ros2.native.node import RclpyNode
from skytether.ros.ros2.native.overrun import QUIET_S, WINDOW_S, Overrun
from skytether.ros.ros2.port import Ros2Port
from skytether.wire.topic import Role

__all__ = ["ros2_nodes"]

BURSTS = """
from std_msgs.msg import UInt8MultiArray
burst = node.create_publisher(UInt8MultiArray, "/burst", qos(depth=100))
message = UInt8MultiArray(data=bytes(50_000))
def work():
    for _ in sys.stdin:
        for _ in range(400):
            burst.publish(message)
            time.sleep(0.001)
        say("published")
threading.Thread(target=work, daemon=True).start()
"""


class BusyBridge(Bridge):
    """On a machine that has more to do: each message takes 20 ms."""

    def __init__(self, *arguments, **more):
        super().__init__(*arguments, **more)
        self.taken = 0

    def publish(self, topic, payload):
        self.taken += 1
        time.sleep(0.02)
        return super().publish(topic, payload)


def test_where_only_the_newest_waits_one_that_gives_way_now_and_then_is_not_told():
    newest, queue = Overrun(1), Overrun(5)
    found = {1: [], 5: []}
    for second in range(21):
        for watched, depth in ((newest, 1), (queue, 5)):
            found[depth].append(watched.update(100 * second, 10 * second, 50.0 + second))
    assert set(found[1]) == {""}
    assert found[5][: int(WINDOW_S)] == [""] * int(WINDOW_S)
    assert found[5][int(WINDOW_S) :] == ["50 of 550 were dropped in 5 s, for 5 at most may wait"] * 16


def test_it_is_over_after_a_while_without_any_and_told_anew_after_that():
    watched = Overrun(1)
    assert watched.update(0, 0, 0.0) == ""
    assert watched.update(10, 30, 1.0) == ""
    told = "30 of 40 were dropped in 5 s, for 1 at most may wait"
    assert watched.update(10, 30, 5.0) == told
    assert watched.update(500, 31, 20.0) == told
    assert watched.update(600, 31, 20.0 + QUIET_S) == told
    assert watched.update(700, 31, 21.0 + QUIET_S) == ""
    assert watched.update(800, 32, 25.0 + QUIET_S) == ""
    assert watched.update(803, 60, 31.0 + QUIET_S) == "29 of 132 were dropped in 10 s, for 1 at most may wait"


@pytest.mark.slow
@pytest.mark.ros2
@pytest.mark.parametrize("depth", [1, 10])
def test_a_publisher_that_overruns_us_is_named_once_and_every_message_is_accounted_for(ros2_nodes, monkeypatch, depth):
    monkeypatch.setattr(overrun, "WINDOW_S", 1.0)
    monkeypatch.setattr(overrun, "QUIET_S", 2.0)
    peer = ros2_nodes.start(BURSTS)
    kind = "std_msgs/msg/UInt8MultiArray"
    row = {"name": "burst", "type": kind, "direction": "in", "depth": depth, "reliable": depth > 1}
    topics = topics_from_api([TopicSpec.model_validate(row)])
    said = []
    with RclpyNode(say=said.append) as node:
        port = Ros2Port(node, topics, Role.ROBOT)
        with BusyBridge(SessionSpec(7, bytes(32), Role.ROBOT, topics), port, peer=("127.0.0.1", 9)) as bridge:
            until(lambda: port.topics()[0].there, "the publisher")
            until(lambda: (peer.tell("go"), peer.next(), port.topics()[0].dropped)[-1], "messages to be dropped")
            until(lambda: said, "a word on that")
            assert said == list(node.troubles)
            told = said[0].removeprefix("/burst: messages come quicker than they are taken: ")
            lost, of, came, *rest = told.split()
            assert (of, rest[:4]) == ("of", ["were", "dropped", "in", rest[3]])
            assert " ".join(rest[5:]) == (
                f"for {depth} at most may wait; publish them less often, or give the topic's row more depth"
            )
            assert 0 < int(lost) < int(came) <= 400 * 3
            until(lambda: not node.troubles, "it to be over")
            assert len(said) == 1, "once, however long it lasts"
            (counted,) = bridge.stats().topics
            dropped = port.topics()[0].dropped
        assert counted.published == dropped + bridge.taken
        assert counted.published == counted.refused + counted.dropped + counted.sent
        assert counted.dropped >= dropped >= int(lost)
