"""How the topics of a robot of real ROS 2 stand, as ``skytether robot status`` tells it: also those that come late."""

import pytest
from ros2_nodes import ros2_nodes, until

from skytether.robot.graphs.ros2.robot import Ros2Robot, Ros2RobotConfig
from skytether.ros.ros2.dialect import NodeName
from skytether.ros.ros2.native.node import RclpyNode

__all__ = ["ros2_nodes"]
pytestmark = [pytest.mark.slow, pytest.mark.ros2]


def test_topics_are_seen_as_they_come_with_quality_and_refusal(ros2_nodes):
    base = ros2_nodes.start(
        """
from geometry_msgs.msg import Twist
from std_msgs.msg import String
node.create_subscription(Twist, "/cmd_vel", lambda m: None, 10)
wrong = node.create_publisher(String, "/odom", 10)
def work():
    sys.stdin.readline()
    from sensor_msgs.msg import LaserScan
    global scans
    scans = node.create_publisher(LaserScan, "/scan", qos(reliable=False))
    say("scans")
threading.Thread(target=work, daemon=True).start()
""",
        "base",
    )
    readings = {"scan": "sensor_msgs/msg/LaserScan", "odom": "nav_msgs/msg/Odometry"}
    config = Ros2RobotConfig(robot="walker", service="guide", namespace="/", readings=readings, topics=["/image"])
    with RclpyNode(NodeName()) as node:
        robot = Ros2Robot(config, node)

        def seen(name):
            return next(topic for topic in robot.topics() if topic.name == name)

        until(lambda: seen("cmd_vel").there and seen("odom").refused, "the base")
        assert (seen("cmd_vel").way, seen("cmd_vel").nodes) == ("to", ("/base",))
        assert "has type std_msgs/msg/String, this end's is nav_msgs/msg/Odometry" in seen("odom").refused
        assert (seen("scan").there, seen("scan").nodes, seen("scan").quality) == (False, (), "")
        assert (seen("/image").there, seen("/image").type) == (False, "any")
        base.tell("go")
        assert base.next() == "scans"
        until(lambda: seen("scan").there, "the late topic")
        assert (seen("scan").nodes, seen("scan").quality) == (("/base",), "best effort")
        robot.close()
