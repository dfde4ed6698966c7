import math

import numpy as np
import pytest
from deep_size import deep_size

from skytether.guard.velocity import STANDSTILL, Velocity
from skytether.robot.safety.geometry.dead_reckoning import DeadReckoning, variation

THING = np.array([[2.0, 0.0]])


def told(*turns: tuple[float, float, float]) -> DeadReckoning:
    reckoning = DeadReckoning(10.0)
    for at, linear, angular in turns:
        reckoning.update(Velocity(linear, angular), at)
    return reckoning


def test_straight_on_things_come_nearer():
    assert told((0.0, 0.5, 0.0)).now_at(THING, 0.0, 1.0) == pytest.approx(np.array([[1.5, 0.0]]))


def test_a_turn_to_the_left_moves_things_to_the_right():
    reckoning = told((0.0, 0.0, math.pi / 2))
    assert reckoning.now_at(THING, 0.0, 1.0) == pytest.approx(np.array([[0.0, -2.0]]), abs=1e-9)


def test_only_the_motion_since_the_scan_counts():
    # 1 s to the left on a circle of radius 1, then straight; the scan came half a second before the end.
    reckoning = told((0.0, 1.0, 1.0), (1.0, 0.4, 0.0))
    assert reckoning.now_at(THING, 1.5, 2.0) == pytest.approx(np.array([[1.8, 0.0]]))
    # From the start: the robot is at (sin 1, 1 - cos 1), and 0.4 m on from there, turned by 1 rad.
    x, y = math.sin(1) + 0.4 * math.cos(1), 1 - math.cos(1) + 0.4 * math.sin(1)
    expected = [math.cos(1) * (2 - x) - math.sin(1) * y, -math.sin(1) * (2 - x) - math.cos(1) * y]
    assert reckoning.now_at(THING, 0.0, 2.0)[0] == pytest.approx(expected)


def test_whoever_stood_or_was_never_told_anything_leaves_things_where_they_are():
    assert told().now_at(THING, 0.0, 5.0) is THING
    assert told((3.0, 0.0, 0.0)).now_at(THING, 0.0, 5.0) is THING
    # Before the first turn the robot stood.
    assert told((3.0, 0.5, 0.0)).now_at(THING, 0.0, 4.0) == pytest.approx(np.array([[1.5, 0.0]]))


def test_faster_on_the_same_curve_is_no_variation_and_all_else_is():
    assert variation(Velocity(0.2, 0.1), Velocity(0.4, 0.2)) == pytest.approx((0.0, 0.0))
    assert variation(Velocity(0.4, 0.2), Velocity(0.2, 0.1)) == pytest.approx((0.2, 0.1))
    assert variation(Velocity(0.4, 0.0), Velocity(0.4, 0.3)) == pytest.approx((0.0, 0.3))
    assert variation(Velocity(0.4, 0.0), Velocity(-0.1, 0.0)) == pytest.approx((0.5, 0.0))
    assert variation(STANDSTILL, Velocity(0.1, 0.2)) == (0.0, 0.0)
    assert variation(Velocity(0.1, 0.2), STANDSTILL) == pytest.approx((0.1, 0.2))


def test_variations_add_up_over_the_time_that_is_asked_for():
    reckoning = told((0.0, 0.4, 0.0), (1.0, 0.3, 0.0), (2.0, 0.1, 0.2))
    assert reckoning.varied(0.5, Velocity(0.1, 0.2)) == pytest.approx((0.3, 0.2))
    assert reckoning.varied(1.5, Velocity(0.1, 0.0)) == pytest.approx((0.2, 0.4))
    assert reckoning.varied(2.5, Velocity(0.1, 0.2)) == pytest.approx((0.0, 0.0))
    assert told().varied(0.0, Velocity(0.1, 0.0)) == (0.0, 0.0)


def test_what_is_old_is_forgotten_and_a_clock_that_goes_back_begins_anew():
    reckoning = DeadReckoning(1.0)
    sizes = []
    for i in range(1000):
        reckoning.update(Velocity(0.1, 0.0), i * 0.1)
        sizes.append(deep_size(reckoning))
    assert max(sizes) < 2 * sizes[12]
    reckoning.update(Velocity(0.1, 0.0), 5.0)
    assert reckoning.now_at(THING, 4.0, 6.0) == pytest.approx(np.array([[1.9, 0.0]]))
