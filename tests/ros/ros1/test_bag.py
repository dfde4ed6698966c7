"""A real recording, played by ROS's own tool in one graph, arrives in another over a bad link (thesis, section 4.2)."""

import signal

import pytest
from ros1_graph import Ros1Graph, wait_for
from ros1_pair import Pair
from rosbags.rosbag1 import Reader

from skytether.api.manifest import TopicSpec
from skytether.emulator.link_model import LinkConditions
from skytether.lab.tun import SERVICE, TunEmulator
from skytether.ros.ros1.node import Node
from skytether.ros.ros1.subscription import Listener

pytestmark = [pytest.mark.ros1, pytest.mark.data, pytest.mark.slow]

PLAYED_S = 8
SCAN = {"name": "scan", "type": "sensor_msgs/msg/LaserScan", "direction": "in", "reliable": True, "depth": 10_000}


@pytest.fixture
def networks(netns):
    bad = LinkConditions(delay=0.03, jitter=0.005, loss=0.03, seed=5)
    with TunEmulator(up=bad, down=bad) as networks:
        yield networks


@pytest.fixture
def graphs(ros1, networks, tmp_path):
    """A roscore at each side of the link, on the loopback of its namespace, where the other cannot reach it."""
    made = [
        Ros1Graph(tmp_path / name, inside=namespace.run, port=11311)
        for name, namespace in (("robot", networks.robot), ("service", networks.service))
    ]
    for graph in made:
        graph.start("roscore", "-p", str(graph.port))
    for graph in made:
        wait_for(graph.answers, "roscore")
    yield made
    for graph in made:
        graph.close()


def read(bag):
    with Reader(bag) as reader:
        return [bytes(data) for connection, _, data in reader.messages() if connection.topic.endswith("scan")]


def in_order(part, whole):
    """Whether all of the part is in the whole, in its order."""
    rest = iter(whole)
    return all(message in rest for message in part)


@pytest.mark.parametrize(("name", "topic"), [("stationary_simple", "/scan"), ("positive_7", "/rear_scan")])
def test_a_real_bag_played_at_the_robot_arrives_identical_in_the_service_s_graph(
    graphs, networks, data_dir, tmp_path, name, topic
):
    robot, service = graphs
    bag = data_dir / "legs" / f"{name}.bag"
    recorded = read(bag)
    pair = Pair(
        robot,
        service,
        [TopicSpec(**SCAN)],
        config={"remap": {"scan": topic}},
        remap={"scan": "/scan"},
        address=SERVICE,
        inside=(networks.robot.run, networks.service.run),
    )
    listener = networks.service.run(lambda: Node("listener", service.uri, look_s=0.2).__enter__())
    try:
        taken, heard = [], []
        # Beside the bridge's end, on the same connection: whatever a busy publisher drops, both have or neither.
        pair.robot_node.subscribe(topic, "*", "", Listener(lambda data, _: taken.append(data)))
        listener.subscribe("/scan", "*", "", Listener(lambda data, _: heard.append(data)))
        recorder = service.start("rosbag", "record", "-O", str(tmp_path / "out.bag"), "/scan")
        wait_for(
            lambda: (
                {"/listener"} < set(service.subscribers("/scan"))
                and listener.publishers_by_topic()["/scan"][0]
                and len(pair.service_port.subscribers("scan")) == 2
            ),
            "listener and recorder",
        )
        player = robot.start("rosbag", "play", "-r", "4", "-u", str(PLAYED_S), "--wait-for-subscribers", str(bag))
        assert player.wait(60) == 0
        wait_for(
            lambda: not pair.robot_node.publishers_by_topic()[topic][0], "the player to be gone, its last message read"
        )
        wait_for(lambda: taken and len(heard) == len(taken), "everything that was sent")
        assert heard == taken
        assert in_order(taken, recorded)
        service.end(recorder, signal.SIGINT)
        written = wait_for(lambda: (tmp_path / "out.bag").exists() and read(tmp_path / "out.bag"), "the recording")
        assert in_order(written, taken)
        with Reader(tmp_path / "out.bag") as reader, Reader(bag) as original:
            ours, theirs = (next(c for c in r.connections if c.topic.endswith("scan")) for r in (reader, original))
            assert (ours.msgtype, ours.digest) == (theirs.msgtype, theirs.digest)
        assert sum(c.lost for c in networks.counters().values()) > 0
    finally:
        listener.close()
        pair.close()
