"""Robots of one generation with services of the other, real nodes on both sides: rospy here, rclpy there."""

import signal
import socket
import subprocess

import pytest
import yaml
from networks import Program
from ros1_graph import PACKAGE
from ros1_nodes import start_rospy
from ros2_nodes import first, ros2_nodes, until

from skytether.api.manifest import Manifest
from skytether.api.rest import RobotCreate
from skytether.messages import definition_of

__all__ = ["ros2_nodes"]
pytestmark = [pytest.mark.ros1, pytest.mark.ros2, pytest.mark.slow]

TOPICS = [
    {"name": "scan", "type": "sensor_msgs/msg/LaserScan", "direction": "in"},
    {"name": "map", "type": "nav_msgs/msg/OccupancyGrid", "direction": "in", "reliable": True, "latched": True},
    {"name": "told", "type": "geometry_msgs/msg/Twist", "direction": "in", "reliable": True, "depth": 100},
    {"name": "log", "type": "rosgraph_msgs/msg/Log", "direction": "in"},
    {"name": "cmd_vel", "type": "geometry_msgs/msg/Twist", "direction": "out", "priority": 127},
    {"name": "plan", "type": "nav_msgs/msg/Path", "direction": "out", "reliable": True, "latched": True},
    {"name": "mode", "kind": "call", "type": "std_srvs/srv/SetBool", "direction": "in"},
    {"name": "go", "kind": "action", "type": "move_base_msgs/action/MoveBase", "direction": "in"},
    {"name": "dock", "kind": "call", "type": "std_srvs/srv/Trigger", "direction": "out"},
]
STAMP = (1_700_000_000, 123_456_789)
"""Of what is sent; seconds and nanoseconds."""

DYNAMIC = f"""
from genpy.dynamic import generate_dynamic  # Debian has no Python for nav_msgs where ros-core alone is installed

def made(name, definition):
    return generate_dynamic(name, definition)[name]
OccupancyGrid = made("nav_msgs/OccupancyGrid", {definition_of("nav_msgs/msg/OccupancyGrid", "ros1")!r})
Path = made("nav_msgs/Path", {definition_of("nav_msgs/msg/Path", "ros1")!r})
"""

# What each side of the session does is the same in either generation; only the words differ.
ROBOT_1 = f"""
from geometry_msgs.msg import Twist
from rosgraph_msgs.msg import Log
from sensor_msgs.msg import LaserScan
from std_srvs.srv import SetBool, Trigger, TriggerResponse

stamp = rospy.Time(*{STAMP})
scans = rospy.Publisher("/bot/scan", LaserScan, queue_size=5)
maps = rospy.Publisher("/bot/map", OccupancyGrid, queue_size=1, latch=True)
told = rospy.Publisher("/bot/told", Twist, queue_size=100)
logs = rospy.Publisher("/bot/log", Log, queue_size=5)
grid = OccupancyGrid(data=[0, 100, -1, 50])
grid.header.stamp, grid.header.frame_id = stamp, "map"
grid.info.map_load_time, grid.info.resolution, grid.info.width, grid.info.height = stamp, 0.05, 2, 2
grid.info.origin.position.x = -1.5
maps.publish(grid)
def publish(_):
    scan = LaserScan(angle_min=-1.0, angle_increment=0.5, range_max=10.0, ranges=[1.0, float("inf"), 3.0])
    scan.header.stamp, scan.header.frame_id = stamp, "laser"
    scans.publish(scan)
    logs.publish(Log())
    twist = Twist()
    twist.linear.x, twist.angular.z = 0.5, -0.25
    told.publish(twist)
rospy.Timer(rospy.Duration(0.1), publish)
def drive(m):
    say(["cmd_vel", m.linear.x, m.angular.z])
rospy.Subscriber("/bot/cmd_vel", Twist, drive)
def plan(m):
    say(["plan", [[p.header.stamp.secs, p.header.stamp.nsecs, p.header.frame_id, p.pose.position.x] for p in m.poses]])
rospy.Subscriber("/bot/plan", Path, plan)
rospy.Service("/bot/dock", Trigger, lambda request: TriggerResponse(True, "docked"))
def work():
    for line in sys.stdin:
        rospy.wait_for_service("/bot/mode")
        answer = rospy.ServiceProxy("/bot/mode", SetBool)(line.strip() == "on")
        say(["mode", answer.success, answer.message])
threading.Thread(target=work, daemon=True).start()
"""
SERVICE_2 = f"""
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import OccupancyGrid, Path
from sensor_msgs.msg import LaserScan
from std_srvs.srv import SetBool, Trigger

def stamp(header):
    return [header.stamp.sec, header.stamp.nanosec, header.frame_id]
def see(m):
    say(["scan", *stamp(m.header), [str(r) for r in m.ranges]])
node.create_subscription(LaserScan, "scan", see, qos(reliable=False))
def look(m):
    loaded = m.info.map_load_time
    say(["map", *stamp(m.header), loaded.sec, loaded.nanosec, list(m.data), m.info.width, m.info.origin.position.x])
node.create_subscription(OccupancyGrid, "map", look, qos(latched=True, depth=1))
node.create_subscription(Twist, "told", lambda m: say(["told", m.linear.x, m.angular.z]), 100)
wheels = node.create_publisher(Twist, "cmd_vel", 10)
def drive():
    message = Twist()
    message.linear.x, message.angular.z = 0.2, 0.1
    wheels.publish(message)
node.create_timer(0.05, drive)
plans = node.create_publisher(Path, "plan", qos(latched=True, depth=1))
pose = PoseStamped()
pose.header.stamp.sec, pose.header.stamp.nanosec = {STAMP}
pose.header.frame_id, pose.pose.position.x = "map", 4.5
plans.publish(Path(poses=[pose, pose]))
def mode(request, response):
    response.success, response.message = request.data, "as you like"
    return response
node.create_service(SetBool, "mode", mode)
docking = node.create_client(Trigger, "dock")
def work():
    for line in sys.stdin:
        docking.wait_for_service()
        docking.call_async(Trigger.Request()).add_done_callback(lambda f: say(["dock", f.result().message]))
threading.Thread(target=work, daemon=True).start()
"""


