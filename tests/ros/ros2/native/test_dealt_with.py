"""What is known of velocities that the node's program is done with, several at a time too."""

import pytest

from skytether.ros.ros2.dialect import Endpoint, Kind
from skytether.ros.ros2.native import handles
from skytether.ros.ros2.native.side.frames import DealtWith, dealt_with, pull_dealt_with

CHANNEL, FRESH_S = 1, 0.03


class Program:
    """Takes what is sent to it."""

    def set(self, channel, priority, depth):
        """As `Sender`."""

    def put(self, frame):
        """As `Sender`."""
        return 0


@pytest.fixture
def clock(monkeypatch):
    times = [0.0]
    monkeypatch.setattr(handles, "_now", lambda: times[0])
    return times


@pytest.fixture
def velocities(clock):
    ours = Endpoint(Kind.PUBLISHER, "/cmd_vel", "geometry_msgs/msg/Twist")
    made = handles.Publication(None, CHANNEL, ours, fresh_s=FRESH_S)
    made.join(Program())
    made.begin()
    return made


def done(number, newest, published, heard=0):
    return dealt_with(CHANNEL, DealtWith(number, newest, heard, published, 0.0, True, 1))


def test_what_it_says_comes_as_it_went():
    said = DealtWith(2**40, 7, 6, 5, 0.25, True, 3)
    assert pull_dealt_with(dealt_with(CHANNEL, said).body) == said


@pytest.mark.parametrize(
    ("newest", "published", "left_at", "lost"),
    [
        (3, 3, 2.02, False),
        (3, 1, 2.02, False),  # a newer one came before the turn of the others
        (2, 2, 2.01, True),
        (1, 1, 2.0, True),
        (0, 0, None, True),
    ],
)
def test_of_several_that_are_over_at_once_the_last_that_left_is_known(
    clock, velocities, newest, published, left_at, lost
):
    for clock[0] in (2.0, 2.01, 2.02):
        assert velocities.put(b"velocity")
    velocities.on_frame(done(3, newest, published))
    assert (velocities.lost, velocities.passed, velocities.dropped) == (lost, published, 3 - published)
    assert velocities.left_at == (-handles.inf if left_at is None else left_at)


def test_what_is_not_over_yet_is_neither_lost_nor_left(clock, velocities):
    for clock[0] in (2.0, 2.01):
        velocities.put(b"velocity")
    velocities.on_frame(done(1, 1, 1))
    assert (velocities.left_at, velocities.lost, velocities.heard_at) == (2.0, False, -handles.inf)
    velocities.on_frame(done(1, 1, 1, heard=1))
    velocities.on_frame(done(2, 1, 1, heard=1))
    assert (velocities.left_at, velocities.lost, velocities.heard_at) == (2.0, True, 2.0)


def test_what_all_have_acknowledged_is_known_as_soon_as_it_is_and_of_none_that_never_left(clock, velocities):
    for clock[0] in (2.0, 2.01, 2.02, 2.03):
        velocities.put(b"velocity")
    velocities.on_frame(done(3, 3, 2))
    assert velocities.heard_at == -handles.inf
    velocities.on_frame(done(3, 3, 2, heard=3))
    assert (velocities.heard_at, velocities.left_at) == (2.02, 2.02)
    velocities.on_frame(done(4, 3, 2, heard=3))
    assert (velocities.heard_at, velocities.lost) == (2.02, True)


def test_what_is_said_again_changes_nothing(clock, velocities):
    clock[0] = 2.0
    velocities.put(b"velocity")
    for _ in range(2):
        velocities.on_frame(done(1, 1, 1))
    assert (velocities.left_at, velocities.lost, velocities.passed, velocities.dropped) == (2.0, False, 1, 0)
