"""The main job on real ROS 2: a walker that is nodes of rclpy is guided by ``virtual-trail`` across a bad network."""

import psutil
import pytest
import yaml
from ros2_nodes import ros2_nodes, until
from ros2_scene import ROOT, scene_over_a_bad_link
from ros2_walker import Ros2Walker

from skytether.api.manifest import Manifest
from skytether.lab.trail import THESIS_TRAIL

__all__ = ["ros2_nodes"]
pytestmark = [pytest.mark.slow, pytest.mark.ros2, pytest.mark.usefixtures("netns")]

SERVICE = "virtual-trail"
WALK_S = 180.0


@pytest.fixture
def scene(ros2_nodes, tmp_path):
    with scene_over_a_bad_link(tmp_path, ros2_nodes.domain) as made:
        yield made


@pytest.fixture
def make_walker(scene, ros2_nodes):
    """A walker and its agent, driven by the service; the person walks."""

    def make(trail):
        agent = scene.robot("walker", SERVICE, params={"trail": list(trail)})
        walker = Ros2Walker(ros2_nodes, "/walker", scene.link.robot, trail)
        agent.start()
        until(lambda: agent.status["link"]["connected"], "a session")
        walker.wait_until_joined()
        walker.begin()
        until(lambda: agent.drives, "the service to drive")
        walker.walk()
        return agent, walker

    return make


def test_a_walker_of_rclpy_is_guided_along_the_trail(scene, make_walker):
    agent, walker = make_walker(THESIS_TRAIL)
    until(lambda: walker.look() and walker.judge.completed, "the end of the trail", WALK_S)
    published = walker.park()
    until(lambda: agent.settled, "both ends to agree on what became of every message")
    until(lambda: agent.taken == published, "every message of the walker's nodes to be accounted for")
    result, counts = walker.result(), agent.counts
    assert result.kte_m < 0.05, agent.log
    assert result.deviation_max_m < 0.15
    assert sum(c.lost for c in scene.link.counters().values()) > 50
    assert set(counts) == {"force", "wheels", "odom", "cmd_vel"}
    for topic, outcomes in counts.items():
        assert outcomes["lost"] - outcomes["late"] <= 0.001 * outcomes["sent"], topic
        assert outcomes["unknown"] == 0, topic
    for topic, messages in published.items():
        # What is newest by the time that it is its turn goes on: on a busy machine not each.
        assert 0.9 * messages < counts[topic]["sent"] <= messages, topic
    assert walker.heard > 3000


def killed(process):
    process.kill()
    psutil.wait_procs([process])


def program_of(agent):
    """The program that is the agent's node."""
    (found,) = [p for p in psutil.Process(agent.process.pid).children() if "side/__main__.py" in " ".join(p.cmdline())]
    return found


def test_each_part_is_killed_in_mid_trail_and_the_walk_is_finished(scene, make_walker):
    """The sensors' node, the service, the agent, its program; the wheels stand meanwhile, and go on where they were."""
    agent, walker = make_walker([{"length": 3.5}])

    def goes_on(way):
        goal = walker.judge.s + way
        until(lambda: walker.look() > goal and agent.drives, "the walk to go on", WALK_S)

    goes_on(0.4)
    walker.lose_forearms()
    until(lambda: not agent.drives, "the loss of the sensors to be seen")
    walker.start_forearms()
    goes_on(0.4)
    instance = agent.status["instance"]["id"]
    (service,) = scene.processes_of(instance)
    killed(service)
    until(lambda: not agent.drives, "the loss of the service to be seen")
    goes_on(0.4)
    assert scene.ask(lambda client: client.get_instance(instance)).restarts == 1
    agent.kill()
    agent.start()
    goes_on(0.4)
    program = program_of(agent)
    killed(program)
    goes_on(0.4)
    assert program_of(agent).pid != program.pid
    until(lambda: walker.look() and walker.judge.completed, "the end of the trail", WALK_S)
    walker.park()
    until(lambda: agent.settled, "both ends to agree on what became of every message")
    assert walker.result().kte_m < 0.05, agent.log


BASE = """
from geometry_msgs.msg import Twist
from sensor_msgs.msg import LaserScan

node.create_subscription(Twist, "cmd_vel", lambda m: say(m.linear.x), 10)
scans = node.create_publisher(LaserScan, "scan", qos(reliable=False, depth=5))
def scan():
    made = LaserScan(angle_min=-1.0, angle_increment=0.01, range_max=10.0, ranges=[3.0] * 200)
    made.header.stamp = node.get_clock().now().to_msg()
    scans.publish(made)
node.create_timer(0.05, scan)
"""


def test_two_robots_in_one_domain_have_nothing_to_do_with_each_other(scene, ros2_nodes):
    manifest = yaml.safe_load((ROOT / "docs" / "examples" / "wall_stop" / "service.yaml").read_text())
    manifest["spec"]["needs"] = {"cpu": 0.1}  # how well a busy machine keeps time is not what is asked here
    scene.ask(lambda client: client.put_service("wall-stop", Manifest.model_validate(manifest)))
    speeds = {"anna": 0.2, "ben": 0.1}
    bases = {name: ros2_nodes.start(BASE, "base", f"/{name}", scene.link.robot) for name in speeds}
    agents = {name: scene.robot(name, "wall-stop", params={"speed": speed}) for name, speed in speeds.items()}
    told = {name: [] for name in speeds}

    def drives(name):
        told[name] += new if (new := bases[name].all()) else []
        return bool(new) and abs(new[-1] - speeds[name]) < 1e-9

    for agent in agents.values():
        agent.start()
    for name in speeds:
        until(lambda name=name: drives(name), f"{name} to be driven")
    of_ben = agents["ben"].status["instance"]["id"]
    agents["anna"].kill()
    until(lambda: bases["anna"].next() == 0.0, "the standstill of the robot whose agent was killed")
    agents["anna"].start()
    until(lambda: drives("anna"), "it to be driven again")
    bases["anna"].close()
    until(lambda: not agents["anna"].drives, "the loss of its base to be seen")
    until(lambda: drives("ben"), "the other one to be driven all the same")
    assert agents["ben"].status["instance"]["id"] == of_ben
    assert agents["ben"].log.rindex("no session") < agents["ben"].log.index("session up"), (
        "it has one session, all along"
    )
    assert max(told["anna"]) <= 0.2 + 1e-9
    assert max(told["ben"]) <= 0.1 + 1e-9
    said = agents["anna"].log + agents["ben"].log
    assert "another node of this ROS 2 graph" not in said
    assert "publishes /" not in said
