"""What counts as acknowledged of velocities that DDS lets go of, with a stand-in for rclpy that does just that."""

import contextlib
import importlib
import sys
from types import ModuleType
from unittest.mock import Mock

import pytest

from skytether.ros.ros2.native.side.frames import FOR_ALL, pull_dealt_with

LIFESPAN_S = 0.03
SIDE = "skytether.ros.ros2.native.side"


class Wheels:
    """A publisher of DDS, and somebody who listens; both by one clock."""

    topic_name = "/cmd_vel"

    def __init__(self):
        self.now, self.published_at, self.hear = 100.0, 0.0, True

    def publish(self, _):
        self.published_at = self.now

    def get_subscription_count(self):
        return 1

    def wait_for_all_acked(self, _):
        return self.hear or self.now - self.published_at >= LIFESPAN_S


@pytest.fixture
def fresh(monkeypatch):
    for name in ("rclpy", "rclpy.duration", "rclpy.qos"):
        stand_in = ModuleType(name)
        stand_in.__dict__["__getattr__"] = lambda _: Mock()
        monkeypatch.setitem(sys.modules, name, stand_in)
    for name in ("graph", "fresh"):
        monkeypatch.delitem(sys.modules, f"{SIDE}.{name}", raising=False)
    module = importlib.import_module(f"{SIDE}.fresh")
    monkeypatch.setattr(module.graph, "listeners", lambda *_: {1: "/base"})
    yield module
    for name in ("graph", "fresh"):
        sys.modules.pop(f"{SIDE}.{name}", None)


@pytest.mark.parametrize("gap_s", [0.02, 0.035, 0.04])
def test_who_hangs_has_acknowledged_nothing_though_dds_lets_go_of_it(fresh, gap_s):
    wheels, number = Wheels(), 0
    publisher = fresh.FreshPublisher(
        Mock(), wheels, LIFESPAN_S, lambda: 1, [], contextlib.nullcontext, lambda: wheels.now
    )

    def publish(times):
        nonlocal number
        for _ in range(times):
            number += 1
            publisher.publish(number, wheels.now + 1, FOR_ALL, b"velocity")
            wheels.now += 0.005
            publisher.hear()
            wheels.now += gap_s - 0.005
            publisher.hear()
        return pull_dealt_with(publisher.answer(1).body)

    assert publish(5).heard == 5
    wheels.hear = False
    done = publish(10)
    assert (done.heard, done.newest) == (5, 15)
    assert done.unread_s == pytest.approx(9 * gap_s)
    wheels.hear = True
    assert publish(2).heard == 17
