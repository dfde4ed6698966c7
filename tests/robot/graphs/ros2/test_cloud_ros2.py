"""What a service may do on a ROS 2 graph, in both dialects: a real router, a session whose table has everything."""

import pytest
from ros2_graph import own_stage, stage

from skytether.api.manifest import TopicSpec
from skytether.bridge import Bridge, GraphPort, LocalGraph, SessionSpec, topics_from_api
from skytether.bridge.calls import CallError
from skytether.messages import Joy, Twist
from skytether.robot.graphs.ros2.robot import Ros2Robot, Ros2RobotConfig
from skytether.ros import permissions
from skytether.ros.permissions import Allowed
from skytether.ros.ros2.dialect import RmwZenoh, Ros2Dds
from skytether.wire.topic import Role

__all__ = ["own_stage", "stage"]
pytestmark = pytest.mark.slow

TRIGGER, EMPTY = "std_srvs/srv/Trigger", b"\0\1\0\0\0"
KEPT = {"joy", "scan", "stop", "cmd_vel", "clock"}


def specs(*rows):
    return [TopicSpec(**{"type": Joy.TYPE, "direction": "out", **row}) for row in rows]


ROWS = specs(
    {"name": "/joy"},
    {"name": "/scan"},
    {"name": "/rt/scan"},
    {"name": "/cmd_vel", "type": Twist.TYPE},
    {"name": "/clock", "type": "rosgraph_msgs/msg/Clock"},
    {"name": "stolen"},
    {"name": "/free"},
    {"name": "own"},
    {"name": "/halt", "kind": "call", "type": TRIGGER},
    {"name": "/power", "kind": "call", "type": TRIGGER, "direction": "in"},
    {"name": "/dock", "kind": "ros2_action", "type": "my_msgs/action/Dock", "direction": "in"},
)
PROTECTED = dict.fromkeys(
    ("/joy", "/scan", "/stop", "/halt", "/power", *(f"/dock/_action/{part}" for part in ("send_goal", "cancel_goal"))),
    "safety's",
)


@pytest.fixture(params=["rmw_zenoh", "ros2dds"])
def robot(request, own_stage):
    own_stage.router.start()
    dialect = RmwZenoh(0) if request.param == "rmw_zenoh" else Ros2Dds()
    config = Ros2RobotConfig(
        "bot",
        "trail",
        namespace="/",
        remap={"stolen": "/stop"},
        allowed=Allowed(["/"], ["/"], ["/"]),
        protected=PROTECTED,
    )
    made = Ros2Robot(config, own_stage.ours(dialect))
    yield made, own_stage
    made.close()


def test_a_session_with_a_name_of_safety_s_is_refused_and_names_each(robot):
    robot, _ = robot
    with pytest.raises(ValueError, match="'/joy': /joy is never published") as error:
        robot.open(ROWS, "cmd_vel")
    for name in ("/scan", "/rt/scan", "/cmd_vel", "/clock", "/stop", "/halt", "/power", "/dock/_action/send_goal"):
        assert f": {name} is never" in str(error.value)
    assert "/free" not in str(error.value)


def test_at_delivery_the_names_are_looked_at_again(robot, monkeypatch):
    robot, stage = robot
    monkeypatch.setattr(permissions, "check", lambda *_: None)
    seen, halted, key = [], [], bytes(32)
    spy = stage.session()
    ear = spy.declare_subscriber("**", lambda sample: seen.append(str(sample.key_expr)))
    power = spy.declare_queryable("**/halt/**", lambda query: halted.append(str(query.key_expr)))
    theirs = topics_from_api(ROWS)
    service = Bridge(SessionSpec(7, key, Role.SERVICE, theirs), GraphPort(LocalGraph(), theirs, Role.SERVICE))
    topics, port = robot.open(ROWS, "cmd_vel")
    service.start()
    bridge = Bridge(SessionSpec(7, key, Role.ROBOT, topics), port, peer=service.address)
    bridge.start()
    try:
        sent = [row.name for row in theirs if row.direction.sender is Role.SERVICE and not row.name.endswith("_vel")]
        sent = [name for name in sent if "/re" not in name]  # halves of calls

        def publish():
            for name in (*sent, "/cmd_vel"):
                service.publish(name, EMPTY)
            return any("free" in key for key in seen) and any("trail/own" in key for key in seen)

        stage.until(publish, "what is nobody's does not come")
        with pytest.raises(CallError, match="/halt is never called for the cloud"):
            service.call("/halt", EMPTY, 5.0)
        live = [str(reply.ok.key_expr) for reply in spy.liveliness().get("**") if reply.ok is not None]
        offered = [token for token in live if "SS" in token]
        assert not [token for token in offered if "power" in token or "dock%_action%send_goal" in token]
        assert not [token for token in offered if "dock§_action§send_goal" in token]
        assert not [key for key in seen if set(key.split("/")) & KEPT]
        assert halted == []
    finally:
        bridge.stop()
        service.stop()
        ear.undeclare()
        power.undeclare()
