"""Two real graphs of ROS 2 in two networks with a bad link between them, and ``skytether bridge`` at either end."""

from typing import Any

import pytest
from networks import Program
from ros2_nodes import far_nodes, first, ros2_nodes, until

from skytether.emulator.link_model import LinkConditions
from skytether.lab.tun import ROBOT, SERVICE, TunEmulator

__all__ = ["far_nodes", "ros2_nodes"]
pytestmark = [pytest.mark.slow, pytest.mark.ros2, pytest.mark.usefixtures("netns")]

TOPICS = [
    {"name": "map", "type": "std_msgs/msg/String", "direction": "in", "reliable": True, "latched": True},
    {"name": "count", "type": "std_msgs/msg/String", "direction": "in", "reliable": True, "depth": 1000},
    {"name": "thing", "type": "test_msgs/msg/BasicTypes", "direction": "in", "reliable": True, "depth": 100},
    {"name": "plan", "type": "std_msgs/msg/String", "direction": "out", "reliable": True, "latched": True},
    {"name": "cmd_vel", "type": "geometry_msgs/msg/Twist", "direction": "out", "priority": 127},
    {"name": "compute", "kind": "ros2_action", "type": "test_msgs/action/Fibonacci", "direction": "in"},
    {"name": "dock", "kind": "call", "type": "std_srvs/srv/Trigger", "direction": "out"},
]
COMMON = {"id": "00000000000000ff", "topics": TOPICS}

WALKER = """
from geometry_msgs.msg import Twist
from rclpy.action import ActionClient
from std_msgs.msg import String
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci
from test_msgs.msg import BasicTypes

latched = node.create_publisher(String, "map", qos(latched=True, depth=1))
latched.publish(String(data="old"))
latched.publish(String(data="the map"))
count = node.create_publisher(String, "count", qos(depth=1000))
thing = node.create_publisher(BasicTypes, "thing", 10)
node.create_subscription(Twist, "cmd_vel", lambda m: say(["cmd_vel", m.linear.x]), 10)
node.create_subscription(String, "plan", lambda m: say(["plan", m.data]), qos(latched=True))
def dock(request, response):
    response.success, response.message = True, "docked"
    return response
node.create_service(Trigger, "dock", dock)
client = ActionClient(node, Fibonacci, "compute")
def goal(order, cancel=False):
    fed = []
    goal = Fibonacci.Goal(order=order)
    def ended(future):
        result = future.result()
        say(["result", result.status, list(result.result.sequence), len(fed) > 0])
    def accepted(future):
        handle = future.result()
        say(["accepted", handle.accepted])
        if cancel:
            handle.cancel_goal_async()
        handle.get_result_async().add_done_callback(ended)
    client.send_goal_async(goal, feedback_callback=fed.append).add_done_callback(accepted)
def work():
    client.wait_for_server()
    say(["server"])
    for line in sys.stdin:
        eval(line)
threading.Thread(target=work, daemon=True).start()
"""
CLOUD = """
from geometry_msgs.msg import Twist
from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from std_msgs.msg import String
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci
from test_msgs.msg import BasicTypes

node.create_subscription(String, "map", lambda m: say(["map", m.data]), qos(latched=True))
node.create_subscription(String, "count", lambda m: say(["count", int(m.data)]), qos(depth=1000))
node.create_subscription(BasicTypes, "thing", lambda m: say(["thing", m.uint64_value]), 10)
plan = node.create_publisher(String, "plan", qos(latched=True, depth=1))
plan.publish(String(data="the plan"))
wheels = node.create_publisher(Twist, "cmd_vel", 10)
def drive():
    message = Twist()
    message.linear.x = 0.25
    wheels.publish(message)
node.create_timer(0.05, drive)
docking = node.create_client(Trigger, "dock")
def execute(handle):
    sequence = [0, 1]
    while len(sequence) < handle.request.order:
        if handle.is_cancel_requested:
            handle.canceled()
            return Fibonacci.Result(sequence=sequence)
        sequence.append(sequence[-1] + sequence[-2])
        handle.publish_feedback(Fibonacci.Feedback(sequence=sequence))
        time.sleep(0.1)
    handle.succeed()
    return Fibonacci.Result(sequence=sequence)
server = ActionServer(
    node, Fibonacci, "compute", execute, callback_group=ReentrantCallbackGroup(),
    cancel_callback=lambda _: CancelResponse.ACCEPT,
)
def work():
    for line in sys.stdin:
        docking.call_async(Trigger.Request()).add_done_callback(lambda f: say(["dock", f.result().message]))
threading.Thread(target=work, daemon=True).start()
def spin(node):
    executor = rclpy.executors.MultiThreadedExecutor(4)
    executor.add_node(node)
    executor.spin()
rclpy.spin = spin
"""


