"""The main job on real ROS 2: a walker that is nodes of rclpy is guided across a bad network by nodes of rclpy.

Nobody has changed the nodes at either end: the service is a graph of its own (``graph: ros2``), in its own network and
domain. Both ends' nodes keep diaries, so that what the bridge says it delivered is held against what they heard.
"""

import time
from collections import Counter

import psutil
import pytest
from ros2_nodes import ros2_nodes, steady, until
from ros2_scene import ROOT, scene_over_a_bad_link
from ros2_walker import Diary, Ros2Walker

from skytether.api.manifest import Manifest
from skytether.lab.trail import THESIS_TRAIL

__all__ = ["ros2_nodes"]
pytestmark = [pytest.mark.slow, pytest.mark.ros2, pytest.mark.usefixtures("netns")]

STANDS_S = 2.0
LOOK_S = 0.1  # an agent's status costs some of the little there is
WALK_S = 180.0
SENSORS = {"force": "geometry_msgs/msg/WrenchStamped", "wheels": "sensor_msgs/msg/JointState"}
SENSORS |= {"odom": "nav_msgs/msg/Odometry"}


def trail_service():
    """Its nodes are a program; each message is to be heard, so rows keep more than the newest."""
    common = {"direction": "in", "period_ms": 20, "lifespan_ms": 50, "delivery": 0.999, "depth": 100}
    topics = [{"name": name, "type": kind, **common} for name, kind in SENSORS.items()]
    velocity = {"period_ms": 20, "lifespan_ms": 100, "delivery": 0.9999, "priority": 127, "depth": 100}
    topics.append({"name": "cmd_vel", "type": "geometry_msgs/msg/Twist", "direction": "out", **velocity})
    numbers = {"type": "array", "items": {"type": "number"}}
    spec = {
        "graph": "ros2",
        "launch": str(ROOT / "tests" / "support" / "ros2_trail.py"),
        "topics": topics,
        "remap": {topic["name"]: f"/{topic['name']}" for topic in topics},
        "params": {"properties": {"lengths": numbers, "curvatures": numbers, "diary": {"type": "string"}}},
        "needs": {"cpu": 0.1, "memory_mb": 256},
    }
    document = {"apiVersion": "skytether.io/v1", "kind": "Service", "metadata": {"name": "trail"}, "spec": spec}
    return Manifest.model_validate(document)


def pieces(trail):
    """Lengths and curvatures."""
    lengths = [p.get("length") or p["radius"] * abs(p["angle"]) for p in trail]
    curvatures = [0.0 if "length" in p else (1 if p["angle"] > 0 else -1) / p["radius"] for p in trail]
    return {"lengths": lengths, "curvatures": curvatures}


@pytest.fixture
def scene(ros2_nodes, tmp_path):
    with scene_over_a_bad_link(tmp_path, ros2_nodes.domain) as made:
        made.ask(lambda client: client.put_service("trail", trail_service()))
        yield made


class Walk:
    """A walker, its agent, and the diary of the service's nodes."""

    def __init__(self, scene, nodes, name, trail, each=2):
        self.service = Diary(scene.diaries / f"{name}-trail")
        params = {**pieces(trail), "diary": str(self.service.path)}
        self.agent = scene.robot(name, "trail", params=params)
        self.walker = Ros2Walker(nodes, name, scene.link.robot, trail, scene.diaries, each)
        self.agent.start()

    def begin(self):
        """The service drives; the person stands."""
        self.walker.wait_until_joined()
        until(lambda: self.service.read("joined"), "the service's nodes")
        # The agent's first standstills, from before its node and the wheels have found each other.
        self.unheard = steady(lambda: self.agent.told - len(self.walker.told()))
        self.walker.begin()
        until(lambda: self.agent.drives, "the service to drive", WALK_S, LOOK_S)

    def finish(self):
        """To the end of the trail, and until all that was under way has come."""
        until(lambda: self.walker.look() and self.walker.judge.completed, "the end of the trail", WALK_S, LOOK_S)
        self.walker.park()
        steady(lambda: (self.agent.told, self.agent.counts))
        until(lambda: self.agent.settled, "both ends to agree on what became of every message", each_s=LOOK_S)

    def goes_on(self, way=0.4):
        """It is guided on for so far [m]."""
        goal = self.walker.judge.s + way
        until(lambda: self.walker.look() > goal and self.agent.drives, "the walk to go on", WALK_S, LOOK_S)

    def stood(self):
        """Wait until the wheels are told to stand; returns when that was [ns]."""
        # A busy machine may have stopped it a moment before the loss did, and it goes on a second after such a stop.
        until(lambda: not self.agent.drives and self._stands_for_s() > STANDS_S, "it to stand", each_s=LOOK_S)
        return self.walker.told()[-1][0]

    def _stands_for_s(self):
        told = self.walker.told()
        moved = max(at for at, x, z in told if (x, z) != (0.0, 0.0))
        return (time.time_ns() - moved) / 1e9 if told[-1][0] > moved else 0.0

    def assert_stood(self, since, until_ns):
        """All that the wheels were told between two times [ns] is to stand."""
        assert since < until_ns
        assert {(x, z) for at, x, z in self.walker.told() if since < at < until_ns} <= {(0.0, 0.0)}

    def assert_all_delivered_was_heard(self):
        """Whatever the bridge says it delivered, one by one; nothing that both ends were there for is missing."""
        counts = self.agent.counts
        for topic in SENSORS:
            published, heard = self.walker.diary.stamps(topic), self.service.stamps(topic)
            assert len(set(heard)) == len(heard), topic
            assert set(heard) <= set(published), topic
            assert len(heard) == counts[topic]["delivered"], topic
        said = [tuple(line) for line in self.service.read("cmd_vel")]
        # Velocities that waited for an end that had no core for a while are not taken: some 3 % at a load of 15.
        assert 0.9 * len(said) <= counts["cmd_vel"]["offered"] <= len(said)
        # The control loop had them all, and the wheels all that it wanted.
        status = self.agent.status
        assert status["commands"] + status["missed_commands"] == counts["cmd_vel"]["delivered"]
        assert self.agent.told - len(self.walker.told()) == self.unheard
        assert_follow(self.walker.told(), said)


