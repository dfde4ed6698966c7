"""Whether whoever listens to the velocities acknowledges them, on real ROS 2."""

import time

import pytest

from skytether.guard.velocity import Velocity
from skytether.lab.safety.ros2_hardware import Ros2Hardware
from skytether.robot.graphs.gate_io import WheelsTiming
from skytether.robot.graphs.ros2.kind import Ros2
from skytether.robot.graphs.ros2.sections import Ros2Way

pytestmark = [pytest.mark.slow, pytest.mark.ros2]
TIMING = WheelsTiming(guard_s=0.3, fresh_s=0.3, stuck_s=0.3, brakes_s=1.0)
PERIOD_S = 0.02
PATIENCE_S = 30.0


def test_a_node_that_hangs_does_not_acknowledge_which_may_be_ignored(tmp_path, ros2, monkeypatch):
    monkeypatch.setenv("SKYTETHER_ROS2_PYTHON", ros2)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    listener = Ros2Hardware(tmp_path)
    section = listener.section["ros2"]
    strict, lenient = (
        Ros2().open_wheels(
            Ros2Way.model_validate({**section, "node": name, "need_acknowledgements": need}), "guard", TIMING, "", None
        )
        for name, need in (("strict", True), ("lenient", False))
    )

    def drive_until(condition):
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline
            for wheels in (strict, lenient):
                wheels.write(Velocity(0.1, 0.0))
            time.sleep(PERIOD_S)

    try:
        drive_until(lambda: strict.listeners() and lenient.listeners())
        drive_until(lambda: listener.record.last.velocity.linear > 0)
        assert strict.unread() == ""
        listener.freeze()
        try:
            drive_until(strict.unread)
            assert "is not acknowledged by /played_hardware" in strict.unread()
            assert lenient.unread() == ""
        finally:
            listener.thaw()
        drive_until(lambda: not strict.unread())
    finally:
        for wheels in (strict, lenient):
            wheels.close()
        listener.close()
