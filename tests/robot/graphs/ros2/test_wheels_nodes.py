"""Who turns the wheels is named: others that listen come and go, and are no reason to stand. Real ROS 2."""

import signal
import time

import pytest
from ros2_nodes import ros2_nodes

from skytether.guard.velocity import Velocity
from skytether.robot.graphs.gate_io import WheelsTiming
from skytether.robot.graphs.ros2.kind import Ros2
from skytether.robot.graphs.ros2.sections import Ros2Way

__all__ = ["ros2_nodes"]
TIMING = WheelsTiming(guard_s=0.3, fresh_s=0.3, stuck_s=0.3, brakes_s=1.0)
PERIOD_S = 0.02
PATIENCE_S = 30.0
LISTENS = """
from geometry_msgs.msg import Twist
node.create_subscription(Twist, "/cmd_vel", lambda m: say(m.linear.x), 10)
"""
BLINKS = """
from geometry_msgs.msg import Twist
def work():
    for _ in range(8):
        listening = node.create_subscription(Twist, "/cmd_vel", lambda m: None, 10)
        time.sleep(0.3)
        node.destroy_subscription(listening)
        time.sleep(0.3)
    say("done")
threading.Thread(target=work, daemon=True).start()
"""


@pytest.mark.slow
@pytest.mark.ros2
def test_a_tool_that_listens_anew_again_and_again_is_not_taken_for_the_wheels(ros2_nodes, caplog):
    wheels = Ros2().open_wheels(
        Ros2Way.model_validate({"cmd_vel": "/cmd_vel", "wheels_nodes": ["base"], "need_acknowledgements": False}),
        "guard",
        TIMING,
        "",
        None,
    )
    seen: list[frozenset[str]] = []

    def drive_until(condition):
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline
            seen.append(wheels.listeners() or frozenset())
            if seen[-1]:
                wheels.write(Velocity(0.1, 0.0))
            time.sleep(PERIOD_S)

    try:
        recorder = ros2_nodes.start(LISTENS, name="recorder")
        drive_until(lambda: "only /recorder" in caplog.text)
        assert set(seen) == {frozenset()}, "whoever else listens, the wheels are not there"
        base = ros2_nodes.start(LISTENS, name="base")
        drive_until(lambda: base.all() and recorder.all())
        time.sleep(0.5)
        seen.clear()
        tool = ros2_nodes.start(BLINKS, name="tool")
        drive_until(lambda: "done" in tool.all())
        assert len(set(seen)) == 1, "it was the same who listened all the time"
        before = seen[-1]
        base.process.send_signal(signal.SIGINT)
        drive_until(lambda: not seen[-1])
        base = ros2_nodes.start(LISTENS, name="base")
        drive_until(lambda: base.all())
        assert not seen[-1] & before, "the wheels that are back are others"
    finally:
        wheels.close()


def test_where_the_graph_does_not_tell_names_they_cannot_be_given():
    with pytest.raises(ValueError, match="wheels_nodes: a graph of Zenoh does not always tell"):
        Ros2Way.model_validate({"dialect": "rmw_zenoh", "wheels_nodes": ["base"]})
    with pytest.raises(ValueError, match="wheels_nodes"):
        Ros2Way.model_validate({"wheels_nodes": ["no name"]})