ROBOT_2 = f"""
from geometry_msgs.msg import Twist
from nav_msgs.msg import OccupancyGrid, Path
from sensor_msgs.msg import LaserScan
from std_srvs.srv import SetBool, Trigger

def stamped(header, frame):
    (header.stamp.sec, header.stamp.nanosec), header.frame_id = {STAMP}, frame
scans = node.create_publisher(LaserScan, "scan", qos(reliable=False))
maps = node.create_publisher(OccupancyGrid, "map", qos(latched=True, depth=1))
told = node.create_publisher(Twist, "told", 100)
grid = OccupancyGrid(data=[0, 100, -1, 50])
stamped(grid.header, "map")
grid.info.map_load_time, grid.info.resolution = grid.header.stamp, 0.05
grid.info.width, grid.info.height, grid.info.origin.position.x = 2, 2, -1.5
maps.publish(grid)
def publish():
    scan = LaserScan(angle_min=-1.0, angle_increment=0.5, range_max=10.0, ranges=[1.0, float("inf"), 3.0])
    stamped(scan.header, "laser")
    scans.publish(scan)
    twist = Twist()
    twist.linear.x, twist.angular.z = 0.5, -0.25
    told.publish(twist)
node.create_timer(0.1, publish)
node.create_subscription(Twist, "cmd_vel", lambda m: say(["cmd_vel", m.linear.x, m.angular.z]), 10)
def plan(m):
    stamps = [p.header.stamp for p in m.poses]
    say(["plan", [[s.sec, s.nanosec, p.header.frame_id, p.pose.position.x] for s, p in zip(stamps, m.poses)]])
node.create_subscription(Path, "plan", plan, qos(latched=True, depth=1))
def dock(request, response):
    response.success, response.message = True, "docked"
    return response
node.create_service(Trigger, "dock", dock)
modes = node.create_client(SetBool, "mode")
def answered(future):
    say(["mode", future.result().success, future.result().message])
def work():
    for line in sys.stdin:
        modes.wait_for_service()
        modes.call_async(SetBool.Request(data=line.strip() == "on")).add_done_callback(answered)
threading.Thread(target=work, daemon=True).start()
"""
SERVICE_1 = f"""
from geometry_msgs.msg import PoseStamped, Twist
from sensor_msgs.msg import LaserScan
from std_srvs.srv import SetBool, SetBoolResponse, Trigger

def stamp(header):
    assert header.seq == 0, "ROS 2 has none"
    return [header.stamp.secs, header.stamp.nsecs, header.frame_id]
rospy.Subscriber("/bot/scan", LaserScan, lambda m: say(["scan", *stamp(m.header), [str(r) for r in m.ranges]]))
def look(m):
    loaded = m.info.map_load_time
    say(["map", *stamp(m.header), loaded.secs, loaded.nsecs, list(m.data), m.info.width, m.info.origin.position.x])
rospy.Subscriber("/bot/map", OccupancyGrid, look)
rospy.Subscriber("/bot/told", Twist, lambda m: say(["told", m.linear.x, m.angular.z]))
wheels = rospy.Publisher("/bot/cmd_vel", Twist, queue_size=5)
def drive(_):
    message = Twist()
    message.linear.x, message.angular.z = 0.2, 0.1
    wheels.publish(message)
rospy.Timer(rospy.Duration(0.05), drive)
plans = rospy.Publisher("/bot/plan", Path, queue_size=1, latch=True)
pose = PoseStamped()
pose.header.stamp, pose.header.frame_id, pose.header.seq = rospy.Time(*{STAMP}), "map", 7
pose.pose.position.x = 4.5
plans.publish(Path(poses=[pose, pose]))
rospy.Service("/bot/mode", SetBool, lambda request: SetBoolResponse(request.data, "as you like"))
def work():
    for line in sys.stdin:
        rospy.wait_for_service("/bot/dock")
        say(["dock", rospy.ServiceProxy("/bot/dock", Trigger)().message])
threading.Thread(target=work, daemon=True).start()
"""


