from skytether.api.manifest import TopicSpec
from skytether.robot.session.topic_table import Offer, robot_table
from skytether.wire.topic import Direction, Topic

FORCE = TopicSpec(
    name="force", type="geometry_msgs/msg/WrenchStamped", direction="in", priority=120, period_ms=10, lifespan_ms=50
)
CMD_VEL = TopicSpec(name="cmd_vel", type="geometry_msgs/msg/Twist", direction="out", priority=127, delivery=0.999)
ANYTHING = TopicSpec(name="*", type="*", direction="in", priority=5, depth=1000, lifespan_ms=5000)


def test_the_table_holds_what_both_have():
    offers = {"force": Offer(FORCE.type, "h"), "camera": Offer("sensor_msgs/msg/CompressedImage")}
    assert robot_table([FORCE, CMD_VEL], offers) == (
        Topic("cmd_vel", CMD_VEL.type, Direction.OUT, priority=127, delivery=0.999),
        Topic("force", FORCE.type, Direction.IN, "h", priority=120, period=0.01, lifespan=0.05),
    )


def test_anything_takes_what_has_no_row_of_its_own():
    offers = {"/scan": Offer("sensor_msgs/msg/LaserScan", "90c7", "ros1"), "force": Offer("x/msg/Y", "", "ros1")}
    assert robot_table([ANYTHING, FORCE], offers) == (
        Topic("/scan", "sensor_msgs/msg/LaserScan", Direction.IN, "90c7", "ros1", priority=5, lifespan=5.0, depth=1000),
        Topic("force", "x/msg/Y", Direction.IN, "", "ros1", priority=120, period=0.01, lifespan=0.05),
    )


def test_an_offer_under_the_name_of_the_services_own_topic_is_left_out():
    assert [topic.direction for topic in robot_table([CMD_VEL, ANYTHING], {"cmd_vel": Offer(CMD_VEL.type)})] == [
        Direction.OUT
    ]
