"""Velocities that were held back are told from those of a slow path."""

from __future__ import annotations

from math import inf

import pytest

from skytether.messages import LaserScan, Twist
from skytether.ros.velocities import HeldBack
from skytether.wire.events import MessageReceived
from skytether.wire.topic import Direction, Topic


def seen(row: Topic, *ways: tuple[float, float], error: float = 0.0) -> list[bool]:
    """Which are late, of messages that were sent and received at these times [s]."""
    judge = HeldBack(row)
    return [judge.is_late(MessageReceived(row.name, b"", 0, sent, error, received)) for sent, received in ways]


WHEELS = Topic("cmd_vel", Twist.TYPE, Direction.OUT, lifespan=0.1)


def test_what_waited_for_an_end_that_stood_still_is_late_and_the_newest_is_not() -> None:
    waited = [(1.0 + 0.1 * number, 4.0) for number in range(30)]  # to 3.9 s
    late = seen(WHEELS, (0.9, 0.91), *waited, (4.0, 4.01))
    assert late == [False, *[True] * 29, False, False]


@pytest.mark.parametrize("delay", [0.0, 0.3, 2.0])
def test_a_slow_path_holds_nothing_back(delay: float) -> None:
    """How long it takes is known by half, as clocks are compared over it."""
    assert not any(seen(WHEELS, *((0.1 * n, 0.1 * n + delay) for n in range(50)), error=delay))


def test_of_a_path_that_is_slow_one_way_only_the_first_second_is_held_back() -> None:
    late = seen(WHEELS, *((n / 8, n / 8 + 0.5) for n in range(24)), error=0.25)
    assert late == [True] * 8 + [False] * 16


def test_what_waited_before_the_first_is_late() -> None:
    """There is none before it, and those after it are less late."""
    assert all(seen(WHEELS, *((1.0 + 0.02 * n, 3.0) for n in range(50)), error=0.01))


def test_on_a_path_that_gets_slower_by_little_at_a_time_nothing_is_held_back() -> None:
    assert not any(seen(WHEELS, *((0.1 * n, 0.1 * n + 0.05 * n) for n in range(50))))


def test_another_path_that_is_slower_is_the_usual_one_after_a_second() -> None:
    before = [(n / 8, n / 8) for n in range(8)]
    late = seen(WHEELS, *before, *((n / 8, n / 8 + 0.25) for n in range(8, 24)))
    assert late == [False] * 8 + [True] * 8 + [False] * 8


def test_of_clocks_that_are_not_compared_well_less_is_known() -> None:
    ways = (0.0, 0.01), (0.1, 0.28)
    assert seen(WHEELS, *ways) == [False, True]
    assert seen(WHEELS, *ways, error=0.1) == [False, False]
    assert seen(WHEELS, *ways, error=inf) == [False, False]


def test_whatever_is_no_velocity_may_come_as_late_as_it_does() -> None:
    scan = Topic("scan", LaserScan.TYPE, Direction.IN, lifespan=0.1)
    assert not any(seen(scan, (0.0, 0.0), (0.1, 5.0)))