@pytest.fixture
def bridge(tmp_path):
    """Starts ends of ``skytether bridge``, of one session over loopback."""
    key = tmp_path / "bridge.key"
    key.touch(0o600)
    key.write_text("MDEyMzQ1Njc4OTAxMjM0NTY3ODkwMTIzNDU2Nzg5MDE=")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    here = {"host": "127.0.0.1", "port": port}
    started = []

    def start(role, **graph):
        where = {"bind": here} if role == "service" else {"peer": here, "bind": {"host": "127.0.0.1"}}
        document = {"id": "00000000000000ff", "key_file": str(key), "topics": TOPICS, "role": role, **where, **graph}
        started.append(Program(None, "bridge", tmp_path, document))
        return started[-1]

    yield start
    for program in started:
        program.kill()


@pytest.fixture
def rospy(graph):
    """Starts nodes of ROS 1."""
    started = []

    def start(code, name):
        started.append(start_rospy(graph, DYNAMIC + code, name))
        return started[-1]

    yield start
    for node in started:
        node.close()


def everything_passes(robot, brain):
    """Topics both ways, latched ones, calls both ways; every value as it was sent, times to the nanosecond."""
    assert first(brain, "scan") == ["scan", *STAMP, "laser", ["1.0", "inf", "3.0"]]
    assert first(brain, "map") == ["map", *STAMP, "map", *STAMP, [0, 100, -1, 50], 2, -1.5]
    assert first(brain, "told") == ["told", 0.5, -0.25]
    assert first(robot, "cmd_vel") == ["cmd_vel", 0.2, 0.1]
    assert first(robot, "plan") == ["plan", [[*STAMP, "map", 4.5]] * 2]
    robot.tell("on")
    assert first(robot, "mode") == ["mode", True, "as you like"]
    brain.tell("dock")
    assert first(brain, "dock") == ["dock", "docked"]


def test_a_robot_of_ros_1_has_a_service_of_ros_2(graph, rospy, ros2_nodes, bridge):
    service = bridge("service", ros2={"namespace": "/bot", "domain": ros2_nodes.domain})
    bridge("robot", ros1={"namespace": "/bot", "master": graph.uri, "host": "127.0.0.1"})
    everything_passes(rospy(ROBOT_1, "robot"), ros2_nodes.start(SERVICE_2, "brain", "/bot"))
    assert service.log.count("cannot be turned") == 1
    assert service.log.count("go: an action of the other generation of ROS (kind: action) is left out") == 1
    assert "log: rosgraph_msgs/msg/Log cannot be turned from ROS 1 into ROS 2: the codec knows no type" in service.log


