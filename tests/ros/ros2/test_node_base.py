"""What nodes on a ROS 2 graph share: endpoints, workers, their end."""

import threading

import pytest

from skytether.ros.ros2.dialect import Endpoint, Kind
from skytether.ros.ros2.node_base import MAX_WORKING, WORKERS, NodeBase


class Still(NodeBase):
    """Joins nothing; its thread waits for the end."""

    def _jobs(self):
        return (self._closing.wait,)

    def _interrupt(self):
        pass

    def know(self, **endpoints):
        self._known = endpoints


@pytest.fixture
def node():
    with Still(None, lambda _: None) as node:
        yield node


def test_endpoints_are_found_by_name_and_kind(node):
    scan = Endpoint(Kind.PUBLISHER, "/scan", "sensor_msgs/msg/LaserScan")
    wheels = Endpoint(Kind.SUBSCRIPTION, "/cmd_vel", "geometry_msgs/msg/Twist")
    node.know(a=scan, b=wheels, c=scan)
    assert node.endpoints() == [scan, wheels, scan]
    assert node.endpoints("/scan", Kind.PUBLISHER) == [scan, scan]
    assert node.endpoints("/scan", Kind.SUBSCRIPTION) == []
    assert node.lives("/scan", Kind.PUBLISHER) == {"a", "c"}


def test_work_beyond_the_bound_is_refused_and_taken_again_later(node):
    go, began, done = threading.Event(), threading.Semaphore(0), threading.Semaphore(0)

    def job():
        began.release()
        assert go.wait(10.0)
        done.release()

    assert all(node.work(job) for _ in range(MAX_WORKING))
    for _ in range(WORKERS):
        assert began.acquire(timeout=10.0)
    assert not began.acquire(blocking=False)
    assert not node.work(job)
    go.set()
    for _ in range(MAX_WORKING):
        assert done.acquire(timeout=10.0)
    while not node.work(job):  # the last one's place is free a moment after it is done
        pass
    assert done.acquire(timeout=10.0)


def test_after_the_end_nothing_is_worked_on():
    node = Still(None, lambda _: None)
    with node:
        pass
    assert not node.work(lambda: None)
