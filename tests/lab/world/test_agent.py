from collections import Counter
from typing import Any

import pytest

from skytether.api.manifest import TopicSpec
from skytether.lab.world.agent import CATCH_UP, Clockwork, WorldGraph, WorldHardware
from skytether.lab.world.plan import building
from skytether.lab.world.simulation import TICK, Simulation
from skytether.messages import LaserScan, String, Twist, Vector3, decode, encode
from skytether.robot.control.arbiter import LinkRequirements
from skytether.robot.control.control_loop import ControlLoop
from skytether.robot.control.fallback import Stop
from skytether.robot.control.supervisor import VelocityLimits
from skytether.wire.events import MessageReceived

MOVE = Twist(Vector3(x=0.4))


def test_a_base_moves_the_world_by_the_robots_clock() -> None:
    world = Simulation(building(), seed=1)
    base = WorldHardware(Clockwork(world), names={"scan": "RosAria/laserscan"})
    assert base.topics["RosAria/laserscan"] is LaserScan
    found = Counter()
    for tick in range(120):
        found.update(topic for topic, _ in base.read(1000.0 + tick * TICK))
        base.write(MOVE)
    assert world.time == pytest.approx(1.2)
    assert (found["tf"], found["odom"], found["RosAria/laserscan"]) == (120, 12, 10)
    assert world.robots[0].motion.forward == pytest.approx(0.4, abs=0.01)
    # A loop that was held up is not made good in full.
    base.read(1000.0 + 60)
    assert world.ticks == 120 + CATCH_UP


def test_two_robots_share_one_world() -> None:
    world = Simulation(building(), seed=1, robots=2)
    clockwork = Clockwork(world)
    bases = [WorldHardware(clockwork, index) for index in (0, 1)]
    found = [Counter(), Counter()]
    for tick in range(100):
        for count, base in zip(found, bases, strict=True):
            count.update(topic for topic, _ in base.read(tick * TICK))
    assert world.ticks == 100
    # The second hears of a tick when it is asked next.
    assert (found[0]["tf"], found[1]["tf"]) == (100, 100)


def test_an_unknown_topic_name_is_refused() -> None:
    with pytest.raises(ValueError, match="has no topic camera; it has tf, odom, scan"):
        WorldHardware(Clockwork(Simulation(building(), seed=1)), names={"camera": "camera"})


def test_the_robots_control_loop_runs_on_it() -> None:
    base = WorldHardware(Clockwork(Simulation(building(), seed=1)))
    driver = ControlLoop(base, Stop(), VelocityLimits(), LinkRequirements(), 0.0)
    for tick in range(24):
        driver.tick(tick * TICK)
    status = driver.status()
    assert status.readings["scan"] == 2
    assert not status.errors


def test_a_graph_carries_readings_out_and_what_a_service_publishes_in() -> None:
    graph = WorldGraph()
    world = Simulation(building(), seed=1)
    base = WorldHardware(Clockwork(world), graph=graph)
    specs = [
        TopicSpec(name="scan", type="sensor_msgs/msg/LaserScan", direction="in", priority=10),
        TopicSpec(name="goal", type="std_msgs/msg/String", direction="in", priority=10),
        TopicSpec(name="progress", type="std_msgs/msg/String", direction="out", priority=10),
        TopicSpec(name="cmd_vel", type="geometry_msgs/msg/Twist", direction="out", priority=10),
    ]
    table, port = graph.open(specs, "cmd_vel")
    assert {topic.name for topic in table} == {"scan", "goal", "progress", "cmd_vel"}
    sent: list[tuple[str, bytes]] = []

    class Bridge:
        def publish(self, topic, payload):
            sent.append((topic, bytes(payload)))
            return True

    port.attach(Bridge())
    for tick in range(13):
        list(base.read(tick * TICK))
    graph.publish("goal", String("kitchen"))
    assert [topic for topic, _ in sent] == ["scan", "scan", "goal"]
    assert len(decode(LaserScan, sent[0][1], "cdr").ranges) == 541
    heard: list[Any] = []
    graph.subscribe("progress", heard.append)
    port.deliver(MessageReceived("progress", encode(String("half"), "cdr"), 0, 0.0, 0.0, 0.0))
    assert decode(String, heard[0], "cdr").data == "half"
    # A service that takes anything gets all that the robot measures.
    anything, _ = graph.open([TopicSpec(name="*", type="*", direction="in")], "cmd_vel")
    assert {topic.name for topic in anything} == set(base.topics)
    # A session that came after it takes its place.
    graph.open(specs, "cmd_vel")
    graph.publish("goal", String("store"))
    assert len(sent) == 3