@pytest.fixture
def link():
    bad = LinkConditions(delay=0.05, loss=0.01)
    with TunEmulator(up=bad, down=bad) as link:
        yield link


@pytest.fixture
def bridge(link, ros2_nodes, far_nodes, tmp_path):
    """Starts ``skytether bridge`` at either end."""
    key = tmp_path / "bridge.key"
    key.touch(0o600)
    key.write_text("MDEyMzQ1Njc4OTAxMjM0NTY3ODkwMTIzNDU2Nzg5MDE=")
    there = {"host": SERVICE, "port": 4600}
    ends: dict[str, dict[str, Any]] = {
        "service": {"bind": there, "ros2": {"domain": far_nodes.domain, "namespace": "/cloud"}},
        "robot": {
            "peer": there,
            "bind": {"host": ROBOT},
            "ros2": {"domain": ros2_nodes.domain, "namespace": "/bot"},
        },
    }
    started = []

    def start(role):
        where = link.service if role == "service" else link.robot
        document = COMMON | {"key_file": str(key), "role": role} | ends[role]
        started.append(Program(where, "bridge", tmp_path, document))
        return started[-1]

    yield start
    for program in started:
        program.kill()


def test_topics_calls_and_actions_cross_a_bad_link(ros2_nodes, far_nodes, bridge, link):
    bridge("service")
    bridge("robot")
    cloud = far_nodes.start(CLOUD, "cloud", "/cloud", where=link.service)
    walker = ros2_nodes.start(WALKER, "walker", "/bot", where=link.robot)
    assert first(cloud, "map") == ["map", "the map"]
    assert first(walker, "plan") == ["plan", "the plan"]
    assert first(walker, "cmd_vel") == ["cmd_vel", 0.25]
    first(walker, "server")
    walker.tell("[count.publish(String(data=str(i))) for i in range(500)]")
    assert [first(cloud, "count")[1] for _ in range(500)] == list(range(500))
    walker.tell("thing.publish(BasicTypes(uint64_value=2**63))")
    assert first(cloud, "thing") == ["thing", 2**63]
    cloud.tell("dock")
    assert first(cloud, "dock") == ["dock", "docked"]
    walker.tell("goal(6)")
    assert first(walker, "accepted") == ["accepted", True]
    assert first(walker, "result") == ["result", 4, [0, 1, 1, 2, 3, 5], True]  # STATUS_SUCCEEDED
    walker.tell("goal(500, cancel=True)")
    assert first(walker, "accepted") == ["accepted", True]
    assert first(walker, "result")[1] == 5  # STATUS_CANCELED
    late = far_nodes.start(
        "from std_msgs.msg import String\n"
        'node.create_subscription(String, "/cloud/map", lambda m: say(m.data), qos(latched=True))\n',
        "late",
        where=link.service,
    )
    assert late.next() == "the map"


def test_each_end_and_each_node_is_killed_and_comes_back(ros2_nodes, far_nodes, bridge, link):
    """Latched topics come anew, everything goes on, and nothing that both ends were there for is lost."""
    nodes = {}

    def start(which):
        if which == "cloud":
            nodes[which] = far_nodes.start(CLOUD, "cloud", "/cloud", where=link.service)
        elif which == "walker":
            nodes[which] = ros2_nodes.start(WALKER, "walker", "/bot", where=link.robot)
        else:
            nodes[which] = bridge(which)

    def all_passes():
        cloud, walker = nodes["cloud"], nodes["walker"]
        for node in (cloud, walker):  # what was said before
            node.all()
            node.heard.clear()
        assert first(walker, "cmd_vel") == ["cmd_vel", 0.25]
        # The last end that joins may not know the others yet; what is told it from then on comes whole.
        until(lambda: (walker.tell("thing.publish(BasicTypes(uint64_value=7))"), said(cloud, "thing"))[1], "a thing")
        walker.tell("[count.publish(String(data=str(i))) for i in range(100)]")
        assert [first(cloud, "count")[1] for _ in range(100)] == list(range(100))
        cloud.tell("dock")
        assert first(cloud, "dock") == ["dock", "docked"]

    for which in ("service", "robot", "cloud", "walker"):
        start(which)
    assert first(nodes["cloud"], "map") == ["map", "the map"]
    assert first(nodes["walker"], "plan") == ["plan", "the plan"]
    all_passes()
    for which, anew in (("service", "map"), ("robot", "plan"), ("cloud", "map"), ("walker", "plan")):
        end = nodes[which]
        end.kill() if which in ("service", "robot") else end.close()
        start(which)
        assert first(nodes["cloud" if anew == "map" else "walker"], anew) == [anew, f"the {anew}"], which
        all_passes()


def said(node, what):
    """Whether it has said something of this; all of that is taken."""
    node.heard.extend(node.all())
    found = [one for one in node.heard if one[0] == what]
    node.heard[:] = [one for one in node.heard if one[0] != what]
    return found
