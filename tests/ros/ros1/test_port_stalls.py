"""What waited in the kernel while our end stood still is not sent as if it were new."""

import time
from unittest.mock import Mock

import pytest

from skytether.messages import LaserScan, Twist
from skytether.ros.ros1 import port as port_module
from skytether.ros.ros1.port import Ros1Port
from skytether.wire.topic import Direction, Role, Topic


@pytest.mark.parametrize("kind", [Twist, LaserScan])
def test_a_velocity_that_waited_is_not_taken_and_that_is_told_once(monkeypatch, caplog, kind):
    now = 100.0
    monkeypatch.setattr(port_module, "boottime", lambda: now)
    node, peer, got = Mock(), Mock(), []
    peer.publish.side_effect = lambda topic, data: topic == "cmd_vel" and got.append(data)
    port = Ros1Port(node, Role.ROBOT, Mock(), [Topic("cmd_vel", kind.TYPE, Direction.IN, encoding="ros1")])
    port.attach(peer)
    on_message = node.subscribe.call_args.args[3].on_message
    on_message("before", None)
    now += 2.0
    for _ in range(3):
        on_message("waited", None)
    deadline = time.monotonic() + 10.0
    while "after" not in got and time.monotonic() < deadline:  # its thread sees that it runs
        now += 0.01
        on_message("after", None)
        time.sleep(0.01)
    port.close()
    if kind is LaserScan:
        assert got == ["before", *["waited"] * 3, "after"], "all else is taken"
    else:
        assert got == ["before", "after"]
        assert caplog.messages == ["cmd_vel: our end stood still; what came meanwhile is not taken"]
        assert peer.count_dropped.call_count >= 3