def test_a_robot_of_ros_2_has_a_service_of_ros_1(graph, rospy, ros2_nodes, bridge):
    bridge("robot", ros2={"namespace": "/bot", "domain": ros2_nodes.domain})
    bridge("service", ros1={"namespace": "/bot", "master": graph.uri, "host": "127.0.0.1"})
    everything_passes(ros2_nodes.start(ROBOT_2, "robot", "/bot"), rospy(SERVICE_1, "brain"))


BRAIN = """#!/usr/bin/python3
import rospy
from geometry_msgs.msg import Twist
from sensor_msgs.msg import LaserScan

def see(scan):
    assert scan.header.seq == 0 and scan.header.frame_id == "laser"
    message = Twist()
    message.linear.x = min(0.1 * min(scan.ranges), 0.2)
    wheels.publish(message)
rospy.init_node("brain")
wheels = rospy.Publisher("/brain/cmd_vel", Twist, queue_size=1)
rospy.Subscriber("/walker/scan", LaserScan, see)
rospy.spin()
"""
BASE = """
from geometry_msgs.msg import Twist
from sensor_msgs.msg import LaserScan

node.create_subscription(Twist, "cmd_vel", lambda m: say(m.linear.x), 10)
scans = node.create_publisher(LaserScan, "scan", qos(reliable=False))
room = [3.0]
def scan():
    made = LaserScan(ranges=room)
    made.header.stamp, made.header.frame_id = node.get_clock().now().to_msg(), "laser"
    scans.publish(made)
node.create_timer(0.05, scan)
def work():
    for line in sys.stdin:
        room[0] = float(line)
threading.Thread(target=work, daemon=True).start()
"""


def test_a_robot_of_ros_2_is_driven_by_a_node_of_rospy_that_the_orchestrator_starts(
    orchestrator, ros2_nodes, program, tmp_path
):
    """``graph: ros1`` in the manifest, and nothing about generations anywhere else."""
    package = tmp_path / "packages" / "share" / "brain"
    package.mkdir()
    (package / "package.xml").write_text(PACKAGE.format(name="brain", more=""))
    (package / "brain.py").write_text(BRAIN)
    (package / "brain.py").chmod(0o755)
    launch = package / "brain.launch"
    launch.write_text('<launch><node pkg="brain" type="brain.py" name="brain"/></launch>')
    topics = [
        {"name": "scan", "type": "sensor_msgs/msg/LaserScan", "direction": "in"},
        {"name": "cmd_vel", "type": "geometry_msgs/msg/Twist", "direction": "out", "priority": 127},
    ]
    manifest = {
        "apiVersion": "skytether.io/v1",
        "kind": "Service",
        "metadata": {"name": "brain"},
        "spec": {"graph": "ros1", "launch": str(launch), "topics": topics, "needs": {"cpu": 0.1}},
    }
    orchestrator.client.put_service("brain", Manifest.model_validate(manifest))
    token = tmp_path / "walker.token"
    token.touch(0o600)
    token.write_text(orchestrator.client.create_robot(RobotCreate(name="walker")).token)
    path = tmp_path / "robot.yaml"
    robot = {"robot": "walker", "orchestrator": orchestrator.url, "token_file": token.name, "service": "brain"}
    more = {"ros2": {}, "safety": "none", "status_port": None, "limits": {"max_gap_s": 1.0}}
    path.write_text(yaml.safe_dump(robot | more))
    base = ros2_nodes.start(BASE, "base", "/walker")
    with (tmp_path / "agent.log").open("wb") as log:
        agent = subprocess.Popen([str(program), "robot", "run", str(path)], stdout=log, stderr=log)
    try:
        until(lambda: 0.2 in base.all(), "the service to drive", 60)
        base.tell("0.5")
        until(lambda: any(abs(told - 0.05) < 1e-6 for told in base.all()), "it to see that there is little room")
    finally:
        agent.send_signal(signal.SIGINT)
        agent.wait(30)
    until(lambda: base.next() == 0.0, "the last standstill")