def assert_follow(told, said):
    """What wheels were told is what was said, in its order; but for ramps, and where a newer one came within a tick."""
    at, heard = 0, set()
    for _, *velocity in told:
        if any(velocity) and tuple(velocity) in said:  # a standstill may be the supervisor's
            at = said.index(tuple(velocity), at)
            heard.add(at)
    assert len(heard) > 100


def test_a_walker_of_rclpy_is_guided_along_the_trail(scene, ros2_nodes):
    walk = Walk(scene, ros2_nodes, "walker", THESIS_TRAIL)
    walk.begin()
    walk.walker.walk()
    walk.finish()
    counts, result = walk.agent.counts, walk.walker.result()
    assert result.kte_m < 0.05, walk.agent.log
    assert result.deviation_max_m < 0.15
    assert sum(c.lost for c in scene.link.counters().values()) > 50
    assert set(counts) == {*SENSORS, "cmd_vel"}
    # The share that a row may lose is of all its messages: of so few, a row alone tells nothing.
    sensors = sum((counts[topic] for topic in SENSORS), Counter())
    for outcomes in (sensors, counts["cmd_vel"]):
        assert outcomes["lost"] - outcomes["late"] <= 0.001 * outcomes["sent"], counts
    assert not any(outcomes["unknown"] for outcomes in counts.values()), counts
    for topic in SENSORS:
        published = len(walk.walker.diary.stamps(topic))
        assert 0.98 * published <= walk.agent.taken[topic] <= published, topic
    walk.assert_all_delivered_was_heard()


def killed(*processes):
    for process in processes:
        process.kill()
    psutil.wait_procs(processes)


def program_of(agent):
    """The program that is the agent's node."""
    (found,) = [p for p in psutil.Process(agent.process.pid).children() if "side/__main__.py" in " ".join(p.cmdline())]
    return found


def test_each_part_of_one_robot_is_killed_beside_another_and_both_walks_are_finished(scene, ros2_nodes):
    """The agent, the service, the sensors' node, the agent's program; the wheels stand meanwhile, and go on there.

    The other robot of the domain, with a service of its own, does not notice.
    """
    # At the rate of one robot two of them, with their services, want all that two slow cores have.
    walk, other = (Walk(scene, ros2_nodes, name, [{"length": 3.5}], each=4) for name in ("anna", "ben"))
    agent, walker = walk.agent, walk.walker
    for each in (walk, other):
        each.begin()
    for each in (walk, other):
        each.walker.walk()

    walk.goes_on()
    agent.kill()
    stood = walk.stood()
    back = time.time_ns()
    agent.start()
    walk.goes_on()
    walk.assert_stood(stood, back)
    instance = agent.status["instance"]["id"]

    killed(*scene.processes_of(instance))
    stood = walk.stood()
    walk.goes_on()
    walk.assert_stood(stood, walk.service.read("began")[-1][0])
    assert scene.ask(lambda client: client.get_instance(instance)).restarts == 1

    walker.lose_sensors()
    stood = walk.stood()
    back = time.time_ns()
    walker.start_sensors()
    walk.goes_on()
    walk.assert_stood(stood, back)

    program = program_of(agent)
    killed(program)
    walk.goes_on()
    assert program_of(agent).pid != program.pid

    walk.finish()
    other.finish()
    other.assert_all_delivered_was_heard()
    assert max(other.walker.result().kte_m, walker.result().kte_m) < 0.05, agent.log
    for topic in SENSORS:
        published, heard = walker.diary.stamps(topic), walk.service.stamps(topic)
        assert len(set(heard)) == len(heard), topic
        assert set(heard) <= set(published), topic
    assert "another node of this ROS 2 graph" not in agent.log + other.agent.log
