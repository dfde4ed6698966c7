"""An agent that is stopped and continued while it drives, on a real ROS 1 graph and without a gate."""

import signal
import time

import pytest
from ros1_graph import wait_for

from skytether.messages import Twist, decode, type_hash
from skytether.robot.control.supervisor import VelocityLimits
from skytether.ros.ros1.subscription import Listener

pytestmark = [pytest.mark.ros1, pytest.mark.slow]

PERIOD = 0.01
LATE = 0.1
"""Between being sent and being looked at here, on a busy machine [s]."""


def test_an_agent_that_was_stopped_goes_on_from_standstill(graph, config, walker):
    told = []
    listener = Listener(lambda data, _: told.append((time.monotonic(), decode(Twist, data, "ros1").linear.x)))
    walker.node.subscribe("/cmd_vel", "geometry_msgs/Twist", type_hash(Twist, "ros1"), listener)
    process = graph.skytether("robot", "run", str(config))
    limits = VelocityLimits()
    for stopped in (2.0, 0.5, 2.0):
        wait_for(lambda: told and told[-1][1] > 0.15, "the service to drive")
        process.send_signal(signal.SIGSTOP)
        time.sleep(0.2)
        before = len(told)
        time.sleep(stopped - 0.2)
        assert len(told) == before
        continued = time.monotonic()
        process.send_signal(signal.SIGCONT)
        wait_for(lambda before=before: len(told) > before + 20 and told[-1][1] > 0.15, "the service to drive again")
        after = told[before:]
        if after[0][1]:
            # What it had worked out at the very moment when it was stopped is still told; only a gate looks at its age.
            assert abs(after[0][1] - told[before - 1][1]) <= limits.linear_acceleration * PERIOD * 1.5
            del after[0]
        assert after[0][1] == 0.0
        began = next(at for at, velocity in after if velocity)
        assert began > continued
        for at, velocity in after:
            assert velocity <= limits.linear_acceleration * (max(0.0, at - began) + PERIOD + LATE)
    graph.end(process)
    log = next(graph.folder.glob("python*.log")).read_text()
    assert "the control loop stood still for 2" in log
